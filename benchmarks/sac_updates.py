r"""Updates of a task's SAC a second: a fleet, Stable-Baselines3 and SBX, whole learning loops.

    python benchmarks/sac_updates.py --sbx ~/sbx/bin/python --out benchmarks/results/sac_updates.csv

Each side is so many processes of one thread, with environment steps, replay memory and updates;
sides take turns, and a ratio is taken within one turn. SBX is measured where `--sbx` names the
Python of an environment of its own (`pip install sbx-rl` and this project).
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from env_steps import write_results
from rich.console import Console
from rich.table import Table

from datagen.workers import THREAD_VARIABLES

SIDE = Path(__file__).with_name("sac_side.py")
CASES = (
    ("half_cheetah_vel", 256, 256, 20),
    ("half_cheetah_vel", 128, 256, 20),
    ("point_robot_wind", 64, 128, 25),
)
"""Environment, width of the two hidden layers, batch, tasks of each fleet's process."""


@dataclass(frozen=True)
class Benchmark:
    """Measure updates a second of behaviour policies' SAC."""

    processes: int = 2
    """Of each side, one thread each."""
    repetitions: int = 9
    """Turns; the table has their medians."""
    seconds: float = 3.0
    """Least time a side learns in a turn."""
    sbx: Path | None = None
    """Python that has sbx-rl."""
    out: Path | None = None
    """CSV file to write; without it nothing is written."""


@dataclass(frozen=True)
class Result:
    """A row of the table and of the CSV file; medians of the turns."""

    env: str
    hidden: int
    batch: int
    engine: str
    processes: int
    tasks: int
    """In each process."""
    updates: int
    """Of a task, a second, all processes together."""
    ratio: float
    """To Stable-Baselines3 in the same turn."""


class Group:
    """The processes of one side."""

    def __init__(self, python: str, arguments: list[str], processes: int, tasks: int) -> None:
        """Start them and wait until all learn.

        Raises:
            RuntimeError: one of them ended.
        """
        threads = dict.fromkeys(THREAD_VARIABLES, "1")
        threads["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
        # A file each: two that end at once would write into each other's words.
        self.errors = [tempfile.TemporaryFile() for _ in range(processes)]  # noqa: SIM115
        self.members = [
            subprocess.Popen(
                [python, str(SIDE), *arguments, "--first-task", str(tasks * number)],
                env={**os.environ, **threads},
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=self.errors[number],
                text=True,
            )
            for number in range(processes)
        ]
        try:
            self._answers()
        except BaseException:
            self.close()
            raise

    def _answers(self) -> float:
        total = 0.0
        for number, member in enumerate(self.members):
            assert member.stdout is not None
            line = member.stdout.readline()
            if not line:
                raise RuntimeError(f"{SIDE.name} ended: {self._last_words(number)}")
            total += float(line)
        return total

    def _last_words(self, number: int) -> str:
        """The last line of what a process said went wrong."""
        self.errors[number].seek(0)
        lines = self.errors[number].read().decode(errors="replace").strip().splitlines()
        return lines[-1] if lines else "it did not say why"

    def learn(self, seconds: float) -> float:
        """Updates a second of all processes together, for so long.

        Raises:
            RuntimeError: one of them ended.
        """
        for member in self.members:
            assert member.stdin is not None
            # One that has ended does not answer.
            with suppress(BrokenPipeError):
                member.stdin.write(f"{seconds}\n")
                member.stdin.flush()
        return self._answers()

    def close(self) -> None:
        """End them."""
        for member in self.members:
            member.kill()
            with suppress(BrokenPipeError):
                member.communicate()
        for errors in self.errors:
            errors.close()


def measure(case: tuple[str, int, int, int], options: Benchmark) -> list[Result]:
    """One case, all sides."""
    env, hidden, batch, size = case
    sides = {"sb3": (sys.executable, 1)}
    if options.sbx is not None:
        sides["sbx"] = (str(options.sbx), 1)
    sides["fleet-float32"] = sides["fleet-bfloat16"] = (sys.executable, size)
    common = ["--env", env, "--hidden", str(hidden), "--batch", str(batch)]
    with ExitStack() as stack:
        groups = {}
        for name, (python, tasks) in sides.items():
            words = ["--engine", name, *common, "--tasks", str(tasks)]
            groups[name] = Group(python, words, options.processes, tasks)
            stack.callback(groups[name].close)
        turns = [
            {name: group.learn(options.seconds) for name, group in groups.items()}
            for _ in range(options.repetitions)
        ]
    return [
        Result(
            env,
            hidden,
            batch,
            name,
            options.processes,
            tasks,
            round(float(np.median([turn[name] for turn in turns]))),
            round(float(np.median([turn[name] / turn["sb3"] for turn in turns])), 2),
        )
        for name, (_, tasks) in sides.items()
    ]


def _check(options: Benchmark) -> None:
    if min(options.processes, options.repetitions) < 1 or options.seconds <= 0:
        raise ValueError("--processes, --repetitions and --seconds must be above 0")
    if options.sbx is not None and shutil.which(options.sbx) is None:
        raise ValueError(f"--sbx {options.sbx}: there is no such program")
    if options.out is not None and not options.out.parent.is_dir():
        raise ValueError(f"--out {options.out}: there is no folder {options.out.parent}")


def main() -> int:
    """Run the benchmark; exit code 1 where a side ended, 2 for a mistake, 130 for Ctrl-C."""
    options = tyro.cli(Benchmark, prog="python benchmarks/sac_updates.py")
    console, errors = Console(), Console(stderr=True)
    try:
        _check(options)
        results = [one for case in CASES for one in measure(case, options)]
    except (ValueError, RuntimeError) as error:
        errors.print(str(error), soft_wrap=True, markup=False, highlight=False)
        return 2 if isinstance(error, ValueError) else 1
    except KeyboardInterrupt:
        errors.print("Interrupted; nothing was written.")
        return 130
    table = Table("environment", "layers", "batch", "engine", "tasks", "updates/s", "/ sb3")
    for one in results:
        cells = (one.batch, one.engine, one.tasks, one.updates, one.ratio)
        table.add_row(one.env, f"2 x {one.hidden}", *map(str, cells))
    console.print(table)
    if options.out is not None:
        write_results(options.out, results, {})
        console.print(f"Wrote {options.out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
