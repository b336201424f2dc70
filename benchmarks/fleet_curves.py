r"""Learning curves of a fleet beside Stable-Baselines3's SAC: same tasks, same hyper-parameters.

    python benchmarks/fleet_curves.py --env half_cheetah_vel --work ~/fleet_curves

Collects a dataset of ten tasks with each engine (killed and run again, it goes on), and compares
the returns of the behaviour policies at every checkpoint: the mean over tasks with its 95%
bootstrap interval. Writes benchmarks/results/fleet_curves_ENV.csv and docs/results/ the picture.
"""

from __future__ import annotations

import csv
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import matplotlib
import numpy as np
import tyro
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from scipy import stats

from datagen.budgets import BUDGETS, Budget, FleetSettings, budget
from datagen.collect import CollectionError, InterruptedCollectionError, collect
from datagen.plan import Plan
from meta_envs import resolve, task_set

ROOT = Path(__file__).parents[1]
COLOURS = {"sb3": "#3b6ea5", "fleet-float32": "#c1666b", "fleet-bfloat16": "#4f9d69"}


@dataclass(frozen=True)
class Curves:
    """Compare the learning curves of a fleet with those of Stable-Baselines3's SAC."""

    env: str
    """Environment."""
    work: Path
    """Folder for the datasets, outside the repository."""
    tasks: int = 10
    """Number of tasks, spread over the task set."""
    steps: int = 20_000
    """Environment steps of each task, for MuJoCo environments; point robots have their budget's."""
    episodes: int = 10
    """Episodes of each checkpoint."""
    workers: int = 2
    """Processes, one thread each."""


def curve_budget(options: Curves) -> Budget:
    """The budget of the comparison, without an engine."""
    row = budget(options.env, "paper" if "point" in options.env else "standard", options.episodes)
    if "point" not in options.env:
        every = options.steps // 10
        marks = tuple(range(every, options.steps + 1, every))
        row = replace(
            row, steps=options.steps, random_steps=every // 2, checkpoints=marks, name="curves"
        )
    return replace(row, fleet=None)


def engines(options: Curves) -> Iterator[tuple[str, Budget]]:
    """Each engine's name and budget."""
    row = curve_budget(options)
    yield "sb3", row
    size = -(-options.tasks // options.workers)
    yield "fleet-float32", replace(row, fleet=FleetSettings(size, "float32"))
    yield "fleet-bfloat16", replace(row, fleet=FleetSettings(size, "bfloat16"))


def interval(values: NDArray[np.float64]) -> tuple[float, float]:
    """95% bootstrap interval of the mean, [n] -> low, high."""
    found = stats.bootstrap(
        (values,), np.mean, method="percentile", rng=np.random.default_rng(0)
    ).confidence_interval
    return float(found.low), float(found.high)


def draw(curves: dict[str, NDArray[np.float64]], marks: list[int], title: str, path: Path) -> None:
    """The picture: a line an engine, its interval as a band."""
    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(7, 4), layout="constrained")
    for name, returns in curves.items():
        low, high = np.array([interval(column) for column in returns.T]).T
        style = "--" if name.endswith("bfloat16") else "-"
        axes.plot(marks, returns.mean(axis=0), style, color=COLOURS[name], label=name)
        axes.fill_between(marks, low, high, color=COLOURS[name], alpha=0.15, linewidth=0)
    axes.set(xlabel="environment steps", ylabel="behaviour policy's return", title=title)
    axes.legend(frameon=False)
    axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, dpi=120, metadata={"Software": None})


def main() -> int:
    """Run the comparison and return its exit code."""
    options, errors = tyro.cli(Curves), Console(stderr=True)
    try:
        compare(options, Console())
    except (ValueError, CollectionError, InterruptedCollectionError) as error:
        errors.print(str(error), soft_wrap=True, markup=False, highlight=False)
        codes = {CollectionError: 1, InterruptedCollectionError: 130}
        return codes.get(type(error), 2)
    return 0


def compare(options: Curves, console: Console) -> None:
    """Collect what is missing and compare.

    Raises:
        ValueError: an option is wrong.
        CollectionError: a collection failed.
        InterruptedCollectionError: Ctrl-C.
    """
    name = resolve(options.env).name
    rows = np.linspace(0, len(task_set(name)) - 1, options.tasks).round().astype(int)
    curves: dict[str, NDArray[np.float64]] = {}
    marks: list[int] = []
    row = curve_budget(options)
    # A dataset's card looks its budget up.
    BUDGETS[name] = {**BUDGETS[name], row.name: row}
    for engine, row in engines(options):
        folder = options.work / f"{name}_{engine}"
        plan = Plan(name, row.groups(rows.tolist()), row, 0, folder, options.workers)
        index = collect(plan, console)
        marks = list(row.checkpoints)
        curves[engine] = np.array(
            [
                [record["returns"]["behavior"][str(mark)] for mark in marks]
                for record in index["tasks"]
            ]
        )
    with (ROOT / f"benchmarks/results/fleet_curves_{name}.csv").open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["engine", "task", *marks])
        for engine, returns in curves.items():
            writer.writerows(
                [engine, task, *map(float, r)] for task, r in zip(rows, returns, strict=True)
            )
    title = f"{resolve(name).id}: {options.tasks} tasks, mean and 95% interval"
    draw(curves, marks, title, ROOT / f"docs/results/fleet_curves_{name}.png")
    table = Table("steps", *curves, title=title)
    inside = dict.fromkeys(curves, 0)
    low_high = [interval(column) for column in curves["sb3"].T]
    for place, mark in enumerate(marks):
        cells = []
        for engine, returns in curves.items():
            mean, (low, high) = returns[:, place].mean(), interval(returns[:, place])
            within = low_high[place][0] <= mean <= low_high[place][1]
            inside[engine] += within
            cells.append(f"{mean:.2f} ({low:.2f} to {high:.2f}){'' if within else ' outside'}")
        table.add_row(f"{mark:,}", *cells)
    console.print(table)
    for engine, count in inside.items():
        console.print(f"{engine}: within sb3's interval at {count} of {len(marks)} checkpoints")


if __name__ == "__main__":
    sys.exit(main())
