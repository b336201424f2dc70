r"""Environment steps a second: the native point robots beside Gymnasium's SyncVectorEnv.

    python benchmarks/env_steps.py --repetitions 11 --seconds 0.15 \
        --out benchmarks/results/env_steps.csv

Both step the same environment with the same actions, in one thread of one process, by turns, resets
included. A ratio is taken within one turn, so that a busy machine slows both sides of it.
"""

from __future__ import annotations

import csv
import io
import os
import platform
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import tyro
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track
from rich.table import Table

from meta_envs import resolve

PRERECORDED = 64
"""Number of action batches that take turns, so that drawing them is not timed."""


@dataclass(frozen=True)
class Benchmark:
    """Measure environment steps a second, native vector environment against SyncVectorEnv."""

    envs: tuple[str, ...] = ("point_robot", "point_robot_wind", "sparse_point_robot")
    """Environments to measure."""
    num_envs: int = 100
    """Sub-environments side by side."""
    repetitions: int = 15
    """Turns; the table has their medians."""
    seconds: float = 0.2
    """Least time a side is measured in a turn."""
    out: Path | None = None
    """CSV file to write; without it nothing is written."""


@dataclass(frozen=True)
class Result:
    """One environment's figures, a row of the table and of the CSV file."""

    env: str
    num_envs: int
    repetitions: int
    native_steps_per_second: int
    native_best: int
    sync_steps_per_second: int
    sync_best: int
    ratio: float
    """Median over the turns of native / sync."""


def _steps_per_second(env: Any, actions: NDArray[np.float32], seconds: float) -> float:
    done, start = 0, time.perf_counter()
    while (elapsed := time.perf_counter() - start) < seconds:
        for action in actions:
            env.step(action)
        done += len(actions)
    return float(done * env.num_envs / elapsed)


def _measure(name: str, options: Benchmark) -> Result:
    env_id = resolve(name).id
    native = gymnasium.make_vec(env_id, options.num_envs, "vector_entry_point")
    sync = gymnasium.make_vec(env_id, options.num_envs, "sync", disable_env_checker=True)
    size = (PRERECORDED, *(native.action_space.shape or ()))
    actions = np.random.default_rng(0).uniform(-1, 1, size).astype(np.float32)
    for env in (native, sync):
        env.reset(seed=0)
        _steps_per_second(env, actions, options.seconds / 4)
    turns = np.array(
        [
            [_steps_per_second(env, actions, options.seconds) for env in (native, sync)]
            for _ in range(options.repetitions)
        ]
    )
    native_median, sync_median = np.median(turns, axis=0)
    native_best, sync_best = turns.max(axis=0)
    return Result(
        resolve(name).name,
        options.num_envs,
        options.repetitions,
        round(native_median),
        round(native_best),
        round(sync_median),
        round(sync_best),
        round(float(np.median(turns[:, 0] / turns[:, 1])), 1),
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
        "numpy": np.__version__,
        "gymnasium": gymnasium.__version__,
    }


def write_results(path: Path, results: Sequence[object], more: Mapping[str, str]) -> None:
    """Write a CSV file with a row for each record, whole or not at all.

    Args:
        path: of the file.
        results: records of one dataclass; their fields are columns.
        more: what else the figures were taken on, beside what `machine` says.
    """
    rows = [{**vars(result), **machine(), **more} for result in results]
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    partial = path.with_name(f".{path.name}.partial")
    with partial.open("w") as file:
        file.write(text.getvalue())
        file.flush()
        os.fsync(file.fileno())
    partial.replace(path)


def main() -> int:
    """Run the benchmark and return its exit code: 2 for a user's mistake, 130 for Ctrl-C."""
    options = tyro.cli(Benchmark, prog="python benchmarks/env_steps.py")
    console, errors = Console(), Console(stderr=True)
    try:
        for name in options.envs:
            resolve(name)
        if min(options.num_envs, options.repetitions) < 1 or options.seconds <= 0:
            raise ValueError("--num-envs, --repetitions and --seconds must be above 0")
        if options.out is not None and not options.out.parent.is_dir():
            raise ValueError(f"--out {options.out}: there is no folder {options.out.parent}")
    except ValueError as mistake:
        errors.print(str(mistake), soft_wrap=True, markup=False, highlight=False)
        return 2
    table = Table("environment", title=f"Steps a second, {options.num_envs} sub-environments")
    for heading in ("native", "native, best", "SyncVectorEnv", "ratio"):
        table.add_column(heading, justify="right")
    try:
        results = [
            _measure(name, options)
            for name in track(options.envs, "measuring", console=errors, transient=True)
        ]
    except KeyboardInterrupt:
        errors.print("Interrupted; nothing was written.")
        return 130
    for result in results:
        table.add_row(
            result.env,
            f"{result.native_steps_per_second:,}",
            f"{result.native_best:,}",
            f"{result.sync_steps_per_second:,}",
            f"{result.ratio:.1f}",
        )
    console.print(table)
    if options.out is not None:
        write_results(options.out, results, {})
        console.print(f"Wrote {options.out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
