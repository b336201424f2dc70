"""The actor-critic: every gradient of an update against the formulas of the field, by hand."""

from __future__ import annotations

import copy
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch.distributions import Normal, TransformedDistribution
from torch.distributions.transforms import TanhTransform

from ctmrl.actor_critic import ActorCritic, ActorCriticConfig
from ctmrl.data import Transitions
from tests.ctmrl.examples import ACT, Z, batch, generator, normal, statistics

R = 37.0
"""Reward scale."""
ROWS = 19


def actor_critic(**changes: Any) -> ActorCritic:
    config = ActorCriticConfig(hidden=(23, 29), reward_scale=R, gamma=0.9, **changes)
    made = ActorCritic(config, statistics(), ACT, Z)
    made.double()
    # A target network that differs from the value network, as after some steps.
    with torch.no_grad():
        for seed, parameter in enumerate(made.target_value.parameters()):
            parameter.add_(0.1 * normal(*parameter.shape, seed=seed))
    return made


def double_batch() -> Transitions:
    return Transitions(*(part.double() for part in batch(ROWS)))


def contexts() -> Tensor:
    return normal(ROWS, Z, seed=9)


def gradients(module: nn.Module) -> list[Tensor]:
    """Gradients that the last backward pass left, 0 where there are none."""
    return [torch.zeros_like(p) if p.grad is None else p.grad.clone() for p in module.parameters()]


def after_a_backward_pass(
    ac: ActorCritic, rows: Transitions, z: Tensor, seed: int = 1
) -> dict[str, Tensor]:
    """The metrics of a loss whose gradients are in the parameters."""
    loss, metrics = ac.loss(rows, z, generator(seed))
    loss.backward()  # type: ignore[no-untyped-call]
    return metrics


def of(loss: Tensor, module: nn.Module) -> list[Tensor]:
    """Gradients of a loss."""
    return list(torch.autograd.grad(loss, tuple(module.parameters())))


def assert_same(found: list[Tensor], wanted: list[Tensor], scale: float = 1.0) -> None:
    assert len(found) == len(wanted)
    for one, other in zip(found, wanted, strict=True):
        torch.testing.assert_close(scale * one, other, rtol=1e-5, atol=1e-7)
    assert any(one.abs().max() > 1e-6 for one in found)


def test_the_largest_q_is_of_both_critics_and_both_kinds_of_actions() -> None:
    rows, z = double_batch(), contexts()
    for seed in range(4):
        torch.manual_seed(seed)
        ac = actor_critic()
        sampled = ac.actor.sample(rows.obs, z, generator(1)).action.detach()
        _, metrics = ac.loss(rows, z, generator(1))
        at_policy = ac.critic(rows.obs, sampled, z).amin(dim=0)
        wanted = max(at_policy.abs().max(), ac.critic(rows.obs, rows.action, z).abs().max())
        assert metrics["policy/q_largest"].item() == pytest.approx(wanted.item())
        assert metrics["policy/q"].item() == pytest.approx(at_policy.mean().item())


def test_the_critics_target() -> None:
    ac, rows, z = actor_critic(), double_batch(), contexts()
    found = ac.critic_target(rows, z)
    future = ac.target_value(rows.next_obs, z)[0].tolist()
    for k in range(ROWS):
        wanted = rows.reward[k].item()
        if k % 3 != 0:
            wanted += 0.9 * future[k]
        assert found[k].item() == pytest.approx(wanted, rel=1e-10)
    assert not found.requires_grad


def test_the_critics_learn_from_their_loss_alone_as_in_the_fields_code() -> None:
    ac, rows, z = actor_critic(), double_batch(), contexts()
    old = copy.deepcopy(ac)
    metrics = after_a_backward_pass(ac, rows, z)
    # The field's critics are of rewards times R: Q = R q, so L_Q = R^2 times the loss here.
    future = old.target_value(rows.next_obs, z)[0]
    y = (R * rows.reward + (1 - rows.terminal) * 0.9 * R * future).detach()
    q1, q2 = R * old.critic(rows.obs, rows.action, z)
    loss = (q1 - y).square().mean() + (q2 - y).square().mean()
    assert_same(gradients(ac.critic), of(loss, old.critic), R**2)
    assert metrics["loss/critic"].item() * R**2 == pytest.approx(loss.item(), rel=1e-6)


