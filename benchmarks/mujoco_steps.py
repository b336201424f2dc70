r"""Environment steps a second of the MuJoCo environments, beside all that steps the same physics.

    python benchmarks/mujoco_steps.py --out benchmarks/results/mujoco_steps.csv

Side by side, by turns, in one run: the native vector environment; Gymnasium's SyncVectorEnv and
AsyncVectorEnv of the single one; SyncVectorEnv of Gymnasium's own class of the robot; EnvPool's,
where it is installed; and a bare loop of `mj_step`, which replays the very steps of the native one,
on one core and then in as many threads at once. Random actions, a task each (Gymnasium's class and
EnvPool's have nominal parameters, EnvPool's its own time step). Resets are run but not counted. A
ratio is taken within one turn.
"""

from __future__ import annotations

import functools
import importlib
import itertools
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import gymnasium
import mujoco
import numpy as np
import tyro
from env_steps import PRERECORDED, write_results
from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track
from rich.table import Table

from meta_envs import MetaVectorEnv, resolve, task_set
from meta_envs.mujoco_robot import MujocoRobot
from meta_envs.registry import definition
from meta_envs.simulation import MODELS

CLASSES = {
    "half_cheetah.xml": "HalfCheetah",
    "hopper.xml": "Hopper",
    "walker2d.xml": "Walker2d",
    "ant.xml": "Ant",
    "humanoid.xml": "Humanoid",
}
"""Name of a robot in Gymnasium and EnvPool."""

PLAIN_WIDTH = 165
"""Columns of the table where the output is not a terminal."""

Floats = NDArray[np.float64]
Side = Callable[[float], float]
"""Steps a second, measured for at least so many seconds."""


@dataclass(frozen=True)
class Benchmark:
    """Measure steps a second of the MuJoCo environments."""

    envs: tuple[str, ...] = ("half_cheetah_vel", "hopper_params", "walker_params", "ant_goal")
    """Environments to measure."""
    num_envs: int = 40
    """Sub-environments side by side."""
    threads: int = 2
    """Native threads."""
    repetitions: int = 41
    """Turns; the table has their medians."""
    seconds: float = 0.25
    """Least time a side is measured in a turn: short, so that all sides of a turn see the same
    machine."""
    out: Path | None = None
    """CSV file to write; without it nothing is written."""


@dataclass(frozen=True)
class Result:
    """One environment's figures, a row of the table and of the CSV file; medians of the turns."""

    env: str
    num_envs: int
    threads: int
    repetitions: int
    native: int
    sync: int
    asynchronous: int
    sync_of_gymnasiums: int
    envpool: int | None
    """None where it is not installed."""
    mj_step: int
    """On one core."""
    mj_step_at_once: int
    """In as many threads as the native one has: what the machine can give."""
    native_to_gymnasium: float
    """Native to the faster of SyncVectorEnv and AsyncVectorEnv."""
    native_to_gymnasiums: float
    """Native to SyncVectorEnv of Gymnasium's own class, which has nominal parameters."""
    native_to_envpool: float | None
    native_to_bare: float
    """Native to `threads` times bare `mj_step`."""
    native_to_at_once: float


def _steps_per_second(env: Any, actions: NDArray[np.float32], seconds: float) -> float:
    done, start = 0, time.perf_counter()
    for action in itertools.cycle(actions):
        terminated, truncated = env.step(action)[2:4]
        # Whatever ends here is only reset in the next step.
        done += len(terminated) - int(np.count_nonzero(terminated | truncated))
        if (elapsed := time.perf_counter() - start) >= seconds:
            break
    return done / elapsed


