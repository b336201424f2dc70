"""no_context: nothing of a task reaches the actor-critic."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from ctmrl.data import OfflineData
from ctmrl.meta_test import MetaTestConfig, meta_test
from ctmrl.meta_train import Learner
from ctmrl.methods.no_context import NoContext, NoContextConfig
from ctmrl.networks import mean_encoding
from ctmrl.presets import preset
from meta_envs import task_set
from tests.ctmrl.examples import BATCH, PARAMS, Z, contexts, dimensions, normal, statistics

CONFIG = preset("point_robot_wind", "no_context", "smoke")


def trained(data: OfflineData, steps: int = 5) -> Learner:
    learner = Learner(CONFIG, data)
    for _ in range(steps):
        learner.update()
    return learner


def test_its_contexts_are_0() -> None:
    encoder = NoContext(NoContextConfig(z_dim=Z), statistics(), dimensions()).encoder
    z = mean_encoding(encoder(contexts()))
    assert z.equal(torch.zeros(2, BATCH, Z))
    assert encoder.told(z, normal(BATCH, PARAMS)) is z


def test_what_it_learns_does_not_depend_on_contexts(
    wind_data: OfflineData, monkeypatch: pytest.MonkeyPatch
) -> None:
    plain = trained(wind_data).state()
    draw = wind_data.contexts

    def garbled(*arguments: Any) -> Tensor:
        return torch.full_like(draw(*arguments), torch.nan)

    monkeypatch.setattr(wind_data, "contexts", garbled)
    found = trained(wind_data).state()
    assert found.keys() == plain.keys()
    assert all(value.equal(plain[key]) for key, value in found.items())


def test_it_never_uses_the_weights_of_its_contexts(wind_data: OfflineData) -> None:
    start = Learner(CONFIG, wind_data).actor_critic
    end = trained(wind_data).actor_critic
    z_dim = CONFIG.context.z_dim
    # Inputs are the observation, then z, in the actor; z comes last in the critics, too.
    for before, after in (
        (next(start.actor.parameters()).T, next(end.actor.parameters()).T),
        (start.critic.weights[0][0], end.critic.weights[0][0]),
        (start.value.weights[0][0], end.value.weights[0][0]),
    ):
        assert after[-z_dim:].equal(before[-z_dim:])
        assert not after[:-z_dim].equal(before[:-z_dim])


def test_its_returns_do_not_depend_on_exploration(wind_data: OfflineData) -> None:
    agent, tasks = trained(wind_data).agent, task_set("point_robot_wind")
    protocol = MetaTestConfig(random_episodes=1, policy_episodes=1, repetitions=2)
    none = dataclasses.replace(protocol, random_episodes=0, policy_episodes=0)
    rows = np.array([2, 7])
    wanted = meta_test(agent.method.encoder, agent.actor, tasks, rows, none, 0)
    for seed in (0, 1):
        found = meta_test(agent.method.encoder, agent.actor, tasks, rows, protocol, seed)
        assert not found.contexts.any()
        np.testing.assert_array_equal(found.returns, wanted.returns)
        np.testing.assert_array_equal(found.curve, [wanted.curve[0]] * 3)
