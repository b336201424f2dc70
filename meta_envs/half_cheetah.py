"""The half-cheetah: run at a velocity, or in a direction."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import numpy as np
from numpy.typing import NDArray

from meta_envs.definition import Floats, Terms
from meta_envs.mujoco_robot import MujocoRobot, sum_of_squares
from meta_envs.splits import outer_splits
from meta_envs.tasks import DEFAULT_SPLIT, Split, TaskSet, interleaved_test_tasks

if TYPE_CHECKING:
    from meta_envs.render_mujoco import Marker

TORSO_HEIGHT = 0.7
"""Height of the torso where its position is 0, metres."""
CONTROL_WEIGHT = 0.05
SLOWEST, FASTEST = 1.0, 3.0
"""Range of target velocities, m/s."""


class HalfCheetahVel(MujocoRobot):
    """Run at a target velocity: reward is minus the error, minus a cost of the action.

    The task is the target, params (target_velocity,) in m/s. The observation is all positions but
    the first, the velocities, and the torso's place in space. No episode terminates.
    """

    name: ClassVar[str] = "half_cheetah_vel"
    file: ClassVar[str] = "half_cheetah.xml"
    timestep: ClassVar[float] = 0.01
    frame_skip: ClassVar[int] = 5
    nq: ClassVar[int] = 9
    nv: ClassVar[int] = 9
    nu: ClassVar[int] = 6
    observation_size: ClassVar[int] = 20

    def tasks(self) -> TaskSet:
        """Target velocities at equal distances from 1 to 3 m/s, both included."""
        targets = np.linspace(SLOWEST, FASTEST, 100)[:, None]
        return TaskSet(
            self.name,
            ("target_velocity",),
            targets,
            interleaved_test_tasks(80, 20),
            _sample_velocities,
            outer_splits(len(targets)),
        )

    def draw_noise(self, generator: np.random.Generator) -> Floats:
        """Gymnasium's: uniform positions, normal velocities."""
        positions = generator.uniform(-0.1, 0.1, self.nq)
        return np.concatenate([positions, 0.1 * generator.standard_normal(self.nv)])

    def observe(self, state: Floats) -> NDArray[np.float32]:
        """Positions but the first, velocities, and the torso's x, y and z."""
        obs = np.empty((len(state), self.observation_size), dtype=np.float32)
        obs[:, :17] = state[:, 1:18]
        obs[:, 17] = state[:, 0]
        obs[:, 18] = 0.0
        obs[:, 19] = state[:, 1] + TORSO_HEIGHT
        return obs

    def velocity(self, state: Floats, next_state: Floats) -> Floats:
        """Mean velocity over a step, m/s, [n]."""
        return (next_state[:, 0] - state[:, 0]) / self.dt

    def reward(
        self, state: Floats, action: Floats, next_state: Floats, params: Floats
    ) -> tuple[Floats, Terms]:
        """Minus |v - target|, minus 0.05 |a|^2."""
        velocity = self.velocity(state, next_state)
        error = -np.abs(velocity - params[:, 0])
        cost = -CONTROL_WEIGHT * sum_of_squares(action)
        return error + cost, {
            "velocity": velocity,
            "reward_velocity": error,
            "reward_control": cost,
        }

    def markers(self, state: Floats, params: Floats) -> list[Marker]:
        """The target velocity."""
        from meta_envs.render_mujoco import Marker

        return [Marker("velocity", vector=(float(params[0]), 0.0, 0.0))]


class HalfCheetahDir(HalfCheetahVel):
    """Run forwards or backwards: reward is the velocity that way, minus a cost of the action.

    The task is the direction, params (direction,): -1 or 1.
    """

    name: ClassVar[str] = "half_cheetah_dir"

    def tasks(self) -> TaskSet:
        """Backwards, then forwards; both are training and test tasks."""
        both = np.arange(2)
        return TaskSet(
            self.name,
            ("direction",),
            np.array([[-1.0], [1.0]]),
            both,
            _sample_directions,
            {DEFAULT_SPLIT: Split(both, both)},
            choices={"direction": (-1.0, 1.0)},
        )

    def reward(
        self, state: Floats, action: Floats, next_state: Floats, params: Floats
    ) -> tuple[Floats, Terms]:
        """The velocity in the direction, minus 0.05 |a|^2."""
        velocity = self.velocity(state, next_state)
        forward = params[:, 0] * velocity
        cost = -CONTROL_WEIGHT * sum_of_squares(action)
        return forward + cost, {
            "velocity": velocity,
            "reward_forward": forward,
            "reward_control": cost,
        }

    def markers(self, state: Floats, params: Floats) -> list[Marker]:
        """The direction."""
        from meta_envs.render_mujoco import Marker

        return [Marker("direction", vector=(float(params[0]), 0.0, 0.0))]


def _sample_velocities(generator: np.random.Generator, n_tasks: int) -> Floats:
    return generator.uniform(SLOWEST, FASTEST, (n_tasks, 1))


def _sample_directions(generator: np.random.Generator, n_tasks: int) -> Floats:
    return generator.choice([-1.0, 1.0], (n_tasks, 1))
