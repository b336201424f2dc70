r"""Gradient steps of CTMRL's meta-training a second: ours beside `plain_learner.py`.

    python benchmarks/meta_train_steps.py --out benchmarks/results/meta_train_steps.csv

Whole steps with sampling and optimisers, on random numbers in the shape of the dataset: the
field's settings on HalfCheetahVel and PointRobot, and those of `python -m ctmrl.train` without an
argument; before the codebook is placed and with it. One run of one or two threads, and two seeds
side by side, one thread each, whose rates add up. Sides take turns; a ratio is taken within one
turn, so that a busy machine slows both sides of it. The precision is that of ours; the plain side
is in float32 always.
"""

from __future__ import annotations

import multiprocessing
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import torch
import tyro
from env_steps import write_results
from plain_learner import PlainLearner
from rich.console import Console
from rich.table import Table

from ctmrl.config import RunConfig
from ctmrl.data import OfflineData
from ctmrl.errors import UsageError
from ctmrl.meta_train import Learner
from ctmrl.methods.ctmrl import CTMRL
from ctmrl.precision import Precision
from ctmrl.presets import known_preset, preset
from ctmrl.synthetic import synthetic_dataset
from ctmrl.threads import settle_threads
from datagen.accelerator import check_precision
from meta_envs import resolve

EPISODES = 20
"""Of each task's random numbers, at least."""
CONTEXT_ROWS = 1_020
"""Of the episodes behind a context, at most: the random data are few."""
ARRANGEMENTS = {
    "one run, one thread": (1, 1),
    "one run, two threads": (1, 2),
    "two seeds side by side": (2, 1),
}
"""Processes and threads of each."""
Engine = Literal["ours", "plain"]


@dataclass(frozen=True)
class Benchmark:
    """Measure gradient steps a second, ours against a plain implementation."""

    precision: Literal["auto", "float32", "bfloat16"] = "float32"
    """Of our matrix products; the plain implementation's are float32."""
    cases: tuple[str, ...] = (
        "half_cheetah_vel paper",
        "point_robot paper",
        "point_robot_wind standard",
    )
    """Environment and settings."""
    repetitions: int = 7
    """Turns; the table has their medians."""
    seconds: float = 3.0
    """Least time a side is measured in a turn."""
    out: Path | None = None
    """CSV file to write; without it nothing is written."""


@dataclass(frozen=True)
class Result:
    """A row of the table and of the CSV file; medians of the turns."""

    case: str
    codebook: bool
    arrangement: str
    precision: str
    repetitions: int
    ours: float
    """Steps a second, all processes together."""
    plain: float
    ratio: float
    """Median over the turns of ours / plain."""


def settings(case: str, seed: int) -> RunConfig:
    """The settings of a case, with fewer episodes behind a context where they are long."""
    env, _, name = case.partition(" ")
    try:
        config = preset(env, "ctmrl", known_preset(name), seed=seed)
    except UsageError as error:
        raise SystemExit(f"--cases '{case}': {error}") from None
    # How many episodes are behind a context is nothing to a step's time.
    most = CONTEXT_ROWS // resolve(env).horizon
    episodes = min(config.training.context_episodes, most)
    return replace(config, training=replace(config.training, context_episodes=episodes))


class Task(NamedTuple):
    """What a process builds: a learner of an engine, but for its seed."""

    engine: Engine
    case: str
    codebook: bool
    precision: Precision


def build(task: Task, seed: int) -> Callable[[], object]:
    """A learner's gradient step."""
    config = replace(settings(task.case, seed), precision=task.precision)
    dataset = synthetic_dataset(config.env, max(EPISODES, 2 * config.training.context_episodes))
    data = OfflineData(dataset, dataset.train_tasks)
    if task.engine == "ours":
        ours = Learner(config, data)
        assert isinstance(ours.method, CTMRL)
        # Few steps are taken, so the schedule does not get to place it.
        ours.method.codebook.placed.fill_(task.codebook)
        return ours.update
    torch.manual_seed(seed)
    statistics = data.statistics(config.context.next_obs_in_context)
    plain = PlainLearner(config, [dataset.read(int(t)) for t in dataset.train_tasks], statistics)
    plain.with_codebook = task.codebook
    return plain.update


def serve(pipe: Connection, task: Task, seed: int) -> None:
    """One process: answers (threads, seconds) with steps a second of that time."""
    if task.engine == "ours":
        settle_threads(1)
    else:
        torch.set_num_threads(1)
    step = build(task, seed)
    step()
    pipe.send(0.0)
    while True:
        threads, seconds = pipe.recv()
        torch.set_num_threads(threads)
        done, start = 0, time.perf_counter()
        while (elapsed := time.perf_counter() - start) < seconds:
            step()
            done += 1
        pipe.send(done / elapsed)


class Side:
    """Two processes of an engine."""

    def __init__(self, task: Task) -> None:
        """Start them and wait until both have taken a step."""
        context = multiprocessing.get_context("spawn")
        self._members = []
        for seed in (0, 1):
            pipe, end = context.Pipe()
            process = context.Process(target=serve, args=(end, task, seed), daemon=True)
            process.start()
            end.close()
            self._members.append((process, pipe))
        for _, pipe in self._members:
            pipe.recv()

    def rate(self, processes: int, threads: int, seconds: float) -> float:
        """Steps a second of so many processes together."""
        asked = [pipe for _, pipe in self._members[:processes]]
        for pipe in asked:
            pipe.send((threads, seconds))
        return sum(float(pipe.recv()) for pipe in asked)

    def close(self) -> None:
        """End them."""
        for process, _ in self._members:
            process.kill()
            process.join()


def measure(case: str, codebook: bool, options: Benchmark) -> list[Result]:
    """All arrangements of a case."""
    precision = check_precision(options.precision, "cpu")
    with ExitStack() as stack:
        ours = Side(Task("ours", case, codebook, precision))
        plain = Side(Task("plain", case, codebook, precision))
        stack.callback(ours.close)
        stack.callback(plain.close)
        results = []
        for name, (processes, threads) in ARRANGEMENTS.items():
            turns = np.array(
                [
                    [side.rate(processes, threads, options.seconds) for side in (ours, plain)]
                    for _ in range(options.repetitions)
                ]
            )
            ours_rate, plain_rate = np.median(turns, axis=0).round(2).tolist()
            ratio = float(np.median(turns[:, 0] / turns[:, 1]))
            results.append(
                Result(
                    case,
                    codebook,
                    name,
                    precision,
                    options.repetitions,
                    ours_rate,
                    plain_rate,
                    round(ratio, 2),
                )
            )
        return results


def main() -> int:
    """Run the benchmark."""
    options, console = tyro.cli(Benchmark), Console()
    table = Table("settings", "codebook", "arrangement", "ours", "plain", "ratio")
    results = []
    for case in options.cases:
        settings(case, 0)
    for case in options.cases:
        for codebook in (False, True):
            for one in measure(case, codebook, options):
                results.append(one)
                words = (one.case, "yes" if codebook else "no", one.arrangement)
                table.add_row(*words, *map(str, (one.ours, one.plain, one.ratio)))
    console.print(table)
    if options.out is not None:
        write_results(options.out, results, {"torch": torch.__version__})
        console.print(f"Wrote {options.out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
