r"""How many steps a behaviour policy needs: learning curves far beyond the standard budget.

    python benchmarks/budget_curves.py --env ant_goal --work ~/budget_curves

Collects train tasks of an environment with the standard budget's fleet, but for four times its
steps (killed and run again, it goes on). A policy's worth after a number of steps is the mean
return of its last three checkpoints above the random policy's; the table has its mean over tasks,
and its share of what four times these steps reach. Writes
benchmarks/results/budget_curves_ENV_STEPS.csv, and docs/results/budget_curves.png with all such
files.
"""

from __future__ import annotations

import csv
import os
import sys
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import matplotlib
import numpy as np
import tyro
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from datagen.budgets import BUDGETS, Budget, budget
from datagen.collect import CollectConfig, CollectionError, InterruptedCollectionError, collect
from datagen.collect import with_engine as engine_of
from datagen.plan import Plan
from meta_envs import resolve, task_set

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "benchmarks/results"
TIMES, CHECKPOINTS = 4, 40
"""So many times the steps a budget is compared with, and so many checkpoints up to there."""
LAST = 3
"""So many checkpoints are averaged: a policy's return goes up and down between two of them."""
ENOUGH = 0.9
"""Share of what four times the steps reach that a budget must reach."""
ACROSS = 3
"""Panels side by side in the picture."""
FIRST = ("task", "random")
"""Columns of a file before those of the checkpoints."""


@dataclass(frozen=True)
class BudgetCurves:
    """Learning curves of behaviour policies, by default up to four times the standard budget."""

    env: str
    """Environment."""
    work: Path
    """Folder for the datasets, outside the repository."""
    steps: int | None = None
    """Last step, a multiple of 800; four times the standard budget's by default."""
    tasks: int = 8
    """Number of train tasks, spread over them."""
    fleet_size: int = 8
    """Tasks of a group; a process of one thread trains a group."""


@dataclass(frozen=True)
class Curves:
    """What a file of results holds.

    Attributes:
        tasks: rows of the task set, [T].
        random: the random policy's return on each, [T].
        marks: steps of the checkpoints, [C].
        returns: mean return of each checkpoint's episodes, [T, C].
    """

    tasks: NDArray[np.int64]
    random: NDArray[np.float64]
    marks: NDArray[np.int64]
    returns: NDArray[np.float64]

    @property
    def worth(self) -> NDArray[np.float64]:
        """Mean return of the last checkpoints above the random policy's, over tasks, [C]."""
        means = self.returns.mean(axis=0) - self.random.mean()
        parts = [means[max(0, end - LAST) : end].mean() for end in range(1, len(means) + 1)]
        return np.array(parts)

    @property
    def shares(self) -> dict[int, float]:
        """Steps -> worth there as a share of the worth at four times these steps."""
        worth = dict(zip(self.marks.tolist(), self.worth.tolist(), strict=True))
        return {
            mark: value / worth[TIMES * mark]
            for mark, value in worth.items()
            if TIMES * mark in worth
        }


