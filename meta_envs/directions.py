"""Directions in the plane, the tasks of robots that walk anywhere."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from meta_envs.definition import Floats
from meta_envs.splits import outer_splits
from meta_envs.tasks import TaskSet, interleaved_test_tasks

if TYPE_CHECKING:
    from meta_envs.render_mujoco import Marker


def circle(n_tasks: int) -> Floats:
    """Equal angles from 0 to 2 pi without the end, radians, [n_tasks]."""
    return np.linspace(0.0, 2.0 * np.pi, n_tasks + 1)[:-1]


def directions(env: str) -> TaskSet:
    """40 directions at equal angles, params (direction,) in radians."""
    rows, angles = interleaved_test_tasks(30, 10), circle(40)[:, None]
    return TaskSet(env, ("direction",), angles, rows, _sample, outer_splits(len(angles)))


def along(direction: Floats, moved: Floats) -> Floats:
    """Parts of movements [n, 2] along directions [n] in radians, [n]."""
    return np.asarray(np.cos(direction) * moved[:, 0] + np.sin(direction) * moved[:, 1])


def arrow(direction: float) -> Marker:
    """Marker of a direction in radians."""
    from meta_envs.render_mujoco import Marker

    return Marker("direction", vector=(float(np.cos(direction)), float(np.sin(direction)), 0.0))


def _sample(generator: np.random.Generator, n_tasks: int) -> Floats:
    return generator.uniform(0.0, 2.0 * np.pi, (n_tasks, 1))
