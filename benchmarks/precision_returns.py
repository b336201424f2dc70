r"""Returns of runs in float32 and in bfloat16, beside each other.

    python benchmarks/precision_returns.py --envs point_robot_wind --work ~/runs \
        --out benchmarks/results/precision_returns.csv

Trains every environment, precision and seed as `python -m ctmrl.train` does, one after the other,
and measures its returns, in float32 both. A run that is finished is not trained again, and one that
was interrupted goes on. The interval of a mean over seeds is `ctmrl.report`'s.
"""

from __future__ import annotations

import dataclasses
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import tyro
from env_steps import write_results
from rich.console import Console
from rich.table import Table

from ctmrl.precision import Precision
from ctmrl.summary import interval
from ctmrl.train import parse, train

PRECISIONS: tuple[Precision, ...] = ("float32", "bfloat16")


@dataclass(frozen=True)
class Benchmark:
    """Compare what is learnt in two precisions."""

    work: Path
    """Folder for the runs, outside the repository."""
    envs: tuple[str, ...] = ("point_robot_wind",)
    """Environments; each needs its dataset in datasets/."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Runs of each environment and precision."""
    method: str = "ctmrl"
    """Context-learning method."""
    preset: str = "standard"
    """Where all other settings come from."""
    out: Path | None = None
    """CSV file to write, anew after each run; without it nothing is written."""


@dataclass(frozen=True)
class Result:
    """A row of the CSV file."""

    env: str
    precision: Precision
    seed: int
    unseen: float
    """Mean return of the tasks it never saw."""
    seen: float
    """Mean return of the tasks it was trained on."""


def result(env: str, precision: Precision, seed: int, options: Benchmark) -> Result:
    """Train a run to its end, if it is not there, and give its returns."""
    words = ["--env", env, "--method", options.method, "--preset", options.preset]
    config = parse([*words, "--seed", str(seed), "--precision", precision])
    out = options.work / config.env / options.method / precision / f"seed-{seed}"
    groups = train(dataclasses.replace(config, out=out), Console())["groups"]
    unseen, seen = (round(groups[name]["return"], 4) for name in ("unseen", "seen"))
    return Result(config.env, precision, seed, unseen, seen)


def table_of(results: list[Result]) -> Table:
    """Means over seeds and their intervals, a row for each environment and group of tasks."""
    table = Table("environment", "tasks", *PRECISIONS)
    for env in dict.fromkeys(one.env for one in results):
        for group in ("unseen", "seen"):
            cells = []
            for precision in PRECISIONS:
                rows = [one for one in results if (one.env, one.precision) == (env, precision)]
                values = np.array([getattr(one, group) for one in rows])
                low, high = interval(values)
                cells.append(f"{values.mean():.3f} [{low:.3f}, {high:.3f}]")
            table.add_row(env, group, *cells)
    return table


def main() -> int:
    """Run the benchmark."""
    options, results = tyro.cli(Benchmark), list[Result]()
    for env in options.envs:
        for seed in options.seeds:
            for precision in PRECISIONS:
                results.append(result(env, precision, seed, options))
                if options.out is not None:
                    write_results(options.out, results, {"torch": torch.__version__})
    Console(width=100).print(table_of(results))
    return 0


if __name__ == "__main__":
    sys.exit(main())
