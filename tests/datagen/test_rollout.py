"""Rollouts: every column against an independent calculation, also where episodes end early."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from datagen.columns import check_columns
from datagen.rollout import Columns, Floats32, episode_returns, join, rollout
from meta_envs import ENVIRONMENTS, task_set
from tests.meta_envs.noisy_robot import EDGE, ROW
from tests.meta_envs.robots import POINT_ROBOTS

EPISODES = 7


def to_the_right(obs: Floats32) -> tuple[Floats32, Floats32]:
    """Leans to the right and away from y = 0, with noise of standard deviation 0.5."""
    mean = np.stack([np.full(len(obs), 0.6), obs[:, 1]], axis=1).astype(np.float32)
    return mean, np.full_like(mean, np.log(0.5))


def roll(env: str, task: int = 3, seed: int | None = 5) -> Columns:
    generator = None if seed is None else np.random.default_rng(seed)
    return rollout(env, task, to_the_right, 400, EPISODES, generator)


def distances(columns: Columns, goal: NDArray[np.float64]) -> NDArray[np.float64]:
    x, y = (columns["next_observations"].astype(np.float64) - goal).T
    return np.asarray(np.hypot(x, y))


@pytest.mark.parametrize("env", POINT_ROBOTS)
def test_columns_keep_the_formats_promises(env: str) -> None:
    columns = roll(env)
    check_columns(columns, 2, 2, env.startswith("sparse"))
    horizon = ENVIRONMENTS[env].horizon
    assert len(columns["rewards"]) == EPISODES * horizon
    assert (columns["checkpoint"] == 400).all()
    assert not columns["terminals"].any()
    assert np.flatnonzero(columns["timeouts"]).tolist() == [
        horizon * (n + 1) - 1 for n in range(EPISODES)
    ]


def test_wind_moves_the_robot_and_the_reward_is_the_distance() -> None:
    wind = task_set("point_robot_wind").params[3]
    columns = roll("point_robot_wind")
    moved = columns["observations"] + 0.1 * columns["actions"] + wind
    np.testing.assert_allclose(columns["next_observations"], moved, atol=1e-6)
    wanted = -distances(columns, np.array([1.0, 0.0]))
    np.testing.assert_allclose(columns["rewards"], wanted, atol=1e-6)
    assert (columns["observations"][::25] == 0).all()


def test_sparse_and_dense_rewards_have_a_column_each() -> None:
    columns = roll("sparse_point_robot", task=0)  # its goal, (1, 0), is to the right
    away = distances(columns, task_set("sparse_point_robot").params[0])
    np.testing.assert_allclose(columns["dense_rewards"], -away, atol=1e-6)
    wanted = np.where(away < 0.2, 1.0 - away / 0.2, 0.0)
    np.testing.assert_allclose(columns["rewards"], wanted, atol=1e-5)
    assert (columns["rewards"] > 0).any(), "the episodes must reach the goal for this test"
    assert "dense_rewards" not in roll("point_robot")


def test_actions_are_the_policys_with_the_generators_noise() -> None:
    columns = roll("point_robot")
    generator = np.random.default_rng(5)
    generator.integers(2**31, size=EPISODES)  # the reset seeds
    noise = np.stack(
        [generator.standard_normal((EPISODES, 2), dtype=np.float32) for _ in range(20)], axis=1
    )
    mean, _ = to_the_right(columns["observations"])
    wanted = np.tanh(mean + 0.5 * noise.reshape(-1, 2))
    np.testing.assert_allclose(columns["actions"], wanted, atol=1e-6)


def test_without_a_generator_the_mean_acts() -> None:
    columns = roll("point_robot", seed=None)
    mean, _ = to_the_right(columns["observations"])
    np.testing.assert_array_equal(columns["actions"], np.tanh(mean))


def test_the_same_generator_gives_the_same_bytes_and_another_one_others() -> None:
    one, same, other = roll("point_robot"), roll("point_robot"), roll("point_robot", seed=6)
    assert all(one[name].tobytes() == same[name].tobytes() for name in one)
    assert not np.array_equal(one["actions"], other["actions"])


def test_episodes_of_different_lengths(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(ENVIRONMENTS, ROW.name, ROW)
    columns = roll(ROW.name)
    check_columns(columns, 2, 2, sparse=False)
    lengths = np.bincount(columns["episode"])
    assert len(lengths) == EPISODES
    assert lengths.min() < lengths.max() == ROW.horizon
    ends = np.cumsum(lengths) - 1
    past = columns["next_observations"][:, 0] > EDGE
    assert columns["terminals"].any()
    np.testing.assert_array_equal(columns["terminals"], past)
    at_limit = np.zeros(len(past), dtype=bool)
    at_limit[ends[lengths == ROW.horizon]] = True
    np.testing.assert_array_equal(columns["timeouts"], at_limit & ~past)
    # Every episode starts where its own reset put it, never where another one ended.
    starts = columns["observations"][np.append(0, ends[:-1] + 1)]
    assert (np.abs(starts) <= 0.1).all()
    assert len(np.unique(starts[:, 0])) == EPISODES
    goal = task_set(ROW.name).params[3]
    np.testing.assert_allclose(columns["rewards"], -distances(columns, goal), atol=1e-6)


def test_join_numbers_the_episodes_through() -> None:
    one = rollout("point_robot", 0, to_the_right, 200, 2, np.random.default_rng(0))
    two = rollout("point_robot", 0, to_the_right, 400, 3, np.random.default_rng(1))
    both = join([one, two])
    check_columns(both, 2, 2, sparse=False)
    assert both["episode"].tolist() == [n for n in range(5) for _ in range(20)]
    assert both["checkpoint"].tolist() == [200] * 40 + [400] * 60
    np.testing.assert_array_equal(both["rewards"][40:], two["rewards"])
    assert two["episode"][0] == 0, "the parts stay as they are"


def test_returns_are_the_sums_of_the_stored_rewards() -> None:
    columns = roll("point_robot")
    wanted = columns["rewards"].reshape(EPISODES, 20).astype(np.float64).sum(axis=1)
    np.testing.assert_allclose(episode_returns(columns), wanted, rtol=1e-12)
