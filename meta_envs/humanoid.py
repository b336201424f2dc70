"""The humanoid: walk in a direction."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from functools import cached_property
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from numpy.typing import NDArray

from meta_envs.definition import Floats, Terms
from meta_envs.directions import along, arrow, directions
from meta_envs.mujoco_robot import MujocoRobot, sum_of_squares
from meta_envs.tasks import TaskSet

if TYPE_CHECKING:
    import mujoco

    from meta_envs.render_mujoco import Marker

STRENGTH = 0.4
"""Control of an actuator at an action of 1."""
LOWEST, HIGHEST = 1.0, 2.0
"""Height of a healthy torso, metres."""
BODIES = 14


class HumanoidDir(MujocoRobot):
    """Walk in a direction: reward is the velocity that way, 5, and minus a cost of the action.

    The task is the direction, params (direction,), an angle in radians. The observation is the
    field's: positions but x and y, velocities, inertias and velocities of the bodies, forces of
    the actuators, and 84 zeros in the place of contact forces, which its engine did not fill.
    An episode ends where the torso is lower than 1 m or higher than 2 m.
    """

    name: ClassVar[str] = "humanoid_dir"
    file: ClassVar[str] = "humanoid.xml"
    timestep: ClassVar[float] = 0.003
    frame_skip: ClassVar[int] = 5
    nq: ClassVar[int] = 24
    nv: ClassVar[int] = 23
    nu: ClassVar[int] = 17
    observation_size: ClassVar[int] = 376
    carried: ClassVar[tuple[str, ...]] = ("cinert", "cvel", "qfrc_actuator", "subtree_com")

    def __init__(self) -> None:
        """Set up the layout of the state: its first column of each part."""
        super().__init__()
        self._carried_at = self.nq + 2 * self.nv
        self._center_at = self._carried_at + BODIES * (10 + 6) + self.nv
        self._lock = threading.Lock()

    @cached_property
    def _scratch(self) -> mujoco.MjData:
        import mujoco

        return mujoco.MjData(self.model)

    def tasks(self) -> TaskSet:
        """Directions at equal angles, all around."""
        return directions(self.name)

    def draw_noise(self, generator: np.random.Generator) -> Floats:
        """Gymnasium's: uniform positions and velocities."""
        return generator.uniform(-0.01, 0.01, self.nq + self.nv)

    def initial_state(self, generators: Sequence[np.random.Generator]) -> Floats:
        """The model at rest, with noise, no warm start, and what its bodies then do."""
        import mujoco

        start = super().initial_state(generators)
        state = np.zeros((len(start), self._center_at + 3 * BODIES))
        state[:, : self._carried_at] = start
        with self._lock:
            data = self._scratch
            for row in state:
                mujoco.mj_resetData(self.model, data)
                data.qpos[:] = row[: self.nq]
                data.qvel[:] = row[self.nq : self.nq + self.nv]
                mujoco.mj_forward(self.model, data)
                parts = [getattr(data, name).ravel() for name in self.carried]
                row[self._carried_at :] = np.concatenate(parts)
        return state

    def observe(self, state: Floats) -> NDArray[np.float32]:
        """Positions but x and y, velocities, what the bodies and actuators do, and zeros."""
        obs = np.zeros((len(state), self.observation_size), dtype=np.float32)
        moving = self.nq + self.nv
        obs[:, : moving - 2] = state[:, 2:moving]
        seen = self._center_at - self._carried_at
        obs[:, moving - 2 : moving - 2 + seen] = state[:, self._carried_at : self._center_at]
        return obs

    def reward(
        self, state: Floats, action: Floats, next_state: Floats, params: Floats
    ) -> tuple[Floats, Terms]:
        """0.25 (way of the centre of mass in the direction) / 0.003 + 5 - 0.1 |control|^2."""
        # Of the subtree of the torso, which is the whole robot.
        center = slice(self._center_at + 3, self._center_at + 5)
        moved = next_state[:, center] - state[:, center]
        # The field divides the way of a whole step by the integrator's, five times smaller.
        forward = 0.25 * along(params[:, 0], moved) / self.timestep
        alive = np.full(len(state), 5.0)
        cost = -0.1 * sum_of_squares(STRENGTH * action)
        return forward + alive + cost, {
            "reward_forward": forward,
            "reward_alive": alive,
            "reward_control": cost,
        }

    def terminated(self, state: Floats) -> NDArray[np.bool_]:
        """Where the torso is too low or too high."""
        height = state[:, 2]
        # Not its negation, of which a height that is not a number would be false too.
        return ~((height >= LOWEST) & (height <= HIGHEST))

    def markers(self, state: Floats, params: Floats) -> list[Marker]:
        """The direction."""
        return [arrow(float(params[0]))]
