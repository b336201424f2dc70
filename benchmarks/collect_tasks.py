r"""Seconds of data collection: a learning step, a checkpoint's episodes, a task.

    python benchmarks/collect_tasks.py --repetitions 5 --out benchmarks/results/collect_tasks.csv

One process with one thread, as a worker of `python -m datagen.collect --engine sb3` is. A task is
reckoned from its parts; `--whole` collects one as well, which the reckoning can be compared with.
"""

from __future__ import annotations

import csv
import io
import os
import platform
import sys
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
import tyro
from rich.console import Console
from rich.progress import track
from rich.table import Table

from datagen.budgets import BUDGETS, budget
from datagen.collect_task import collect_task
from datagen.estimate import seconds_a_learning_step, seconds_a_rollout
from datagen.files import write_whole
from datagen.job import Job
from meta_envs import resolve


@dataclass(frozen=True)
class Benchmark:
    """Measure the parts of a task's collection."""

    envs: tuple[str, ...] = tuple(BUDGETS)
    """Environments to measure."""
    budget: str = "paper"
    """Budget to measure."""
    repetitions: int = 5
    """Turns; the table has their medians."""
    whole: bool = False
    """Also collect one task of each environment from start to end."""
    out: Path | None = None
    """CSV file to write; without it nothing is written."""


@dataclass(frozen=True)
class Result:
    """One environment's figures, a row of the table and of the CSV file."""

    env: str
    budget: str
    repetitions: int
    milliseconds_a_learning_step: float
    milliseconds_a_checkpoint: float
    seconds_a_task: float
    """Reckoned from the two before."""
    seconds_measured: float | None
    """One task, from start to end; None unless asked for."""


def _measure(name: str, options: Benchmark) -> Result:
    row = replace(budget(name, options.budget), fleet=None)
    turns = [
        (seconds_a_learning_step(name, row), seconds_a_rollout(name, row.episodes))
        for _ in range(options.repetitions)
    ]
    learning, checkpoint = np.median(turns, axis=0)
    measured = None
    if options.whole:
        with tempfile.TemporaryDirectory() as folder:
            begin = time.perf_counter()
            collect_task(Job(resolve(name).name, 0, row, 0, Path(folder)))
            measured = round(time.perf_counter() - begin, 2)
    return Result(
        resolve(name).name,
        row.name,
        options.repetitions,
        round(1000 * float(learning), 2),
        round(1000 * float(checkpoint), 2),
        round(float(row.updates * learning + len(row.checkpoints) * checkpoint), 2),
        measured,
    )


def machine() -> dict[str, str]:
    """What the figures were taken on."""
    cpu = platform.processor()
    info = Path("/proc/cpuinfo")
    if info.exists():
        models = [line for line in info.read_text().splitlines() if line.startswith("model name")]
        cpu = models[0].partition(":")[2].strip() if models else cpu
    return {
        "cpu": cpu,
        "cores": str(os.cpu_count()),
        # About 1 is this benchmark alone; more is a machine that did something else beside it.
        "load": f"{os.getloadavg()[0]:.2f}",
        "system": platform.system(),
        "python": platform.python_version(),
        "torch": torch.__version__,
    }


def _write(path: Path, results: list[Result]) -> None:
    rows = [{**vars(result), **machine()} for result in results]
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_whole(path, text.getvalue().encode())


def _check(options: Benchmark) -> None:
    for name in options.envs:
        budget(name, options.budget)
    if options.repetitions < 1:
        raise ValueError("--repetitions must be above 0")
    if options.out is not None and not options.out.parent.is_dir():
        raise ValueError(f"--out {options.out}: there is no folder {options.out.parent}")


def main() -> int:
    """Run the benchmark and return its exit code: 2 for a user's mistake, 130 for Ctrl-C."""
    options = tyro.cli(Benchmark, prog="python benchmarks/collect_tasks.py")
    console, errors = Console(), Console(stderr=True)
    try:
        _check(options)
        results = [
            _measure(name, options)
            for name in track(options.envs, "measuring", console=errors, transient=True)
        ]
    except ValueError as mistake:
        errors.print(str(mistake), soft_wrap=True, markup=False, highlight=False)
        return 2
    except KeyboardInterrupt:
        errors.print("Interrupted; nothing was written.")
        return 130
    table = Table("environment", title=f"Collection, budget {options.budget}, one thread")
    for heading in ("step, ms", "checkpoint, ms", "task, s", "measured, s"):
        table.add_column(heading, justify="right")
    for one in results:
        times = (one.milliseconds_a_learning_step, one.milliseconds_a_checkpoint)
        seconds = (one.seconds_a_task, one.seconds_measured or "")
        table.add_row(one.env, *map(str, (*times, *seconds)))
    console.print(table)
    if options.out is not None:
        _write(options.out, results)
        console.print(f"Wrote {options.out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
