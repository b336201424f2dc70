"""Training data in memory and in a file: steps a second, and what reading ahead saves on a disk.

    python benchmarks/training_data.py --out benchmarks/results/training_data.csv

Steps are those of the standard preset on the starter dataset, whose file the system keeps at hand;
both sides take turns and the ratio is taken within one. A draw from the disk is one of rows that
the system was made to forget; reading ahead is given `--pause` between its begin and the draw.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import tyro
from env_steps import write_results
from rich.console import Console
from rich.table import Table as Shown

from ctmrl.data import OfflineData
from ctmrl.meta_train import Learner
from ctmrl.presets import preset
from ctmrl.table import Room
from ctmrl.threads import settle_threads
from datagen.dataset import open_dataset

ROWS, WIDTH = 4_000_000, 43
"""A table of HalfCheetah's size, 0.69 GB."""
DRAWN = 1024
"""Rows of a step of the standard preset: 16 tasks, 2 contexts of 16 and a batch of 32."""

PAGE_OUT = 21
"""Linux's MADV_PAGEOUT, which the standard library has no name for: forget what was read."""


@dataclass(frozen=True)
class Benchmark:
    """Measure a learner whose data are in a file."""

    data: Path = Path("datasets/point_robot_wind")
    """Dataset of the steps."""
    folder: Path = Path()
    """Where the files are, on the disk to measure."""
    repetitions: int = 15
    """Turns; the table has their medians."""
    steps: int = 100
    """Steps of each side in a turn."""
    pause: float = 0.01
    """Seconds of other work between reading ahead and the draw."""
    out: Path | None = None
    """CSV file to write; without it nothing is written."""


@dataclass(frozen=True)
class Result:
    """A row of the table and of the CSV file; a median."""

    what: str
    value: float


def steps_per_second(options: Benchmark) -> list[Result]:
    """Steps of the learner, and what share of them a file leaves."""
    config = preset("point_robot_wind", "ctmrl", "standard")
    dataset = open_dataset(options.data)
    memory, file = (
        Learner(config, OfflineData(dataset, dataset.train_tasks, room=Room(most, options.folder)))
        for most in (1e3, 0)
    )
    turns = []
    for _ in range(options.repetitions):
        rates = []
        for learner in (memory, file):
            begun = time.perf_counter()
            for _ in range(options.steps):
                learner.update()
            rates.append(options.steps / (time.perf_counter() - begun))
        turns.append((*rates, rates[1] / rates[0]))
    names = ("steps/s in memory", "steps/s in a file", "ratio of them")
    return [Result(*row) for row in zip(names, np.median(turns, axis=0).tolist(), strict=True)]


def draws(options: Benchmark) -> list[Result]:
    """Milliseconds that a draw from the disk takes, without and with reading ahead."""
    generator = torch.Generator().manual_seed(0)
    table = Room(0, options.folder).table(ROWS, WIDTH)
    assert table._mapping
    table.values.fill_(1.0)
    table._mapping.flush()
    table.filled()
    times: dict[bool, list[float]] = {False: [], True: []}
    for _ in range(options.repetitions):
        for ahead, found in times.items():
            rows = torch.randint(ROWS, (DRAWN,), generator=generator)
            table._mapping.madvise(PAGE_OUT)
            if ahead:
                table.page_in(rows)
            time.sleep(options.pause)
            begun = time.perf_counter()
            table.values.index_select(0, rows)
            found.append(1e3 * (time.perf_counter() - begun))
    names = {False: "ms a draw from the disk", True: "ms a draw, read ahead"}
    return [Result(names[ahead], float(np.median(found))) for ahead, found in times.items()]


def main() -> None:
    """Measure, print, and write what was asked for."""
    options = tyro.cli(Benchmark)
    settle_threads(1)
    results = [*steps_per_second(options), *draws(options)]
    shown = Shown("", "median")
    for result in results:
        shown.add_row(result.what, f"{result.value:.3g}")
    Console().print(shown)
    if options.out:
        write_results(options.out, results, {})


if __name__ == "__main__":
    main()
