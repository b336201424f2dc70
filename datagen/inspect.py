"""Command line: what is in a dataset, in numbers and in a picture.

python -m datagen.inspect datasets/point_robot_wind --plot picture.png
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from datagen.card import mean_returns, named_checkpoints
from datagen.dataset import QUALITIES, Dataset, Episodes, Quality, open_dataset
from datagen.slices import chosen_checkpoints
from meta_envs import normalized_score

PLAIN_WIDTH = 140
"""Columns of the table where the output is not a terminal."""
PICTURES = (".png", ".pdf")
"""Kinds of picture `--plot` writes."""
MOST_PARAMS = 3
"""Parameters of a task the table shows; some environments have dozens."""


@dataclass(frozen=True)
class InspectConfig:
    """Show what is in a dataset: its tasks, their sizes and returns; `--plot` draws them."""

    path: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="PATH")]
    """Folder of the dataset."""
    plot: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Picture to write (.png or .pdf): returns by checkpoint, and episodes."""


def score(returns: Mapping[str, float], name: str) -> float:
    """Normalised score of one of the returns of `mean_returns`: 0 is random, 100 the expert."""
    return float(normalized_score(returns[name], returns["random"], returns["expert"]))


def returns_table(dataset: Dataset) -> Table:
    """A row for each task of a dataset, then the means over its train and its test tasks."""
    records = dataset.index["tasks"]
    marks = named_checkpoints(records[0])
    columns = ["random", *marks, "best", "expert"]
    table = Table(
        title=f"{dataset.index['env_id']}: {len(records)} tasks, budget "
        f"{dataset.index['budget']}, seed {dataset.index['seed']}",
        caption="Returns are means over stochastic episodes. best: of the task's best checkpoint; "
        "score: of best, with random 0 and expert 100.",
        title_justify="left",
        caption_justify="left",
        box=SIMPLE_HEAD,
    )
    table.add_column("task", justify="right")
    table.add_column("split")
    table.add_column(", ".join(dataset.index["param_names"][:MOST_PARAMS]))
    for heading in ("transitions", "episodes", *(_heading(name, marks) for name in columns)):
        table.add_column(heading, justify="right")
    table.add_column("score", justify="right")
    for record in records:
        cells = (str(record["task"]), record["split"], params_text(record["params"]))
        table.add_row(*cells, *_numbers([record], columns))
    table.add_section()
    for split in ("train", "test"):
        group = [record for record in records if record["split"] == split]
        if group:
            cells = ("all", split, f"{len(group)} tasks")
            table.add_row(*cells, *_numbers(group, columns), style="bold")
    return table


def slices_table(dataset: Dataset) -> Table:
    """A row for each quality: what `select` and `--quality` give of a dataset.

    Raises:
        DatasetError: a file is missing or damaged.
    """
    episodes = {int(task): dataset.episodes(int(task)) for task in dataset.tasks}
    table = Table(
        title="Slices, by quality of the behaviour policy",
        caption="docs/dataset_format.md defines them. Returns are means over checkpoints, then "
        "tasks; score: of that return, with random 0 and expert 100.",
        title_justify="left",
        caption_justify="left",
        box=SIMPLE_HEAD,
    )
    table.add_column("slice")
    headings = ("tasks", "rows", "episodes", "checkpoints\nof a task", "episodes of\na checkpoint")
    for heading in (*headings, "return", "score"):
        table.add_column(heading, justify="right")
    for quality in QUALITIES:
        table.add_row(quality, *_slice_cells(dataset, episodes, quality))
    return table


