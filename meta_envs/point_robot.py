"""The three point robots: a point in the plane that moves by a tenth of its action a step."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray

from meta_envs.definition import Definition, Floats, Terms
from meta_envs.draw import draw_point_robot
from meta_envs.tasks import TaskSet, interleaved_test_tasks

SPEED = 0.1
"""Distance an action of 1 moves the robot in one step, on each axis."""
GOAL_RADIUS = 0.2
"""Within this distance of the goal a step counts as a success."""
MAX_WIND = 0.05
"""Largest wind on each axis, distance a step."""
WIND_GOAL = np.array([[1.0, 0.0]])
"""Goal of every task with wind, [1, 2]."""
WIND_GOAL.setflags(write=False)


def _sample_goals(generator: np.random.Generator, n_tasks: int) -> Floats:
    return _on_half_circle(generator.uniform(0.0, np.pi, n_tasks))


def _on_half_circle(angles: Floats) -> Floats:
    return np.stack([np.cos(angles), np.sin(angles)], axis=1)


def _sample_winds(generator: np.random.Generator, n_tasks: int) -> Floats:
    return generator.uniform(-MAX_WIND, MAX_WIND, (n_tasks, 2))


class PointRobot(Definition):
    """Reach a goal on the unit half circle: reward is minus the distance to it.

    State and observation are the position (x, y); the task is the goal, params (goal_x, goal_y).
    Every episode starts at the origin; none terminates.
    """

    name: ClassVar[str] = "point_robot"
    horizon: ClassVar[int] = 20
    n_train: ClassVar[int] = 80
    n_test: ClassVar[int] = 20
    param_names: ClassVar[tuple[str, ...]] = ("goal_x", "goal_y")
    max_wind: ClassVar[float] = 0.0

    def __init__(self) -> None:
        """Set up the spaces: the farthest a robot can get within the horizon bounds them."""
        reach = np.float32(self.horizon * (SPEED + self.max_wind))
        self.observation_space = Box(-reach, reach, (2,), np.float32)
        self.action_space = Box(-1.0, 1.0, (2,), np.float32)
        self.controllers = {"oracle": self.oracle}

    def tasks(self) -> TaskSet:
        """Goals at equal angles over the half circle, both ends included."""
        goals = _on_half_circle(np.linspace(0.0, np.pi, self.n_train + self.n_test))
        return self._task_set(goals)

    def _task_set(self, params: Floats) -> TaskSet:
        test_tasks = interleaved_test_tasks(self.n_train, self.n_test)
        sampler = _sample_winds if self.max_wind else _sample_goals
        return TaskSet(self.name, self.param_names, params, test_tasks, sampler)

    def goal(self, params: Floats) -> Floats:
        """Goals of tasks [n, P]: [n, 2], or [1, 2] if it is one goal for all."""
        return params

    def wind(self, params: Floats) -> Floats | None:
        """Winds [n, 2] of tasks [n, P], distance a step; None in still air."""
        return None

    def initial_state(self, generators: Sequence[np.random.Generator]) -> Floats:
        """Every episode starts at the origin."""
        return np.zeros((len(generators), 2))

    def advance(self, state: Floats, action: Floats, params: Floats) -> Floats:
        """The position moves by 0.1 a + wind."""
        moved = SPEED * action
        moved += state
        wind = self.wind(params)
        return moved if wind is None else np.add(moved, wind, out=moved)

    def observe(self, state: Floats) -> NDArray[np.float32]:
        """The position."""
        return state.astype(np.float32)

    def _distance(self, state: Floats, params: Floats) -> Floats:
        goal = self.goal(params)
        # Not a norm or a dot product: those may round differently from one batch size to another.
        square = state[:, 0] - goal[:, 0]
        square *= square
        side = state[:, 1] - goal[:, 1]
        side *= side
        square += side
        return np.sqrt(square, out=square)

    def reward(
        self, state: Floats, action: Floats, next_state: Floats, params: Floats
    ) -> tuple[Floats, Terms]:
        """Minus the distance from the new position to the goal."""
        distance = self._distance(next_state, params)
        return -distance, {"distance": distance, "is_success": distance <= GOAL_RADIUS}

    def terminated(self, state: Floats) -> NDArray[np.bool_]:
        """Never."""
        return np.zeros(len(state), dtype=np.bool_)

    def oracle(self, state: Floats, params: Floats) -> Floats:
        """The exact optimum: each axis goes to the goal as fast as it can and stays there.

        The axes are independent and the wind is weaker than the robot, so this makes both
        coordinates of the offset, hence the distance, as small as can be at every step at once.
        """
        wind = self.wind(params)
        target = self.goal(params) if wind is None else self.goal(params) - wind
        return np.clip((target - state) / SPEED, -1.0, 1.0)

    def render(self, path: Floats, params: Floats) -> NDArray[np.uint8]:
        """Robot, path, goal with its success radius, and wind."""
        row = params[None]
        wind = self.wind(row)
        return draw_point_robot(
            path, self.goal(row)[0], GOAL_RADIUS, None if wind is None else wind[0]
        )


class PointRobotWind(PointRobot):
    """Reach (1, 0) against a wind that differs from task to task, params (wind_x, wind_y)."""

    name: ClassVar[str] = "point_robot_wind"
    horizon: ClassVar[int] = 25
    n_train: ClassVar[int] = 40
    n_test: ClassVar[int] = 10
    param_names: ClassVar[tuple[str, ...]] = ("wind_x", "wind_y")
    max_wind: ClassVar[float] = MAX_WIND

    def __init__(self) -> None:
        """Add the controller that ignores the wind."""
        super().__init__()
        self.controllers = {"oracle": self.oracle, "wind_blind": self.wind_blind}

    def tasks(self) -> TaskSet:
        """Winds uniform in a square: seed 1337, all x components first, then all y."""
        # The field's published table comes from this legacy stream, so it cannot be a Generator.
        stream = np.random.RandomState(1337)
        n_tasks = self.n_train + self.n_test
        x, y = (stream.uniform(-MAX_WIND, MAX_WIND, n_tasks) for _ in range(2))
        return self._task_set(np.stack([x, y], axis=1))

    def goal(self, params: Floats) -> Floats:
        """Always (1, 0)."""
        return WIND_GOAL

    def wind(self, params: Floats) -> Floats:
        """The task itself."""
        return params

    def wind_blind(self, state: Floats, params: Floats) -> Floats:
        """Track the goal from the position alone, as if the air were still."""
        return np.clip((self.goal(params) - state) / SPEED, -1.0, 1.0)


class SparsePointRobot(PointRobot):
    """PointRobot whose reward is 1 - distance / 0.2 within 0.2 of the goal and 0 elsewhere."""

    name: ClassVar[str] = "sparse_point_robot"
    sparse: ClassVar[bool] = True

    def reward(
        self, state: Floats, action: Floats, next_state: Floats, params: Floats
    ) -> tuple[Floats, Terms]:
        """The sparse reward; its terms hold the dense one."""
        dense, terms = super().reward(state, action, next_state, params)
        sparse = dense / GOAL_RADIUS
        sparse += 1.0
        return np.maximum(sparse, 0.0, out=sparse), {**terms, "dense_reward": dense}