@pytest.mark.parametrize("brac", [False, True])
def test_the_actors_and_the_value_networks_losses_are_the_fields_divided_by_r(brac: bool) -> None:
    ac = actor_critic(behavior_regularization=brac, divergence_initial=53.0)
    rows, z = double_batch(), contexts()
    old = copy.deepcopy(ac)
    metrics = after_a_backward_pass(ac, rows, z)
    sample = old.actor.sample(rows.obs, z, generator(1))
    q = R * old.critic(rows.obs, sample.action, z).min(dim=0).values
    target = (q - sample.log_prob).detach()
    value_loss = (R * old.value(rows.obs, z)[0] - target).square().mean()
    actor_loss = (sample.log_prob - q).mean()
    actor_loss = actor_loss + 1e-3 * (sample.mean**2).mean() + 1e-3 * (sample.log_std**2).mean()
    if brac:
        # Taken after the dual critic's step: `ac.dual_critic` is the stepped one.
        at_policy = nn.functional.softplus(ac.dual_critic(rows.obs, sample.action, z)[0])
        at_data = nn.functional.softplus(ac.dual_critic(rows.obs, rows.action, z)[0])
        divergence = (torch.log(at_policy + 1e-8) - at_data + 1).mean()
        actor_loss = actor_loss + 53.0 * divergence
        assert metrics["divergence/mean"].item() == pytest.approx(divergence.item(), rel=1e-6)
        assert metrics["divergence/coefficient"].item() == 53.0
    assert_same(gradients(ac.value), of(value_loss, old.value), R**2)
    assert_same(gradients(ac.actor), of(actor_loss, old.actor), R)
    assert metrics["loss/value"].item() * R**2 == pytest.approx(value_loss.item(), rel=1e-6)
    assert metrics["loss/actor"].item() * R == pytest.approx(actor_loss.item(), rel=1e-6)
    entropy = -sample.log_prob.mean().item()
    assert metrics["policy/entropy"].item() == pytest.approx(entropy, rel=1e-6)


@pytest.mark.parametrize(("strength", "by_rank"), [(0.0, 0.0), (1.3, 0.0), (0.0, 2.1), (1.3, 2.1)])
def test_behaviour_cloning_is_of_the_better_data_in_units_of_the_spread_of_q(
    strength: float, by_rank: float
) -> None:
    plain = actor_critic()
    cloning = actor_critic(behavior_cloning=0.7, cloning_advantage=strength, cloning_rank=by_rank)
    rows, z = double_batch(), contexts()
    with torch.no_grad():
        # All spreads inside their bounds: outside, gradients of two losses do not add up.
        list(plain.actor.parameters())[-1][ACT:] = -1.0
        assert plain.actor(rows.obs, z)[1].amax() < 0
    cloning.load_state_dict(plain.state_dict())
    old = copy.deepcopy(cloning)
    after_a_backward_pass(plain, rows, z)
    metrics = after_a_backward_pass(cloning, rows, z)
    mean, log_std = old.actor(rows.obs, z)
    policy = TransformedDistribution(Normal(mean, log_std.exp()), TanhTransform())
    with torch.no_grad():
        advantage = old.critic(rows.obs, rows.action, z).amin(dim=0) - old.value(rows.obs, z)[0]
        weights = (strength * advantage / advantage.std()).exp() * (by_rank * rows.rank).exp()
        weights /= weights.mean()
    assert strength == by_rank == 0 or weights.max() > 1.5 * weights.min()
    log_prob = policy.log_prob(rows.action).sum(dim=1)  # type: ignore[no-untyped-call]
    unlikely = -(weights * log_prob).mean()
    sampled = old.actor.sample(rows.obs, z, generator(1)).action
    spread = old.critic(rows.obs, sampled, z).amin(dim=0).std().item()
    assert spread > 0.01
    assert metrics["loss/behavior_cloning"].item() == pytest.approx(unlikely.item(), rel=1e-4)
    both = zip(gradients(cloning.actor), gradients(plain.actor), strict=True)
    added = of(0.7 * spread * unlikely, old.actor)
    for (found, without), wanted in zip(both, added, strict=True):
        torch.testing.assert_close(found - without, wanted, rtol=1e-4, atol=1e-6)
    for network in ("critic", "value"):
        assert_same(gradients(getattr(cloning, network)), gradients(getattr(plain, network)))


