"""Hopper and walker with one multiplier a task, of all masses or of all friction."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from meta_envs.definition import Floats
from meta_envs.rand_params import HopperRandParams, WalkerRandParams
from meta_envs.splits import outer_splits
from meta_envs.tasks import TaskSet, interleaved_test_tasks

BASE, POWER = 1.5, 2.0
"""A multiplier is the base to a power between -2 and 2."""


class HopperMass(HopperRandParams):
    """Hop forwards with all masses and inertias times one number, params (body_mass,)."""

    name: ClassVar[str] = "hopper_mass"
    timestep: ClassVar[float] = 0.002
    scaled: ClassVar[tuple[str, ...]] = ("body_mass", "body_inertia")
    """The fields of the model that the multiplier is of; the first one names the parameter."""

    @property
    def param_names(self) -> tuple[str, ...]:
        """The one field, or the first of those that go together."""
        return self.scaled[:1]

    def tasks(self) -> TaskSet:
        """40 multipliers from 1.5^-2 to 1.5^2, each the one before times the same number."""
        multipliers = BASE ** np.linspace(-POWER, POWER, 40)[:, None]
        return TaskSet(
            self.name,
            self.param_names,
            multipliers,
            interleaved_test_tasks(30, 10),
            self._sample,
            outer_splits(len(multipliers)),
            self._bounds(),
        )

    def _sample(self, generator: np.random.Generator, n_tasks: int) -> Floats:
        powers: Floats = generator.uniform(-POWER, POWER, (n_tasks, 1))
        return BASE**powers

    def fields(self, params: Floats) -> Mapping[str, Floats]:
        """The nominal fields times the task's multiplier; nothing that MuJoCo derived of them."""
        nominal = {name: getattr(self.model, name) for name in self.scaled}
        return {
            name: values * params.reshape(-1, *[1] * values.ndim)
            for name, values in nominal.items()
        }


class HopperFriction(HopperMass):
    """Hop forwards with all friction times one number, params (geom_friction,)."""

    name: ClassVar[str] = "hopper_friction"
    scaled: ClassVar[tuple[str, ...]] = ("geom_friction",)


class WalkerMass(HopperMass, WalkerRandParams):
    """Walk forwards with all masses and inertias times one number, params (body_mass,)."""

    name: ClassVar[str] = "walker_mass"
    frame_skip: ClassVar[int] = 5


class WalkerFriction(HopperFriction, WalkerRandParams):
    """Walk forwards with all friction times one number, params (geom_friction,)."""

    name: ClassVar[str] = "walker_friction"
    frame_skip: ClassVar[int] = 5
