"""Command line: which environments there are, and what one of them is.

python -m meta_envs list
python -m meta_envs show point_robot_wind --task 3 --out picture.png
"""

from __future__ import annotations

import io
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from numpy.typing import NDArray
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from meta_envs.env import MetaVectorEnv
from meta_envs.registry import ENVIRONMENTS, Row, definition, resolve, task_set
from meta_envs.scores import RANDOM_EPISODES, normalized_score, reference_returns

PLAIN_WIDTH = 120
"""Columns of the tables where the output is not a terminal."""


@dataclass(frozen=True)
class List:
    """Print a table of all environments."""


@dataclass(frozen=True)
class Show:
    """Print an environment's tasks, its split and its reference returns."""

    env: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="ENV")]
    """Environment: its short name, its id or the field's hyphenated name."""
    task: Annotated[int | None, tyro.conf.arg(metavar="TASK")] = None
    """A task to show in detail."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Picture (.png) to write: the exact optimum's episode on --task, or on task 0."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code: 2 for a user's mistake, 130 for Ctrl-C."""
    command = tyro.cli(List | Show, prog="python -m meta_envs", args=argv)
    console = Console()
    if not console.is_terminal:
        console = Console(width=PLAIN_WIDTH)
    try:
        if isinstance(command, List):
            console.print(_table_of_environments())
        else:
            _show(command, console)
    except _MistakeError as mistake:
        Console(stderr=True).print(str(mistake), soft_wrap=True, markup=False, highlight=False)
        return 2
    except KeyboardInterrupt:
        Console(stderr=True).print("Interrupted; nothing is left half written.")
        return 130
    return 0


class _MistakeError(Exception):
    """What a user got wrong, in one sentence."""


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


def _show(command: Show, console: Console) -> None:
    try:
        row = resolve(command.env)
        task = task_set(row.name).check_task(command.task or 0)
    except ValueError as error:
        raise _MistakeError(str(error)) from None
    if command.out is not None:
        _check_picture(command.out)
    console.print(_facts(row))
    console.print(_parameters(row, command.task))
    console.print(_references(row, command.task))
    if command.out is not None:
        _write_picture(command.out, _optimal_episode(row.name, task))
        written = f"Wrote {command.out}: the optimum's episode on task {task}."
        console.print(written, soft_wrap=True, markup=False, highlight=False)


def _facts(row: Row) -> Table:
    made, tasks = definition(row.name), task_set(row.name)
    facts = Table(title=f"{row.id} ({row.name})", show_header=False, title_justify="left")
    facts.add_row("what varies", row.varies)
    facts.add_row("observation", f"{_shape(made.observation_space.shape)} numbers")
    facts.add_row("action", f"{_shape(made.action_space.shape)} numbers in [-1, 1]")
    facts.add_row("steps an episode", str(row.horizon))
    facts.add_row(
        "tasks", f"{len(tasks)}: {len(tasks.train_tasks)} train, {len(tasks.test_tasks)} test"
    )
    facts.add_row("test tasks", ", ".join(map(str, tasks.test_tasks)))
    facts.add_row("hash", tasks.hash)
    return facts


def _parameters(row: Row, task: int | None) -> Table:
    tasks = task_set(row.name)
    table = Table("parameter", title="Task parameters", title_justify="left")
    for heading in ("lowest", "mean", "highest"):
        table.add_column(heading, justify="right")
    if task is not None:
        kind = "test" if task in tasks.test_tasks else "train"
        table.add_column(f"task {task} ({kind})", justify="right")
    for name, values in zip(tasks.param_names, tasks.params.T, strict=True):
        cells = [values.min(), values.mean(), values.max()]
        cells += [] if task is None else [values[task]]
        table.add_row(name, *(f"{cell + 0.0:z.4f}" for cell in cells))
    return table


def _references(row: Row, task: int | None) -> Table:
    tasks = task_set(row.name)
    returns = reference_returns(tasks)
    groups = {"train tasks": tasks.train_tasks, "test tasks": tasks.test_tasks}
    if task is not None:
        groups[f"task {task}"] = np.array([task])
    table = Table(
        "controller",
        title="Mean returns and normalised scores",
        caption=f"random: {RANDOM_EPISODES} episodes a task; score: 0 random, 100 oracle",
        title_justify="left",
        caption_justify="left",
    )
    for heading in groups:
        table.add_column(heading, justify="right")
        table.add_column("score", justify="right")
    for name, found in returns.items():
        cells = []
        for rows in groups.values():
            low, high = returns["random"][rows].mean(), returns["oracle"][rows].mean()
            mean = found[rows].mean()
            cells += [f"{mean:.2f}", f"{normalized_score(mean, low, high):.1f}"]
        table.add_row(name, *cells)
    return table


def _optimal_episode(name: str, task: int) -> NDArray[np.uint8]:
    env = MetaVectorEnv(name, tasks=[task], autoreset_mode="Disabled", render_mode="rgb_array")
    oracle = env.definition.controllers["oracle"]
    env.reset(seed=0)
    over = False
    while not over:
        _, _, terminated, truncated, _ = env.step(oracle(env.state, env.params))
        over = bool(terminated[0] or truncated[0])
    pictures = env.render()
    assert pictures is not None
    return pictures[0]


def _check_picture(path: Path) -> None:
    if path.suffix.lower() != ".png":
        raise _MistakeError(f"--out {path}: the picture is a PNG, so its name must end in .png")
    if not path.parent.is_dir():
        raise _MistakeError(f"--out {path}: there is no folder {path.parent}; make it first")
    if path.is_dir():
        raise _MistakeError(f"--out {path}: this is a folder; name a file in it")


def _write_picture(path: Path, picture: NDArray[np.uint8]) -> None:
    """Write it under a temporary name and rename it, so that it is whole or absent."""
    from PIL import Image

    encoded = io.BytesIO()
    Image.fromarray(picture).save(encoded, "PNG", optimize=True)
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        with partial.open("wb") as file:
            file.write(encoded.getvalue())
            file.flush()
            os.fsync(file.fileno())
        partial.replace(path)
    except OSError as error:
        raise _MistakeError(f"--out {path}: cannot be written: {error.strerror}") from None
    finally:
        partial.unlink(missing_ok=True)


if __name__ == "__main__":
    sys.exit(main())