def test_the_value_can_be_an_expectile_of_the_datas_own_actions() -> None:
    plain, expectile = actor_critic(), actor_critic(value_expectile=0.8)
    expectile.load_state_dict(plain.state_dict())
    rows, z = double_batch(), contexts()
    old = copy.deepcopy(expectile)
    after_a_backward_pass(plain, rows, z)
    metrics = after_a_backward_pass(expectile, rows, z)
    behind = old.critic(rows.obs, rows.action, z).amin(dim=0).detach() - old.value(rows.obs, z)[0]
    below, above = behind.clamp(max=0), behind.clamp(min=0)
    assert below.min() < 0 < above.max()
    loss = 0.2 * below.square().mean() + 0.8 * above.square().mean()
    assert_same(gradients(expectile.value), of(loss, old.value))
    assert metrics["loss/value"].item() == pytest.approx(loss.item(), rel=1e-6)
    for network in ("critic", "actor"):
        assert_same(gradients(getattr(expectile, network)), gradients(getattr(plain, network)))


def test_critics_and_value_networks_begin_at_a_value() -> None:
    made = []
    for value in (0.0, -53.0):
        torch.manual_seed(0)
        made.append(ActorCritic(ActorCriticConfig(hidden=(23,)), statistics(), ACT, Z, value))
    rows, z = batch(ROWS), contexts().float()
    for name, inputs in (("critic", (rows.action, z)), ("value", (z,)), ("target_value", (z,))):
        plain, moved = (getattr(ac, name)(rows.obs, *inputs) for ac in made)
        torch.testing.assert_close(moved, plain - 53.0)
    assert_same([*made[0].actor.parameters()], [*made[1].actor.parameters()])


@pytest.mark.parametrize("penalty", ["value", "gradient"])
def test_the_dual_critic_learns_from_its_own_loss_alone(penalty: Any) -> None:
    ac = actor_critic(behavior_regularization=True, dual_penalty=penalty)
    with torch.no_grad():
        # Steep enough for either penalty to bite.
        for parameter in ac.dual_critic.parameters():
            parameter.mul_(3.0)
    rows, z = double_batch(), contexts()
    old = copy.deepcopy(ac)
    after_a_backward_pass(ac, rows, z)
    draw = generator(1)
    action = old.actor.sample(rows.obs, z, draw).action.detach()
    share = torch.rand(ROWS, 1, generator=draw)
    between = (action + share * (rows.action - action)).requires_grad_()
    value = old.dual_critic(rows.obs, between, z)[0]
    bound = value.abs()
    if penalty == "gradient":
        bound = torch.autograd.grad(value.sum(), between, create_graph=True)[0].norm(dim=1)
    at_policy = nn.functional.softplus(old.dual_critic(rows.obs, action, z)[0])
    at_data = nn.functional.softplus(old.dual_critic(rows.obs, rows.action, z)[0])
    loss = 5 * (bound - 1).clamp_min(0).square().mean()
    assert loss > 0.01
    loss = loss - (at_policy.log() - at_data + 1).mean()
    assert_same(gradients(ac.dual_critic), of(loss, old.dual_critic))


def test_the_target_follows_the_value_network_at_its_rate() -> None:
    ac = actor_critic(target_rate=0.13)
    old = copy.deepcopy(ac)
    after_a_backward_pass(ac, double_batch(), contexts())
    ac.follow_value()
    networks = (ac.target_value, old.target_value, ac.value)
    for found, before, value in zip(*(n.parameters() for n in networks), strict=True):
        torch.testing.assert_close(found, 0.87 * before + 0.13 * value)
        assert not found.equal(before)
        assert found.grad is None
        assert not found.requires_grad
        assert value.grad is not None


