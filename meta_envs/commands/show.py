"""`list` and `show`: which environments there are, and what one of them is."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from numpy.typing import NDArray
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from meta_envs.commands import episode, files
from meta_envs.commands.mistake import mistakes
from meta_envs.registry import ENVIRONMENTS, Row, definition, resolve, task_set
from meta_envs.scores import normalized_score, reference_returns
from meta_envs.tasks import DEFAULT_SPLIT, Split


@dataclass(frozen=True)
class List:
    """Print a table of all environments."""

    def run(self, console: Console) -> int:
        """Print it."""
        console.print(_table_of_environments())
        return 0


@dataclass(frozen=True)
class Show:
    """Print an environment's tasks, its splits and its reference returns."""

    env: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="ENV")]
    """Environment: its short name, its id or the field's hyphenated name."""
    task: Annotated[int | None, tyro.conf.arg(metavar="TASK")] = None
    """A task to show in detail."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Picture (.png) to write: the end of the exact optimum's episode, or of a random one."""

    def run(self, console: Console) -> int:
        """Print it, and write the picture if one is wanted."""
        with mistakes():
            row = resolve(self.env)
            task = task_set(row.name).check_task(self.task or 0)
        if self.out is not None:
            files.check_out(self.out, (".png",))
        console.print(_facts(row))
        console.print(_parameters(row, self.task))
        with mistakes(), console.status("Running episodes of the reference controllers ..."):
            references = _references(row, self.task)
        console.print(references)
        if self.out is not None:
            with mistakes():
                (picture,) = episode.pictures(row, task)
            files.write_file(self.out, files.encode_png(picture))
            written = f"Wrote {self.out}: {episode.who_acts(row, 0)} on task {task}."
            console.print(written, soft_wrap=True, markup=False, highlight=False)
        return 0


def _table_of_environments() -> Table:
    table = Table(
        title="Environments of meta_envs",
        title_justify="left",
        caption="obs, act: dimensions; steps: of an episode; train, test: number of tasks",
        caption_justify="left",
        box=SIMPLE_HEAD,
        collapse_padding=True,
        leading=1,
    )
    table.add_column("name and id", no_wrap=True)
    for heading in ("obs", "act", "steps", "train", "test"):
        table.add_column(heading, justify="right")
    table.add_column("what varies")
    for row in ENVIRONMENTS.values():
        made, tasks = definition(row.name), task_set(row.name)
        table.add_row(
            f"{row.name}\n{row.id}",
            _shape(made.observation_space.shape),
            _shape(made.action_space.shape),
            str(row.horizon),
            str(len(tasks.train_tasks)),
            str(len(tasks.test_tasks)),
            row.varies,
        )
    return table


def _shape(shape: tuple[int, ...]) -> str:
    return " x ".join(map(str, shape))


def _facts(row: Row) -> Table:
    made, tasks = definition(row.name), task_set(row.name)
    facts = Table(title=f"{row.id} ({row.name})", show_header=False, title_justify="left")
    facts.add_row("what varies", row.varies)
    facts.add_row("observation", f"{_shape(made.observation_space.shape)} numbers")
    facts.add_row("action", f"{_shape(made.action_space.shape)} numbers in [-1, 1]")
    facts.add_row("steps an episode", str(row.horizon))
    facts.add_row("tasks", f"{len(tasks)}: {_sizes(tasks.splits[DEFAULT_SPLIT])}")
    facts.add_row("test tasks", _rows(tasks.test_tasks))
    for name, split in tasks.splits.items():
        if name != DEFAULT_SPLIT:
            facts.add_row(f"split '{name}'", _sizes(split))
            facts.add_row("its test tasks", _rows(split.test_tasks))
    facts.add_row("hash", tasks.hash)
    return facts


def _sizes(split: Split) -> str:
    return f"{len(split.train_tasks)} train, {len(split.test_tasks)} test"


def _rows(tasks: NDArray[np.int64]) -> str:
    return ", ".join(map(str, tasks))


def _kind(row: Row, task: int) -> str:
    """Whether a task is for training, for the test, for both or for neither."""
    tasks = task_set(row.name)
    groups = {"train": tasks.train_tasks, "test": tasks.test_tasks}
    return " and ".join(name for name, rows in groups.items() if task in rows) or "unused"


def _parameters(row: Row, task: int | None) -> Table:
    tasks = task_set(row.name)
    table = Table("parameter", title="Task parameters", title_justify="left")
    for heading in ("lowest", "mean", "highest"):
        table.add_column(heading, justify="right")
    if task is not None:
        table.add_column(f"task {task} ({_kind(row, task)})", justify="right")
    for name, values in zip(tasks.param_names, tasks.params.T, strict=True):
        cells = [values.min(), values.mean(), values.max()]
        cells += [] if task is None else [values[task]]
        table.add_row(name, *(f"{cell + 0.0:z.4f}" for cell in cells))
    return table


def _references(row: Row, task: int | None) -> Table:
    tasks, episodes = task_set(row.name), definition(row.name).random_episodes
    returns = reference_returns(tasks)
    groups = {"train tasks": tasks.train_tasks, "test tasks": tasks.test_tasks}
    if task is not None:
        groups[f"task {task}"] = np.array([task])
    scored = "oracle" in returns
    table = Table(
        "controller",
        title="Mean returns and normalised scores" if scored else "Mean returns",
        caption=f"random: {episodes} episodes a task; "
        + ("score: 0 random, 100 oracle" if scored else "no score: the optimum is not known"),
        title_justify="left",
        caption_justify="left",
    )
    for heading in groups:
        table.add_column(heading, justify="right")
        if scored:
            table.add_column("score", justify="right")
    for name, found in returns.items():
        cells = []
        for rows in groups.values():
            mean = found[rows].mean()
            cells.append(f"{mean:.2f}")
            if scored:
                low, high = returns["random"][rows].mean(), returns["oracle"][rows].mean()
                cells.append(f"{normalized_score(mean, low, high):.1f}")
        table.add_row(name, *cells)
    return table