def long_budget(env: str, steps: int | None) -> Budget:
    """The standard budget for other steps, random in a quarter of them as in the paper's budget.

    Raises:
        ValueError: steps that are no multiple of the checkpoints' and the updates' distances.
    """
    row, field = budget(env, "standard"), budget(env, "paper")
    steps = TIMES * row.steps if steps is None else steps
    unit = CHECKPOINTS * row.sac.update_every
    if steps < unit or steps % unit:
        raise ValueError(f"--steps must be a multiple of {unit}, got {steps}")
    random = field.random_steps * steps // (TIMES * field.steps)
    marks = (steps * part // CHECKPOINTS for part in range(1, CHECKPOINTS + 1))
    learnt = tuple(mark for mark in marks if mark > random)
    return replace(row, name="curves", steps=steps, random_steps=random, checkpoints=learnt)


def measure(options: BudgetCurves, console: Console) -> Curves:
    """Collect what is missing and read the returns.

    Raises:
        ValueError: an option is wrong.
        CollectionError: a collection failed.
        InterruptedCollectionError: Ctrl-C.
    """
    name = resolve(options.env).name
    row = long_budget(name, options.steps)
    # A dataset's card looks its budget up.
    BUDGETS[name] = {**BUDGETS[name], row.name: row}
    row = engine_of(row, CollectConfig(name, fleet_size=options.fleet_size))
    train = task_set(name).train_tasks
    tasks = train[np.linspace(0, len(train) - 1, options.tasks).round().astype(int)]
    groups, folder = row.groups(tasks.tolist()), options.work / f"{name}_{row.steps}"
    plan = Plan(name, groups, row, 0, folder, os.cpu_count() or 1)
    records = collect(plan, console)["tasks"]
    return Curves(
        tasks,
        np.array([one["returns"]["random"] for one in records]),
        np.array(row.checkpoints),
        np.array(
            [[one["returns"]["behavior"][str(mark)] for mark in row.checkpoints] for one in records]
        ),
    )


def write(curves: Curves, path: Path) -> None:
    """One row a task."""
    with path.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow([*FIRST, *curves.marks])
        for task, random, returns in zip(curves.tasks, curves.random, curves.returns, strict=True):
            writer.writerow([task, float(random), *map(float, returns)])


def read(path: Path) -> Curves:
    """What `write` wrote."""
    with path.open(newline="") as file:
        header, *rows = csv.reader(file)
    values = np.array(rows, dtype=np.float64)
    skip = len(FIRST)
    marks = np.array(header[skip:], dtype=np.int64)
    return Curves(values[:, 0].astype(np.int64), values[:, 1], marks, values[:, skip:])


def draw(path: Path) -> None:
    """The picture: a panel an experiment, tasks and their mean; dashed, the standard budget."""
    matplotlib.use("Agg")
    from matplotlib import pyplot

    files = sorted(RESULTS.glob("budget_curves_*.csv"))
    rows = -(-len(files) // ACROSS)
    figure, panels = pyplot.subplots(
        rows, ACROSS, figsize=(3.2 * ACROSS, 2.6 * rows), layout="constrained", squeeze=False
    )
    for axes in panels.flat[len(files) :]:
        axes.set_axis_off()
    for axes, file in zip(panels.flat, files, strict=False):
        curves = read(file)
        steps = curves.marks / 1000
        axes.plot(steps, curves.returns.T, color="#3b6ea5", alpha=0.25, linewidth=0.8)
        mean = curves.returns.mean(axis=0)
        axes.plot(steps, mean, color="#c1666b", label="mean over tasks")
        axes.axhline(curves.random.mean(), color="0.6", linestyle=":", label="random")
        name = file.stem.removeprefix("budget_curves_").rpartition("_")[0]
        axes.axvline(budget(name, "standard").steps / 1000, color="0.3", linestyle="--")
        axes.set_title(f"{resolve(name).id}, {len(curves.tasks)} tasks", fontsize=9)
        axes.spines[["top", "right"]].set_visible(False)
    figure.supxlabel("thousand steps", fontsize=9)
    figure.supylabel("behaviour policy's return", fontsize=9)
    panels[0][0].legend(frameon=False, fontsize=8)
    figure.savefig(path, dpi=120, metadata={"Software": None})


def enough_steps(shares: Mapping[int, float]) -> int | None:
    """The fewest steps from which on all shares are enough, or None."""
    found = None
    for mark in sorted(shares, reverse=True):
        if shares[mark] < ENOUGH:
            break
        found = mark
    return found


def report(curves: Curves, title: str, console: Console) -> None:
    """The table, and the fewest steps that are enough."""
    table = Table("steps", "return", f"share of {TIMES} x", "share of the last", title=title)
    for place, mark in enumerate(curves.marks.tolist()):
        share = curves.shares.get(mark)
        table.add_row(
            f"{mark:,}",
            f"{curves.returns[:, place].mean():.1f}",
            "" if share is None else f"{share:.2f}",
            f"{curves.worth[place] / curves.worth[-1]:.2f}",
        )
    console.print(table)
    console.print(
        f"fewest steps from which on {ENOUGH:.0%} of what {TIMES} times the steps reach: "
        f"{enough_steps(curves.shares) or 'none of these'}"
    )


def main() -> int:
    """Run the experiment and return its exit code."""
    options, errors = tyro.cli(BudgetCurves), Console(stderr=True)
    try:
        curves = measure(options, Console())
    except (ValueError, CollectionError, InterruptedCollectionError) as error:
        errors.print(str(error), soft_wrap=True, markup=False, highlight=False)
        codes = {CollectionError: 1, InterruptedCollectionError: 130}
        return codes.get(type(error), 2)
    name = resolve(options.env).name
    write(curves, RESULTS / f"budget_curves_{name}_{curves.marks[-1]}.csv")
    draw(ROOT / "docs/results/budget_curves.png")
    report(curves, f"{resolve(name).id}: {len(curves.tasks)} train tasks", Console())
    return 0


if __name__ == "__main__":
    sys.exit(main())
