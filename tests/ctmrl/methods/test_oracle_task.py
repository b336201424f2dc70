"""oracle_task: its context is the true task, in training and in the meta-test."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from ctmrl.data import OfflineData
from ctmrl.evaluate import evaluate_agent
from ctmrl.meta_train import Learner
from ctmrl.methods.oracle_task import OracleTask, OracleTaskConfig, TrueTask
from ctmrl.presets import preset
from meta_envs import task_set
from tests.ctmrl.examples import BATCH, PARAMS, Z, dimensions, normal, statistics


@pytest.fixture
def learner(wind_data: OfflineData) -> Learner:
    return Learner(preset("point_robot_wind", "oracle_task", "smoke"), wind_data)


def standardised(params: np.ndarray[Any, Any], data: OfflineData) -> np.ndarray[Any, Any]:
    train = task_set("point_robot_wind").params[data.tasks]
    found: np.ndarray[Any, Any] = (params - train.mean(axis=0)) / train.std(axis=0, ddof=1)
    return found


def test_its_context_is_the_standardised_parameters_whatever_was_seen() -> None:
    method = OracleTask(OracleTaskConfig(z_dim=Z), statistics(), dimensions())
    params = normal(BATCH, PARAMS).float()
    mean, std = statistics().params
    assert method.encoder.z_dim == PARAMS
    for z in (torch.zeros(BATCH, PARAMS), torch.full((BATCH, PARAMS), torch.nan)):
        torch.testing.assert_close(method.encoder.told(z, params), (params - mean) / std)


def test_parameters_that_never_vary_are_left_out() -> None:
    stats = statistics()
    constant = stats._replace(params=(stats.params[0], torch.zeros(PARAMS)))
    method = OracleTask(OracleTaskConfig(), constant, dimensions())
    params = normal(BATCH, PARAMS).float()
    assert method.encoder.told(params, params).equal(torch.zeros(BATCH, PARAMS))


def test_all_transitions_of_a_task_have_its_parameters_and_no_other_tasks(
    learner: Learner, wind_data: OfflineData, monkeypatch: pytest.MonkeyPatch
) -> None:
    given: list[Tensor] = []
    loss, draw = learner.actor_critic.loss, wind_data.transitions
    asked: list[Tensor] = []

    def spied_loss(batch: Any, z: Tensor, *rest: Any) -> Any:
        given.append(z)
        return loss(batch, z, *rest)

    def spied_transitions(tasks: Tensor, *rest: Any) -> Any:
        asked.append(tasks)
        return draw(tasks, *rest)

    monkeypatch.setattr(learner.actor_critic, "loss", spied_loss)
    monkeypatch.setattr(wind_data, "transitions", spied_transitions)
    learner.update()
    blocks = given[0].view(5, 7, 2)
    assert (blocks == blocks[:, :1]).all()
    assert len({tuple(row) for row in blocks[:, 0].tolist()}) == 5
    rows = task_set("point_robot_wind").params[wind_data.tasks[asked[0].numpy()]]
    np.testing.assert_allclose(blocks[:, 0], standardised(rows, wind_data), rtol=1e-5)


def test_the_actor_critic_learns_to_use_it(learner: Learner, wind_data: OfflineData) -> None:
    batch = wind_data.transitions(torch.arange(7), 3, learner.generator)
    z = torch.ones(21, 2, requires_grad=True)
    loss, _ = learner.actor_critic.loss(batch, z, learner.generator)
    (reached,) = torch.autograd.grad(loss, z)
    assert reached.any(dim=1).all()


@pytest.mark.parametrize("fresh", [False, True])
def test_a_meta_test_tells_each_task_its_own_parameters_from_the_first_episode_on(
    fresh: bool, learner: Learner, wind_data: OfflineData, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = preset("point_robot_wind", "oracle_task", "smoke")
    tasks = task_set("point_robot_wind")
    tasks = tasks.sample(seed=3, n_tasks=4) if fresh else tasks
    rows = np.arange(4) if fresh else np.array([7, 2])
    for _ in range(3):
        learner.update()
    record = evaluate_agent(learner.agent, config, tasks, {"fresh": rows}, {}, seed=0)["np_online"]
    group = record["groups"]["fresh"]
    wanted = standardised(tasks.params[rows], wind_data)
    np.testing.assert_allclose(group["contexts"], wanted, rtol=1e-4, atol=1e-5)
    # The robot in the wind has no chance in it: without anything to find out nothing changes.
    np.testing.assert_allclose(group["curve"], [group["task_returns"]] * 5, rtol=1e-6)
    assert record["note"] == "reference, given the true task"
    # Told of no wind it acts otherwise.
    monkeypatch.setattr(TrueTask, "told", lambda encoder, z, params: z)
    blind = evaluate_agent(learner.agent, config, tasks, {"fresh": rows}, {}, seed=0)["np_online"]
    assert (np.array(blind["groups"]["fresh"]["curve"]) != group["curve"]).all()


@pytest.mark.parametrize("env", ["hopper_params", "walker_params"])
def test_multipliers_need_no_logarithm(env: str) -> None:
    tasks = task_set(env)
    train = tasks.params[tasks.train_tasks]
    spread = (tasks.params - train.mean(axis=0)) / train.std(axis=0)
    assert np.abs(spread).max() < 4
