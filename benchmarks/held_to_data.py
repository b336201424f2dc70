r"""What holds a policy to the data: returns of oracle_task by its regulariser.

    python benchmarks/budget_curves.py --env half_cheetah_vel --work ~/budget_curves --steps 400000
    python benchmarks/held_to_data.py --env half_cheetah_vel --work ~/runs \
        --data ~/budget_curves/half_cheetah_vel_400000

oracle_task is told the task, so what it lacks is the actor-critic's fault. Trains it once for each
regulariser, on training tasks alone: `--validate` holds every fifth of them out. A run that is
finished is not trained again, and one that was interrupted goes on. Writes
benchmarks/results/held_to_data_ENV.csv.
"""

from __future__ import annotations

import dataclasses
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from env_steps import write_results
from rich.console import Console
from rich.table import Table

from ctmrl.config import RunConfig
from ctmrl.errors import Diverged
from ctmrl.train import best_behavior, parse, train
from datagen.dataset import open_dataset

RESULTS = Path(__file__).parent / "results"
SETTINGS = (
    *("--batch-size", "64", "--context-size", "128", "--target-rate", "0.02"),
    *("--gamma", "0.98", "--learning-rate", "5e-4", "--value-from-data"),
    *("--cloning-advantage", "0", "--cloning-rank", "0"),
)
"""Of all runs, whatever the preset."""
CLONING = ("--no-behavior-regularization", "--reward-scale", "50", "--behavior-cloning")
HELD: dict[str, tuple[str, ...]] = {
    "nothing": (*CLONING, "0"),
    # The field's reward scale.
    "divergence": ("--behavior-regularization", "--reward-scale", "5", "--behavior-cloning", "0"),
    **{f"cloning {weight}": (*CLONING, weight) for weight in ("0.1", "0.2", "0.5", "1")},
}
"""Regularisers by name, and their options."""


@dataclass(frozen=True)
class Benchmark:
    """Compare what holds a policy to the data."""

    data: Path
    """Dataset of the environment."""
    work: Path
    """Folder for the runs, outside the repository."""
    env: str = "half_cheetah_vel"
    """Environment."""
    steps: int = 3_000
    """Gradient steps of a run."""
    seeds: tuple[int, ...] = (0, 1)
    """Runs of each regulariser."""


@dataclass(frozen=True)
class Result:
    """A row of the CSV file; returns are means over tasks, of the last checkpoint."""

    env: str
    held_by: str
    steps: int
    seed: int
    learned: float | None
    """Of the tasks that were learned from; nothing where the run diverged."""
    held_out: float | None
    """Of the training tasks that were held out."""


def result(config: RunConfig, name: str, work: Path) -> Result:
    """Train a run to its end, if it is not there, and give its returns."""
    where = (config.env, name, config.training.steps, config.seed)
    out = work / config.env / f"seed-{config.seed}" / name.replace(" ", "-")
    config = dataclasses.replace(config, out=out, validate=True)
    try:
        groups = train(config, Console())["groups"]
    except Diverged as error:
        print(f"{name}: {error}")
        return Result(*where, None, None)
    return Result(*where, *(round(groups[key]["return"], 1) for key in ("seen", "unseen")))


def behavior(data: Path) -> tuple[float, float]:
    """Mean return of a dataset's behaviour policies, and of the best one of each task."""
    dataset = open_dataset(data, verify=False)
    tasks = [dataset.entry(int(task))["returns"]["behavior"] for task in dataset.tasks]
    mean = np.mean([value for returns in tasks for value in returns.values()])
    return float(mean), float(np.mean([*best_behavior(dataset).values()]))


def show(results: list[Result], data: Path) -> None:
    """A row for each regulariser, with the seeds' returns."""
    table = Table("held by", "returns on tasks learned from", "held out")
    for name in dict.fromkeys(one.held_by for one in results):
        rows = [one for one in results if one.held_by == name]
        cells = ([one.learned for one in rows], [one.held_out for one in rows])
        table.add_row(name, *(" ".join(map(str, values)) for values in cells))
    Console().print(table)
    mean, best = behavior(data)
    print(f"behaviour policies: {mean:.1f} on the mean, {best:.1f} the best of each task")


def main() -> int:
    """Run the benchmark."""
    options = tyro.cli(Benchmark)
    common: list[Any] = ["--env", options.env, "--method", "oracle_task"]
    common += ["--steps", options.steps, "--data", options.data, *SETTINGS]
    results = []
    for seed in options.seeds:
        for name, words in HELD.items():
            config = parse([*map(str, common), "--seed", str(seed), *words])
            results.append(result(config, name, options.work))
            path = RESULTS / f"held_to_data_{config.env}.csv"
            write_results(path, results, {"torch": torch.__version__})
    show(results, options.data)
    return 0


if __name__ == "__main__":
    sys.exit(main())
