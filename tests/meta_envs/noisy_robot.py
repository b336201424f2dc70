"""A definition with what the point robots lack: random starts and episodes that end early."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray

from meta_envs.definition import Floats
from meta_envs.point_robot import PointRobot
from meta_envs.registry import Row
from meta_envs.tasks import TaskSet

EDGE = 0.25


class NoisyRobot(PointRobot):
    """Starts anywhere in a small square and ends its episode to the right of EDGE."""

    name: ClassVar[str] = "noisy_robot"
    horizon: ClassVar[int] = 9

    def __init__(self) -> None:
        super().__init__()
        # It may start a tenth nearer to the edge than the origin is.
        self.observation_space = Box(-1.1, 1.1, (2,), np.float32)

    def tasks(self) -> TaskSet:
        goals = np.random.default_rng(5).uniform(-1.0, 1.0, (12, 2))
        return TaskSet(self.name, self.param_names, goals, np.arange(0, 12, 3), _sample)

    def initial_state(self, generators: Sequence[np.random.Generator]) -> Floats:
        return np.stack([generator.uniform(-0.1, 0.1, 2) for generator in generators])

    def terminated(self, state: Floats) -> NDArray[np.bool_]:
        return np.asarray(state[:, 0] > EDGE)


def _sample(generator: np.random.Generator, n_tasks: int) -> Floats:
    return generator.uniform(-1.0, 1.0, (n_tasks, 2))


ROW = Row(
    "noisy_robot",
    "NoisyRobot-v0",
    "noisy-robot",
    "tests.meta_envs.noisy_robot:NoisyRobot",
    NoisyRobot.horizon,
    "goal, for tests only",
)
