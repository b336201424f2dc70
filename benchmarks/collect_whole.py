r"""Minutes and memory of whole collections.

    python benchmarks/collect_whole.py --envs half_cheetah_vel ant_goal --work ~/datasets \
        --out benchmarks/results/collect_whole.csv

Runs `python -m datagen.collect` and looks every second at what it and its workers hold: the memory
they share counts once. A collection that was interrupted before is timed from where it goes on.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import tyro
from env_steps import write_results
from rich.console import Console
from rich.table import Table

from datagen.budgets import BUDGETS
from meta_envs import resolve

EVERY = 1.0
"""Seconds between two looks."""


@dataclass(frozen=True)
class Benchmark:
    """Collect whole datasets, timed."""

    work: Path
    """Folder for the datasets, outside the repository."""
    envs: tuple[str, ...] = tuple(BUDGETS)
    """Environments to collect."""
    budget: str = "standard"
    """Budget to collect."""
    workers: int = 2
    """Processes, one thread each."""
    out: Path | None = None
    """CSV file to write; without it nothing is written."""


@dataclass(frozen=True)
class Result:
    """A row of the table and of the CSV file."""

    env: str
    budget: str
    tasks: int
    workers: int
    minutes: float
    peak_memory_gb: float
    """Of all its processes together."""
    size_mb: float
    """Of the dataset."""
    transitions: int


def held(pid: int) -> int:
    """Bytes a process and those below it hold; pages that n of them share count 1/n each."""
    total = 0
    try:
        for line in Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines():
            if line.startswith("Pss:"):
                total = 1024 * int(line.split()[1])
        children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    except (FileNotFoundError, ProcessLookupError):
        return total
    return total + sum(held(int(child)) for child in children)


def measure(env: str, options: Benchmark) -> Result:
    """Collect one environment.

    Raises:
        RuntimeError: the command failed.
    """
    folder = options.work / env
    words = ["--env", env, "--budget", options.budget, "--workers", str(options.workers)]
    begin, peak = time.perf_counter(), 0
    with subprocess.Popen(
        [sys.executable, "-m", "datagen.collect", *words, "--out", str(folder)]
    ) as command:
        while command.poll() is None:
            peak = max(peak, held(command.pid))
            time.sleep(EVERY)
    if command.returncode:
        raise RuntimeError(f"the collection of {env} ended with exit code {command.returncode}")
    records = json.loads((folder / "dataset.json").read_text())["tasks"]
    return Result(
        env,
        options.budget,
        len(records),
        options.workers,
        round((time.perf_counter() - begin) / 60, 1),
        round(peak / 1e9, 2),
        round(sum(one["bytes"] for one in records) / 1e6, 1),
        sum(one["transitions"] for one in records),
    )


def main() -> int:
    """Run the benchmark; exit code 1 where a collection failed, 2 for a mistake, 130 for Ctrl-C."""
    options = tyro.cli(Benchmark, prog="python benchmarks/collect_whole.py")
    console, errors = Console(), Console(stderr=True)
    results = []
    try:
        if options.out is not None and not options.out.parent.is_dir():
            raise ValueError(f"--out {options.out}: there is no folder {options.out.parent}")
        for env in options.envs:
            results.append(measure(resolve(env).name, options))
            if options.out is not None:
                write_results(options.out, results, {})
    except (ValueError, RuntimeError) as error:
        errors.print(str(error), soft_wrap=True, markup=False, highlight=False)
        return 2 if isinstance(error, ValueError) else 1
    except KeyboardInterrupt:
        errors.print(
            f"Interrupted with {len(results)} of {len(options.envs)} environments done; the same "
            "command goes on, and times what is left.",
            soft_wrap=True,
            highlight=False,
        )
        return 130
    table = Table("environment", "tasks", "minutes", "GB at most", "MB on disk", "transitions")
    for one in results:
        numbers = (one.tasks, one.minutes, one.peak_memory_gb, one.size_mb, f"{one.transitions:,}")
        table.add_row(one.env, *map(str, numbers))
    console.print(table)
    return 0


if __name__ == "__main__":
    sys.exit(main())