def test_the_target_starts_as_a_copy_of_its_own() -> None:
    ac = ActorCritic(ActorCriticConfig(hidden=(23,)), statistics(), ACT, Z)
    for target, value in zip(ac.target_value.parameters(), ac.value.parameters(), strict=True):
        assert target.equal(value)
        assert target.data_ptr() != value.data_ptr()


def test_no_network_but_the_dual_critic_is_changed_by_its_loss() -> None:
    ac = actor_critic(behavior_regularization=True)
    old = copy.deepcopy(ac)
    after_a_backward_pass(ac, double_batch(), contexts())
    for (name, found), before in zip(ac.named_parameters(), old.parameters(), strict=True):
        assert found.equal(before) is not name.startswith("dual_critic."), name


def test_every_network_is_trained_once_and_the_target_never() -> None:
    ac = actor_critic(behavior_regularization=True)
    assert ac.dual_optimizer
    dual = [p for group in ac.dual_optimizer.param_groups for p in group["params"]]
    owned = [id(parameter) for parameter in [*ac.main_parameters(), *dual]]
    assert len(owned) == len(set(owned))
    named = ac.named_parameters()
    assert set(owned) == {id(p) for name, p in named if not name.startswith("target_value.")}


def test_without_behaviour_regularisation_there_is_no_dual_critic() -> None:
    ac = actor_critic()
    assert ac.multiplier is None
    assert ac.dual_optimizer is None
    assert not any("dual" in name for name, _ in ac.named_parameters())
    metrics = after_a_backward_pass(ac, double_batch(), contexts())
    assert not any("divergence" in name for name in metrics)


def test_the_multiplier_is_updated_after_its_use() -> None:
    ac = actor_critic(behavior_regularization=True, divergence_initial=2.0, divergence_target=0.05)
    assert ac.multiplier
    metrics = after_a_backward_pass(ac, double_batch(), contexts())
    assert metrics["divergence/coefficient"] == 2.0
    wanted = 2.0 + metrics["divergence/mean"].item() - 0.05
    assert ac.multiplier.value.item() == pytest.approx(wanted, rel=1e-6)


@pytest.mark.parametrize("wind_up", [False, True])
def test_the_multipliers_settings_are_the_configs(wind_up: bool) -> None:
    ac = actor_critic(
        behavior_regularization=True,
        divergence_initial=3.0,
        divergence_maximum=5.0,
        divergence_target=0.25,
        divergence_wind_up=wind_up,
    )
    assert ac.multiplier
    found = ac.multiplier
    assert (found.value.item(), found.maximum, found.target) == (3.0, 5.0, 0.25)
    assert found.wind_up is wind_up


def distance_from_behaviour(weight: float) -> float:
    """How far from the data's actions the policy ends up, which the reward draws elsewhere."""
    ac = actor_critic(
        behavior_regularization=True,
        divergence_initial=weight,
        divergence_maximum=weight,
        dual_lr=1e-2,
    )
    optimizer = torch.optim.Adam(ac.main_parameters(), lr=1e-2)
    draw, z = generator(3), contexts()
    for _ in range(300):
        obs = torch.randn(ROWS, 3, generator=draw).double()
        # Behaviour near +0.5 on both axes; the reward prefers -1, and every row ends its episode.
        action = (0.5 + 0.2 * torch.randn(ROWS, ACT, generator=draw).double()).clamp(-0.95, 0.95)
        reward = -action.sum(dim=1)
        ones = torch.ones(ROWS).double()
        rows = Transitions(obs, action, reward, obs, ones, ones)
        loss, _ = ac.loss(rows, z, draw)
        optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimizer.step()
    return (ac.actor.act(obs, z) - 0.5).abs().mean().item()


def test_a_large_multiplier_keeps_the_policy_near_the_behaviour() -> None:
    free, held = distance_from_behaviour(0.0), distance_from_behaviour(500.0)
    assert free > 1.0
    assert held < 0.5 * free