class _Bare:
    """Steps of the native environment, replayed by one `mujoco.MjData` after the other."""

    def __init__(self, robot: MujocoRobot, tasks: list[int], actions: NDArray[np.float32]) -> None:
        self._robot = robot
        env = MetaVectorEnv(robot.name, tasks=tasks)
        models = [robot.task_model(params) for params in env.params]
        self._rows = [(model, mujoco.MjData(model)) for model in models]
        env.reset(seed=0)
        self._start, states, resets = env.state.copy(), [], []
        over = np.zeros(env.num_envs, dtype=np.bool_)
        strength = models[0].actuator_ctrlrange[:, 1]
        self._controls: Floats = strength * np.clip(actions, -1.0, 1.0).astype(np.float64)
        for action in actions:
            resets.append(over)
            terminated, truncated = env.step(action)[2:4]
            over = terminated | truncated
            states.append(env.state.copy())
        self._states, self._resets = np.array(states), np.array(resets)
        self._turn = itertools.cycle(range(env.num_envs))
        for row in range(env.num_envs):
            self._replay(row)
            reached = self._rows[row][1].qpos
            if not np.array_equal(reached, states[-1][row, : robot.nq]):
                raise RuntimeError(
                    f"{robot.name}: the replay of sub-environment {row} went elsewhere"
                )

    def _put(self, data: Any, state: Floats) -> None:
        nq, nv = self._robot.nq, self._robot.nv
        data.qpos[:], data.qvel[:], data.qacc_warmstart[:] = np.split(
            state[: nq + 2 * nv], [nq, nq + nv]
        )

    def _replay(self, row: int) -> int:
        """All steps of one sub-environment; how many there were, without resets."""
        model, data = self._rows[row]
        skip, mj_step = self._robot.frame_skip, mujoco.mj_step
        self._put(data, self._start[row])
        resets: list[bool] = self._resets[:, row].tolist()
        for step, reset in enumerate(resets):
            if reset:
                self._put(data, self._states[step, row])
            else:
                data.ctrl[:] = self._controls[step, row]
                mj_step(model, data, nstep=skip)
        return len(resets) - sum(resets)

    def __call__(self, seconds: float) -> float:
        done, start = 0, time.perf_counter()
        while (elapsed := time.perf_counter() - start) < seconds:
            done += self._replay(next(self._turn))
        return done / elapsed

    def at_once(self, threads: int, seconds: float) -> float:
        """Steps a second of several threads together; MuJoCo does not hold the interpreter."""
        with ThreadPoolExecutor(threads) as pool:
            return sum(pool.map(self, [seconds] * threads))


def _envpool(robot: MujocoRobot, options: Benchmark) -> Any:
    """EnvPool's environment, or None where it is not installed."""
    try:
        # By name, because this project does not need it.
        envpool = importlib.import_module("envpool")
    except ImportError:
        return None
    env = envpool.make(
        f"{CLASSES[robot.file]}-v4",
        env_type="gymnasium",
        num_envs=options.num_envs,
        num_threads=options.threads,
        max_episode_steps=robot.horizon,
    )
    env.reset()
    return env


def _gymnasiums(robot: MujocoRobot) -> Any:
    """Gymnasium's own environment of a robot, at our time step and horizon."""
    # MuJoCo warns of an attribute in the cheetah's file, forty times here.
    mujoco.set_mju_user_warning(lambda message: None)
    try:
        env: Any = gymnasium.make(
            f"{CLASSES[robot.file]}-v5",
            max_episode_steps=robot.horizon,
            disable_env_checker=True,
            xml_file=str(MODELS / robot.file),
            frame_skip=robot.frame_skip,
        )
    finally:
        mujoco.set_mju_user_warning(None)
    env.unwrapped.model.opt.timestep = robot.timestep
    return env


