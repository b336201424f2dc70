"""Gymnasium's own MuJoCo environments, stepped beside ours from the same state and action."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from meta_envs.mujoco_robot import MujocoRobot
from meta_envs.registry import definition

Floats = NDArray[np.float64]


def robot_of(name: str) -> MujocoRobot:
    """The definition of an environment that runs on MuJoCo."""
    made = definition(name)
    assert isinstance(made, MujocoRobot)
    return made


@dataclass(frozen=True)
class Twin:
    """One step of both: our states and action, and what Gymnasium's own class made of them.

    Attributes:
        state: before the step, [1, S].
        next_state: after it, [1, S].
        action: from -1 to 1, [1, A].
        env: Gymnasium's environment after the step.
        result: what its step returned.
    """

    state: Floats
    next_state: Floats
    action: Floats
    env: Any
    result: tuple[Any, ...]


def twins(name: str, env_id: str, params: Floats, steps: int, **kwargs: Any) -> Iterator[Twin]:
    """Steps of random actions from one start of Gymnasium's, task [P], at our timestep."""
    robot = robot_of(name)
    env: Any = gymnasium.make(env_id, frame_skip=robot.frame_skip, **kwargs).unwrapped
    env.model.opt.timestep = robot.timestep
    simulation = robot.simulation(1)
    simulation.set_params(params[None])
    generator = np.random.default_rng(5)
    env.reset(seed=3)
    # Ours starts without the solver's warm start, which Gymnasium's reset leaves behind.
    env.data.qacc_warmstart[:] = 0.0
    state = robot.initial_state([np.random.default_rng(3)])
    strength = env.model.actuator_ctrlrange[:, 1]
    for _ in range(steps):
        action = generator.uniform(-1.0, 1.0, (1, robot.nu))
        next_state = simulation.step(state, action)
        yield Twin(state, next_state, action, env, env.step(strength * action[0]))
        state = next_state


def assert_same_state(robot: MujocoRobot, state: Floats, env: Any) -> None:
    """Positions, velocities and the warm start are equal in every bit."""
    expected = [env.data.qpos, env.data.qvel, env.data.qacc_warmstart]
    np.testing.assert_array_equal(state[0, : robot.nq + 2 * robot.nv], np.concatenate(expected))
