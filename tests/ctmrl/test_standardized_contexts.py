"""--standardize-contexts: what the policy gets in training and meta-test, and how it stays."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from torch import Tensor

from ctmrl.agent import load_agent
from ctmrl.config import RunConfig
from ctmrl.data import OfflineData
from ctmrl.meta_test import MetaTestConfig, meta_test
from ctmrl.meta_train import Learner
from ctmrl.methods import METHODS
from ctmrl.methods.base import Dimensions, Reference
from ctmrl.networks import Actor, ContextEncoder, mean_encoding
from meta_envs import task_set
from tests.ctmrl.test_meta_train import STEPS, assert_same, config_of, frozen, train

LEARNT = [name for name, row in METHODS.items() if not issubclass(row.method, Reference)]


def standardizing(method: str, standardize: bool = True) -> RunConfig:
    config = config_of(method)
    context = dataclasses.replace(config.context, standardize_contexts=standardize)
    return dataclasses.replace(config, context=context)


@pytest.mark.parametrize("method", LEARNT)
def test_actor_and_critics_get_the_batchs_contexts_standardised(
    method: str, wind_data: OfflineData, monkeypatch: pytest.MonkeyPatch
) -> None:
    learner = Learner(standardizing(method), wind_data)
    encoder, loss, draw = learner.method.encoder, learner.actor_critic.loss, learner._draw
    assert isinstance(encoder, ContextEncoder)
    drawn: list[Tensor] = []
    given: list[Tensor] = []

    def keep(batch: object, z: Tensor, *others: object) -> object:
        given.append(z.clone())
        contexts = mean_encoding(encoder(drawn[-1])).detach()
        assert encoder.running is not None
        mean, std = encoder.running.mean, encoder.running.variance.sqrt()
        wanted = ((contexts[0] - mean) / std).clamp(-10, 10)
        size = learner.config.batch_size
        torch.testing.assert_close(z, wanted.repeat_interleave(size, dim=0))
        return loss(batch, z, *others)  # type: ignore[arg-type]

    def remember(tasks: Tensor, sets: int) -> Tensor:
        drawn.append(draw(tasks, sets))
        return drawn[-1]

    monkeypatch.setattr(learner.actor_critic, "loss", keep)
    monkeypatch.setattr(learner, "_draw", remember)
    train(learner, STEPS)
    assert len(given) == STEPS
    spread = torch.stack(given).flatten(0, 1).std(dim=0)
    assert 0.3 < spread.min() < spread.max() < 3.0


def test_statistics_are_of_all_sets(wind_data: OfflineData) -> None:
    learner, twin = (Learner(standardizing("ctmrl"), wind_data) for _ in range(2))
    train(learner, 1)
    encoder = learner.method.encoder
    assert isinstance(encoder, ContextEncoder)
    assert encoder.running is not None
    contexts = twin._draw(twin._draw_tasks(twin.generator), twin.method.context_sets)
    z = mean_encoding(twin.method.encoder(contexts)).detach()
    assert len(z) == 2
    torch.testing.assert_close(encoder.running.mean, z.mean(dim=(0, 1)))


@pytest.mark.parametrize("method", LEARNT)
def test_it_leaves_the_method_as_it_is(method: str, wind_data: OfflineData) -> None:
    """No gradient of the actor-critic reaches the encoder by it, nothing else is drawn."""
    one, other = (Learner(standardizing(method, on), wind_data) for on in (True, False))
    for learner in (one, other):
        train(learner, STEPS)
    found, wanted = one.method.state_dict(), other.method.state_dict()
    assert_same({name: found[name] for name in wanted}, wanted)
    more = {f"encoder.running.{name}" for name in ("shown", "mean", "variance")}
    assert found.keys() - wanted.keys() == more


@pytest.mark.parametrize("method", ["no_context", "oracle_task"])
def test_it_changes_nothing_of_a_reference(method: str, wind_data: OfflineData) -> None:
    one, other = (Learner(standardizing(method, on), wind_data) for on in (True, False))
    assert train(one, STEPS) == train(other, STEPS)
    assert_same(one.state(), other.state())


@pytest.mark.parametrize("method", LEARNT)
def test_a_state_goes_on_bit_for_bit(method: str, wind_data: OfflineData) -> None:
    config = standardizing(method)
    whole, first, second = (Learner(config, wind_data) for _ in range(3))
    train(whole, STEPS)
    train(first, 5)
    second.load(frozen(first.state()))
    train(second, STEPS - 5)
    assert_same(second.state(), whole.state())
    plain = Learner(standardizing(method, standardize=False), wind_data)
    train(plain, STEPS)
    assert not torch.equal(
        plain.state()["actor_critic/actor.net.0.weight"],
        whole.state()["actor_critic/actor.net.0.weight"],
    )


def test_a_stored_agent_has_the_statistics(wind_data: OfflineData) -> None:
    config = standardizing("ctmrl")
    learner = Learner(config, wind_data)
    train(learner, STEPS)
    dims = Dimensions(2, 2, len(wind_data), STEPS)
    agent = load_agent(config, dims, learner.state())
    z = torch.linspace(-0.9, 0.8, 3 * config.context.z_dim).view(3, -1)
    found, wanted = (one.method.encoder.scaled(z) for one in (agent, learner.agent))
    assert found.equal(wanted)
    assert not found.equal(z)


class Scaling(Actor):
    """An actor that standardises the contexts it is given itself."""

    def __init__(self, mean: Tensor, std: Tensor) -> None:
        super().__init__((torch.zeros(2), torch.ones(2)), len(mean), (13,), 2)
        self.of_contexts = mean, std

    def forward(self, obs: Tensor, z: Tensor) -> tuple[Tensor, Tensor]:
        mean, std = self.of_contexts
        known = z.any(dim=-1, keepdim=True)
        return super().forward(obs, torch.where(known, (z - mean) / std, 0.0))


def test_a_meta_test_standardises_for_the_policy_and_shows_contexts_as_they_are() -> None:
    ones = torch.ones(7)
    with torch.random.fork_rng():
        torch.manual_seed(0)
        # So that none is as large as the bound.
        mean, std = torch.rand(5) - 0.5, 0.2 + torch.rand(5)
        plain, encoder = (
            ContextEncoder((0.1 * ones, 0.5 * ones), 2, (11,), 5, standardize_contexts=on)
            for on in (False, True)
        )
        own, simple = Scaling(mean, std), Actor((torch.zeros(2), torch.ones(2)), 5, (13,), 2)
    assert encoder.running is not None
    encoder.running.mean.copy_(mean)
    encoder.running.variance.copy_(std.square())
    encoder.net.load_state_dict(plain.net.state_dict())
    simple.load_state_dict(own.state_dict())
    config = MetaTestConfig(random_episodes=2, policy_episodes=2, repetitions=2)
    tasks, rows = task_set("point_robot_wind"), np.array([4, 0, 7])
    found = meta_test(encoder, simple, tasks, rows, config, 5)
    wanted = meta_test(plain, own, tasks, rows, config, 5)
    np.testing.assert_allclose(found.returns, wanted.returns, rtol=1e-5)
    np.testing.assert_allclose(found.curve, wanted.curve, rtol=1e-5)
    np.testing.assert_allclose(found.contexts, wanted.contexts, atol=1e-5)
    other = meta_test(plain, simple, tasks, rows, config, 5)
    assert abs(other.returns - found.returns).max() > 0.01
