"""What all MuJoCo environments share: the model, the state's layout, the start, the picture."""

from __future__ import annotations

import copy
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, ClassVar, Self

import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray

from meta_envs.definition import Definition, Floats

if TYPE_CHECKING:
    import mujoco

    from meta_envs.render_mujoco import Marker
    from meta_envs.simulation import MujocoSimulation

BEYOND = 1e11
"""Bound of observations: MuJoCo starts a simulation afresh before it gets there."""


class MujocoRobot(Definition):
    """A robot of Gymnasium's in MuJoCo; subclasses add tasks, observation and reward.

    A state is a row of positions [nq], velocities [nv], the constraint solver's warm start [nv]
    and what is carried. MuJoCo is loaded when the first environment is made, not for its tasks.
    """

    horizon: ClassVar[int] = 200
    random_episodes: ClassVar[int] = 10
    file: ClassVar[str]
    """Gymnasium's model file."""
    timestep: ClassVar[float]
    """Of the integrator, seconds."""
    frame_skip: ClassVar[int]
    """Steps of the integrator in one step of the environment."""
    nq: ClassVar[int]
    nv: ClassVar[int]
    nu: ClassVar[int]
    """Number of positions, of velocities and of actuators."""
    observation_size: ClassVar[int]
    carried: ClassVar[tuple[str, ...]] = ()
    """Outputs of a step that states hold too, by their names in `mujoco.MjData`."""

    def __init__(self) -> None:
        """Set up the spaces and the controller that does nothing."""
        self.observation_space = self._observation_space()
        self.action_space = Box(-1.0, 1.0, (self.nu,), np.float32)
        self.controllers = {"still": self.still}
        self.render_fps = round(1 / self.dt)

    def __reduce__(self) -> tuple[type[Self], tuple[()]]:
        """Pickled by its class alone: everything else is made from that."""
        return type(self), ()

    def _observation_space(self) -> Box[np.float32]:
        return Box(-BEYOND, BEYOND, (self.observation_size,), np.float32)

    @property
    def dt(self) -> float:
        """Seconds of one step of the environment."""
        return self.timestep * self.frame_skip

    @cached_property
    def model(self) -> mujoco.MjModel:
        """The compiled model with nominal parameters; nothing writes to it."""
        from meta_envs.simulation import load_model

        return load_model(self.file, self.timestep)

    def fields(self, params: Floats) -> Mapping[str, Floats]:
        """Values [n, ...] of the model's fields on tasks [n, P]; none where all share the model."""
        return {}

    def task_model(self, params: Floats) -> mujoco.MjModel:
        """A copy of the model with the values of one task, params [P]."""
        model = copy.copy(self.model)
        for name, values in self.fields(params[None]).items():
            getattr(model, name)[...] = values[0]
        return model

    def simulation(self, num_envs: int, threads: int = 1) -> MujocoSimulation:
        """Simulations of this robot on native threads."""
        from meta_envs.simulation import MujocoSimulation

        return MujocoSimulation(self, num_envs, threads)

    def advance(self, state: Floats, action: Floats, params: Floats) -> Floats:
        """Next states [n, S], by simulations made for this call alone."""
        simulation = self.simulation(len(state))
        simulation.set_params(params)
        return simulation.step(state, action)

    @abstractmethod
    def draw_noise(self, generator: np.random.Generator) -> Floats:
        """What a start adds to the positions and velocities of the model at rest, [nq + nv]."""

    def initial_state(self, generators: Sequence[np.random.Generator]) -> Floats:
        """The model at rest, with noise, and no warm start."""
        state = np.zeros((len(generators), self.nq + 2 * self.nv))
        state[:, : self.nq] = self.model.qpos0
        state[:, : self.nq + self.nv] += [self.draw_noise(generator) for generator in generators]
        return state

    def still(self, state: Floats, params: Floats) -> Floats:
        """No force on any joint."""
        return np.zeros((len(state), self.nu))

    def terminated(self, state: Floats) -> NDArray[np.bool_]:
        """Never, unless a subclass says when."""
        return np.zeros(len(state), dtype=np.bool_)

    def markers(self, state: Floats, params: Floats) -> list[Marker]:
        """What a picture shows of the task beside the robot: one state [S], one task [P]."""
        return []

    def render(self, path: Floats, params: Floats) -> NDArray[np.uint8]:
        """The robot in its last state, and what its task asks for."""
        from meta_envs.render_mujoco import render

        last = path[-1]
        return render(self.task_model(params), last[: self.nq], self.markers(last, params))


def sum_of_squares(action: Floats) -> Floats:
    """Sum of the squares of each row, [n, A] -> [n]."""
    total: Floats = np.add.reduce(action * action, axis=1)
    return total
