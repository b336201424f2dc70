"""Behaviour policies: their checkpoints, their reward, their repeatability."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from datagen.behavior import Policy, train_policies, training_environment
from datagen.budgets import budget
from datagen.rollout import episode_returns, rollout
from meta_envs import reference_returns, task_set

SMOKE = budget("point_robot_wind", "smoke")


@pytest.fixture(scope="module")
def policies() -> list[Policy]:
    return train_policies("point_robot_wind", 3, SMOKE, seed=1)


def weights(policy: Policy) -> list[bytes]:
    return [part.numpy().tobytes() for part in policy.actor.state_dict().values()]


def test_a_policy_for_each_checkpoint_each_with_more_training(policies: list[Policy]) -> None:
    assert [policy.checkpoint for policy in policies] == [80, 100]
    assert weights(policies[0]) != weights(policies[1])
    assert torch.get_num_threads() == 1


def test_the_seed_decides_everything(policies: list[Policy]) -> None:
    np.random.default_rng(0).normal(size=3)
    torch.rand(3)
    again = train_policies("point_robot_wind", 3, SMOKE, seed=1)
    assert [weights(one) for one in again] == [weights(one) for one in policies]
    other = train_policies("point_robot_wind", 3, SMOKE, seed=2)
    assert weights(other[0]) != weights(policies[0])


def test_a_policy_is_the_actors_distribution(policies: list[Policy]) -> None:
    obs = np.array([[0.0, 0.0], [0.5, -0.2], [1.0, 0.3]], dtype=np.float32)
    mean, log_std = policies[-1](obs)
    assert mean.shape == log_std.shape == (3, 2)
    assert mean.dtype == log_std.dtype == np.float32
    predicted = policies[-1].actor(torch.as_tensor(obs), deterministic=True).detach().numpy()
    np.testing.assert_allclose(np.tanh(mean), predicted, atol=1e-6)


def test_no_temporary_file_is_left(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    train_policies("point_robot_wind", 0, SMOKE, seed=0)
    assert list(tmp_path.iterdir()) == []


def test_progress_is_reported() -> None:
    steps: list[int] = []
    train_policies("point_robot_wind", 0, SMOKE, seed=0, report=steps.append)
    assert steps == [50, 100]


def test_the_sparse_environment_pays_its_dense_reward() -> None:
    env = training_environment("sparse_point_robot", 5)
    goal = task_set("sparse_point_robot").params[5]
    env.reset(seed=0)
    for step in range(1, 21):
        obs, reward, terminated, truncated, _ = env.step(np.array([0.3, 0.9], np.float32))
        assert reward == pytest.approx(-np.linalg.norm(obs - goal), abs=1e-6)
        assert not terminated
        assert truncated == (step == 20)


def test_training_environment_is_on_the_task() -> None:
    env = training_environment("point_robot_wind", 7)
    env.reset(seed=0)
    obs, *_ = env.step(np.zeros(2, np.float32))
    np.testing.assert_allclose(obs, task_set("point_robot_wind").params[7], atol=1e-7)


@pytest.mark.slow
def test_the_paper_budget_ends_near_the_optimum_and_starts_far_from_it() -> None:
    paper = budget("point_robot_wind", "paper")
    returns = []
    for policy in train_policies("point_robot_wind", 3, paper, seed=0):
        columns = rollout("point_robot_wind", 3, policy, 0, 50, np.random.default_rng(0))
        returns.append(episode_returns(columns).mean())
    oracle = reference_returns(task_set("point_robot_wind"), episodes=1)["oracle"][3]
    assert returns[0] < oracle - 5
    assert oracle - 1.5 < returns[-1] < oracle


def test_steps_after_the_last_checkpoint_leave_no_trace() -> None:
    longer = replace(SMOKE, steps=2 * SMOKE.steps)
    one, other = (train_policies("point_robot", 0, row, seed=3)[-1] for row in (SMOKE, longer))
    assert weights(one) == weights(other)
