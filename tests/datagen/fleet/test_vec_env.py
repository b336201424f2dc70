"""The vector environment: step by step what Stable-Baselines3's own makes of the same tasks."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

from datagen.behavior import training_environment
from datagen.fleet.vec_env import FleetVecEnv

TASKS = (4, 0, 7)


def dummy(env: str) -> DummyVecEnv:
    """One environment a task, as the reference engine trains in, with episodes added up."""
    return DummyVecEnv([partial(_monitored, env, task) for task in TASKS])


def _monitored(env: str, task: int) -> Monitor[Any, Any]:
    return Monitor(training_environment(env, task))


def actions(many: FleetVecEnv, steps: int) -> NDArray[np.float32]:
    acts = many.action_space.shape
    assert acts is not None
    shape = (steps, many.num_envs, *acts)
    drawn = np.random.default_rng(0).uniform(-1.0, 1.0, shape)
    return drawn.astype(np.float32)


def same_end(ours: dict[str, Any], theirs: dict[str, Any], task: int) -> None:
    """What is said of a step that ended an episode."""
    assert ours["TimeLimit.truncated"] == theirs["TimeLimit.truncated"]
    np.testing.assert_array_equal(ours["terminal_observation"], theirs["terminal_observation"])
    assert ours["terminal_observation"].dtype == np.float32
    assert ours["episode"]["l"] == theirs["episode"]["l"]
    # The monitor rounds to six digits.
    assert ours["episode"]["r"] == pytest.approx(theirs["episode"]["r"], abs=1e-5)
    assert ours["episode"]["task"] == task


@pytest.mark.parametrize(
    ("env", "steps", "ends"),
    [
        ("point_robot_wind", 60, {True}),
        ("half_cheetah_vel", 210, {True}),
        # Its reward is the dense one; hoppers fall long before their time is up.
        ("sparse_point_robot", 45, {True}),
        ("hopper_params", 200, {False}),
    ],
)
def test_it_is_stable_baselines3s_step_by_step(env: str, steps: int, ends: set[bool]) -> None:
    ours, theirs = FleetVecEnv(env, TASKS), dummy(env)
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    ours.seed(5)
    theirs.seed(5)
    np.testing.assert_array_equal(ours.reset(), theirs.reset())
    seen = set()
    for action in actions(ours, steps):
        obs, reward, done, infos = ours.step(action)
        their_obs, their_reward, their_done, their_infos = theirs.step(action)
        assert isinstance(obs, np.ndarray)
        np.testing.assert_array_equal(obs, their_obs)
        np.testing.assert_array_equal(reward, their_reward)
        np.testing.assert_array_equal(done, their_done)
        assert obs.dtype == reward.dtype == np.float32
        assert done.dtype == np.bool_
        for row, over in enumerate(done):
            if over:
                same_end(infos[row], their_infos[row], TASKS[row])
                seen.add(infos[row]["TimeLimit.truncated"])
            else:
                assert infos[row] == {}
    assert seen == ends
    # Reset without seeds, each goes on with its random stream.
    np.testing.assert_array_equal(ours.reset(), theirs.reset())


def test_seeds_are_used_once_and_each_is_a_tasks_own() -> None:
    one, other = FleetVecEnv("hopper_params", (1, 2)), FleetVecEnv("hopper_params", (1, 2))
    one.seed(8)
    other.seed_tasks([8, 9])
    first = one.reset()
    np.testing.assert_array_equal(first, other.reset())
    again = one.reset()
    np.testing.assert_array_equal(again, other.reset())
    assert not np.array_equal(first, again)
    other.seed_tasks([8, 30])
    third = other.reset()
    np.testing.assert_array_equal(third[0], first[0])
    assert not np.array_equal(third[1], first[1])


def test_a_reset_in_the_middle_begins_the_sums_anew() -> None:
    env = FleetVecEnv("point_robot_wind", (0, 1))
    env.reset()
    for action in actions(env, 10):
        env.step(action)
    env.reset()
    total = np.zeros(2)
    for action in actions(env, 25):
        _, reward, done, infos = env.step(action)
        total += reward
    assert done.all()
    assert [info["episode"]["l"] for info in infos] == [25, 25]
    assert [info["episode"]["r"] for info in infos] == pytest.approx(total.tolist(), rel=1e-5)


def test_it_answers_what_stable_baselines3_asks() -> None:
    env = FleetVecEnv("point_robot_wind", (0, 1, 2))
    assert env.num_envs == 3
    assert env.render_mode is None
    assert env.get_attr("horizon") == [25, 25, 25]
    assert env.get_attr("horizon", [0, 2]) == [25, 25]
    assert env.env_is_wrapped(Monitor) == [False] * 3
    assert env.env_is_wrapped(Monitor, 1) == [False]
    with pytest.raises(AttributeError, match="no wind to set"):
        env.set_attr("wind", 1.0)
    with pytest.raises(AttributeError, match="have no method jump"):
        env.env_method("jump")
    assert env.seed(3) == [3, 4, 5]
    assert env.seed() == [3, 4, 5]
    env.reset()
    assert env.seed() == [None] * 3
    env.close()
