"""Command line: datasets to and from other formats.

python -m datagen.exchange to-minari datasets/point_robot_wind --tasks 0-4
python -m datagen.exchange to-d4rl datasets/point_robot_wind --out exports
python -m datagen.exchange from-legacy data/hopper-rand-params --env hopper_params --out imported
"""

from __future__ import annotations

import shlex
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console
from rich.progress import Progress

from datagen.dataset import Dataset, open_dataset
from datagen.plan import parse_tasks
from meta_envs import resolve, task_set

_DatasetPath = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DATASET")]
_Tasks = Annotated[str | None, tyro.conf.arg(metavar="0-9,12")]


@dataclass(frozen=True)
class ToMinari:
    """Export to Minari, a dataset a task, which `minari.load_dataset` opens.

    They go to Minari's own folder, $MINARI_DATASETS_PATH or ~/.minari/datasets. Needs the package
    minari: pip install 'ctmrl[minari]'.
    """

    dataset: _DatasetPath
    """Folder of the dataset."""
    tasks: _Tasks = None
    """Tasks to export; all of the dataset by default."""
    namespace: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """Where in Minari they go; ctmrl/ENVIRONMENT by default."""

    def run(self, console: Console) -> None:
        """Export, and say what a reader has to type."""
        from datagen.to_minari import to_minari

        dataset, tasks = _opened(self.dataset, self.tasks)
        with _Bar(console, "task") as bar:
            bar.begin(len(tasks))
            names = to_minari(dataset, tasks, self.namespace, bar.done)
        last = f" to {names[-1]}" if len(names) > 1 else ""
        _say(console, f"{names[0]}{last}: {len(names)} of Minari's datasets")
        _say(console, f"open one: minari.load_dataset('{names[0]}')")


@dataclass(frozen=True)
class ToD4RL:
    """Export to one HDF5 file in D4RL's style, all tasks in it, with a column `task`.

    For a file a task no export is needed: those of the dataset are in D4RL's layout as they are.
    """

    dataset: _DatasetPath
    """Folder of the dataset."""
    out: Annotated[Path, tyro.conf.arg(metavar="FOLDER")]
    """Folder the file goes to; it is called after the environment."""
    tasks: _Tasks = None
    """Tasks to export; all of the dataset by default."""

    def run(self, console: Console) -> None:
        """Export, and say where to."""
        from datagen.to_d4rl import to_d4rl

        dataset, tasks = _opened(self.dataset, self.tasks)
        with _Bar(console, "task") as bar:
            bar.begin(len(tasks))
            path = to_d4rl(dataset, tasks, self.out, bar.done)
        _say(console, f"Wrote {path}: {len(tasks)} tasks, {path.stat().st_size / 1e6:.1f} MB.")


@dataclass(frozen=True)
class FromLegacy:
    """Import one of the field's older folders, goal_idx*/trj_*sample*_step*.npy.

    Their files are pickles, which run code when they are read in the usual way. Here they are
    interpreted and nothing in them is run.
    """

    folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FOLDER")]
    """The folder with goal_idx0, goal_idx1 and so on in it."""
    env: str
    """Environment it belongs to: its short name, its id or the field's hyphenated name."""
    out: Annotated[Path, tyro.conf.arg(metavar="DATASET")]
    """Folder of the dataset to make."""
    tasks: _Tasks = None
    """Tasks to import; all of the folder by default."""

    def run(self, console: Console) -> None:
        """Import, and say what could not be known."""
        from datagen.from_legacy import Import, from_legacy

        env = resolve(self.env).name
        wanted = Import(self.folder, env, self.out, self.tasks)
        with _Bar(console, "task") as bar:
            index = from_legacy(wanted, bar.begin, bar.done)
        records, config = index["tasks"], index["config"]
        rows = sum(record["transitions"] for record in records)
        _say(console, f"{self.out}: {len(records)} tasks, {rows:,} transitions.")
        if not config["tasks_verified"]:
            _say(console, f"That these are the tasks of {env} is taken on trust, by their numbers.")
        if config["observation_zeros_dropped"]:
            dropped = config["observation_zeros_dropped"]
            _say(console, f"The last {dropped} numbers of each observation, all 0, were left out.")
        if not config["deterministic_known"]:
            _say(console, "Deterministic returns are unknown; they repeat the stochastic ones.")
        _say(console, f"check it: python -m datagen.check {shlex.quote(str(self.out))}")


class _Bar:
    """A progress bar over tasks that leaves nothing behind, and nothing at all in a file."""

    def __init__(self, console: Console, what: str) -> None:
        self._progress = Progress(console=console, transient=True, disable=not console.is_terminal)
        self._bar = self._progress.add_task(what, total=None)

    def __enter__(self) -> _Bar:
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    def begin(self, total: int) -> None:
        """There are so many tasks."""
        self._progress.update(self._bar, total=total)

    def done(self, task: int) -> None:
        """One more is done."""
        self._progress.advance(self._bar)


def _opened(path: Path, tasks: str | None) -> tuple[Dataset, tuple[int, ...]]:
    """A dataset and the tasks asked for, which it has."""
    dataset = open_dataset(path, verify=False)
    if tasks is None:
        return dataset, tuple(dataset.tasks.tolist())
    rows = parse_tasks(tasks, task_set(dataset.env))
    for task in rows:
        dataset.entry(task)
    return dataset, rows


def _say(console: Console, text: str) -> None:
    console.print(text, soft_wrap=True, markup=False, highlight=False)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command.

    Returns:
        Exit code: 0 done, 2 for a mistake, a bad file or a missing package, 130 for Ctrl-C.
    """
    command = tyro.cli(
        Annotated[ToMinari, tyro.conf.subcommand("to-minari")]
        | Annotated[ToD4RL, tyro.conf.subcommand("to-d4rl")]
        | Annotated[FromLegacy, tyro.conf.subcommand("from-legacy")],
        prog="python -m datagen.exchange",
        args=arguments,
    )
    errors = Console(stderr=True)
    try:
        command.run(Console())
    except (ValueError, OSError) as error:
        errors.print(str(error), style="red", soft_wrap=True, markup=False, highlight=False)
        return 2
    except KeyboardInterrupt:
        _say(errors, "interrupted; nothing is left half written")
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
