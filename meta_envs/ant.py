"""The ant: walk to a goal, or in a direction."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import numpy as np
from numpy.typing import NDArray

from meta_envs.definition import Floats, Terms
from meta_envs.directions import along, arrow, circle, directions
from meta_envs.mujoco_robot import MujocoRobot, sum_of_squares
from meta_envs.tasks import TaskSet, interleaved_test_tasks

if TYPE_CHECKING:
    from meta_envs.render_mujoco import Marker

GOAL_DISTANCE = 2.0
"""Radius of the circle of goals, metres."""
GOAL_RADIUS = 0.2
"""Within this distance of the goal a step counts as a success, metres."""
LOWEST, HIGHEST = 0.2, 1.0
"""Height of a healthy torso, metres."""


class AntGoal(MujocoRobot):
    """Walk to a goal: reward is minus the L1 distance to it, minus a cost of the action.

    The task is the goal, params (goal_x, goal_y) in metres. The observation is all positions and
    velocities. No episode terminates.
    """

    name: ClassVar[str] = "ant_goal"
    file: ClassVar[str] = "ant.xml"
    timestep: ClassVar[float] = 0.01
    frame_skip: ClassVar[int] = 5
    nq: ClassVar[int] = 15
    nv: ClassVar[int] = 14
    nu: ClassVar[int] = 8
    observation_size: ClassVar[int] = 29

    def tasks(self) -> TaskSet:
        """Goals at equal angles around the circle of radius 2."""
        goals = _on_circle(circle(40))
        test_tasks = interleaved_test_tasks(30, 10)
        return TaskSet(self.name, ("goal_x", "goal_y"), goals, test_tasks, _sample_goals)

    def draw_noise(self, generator: np.random.Generator) -> Floats:
        """Gymnasium's: uniform positions, normal velocities."""
        positions = generator.uniform(-0.1, 0.1, self.nq)
        return np.concatenate([positions, 0.1 * generator.standard_normal(self.nv)])

    def observe(self, state: Floats) -> NDArray[np.float32]:
        """Positions and velocities."""
        return state[:, :29].astype(np.float32)

    def reward(
        self, state: Floats, action: Floats, next_state: Floats, params: Floats
    ) -> tuple[Floats, Terms]:
        """Minus |x - goal_x| + |y - goal_y|, minus 0.1 |a|^2."""
        aside, ahead = (
            np.abs(next_state[:, 0] - params[:, 0]),
            np.abs(next_state[:, 1] - params[:, 1]),
        )
        near = -(aside + ahead)
        cost = -0.1 * sum_of_squares(action)
        distance = np.sqrt(aside * aside + ahead * ahead)
        return near + cost, {
            "distance": distance,
            "is_success": distance <= GOAL_RADIUS,
            "reward_goal": near,
            "reward_control": cost,
        }

    def markers(self, state: Floats, params: Floats) -> list[Marker]:
        """The goal."""
        from meta_envs.render_mujoco import Marker

        return [Marker("goal", (float(params[0]), float(params[1]), 0.0))]


class AntDir(AntGoal):
    """Walk in a direction: reward is the velocity that way, 1, and minus a cost of the action.

    The task is the direction, params (direction,), an angle in radians. The observation has no x
    and y. An episode ends where the torso is lower than 0.2 m or higher than 1 m.
    """

    name: ClassVar[str] = "ant_dir"
    observation_size: ClassVar[int] = 27

    def tasks(self) -> TaskSet:
        """Directions at equal angles, all around."""
        return directions(self.name)

    def observe(self, state: Floats) -> NDArray[np.float32]:
        """Positions but x and y, and velocities."""
        return state[:, 2:29].astype(np.float32)

    def reward(
        self, state: Floats, action: Floats, next_state: Floats, params: Floats
    ) -> tuple[Floats, Terms]:
        """The velocity in the direction, plus 1, minus 0.5 |a|^2."""
        forward = along(params[:, 0], next_state[:, :2] - state[:, :2]) / self.dt
        alive = np.ones(len(state))
        cost = -0.5 * sum_of_squares(action)
        return forward + alive + cost, {
            "reward_forward": forward,
            "reward_alive": alive,
            "reward_control": cost,
        }

    def terminated(self, state: Floats) -> NDArray[np.bool_]:
        """Where the torso is too low or too high, or a number is not finite."""
        height = state[:, 2]
        return ~((height >= LOWEST) & (height <= HIGHEST) & np.isfinite(state[:, :29]).all(axis=1))

    def markers(self, state: Floats, params: Floats) -> list[Marker]:
        """The direction."""
        return [arrow(float(params[0]))]


def _on_circle(angles: Floats) -> Floats:
    return GOAL_DISTANCE * np.stack([np.cos(angles), np.sin(angles)], axis=1)


def _sample_goals(generator: np.random.Generator, n_tasks: int) -> Floats:
    return _on_circle(generator.uniform(0.0, 2.0 * np.pi, n_tasks))