@contextmanager
def _sides(name: str, options: Benchmark) -> Iterator[dict[str, Side]]:
    """Everything that is measured, by the names of Result's fields."""
    robot, n_tasks = _robot(name), len(task_set(name))
    tasks = [row % n_tasks for row in range(options.num_envs)]
    size = (PRERECORDED, options.num_envs, robot.nu)
    actions = np.random.default_rng(0).uniform(-1, 1, size).astype(np.float32)
    makers = [
        functools.partial(gymnasium.make, resolve(name).id, task=task, disable_env_checker=True)
        for task in tasks
    ]
    # Its processes are forked, so they must be before there are any threads.
    asynchronous = AsyncVectorEnv(makers)
    try:
        several: dict[str, Any] = {
            "asynchronous": asynchronous,
            "sync": SyncVectorEnv(makers),
            "sync_of_gymnasiums": SyncVectorEnv([lambda: _gymnasiums(robot)] * options.num_envs),
            "native": MetaVectorEnv(name, tasks=tasks, threads=options.threads),
        }
        for env in several.values():
            env.reset(seed=0)
        if (pool := _envpool(robot, options)) is not None:
            several["envpool"] = pool
        sides: dict[str, Side] = {
            side: functools.partial(_steps_per_second, env, actions)
            for side, env in several.items()
        }
        repeats = -(-robot.horizon // PRERECORDED)
        bare = _Bare(robot, tasks, np.tile(actions, (repeats, 1, 1)))
        sides["mj_step"] = bare
        sides["mj_step_at_once"] = functools.partial(bare.at_once, options.threads)
        yield sides
    finally:
        asynchronous.close()


def _robot(name: str) -> MujocoRobot:
    robot = definition(name)
    if not isinstance(robot, MujocoRobot):
        raise ValueError(f"{name} does not run on MuJoCo: benchmarks/env_steps.py measures it")
    return robot


def _measure(name: str, options: Benchmark) -> Result:
    with _sides(name, options) as sides:
        for run in sides.values():
            run(options.seconds / 4)
        turns = {side: np.empty(options.repetitions) for side in sides}
        for turn in range(options.repetitions):
            for side, run in sides.items():
                turns[side][turn] = run(options.seconds)
    native, pool = turns["native"], turns.get("envpool")
    faster = max(turns["sync"], turns["asynchronous"], key=np.median)
    return Result(
        resolve(name).name,
        options.num_envs,
        options.threads,
        options.repetitions,
        _median(native),
        _median(turns["sync"]),
        _median(turns["asynchronous"]),
        _median(turns["sync_of_gymnasiums"]),
        None if pool is None else _median(pool),
        _median(turns["mj_step"]),
        _median(turns["mj_step_at_once"]),
        _ratio(native, faster),
        _ratio(native, turns["sync_of_gymnasiums"]),
        None if pool is None else _ratio(native, pool),
        _ratio(native, options.threads * turns["mj_step"]),
        _ratio(native, turns["mj_step_at_once"]),
    )


def _median(rates: Floats) -> int:
    return round(float(np.median(rates)))


def _ratio(rates: Floats, others: Floats) -> float:
    return round(float(np.median(rates / others)), 2)


def _table(results: list[Result], options: Benchmark) -> Table:
    title = f"Steps a second, {options.num_envs} sub-environments, {options.threads} threads"
    table = Table("environment", title=title)
    for heading in ("native", "Sync", "Async", "Sync of its own", "EnvPool", "mj_step", "at once"):
        table.add_column(heading, justify="right")
    bare = f"/ {options.threads} mj_step"
    for heading in ("/ Sync, Async", "/ its own", "/ EnvPool", bare, "/ at once"):
        table.add_column(heading, justify="right")
    for one in results:
        rates = (
            one.native,
            one.sync,
            one.asynchronous,
            one.sync_of_gymnasiums,
            one.envpool,
            one.mj_step,
            one.mj_step_at_once,
        )
        ratios = (
            one.native_to_gymnasium,
            one.native_to_gymnasiums,
            one.native_to_envpool,
            one.native_to_bare,
            one.native_to_at_once,
        )
        table.add_row(
            one.env,
            *("-" if rate is None else f"{rate:,}" for rate in rates),
            *("-" if ratio is None else f"{ratio:.2f}" for ratio in ratios),
        )
    return table


def main() -> int:
    """Run the benchmark and return its exit code: 2 for a user's mistake, 130 for Ctrl-C."""
    options = tyro.cli(Benchmark, prog="python benchmarks/mujoco_steps.py")
    console, errors = Console(), Console(stderr=True)
    if not console.is_terminal:
        console = Console(width=PLAIN_WIDTH)
    try:
        for name in options.envs:
            _robot(name)
        if min(options.num_envs, options.threads, options.repetitions, options.seconds) <= 0:
            raise ValueError("--num-envs, --threads, --repetitions and --seconds must be above 0")
        if options.out is not None and not options.out.parent.is_dir():
            raise ValueError(f"--out {options.out}: there is no folder {options.out.parent}")
    except ValueError as mistake:
        errors.print(str(mistake), soft_wrap=True, markup=False, highlight=False)
        return 2
    try:
        results = [
            _measure(name, options)
            for name in track(options.envs, "measuring", console=errors, transient=True)
        ]
    except KeyboardInterrupt:
        errors.print("Interrupted; nothing was written.")
        return 130
    console.print(_table(results, options))
    if options.out is not None:
        write_results(options.out, results, {"mujoco": version("mujoco")})
        console.print(f"Wrote {options.out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
