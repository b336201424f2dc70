"""One process of the benchmark sac_updates.py: learns for so many seconds each time it is asked.

Reads a number of seconds from each line of its input and answers with the task-updates a second of
that time. It needs of the project `meta_envs` alone where it runs SBX, in an environment of its
own; everything else is imported by the engine that needs it.
"""

from __future__ import annotations

import importlib
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Literal

import gymnasium
import tyro
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger

import meta_envs

RANDOM_STEPS = 400
UPDATE_EVERY = 20
MEMORY = 100_000


@dataclass(frozen=True)
class Side:
    """What a process learns, and with what."""

    engine: Literal["sb3", "sbx", "fleet-float32", "fleet-bfloat16"]
    env: str
    hidden: int
    batch: int
    first_task: int
    tasks: int


class _Stop(BaseCallback):
    """Ends a learning at a time, counting from when updates began."""

    def __init__(self) -> None:
        super().__init__()
        self.until = 0.0

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        if time.perf_counter() >= self.until:
            raise StopIteration


def alone(side: Side) -> Any:
    """Stable-Baselines3's SAC, or SBX's, of one task."""
    env_id = meta_envs.resolve(side.env).id
    env = gymnasium.make(env_id, task=side.first_task, disable_env_checker=True)
    settings: dict[str, Any] = {
        "learning_starts": RANDOM_STEPS,
        "batch_size": side.batch,
        "train_freq": UPDATE_EVERY,
        "gradient_steps": UPDATE_EVERY,
        "buffer_size": MEMORY,
        "seed": 0,
        "policy_kwargs": {"net_arch": [side.hidden, side.hidden]},
    }
    if side.engine == "sbx":
        # By name, because this project does not need it.
        sbx = importlib.import_module("sbx")
        return sbx.SAC("MlpPolicy", env, **settings)
    import torch
    from stable_baselines3 import SAC

    torch.set_num_threads(1)
    settings["policy_kwargs"]["optimizer_kwargs"] = {"fused": True}
    return SAC("MlpPolicy", env, device="cpu", **settings)


def fleet(side: Side) -> Any:
    """A fleet of several tasks."""
    import torch

    from datagen.budgets import Precision, SACSettings
    from datagen.fleet.algorithm import FleetSAC
    from datagen.fleet.vec_env import FleetVecEnv

    torch.set_num_threads(1)
    layers = (side.hidden, side.hidden)
    settings = SACSettings(layers, 3e-4, side.batch, 0.99, 0.005, UPDATE_EVERY, 1.0)
    rows = [side.first_task + row for row in range(side.tasks)]
    precision: Precision = "float32" if side.engine == "fleet-float32" else "bfloat16"
    env = FleetVecEnv(side.env, rows)
    return FleetSAC(env, settings, rows, MEMORY, RANDOM_STEPS, precision)


def _learn(model: Any, seconds: float) -> float:
    """Task-updates a second."""
    stop, before = _Stop(), model._n_updates
    begin = time.perf_counter()
    stop.until = begin + seconds
    with suppress(StopIteration):
        model.learn(10**9, stop, log_interval=10**9, reset_num_timesteps=False)
    return float((model._n_updates - before) * model.n_envs / (time.perf_counter() - begin))


def _answer(line: str, learn: Callable[[float], float]) -> None:
    sys.stdout.write(f"{learn(float(line))}\n")
    sys.stdout.flush()


def main() -> None:
    """Set up, say so, and answer until the input ends."""
    side = tyro.cli(Side)
    model = fleet(side) if side.engine.startswith("fleet") else alone(side)
    model.set_logger(Logger(folder=None, output_formats=[]))
    # Through the random steps and the first updates, which are slow.
    model.learn((RANDOM_STEPS + 3 * UPDATE_EVERY) * model.n_envs, log_interval=10**9)
    _answer("0.2", lambda seconds: _learn(model, seconds))
    for line in sys.stdin:
        _answer(line, lambda seconds: _learn(model, seconds))


if __name__ == "__main__":
    main()