def _slice_cells(dataset: Dataset, episodes: Mapping[int, Episodes], quality: Quality) -> list[str]:
    """What a slice holds of all tasks, as text."""
    rows, counts, returns = 0, [], []
    records = dataset.index["tasks"]
    for record in records:
        one, all_returns = episodes[record["task"]], record["returns"]
        chosen = chosen_checkpoints(all_returns, quality)
        inside = np.isin(one.checkpoints, chosen)
        if not inside.any():
            continue
        rows += int(one.lengths[inside].sum())
        counts.append(np.unique(one.checkpoints[inside], return_counts=True)[1])
        by_checkpoint = {int(mark): value for mark, value in all_returns["behavior"].items()}
        mean = float(np.mean([by_checkpoint[mark] for mark in chosen]))
        returns.append((all_returns["random"], mean, all_returns["expert"]))
    if not counts:
        return [f"0 of {len(records)}", "0", "0", *["-"] * 4]
    random, mean, expert = np.mean(returns, axis=0)
    return [
        f"{len(counts)} of {len(records)}",
        f"{rows:,}",
        f"{sum(int(part.sum()) for part in counts):,}",
        _span([len(part) for part in counts]),
        _span(np.concatenate(counts).tolist()),
        f"{mean:.2f}",
        f"{normalized_score(mean, random, expert):.1f}",
    ]


def _span(values: Sequence[int]) -> str:
    """Least and largest of some numbers, or the one they all are."""
    low, high = min(values), max(values)
    return str(low) if low == high else f"{low}-{high}"


def params_text(params: Sequence[float]) -> str:
    """The first few parameters of a task, for people."""
    shown = ", ".join(f"{value:.3f}" for value in params[:MOST_PARAMS])
    return shown + (", ..." if len(params) > MOST_PARAMS else "")


def _heading(name: str, marks: Mapping[str, str]) -> str:
    return f"{name}\n{int(marks[name]):,}" if name in marks else name


def _numbers(records: Sequence[Mapping[str, Any]], columns: Sequence[str]) -> list[str]:
    means = mean_returns(records)
    sizes = [sum(record[key] for record in records) for key in ("transitions", "episodes")]
    return [
        *(f"{size:,}" for size in sizes),
        *(f"{means[name]:.2f}" for name in columns),
        f"{score(means, 'best'):.1f}",
    ]


def check_picture(path: Path) -> None:
    """Raise a ValueError unless a picture can be written there."""
    if path.suffix.lower() not in PICTURES:
        raise ValueError(f"--plot {path} must end in {' or '.join(PICTURES)}")
    if not path.parent.is_dir():
        raise ValueError(f"--plot {path}: there is no folder {path.parent}, make it first")


def inspect(config: InspectConfig, console: Console) -> None:
    """Print the table and write the picture.

    Raises:
        ValueError: there is no such dataset, it is damaged, or the picture has no place to go.
        OSError: the picture could not be written.
    """
    if config.plot is not None:
        check_picture(config.plot)
    dataset = open_dataset(config.path, verify=False)
    tables = returns_table(dataset), slices_table(dataset)
    for table in tables:
        console.print(table)
    size = sum(record["bytes"] for record in dataset.index["tasks"])
    _say(console, f"{config.path}: {size / 1e6:.1f} MB, SHA-256 {dataset.hash[:16]}")
    _say(console, f"whether it is intact: python -m datagen.check {config.path}")
    if config.plot is not None:
        from datagen.pictures import draw

        draw(dataset, config.plot)
        _say(console, f"Wrote {config.plot}.")


def _say(console: Console, text: str) -> None:
    console.print(text, soft_wrap=True, markup=False, highlight=False)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command.

    Returns:
        Exit code: 0, 2 for a mistake or a bad dataset, 130 for Ctrl-C.
    """
    config = tyro.cli(InspectConfig, prog="python -m datagen.inspect", args=arguments)
    console = Console()
    if not console.is_terminal:
        console = Console(width=PLAIN_WIDTH)
    try:
        inspect(config, console)
    except (ValueError, OSError) as error:
        Console(stderr=True).print(str(error), style="red", soft_wrap=True, markup=False)
        return 2
    except KeyboardInterrupt:
        _say(Console(stderr=True), "interrupted")
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
