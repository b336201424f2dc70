"""Hopper and walker whose physical parameters differ from task to task."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray

from meta_envs.definition import Floats, Terms
from meta_envs.mujoco_robot import BEYOND, MujocoRobot, sum_of_squares
from meta_envs.tasks import TaskSet, interleaved_test_tasks

SEED = 1234
"""Of the stream the field draws its tasks from."""
SPREAD = 3.0
"""A multiplier is its base to a power that is uniform between -3 and 3."""
LEAST_MASS, MOST = 0.01, 100.0
"""Bounds of multipliers a user may ask for; damping and friction may be 0."""
FASTEST = 10.0
"""Velocities are clipped to this in observations, rad/s and m/s."""
CONTROL_WEIGHT = 0.001


@dataclass(frozen=True)
class Build:
    """How a robot is built and when it has fallen.

    Attributes:
        bodies: names of its bodies, the world first.
        dofs: names of its degrees of freedom.
        geoms: names of its geoms, the floor first.
        heights: between which it stands, metres, both excluded.
        lean: largest angle at which it stands, radians, excluded.
        largest: what positions from the angle on, and velocities, must stay below.
    """

    bodies: tuple[str, ...]
    dofs: tuple[str, ...]
    geoms: tuple[str, ...]
    heights: tuple[float, float]
    lean: float
    largest: float

    @property
    def blocks(self) -> dict[str, tuple[float, tuple[str, ...]]]:
        """Randomised fields of the model, in the order of the draws: base and names."""
        sides = ("x", "y", "z")
        kinds = ("sliding", "torsional", "rolling")
        return {
            "body_mass": (1.5, self.bodies),
            "body_inertia": (1.5, tuple(f"{one}_{side}" for one in self.bodies for side in sides)),
            "dof_damping": (1.3, self.dofs),
            "geom_friction": (1.5, tuple(f"{one}_{kind}" for one in self.geoms for kind in kinds)),
        }


_ROOT = ("rootx", "rootz", "rooty")
_LEG = ("thigh", "leg", "foot")
_LEGS = (*_LEG, *(f"{part}_left" for part in _LEG))

HOPPER = Build(
    bodies=("world", "torso", *_LEG),
    dofs=(*_ROOT, *(f"{part}_joint" for part in _LEG)),
    geoms=("floor", "torso", *_LEG),
    heights=(0.7, np.inf),
    lean=0.2,
    largest=100.0,
)
WALKER = Build(
    bodies=("world", "torso", *_LEGS),
    dofs=(*_ROOT, *(f"{part}_joint" for part in _LEGS)),
    geoms=("floor", "torso", *_LEGS),
    heights=(0.8, 2.0),
    lean=1.0,
    largest=np.inf,
)


class HopperRandParams(MujocoRobot):
    """Hop forwards with masses, inertias, damping and friction unlike any other task's.

    The task is a multiplier of every element of the four fields, params as `Build.blocks` names
    them, such as body_mass_torso. Reward is the velocity plus 1 minus a cost of the action. The
    observation is all positions but the first, and the velocities, clipped. An episode ends in a
    fall.
    """

    name: ClassVar[str] = "hopper_params"
    build: ClassVar[Build] = HOPPER
    file: ClassVar[str] = "hopper.xml"
    timestep: ClassVar[float] = 0.004
    frame_skip: ClassVar[int] = 4
    nq: ClassVar[int] = 6
    nv: ClassVar[int] = 6
    nu: ClassVar[int] = 3
    observation_size: ClassVar[int] = 11

    def _observation_space(self) -> Box[np.float32]:
        high = np.full(self.observation_size, FASTEST, dtype=np.float32)
        high[: self.nq - 1] = BEYOND
        return Box(-high, high, dtype=np.float32)

    @property
    def param_names(self) -> tuple[str, ...]:
        """What each multiplier is of."""
        blocks = self.build.blocks
        return tuple(f"{field}_{one}" for field, (_, names) in blocks.items() for one in names)

    @property
    def _bases(self) -> Floats:
        return np.concatenate(
            [np.full(len(names), base) for base, names in self.build.blocks.values()]
        )

    def tasks(self) -> TaskSet:
        """40 tasks, drawn one after the other from the field's stream."""
        # The field's published table comes from this legacy stream, so it cannot be a Generator.
        stream = np.random.RandomState(SEED)
        powers = stream.uniform(-SPREAD, SPREAD, (40, len(self._bases)))
        multipliers = self._bases**powers
        return TaskSet(
            self.name,
            self.param_names,
            multipliers,
            interleaved_test_tasks(30, 10),
            self._sample,
            bounds=self._bounds(),
        )

    def _bounds(self) -> dict[str, tuple[float, float]]:
        """Multipliers with which MuJoCo can simulate the robot."""
        return {
            name: (LEAST_MASS if name.startswith(("body_mass", "body_inertia")) else 0.0, MOST)
            for name in self.param_names
        }

    def _sample(self, generator: np.random.Generator, n_tasks: int) -> Floats:
        powers: Floats = generator.uniform(-SPREAD, SPREAD, (n_tasks, len(self._bases)))
        return self._bases**powers

    def fields(self, params: Floats) -> Mapping[str, Floats]:
        """The nominal fields times the task's multipliers; nothing that MuJoCo derived of them."""
        found, start = {}, 0
        for name, (_, names) in self.build.blocks.items():
            nominal = getattr(self.model, name)
            multipliers = params[:, start : start + len(names)]
            found[name] = nominal * multipliers.reshape(len(params), *nominal.shape)
            start += len(names)
        return found

    def draw_noise(self, generator: np.random.Generator) -> Floats:
        """Gymnasium's: uniform positions and velocities."""
        return generator.uniform(-5e-3, 5e-3, self.nq + self.nv)

    def observe(self, state: Floats) -> NDArray[np.float32]:
        """Positions but the first, and velocities within -10 to 10."""
        obs = state[:, 1 : self.nq + self.nv].astype(np.float32)
        velocities = obs[:, self.nq - 1 :]
        np.clip(velocities, -FASTEST, FASTEST, out=velocities)
        return obs

    def reward(
        self, state: Floats, action: Floats, next_state: Floats, params: Floats
    ) -> tuple[Floats, Terms]:
        """The velocity, plus 1, minus 0.001 |a|^2."""
        forward = (next_state[:, 0] - state[:, 0]) / self.dt
        alive = np.ones(len(state))
        cost = -CONTROL_WEIGHT * sum_of_squares(action)
        return forward + alive + cost, {
            "reward_forward": forward,
            "reward_alive": alive,
            "reward_control": cost,
        }

    def terminated(self, state: Floats) -> NDArray[np.bool_]:
        """Where the robot has fallen or moves too fast, or a number is not finite."""
        low, high = self.build.heights
        height, angle = state[:, 1], state[:, 2]
        # Of a number that is not finite, every comparison is False.
        stands = (height > low) & (height < high) & (np.abs(angle) < self.build.lean)
        largest = np.maximum.reduce(np.abs(state[:, 2 : self.nq + self.nv]), axis=1)
        stands &= (largest < self.build.largest) & np.isfinite(state[:, 0])
        return ~stands


class WalkerRandParams(HopperRandParams):
    """Walk forwards with masses, inertias, damping and friction unlike any other task's."""

    name: ClassVar[str] = "walker_params"
    build: ClassVar[Build] = WALKER
    file: ClassVar[str] = "walker2d.xml"
    nq: ClassVar[int] = 9
    nv: ClassVar[int] = 9
    nu: ClassVar[int] = 6
    observation_size: ClassVar[int] = 17
