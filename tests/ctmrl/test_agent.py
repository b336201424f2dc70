"""An agent is made of a run's settings and its checkpoint."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from ctmrl.agent import build_method, empty_statistics, load_agent, part
from ctmrl.data import OfflineData
from ctmrl.errors import UsageError
from ctmrl.meta_train import Learner
from ctmrl.methods import METHODS
from ctmrl.presets import preset
from tests.ctmrl.examples import ACT, OBS, PARAMS, dimensions, normal, smoke, statistics


@pytest.mark.parametrize("next_obs", [True, False])
@pytest.mark.parametrize("method", METHODS)
def test_an_agent_is_the_learners(method: str, next_obs: bool, wind_data: OfflineData) -> None:
    config = preset("point_robot_wind", method, "smoke")
    context = dataclasses.replace(config.context, next_obs_in_context=next_obs)
    config = dataclasses.replace(config, context=context)
    learner = Learner(config, wind_data)
    learner.update()
    before = torch.random.get_rng_state()
    agent = load_agent(config, learner.method.dims, learner.state())
    assert torch.random.get_rng_state().equal(before)
    for found, wanted in zip(
        (agent.method, agent.actor), (learner.agent.method, learner.agent.actor), strict=True
    ):
        theirs = wanted.state_dict()
        assert found.state_dict().keys() == theirs.keys()
        assert all(value.equal(theirs[key]) for key, value in found.state_dict().items())
    obs, z = normal(5, 2).float(), normal(5, agent.method.encoder.z_dim).float()
    assert agent.actor.act(obs, z).equal(learner.actor_critic.actor.act(obs, z))


def test_a_checkpoint_of_another_size_does_not_fit(wind_data: OfflineData) -> None:
    config = smoke()
    learner = Learner(config, wind_data)
    for wrong in (
        dataclasses.replace(config, context=dataclasses.replace(config.context, z_dim=3)),
        dataclasses.replace(
            config, actor_critic=dataclasses.replace(config.actor_critic, hidden=(16, 16))
        ),
    ):
        with pytest.raises(RuntimeError, match="Error"):
            load_agent(wrong, learner.method.dims, learner.state())


def test_settings_that_do_not_fit_the_tasks() -> None:
    with pytest.raises(UsageError, match="--codes"):
        build_method(smoke(), statistics(), dimensions()._replace(tasks=3))


@pytest.mark.parametrize("next_obs", [True, False])
def test_empty_statistics_have_the_sizes_of_real_ones(next_obs: bool) -> None:
    empty, real = empty_statistics(dimensions(), next_obs, PARAMS), statistics(next_obs)
    for (mean, std), (wanted, _) in zip(empty, real, strict=True):
        assert mean.shape == std.shape == wanted.shape
        assert mean.equal(torch.zeros_like(wanted))
        assert std.equal(torch.ones_like(wanted))
    assert len(empty.context[0]) == OBS + ACT + 1 + OBS * next_obs


def test_part() -> None:
    a, b, c = torch.zeros(3).unbind()
    found = part({"method/x": a, "method/y.z": b, "methods/x": c}, "method/")
    assert list(found) == ["x", "y.z"]
    assert found["x"] is a
    assert found["y.z"] is b
