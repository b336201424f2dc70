"""The networks against torch's own distributions and layers, and plain loops."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn
from torch.distributions import Independent, Normal, TransformedDistribution
from torch.distributions.transforms import TanhTransform
from torch.nn import functional

from ctmrl import networks
from ctmrl.networks import (
    Actor,
    BlindEncoder,
    ContextEncoder,
    Critic,
    Predictors,
    RunningStandardize,
    Standardize,
    mean_encoding,
    mlp,
)
from ctmrl.precision import products_in
from tests.ctmrl.examples import ACT, BATCH, LENGTH, OBS, Z, contexts, generator, normal, statistics

HIDDEN = (23, 19)


def perceptron(x: Tensor, net: nn.Sequential) -> Tensor:
    """ReLU layers, from the parameters alone."""
    parameters = [parameter.detach() for parameter in net.parameters()]
    pairs = list(zip(parameters[::2], parameters[1::2], strict=True))
    for index, (weight, bias) in enumerate(pairs):
        x = x @ weight.T + bias
        if index < len(pairs) - 1:
            x = x.clamp_min(0)
    return x


def test_mlp_has_relu_between_layers_and_none_at_the_end() -> None:
    net = mlp(OBS, HIDDEN, ACT)
    assert [tuple(p.shape) for p in net.parameters()] == [
        (23, OBS), (23,), (19, 23), (19,), (ACT, 19), (ACT,),
    ]  # fmt: skip
    x = 9 * normal(BATCH, OBS).float()
    torch.testing.assert_close(net(x), perceptron(x, net))
    assert (net(x) < 0).any()


def test_an_mlp_gives_the_same_in_blocks_of_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    net, x = mlp(OBS, HIDDEN, ACT), normal(3, 5, OBS).float()
    found, sizes, through = [], [], networks._through

    def watched(rows: Tensor, layers: networks.Layers) -> Tensor:
        sizes.append(len(rows))
        return through(rows, layers)

    monkeypatch.setattr(networks, "_through", watched)
    for block in (15, 4):
        monkeypatch.setattr(networks, "MLP_BLOCK", block)
        given = x.clone().requires_grad_()
        net.zero_grad()
        out = net(given)
        out.square().sum().backward()
        found.append([out, given.grad, *(parameter.grad for parameter in net.parameters())])
    assert sizes == [15, 4, 4, 4, 3]
    assert found[0][0].shape == (3, 5, ACT)
    torch.testing.assert_close(found[0], found[1])


def test_standardize_and_constant_columns() -> None:
    mean, std = torch.tensor([1.0, 2.0, 3.0]), torch.tensor([2.0, 0.0, 0.5])
    found = Standardize(mean, std)(torch.tensor([[3.0, 7.0, 3.0], [1.0, -7.0, 2.0]]))
    assert found.tolist() == [[1.0, 0.0, 0.0], [0.0, 0.0, -2.0]]
    assert set(Standardize(mean, std).state_dict()) == {"mean", "scale"}


def test_the_inverse_of_standardising_gives_the_mean_in_constant_columns() -> None:
    mean, std = torch.tensor([1.0, 2.0, 3.0]), torch.tensor([2.0, 0.0, 0.5])
    found = Standardize(mean, std).inverse(torch.tensor([[1.0, 9.0, 0.0], [0.0, -9.0, -2.0]]))
    assert found.tolist() == [[3.0, 2.0, 3.0], [1.0, 2.0, 2.0]]


def test_running_statistics_are_means_at_first_and_exponential_ones_later() -> None:
    running, shown = RunningStandardize(2), normal(150, 40, 2).float()
    shown[..., 0] = 3.0
    assert running(shown[0]).equal(shown[0])
    for count, rows in enumerate(shown, start=1):
        running.show(rows)
        if count == 100:
            torch.testing.assert_close(running.mean, shown[:count].flatten(0, 1).mean(dim=0))
            spread = shown[:count].flatten(0, 1).std(dim=0)
            torch.testing.assert_close(running.variance.sqrt(), spread, rtol=0.02, atol=1e-6)
    mean = shown[:100].flatten(0, 1).mean(dim=0)
    variance = shown[:100].var(dim=1, correction=0).mean(dim=0)
    for rows in shown[100:]:
        mean = 0.99 * mean + 0.01 * rows.mean(dim=0)
        variance = 0.99 * variance + 0.01 * rows.var(dim=0, correction=0)
    torch.testing.assert_close(running.mean, mean)
    torch.testing.assert_close(running.variance, variance)
    found = running(shown[0])
    assert found[:, 0].equal(torch.zeros(40))
    assert running(torch.tensor([[3.0, 1e6], [3.0, -1e6]])).tolist() == [[0, 10], [0, -10]]
    wanted = (shown[0, :, 1] - running.mean[1]) / running.variance[1].sqrt()
    torch.testing.assert_close(found[:, 1], wanted)


def test_what_moves_all_contexts_leaves_the_running_spread_alone() -> None:
    running, rows = RunningStandardize(1), 0.02 * normal(500, 1).float()
    for step in range(300):
        running.show(rows + 0.01 * step)
    torch.testing.assert_close(running.variance.sqrt(), rows.std(dim=0), rtol=0.01, atol=0)


def test_contexts_are_standardised_for_the_policy_but_where_there_is_none_yet() -> None:
    plain, encoder = (
        ContextEncoder(statistics().context, OBS, HIDDEN, Z, standardize_contexts=on)
        for on in (False, True)
    )
    z = 0.1 * normal(2, BATCH, Z).float() + 0.5
    for one in (plain, encoder):
        one.show(z)
    assert plain.scaled(z) is z
    assert not any("running" in key for key in plain.state_dict())
    scaled = encoder.scaled(z)
    torch.testing.assert_close(scaled.mean(dim=(0, 1)), torch.zeros(Z), atol=1e-5, rtol=0)
    spread = scaled.flatten(0, 1).std(dim=0, correction=0)
    torch.testing.assert_close(spread, torch.ones(Z))
    z[1, 3] = 0.0
    assert encoder.scaled(z)[1, 3].equal(torch.zeros(Z))
    assert encoder.scaled(z)[0].equal(scaled[0])
    assert len([*encoder.parameters()]) == len([*plain.parameters()])


@pytest.mark.parametrize("next_obs", [True, False])
def test_a_context_is_the_mean_of_its_transitions_encodings(next_obs: bool) -> None:
    stats, h = statistics(next_obs), contexts()
    encoder = ContextEncoder(stats.context, OBS, HIDDEN, Z)
    z = mean_encoding(encoder(h))
    assert z.shape == (2, BATCH, Z)
    mean, std = stats.context
    for k, i in itertools.product(range(2), (0, 4, BATCH - 1)):
        total = torch.zeros(Z)
        for t in range(LENGTH):
            obs, action, reward, after = torch.split(h[k, i, t], [OBS, ACT, 1, OBS])
            seen = [obs, action, reward] + [after - obs] * next_obs
            total += torch.tanh(perceptron((torch.cat(seen) - mean) / std, encoder.net))
        torch.testing.assert_close(z[k, i], total / LENGTH)


def test_without_s_prime_the_encoder_does_not_see_it() -> None:
    h = contexts()
    changed = h.clone()
    changed[..., -OBS:] += 1.0
    for next_obs in (True, False):
        encoder = ContextEncoder(statistics(next_obs).context, OBS, HIDDEN, Z)
        assert encoder(h).equal(encoder(changed)) is not next_obs


def test_encodings_are_between_minus_1_and_1() -> None:
    encoder = ContextEncoder(statistics().context, OBS, HIDDEN, Z)
    encoded = encoder(1e6 * contexts())
    assert encoded.abs().max() <= 1.0
    assert encoded.isfinite().all()


def test_a_blind_encoder_gives_0_for_everything() -> None:
    encoder, h = BlindEncoder(Z), torch.full_like(contexts(), torch.nan)
    assert encoder(h).equal(torch.zeros(2, BATCH, LENGTH, Z))


def actor() -> Actor:
    return Actor(statistics().obs, Z, HIDDEN, ACT).double()


def test_the_log_probability_is_that_of_a_tanh_gaussian() -> None:
    policy, obs, z = actor(), normal(BATCH, OBS), normal(BATCH, Z, seed=1)
    sample = policy.sample(obs, z, generator())
    mean, log_std = policy(obs, z)
    gaussian = Independent(Normal(mean, log_std.exp()), 1)
    wanted = TransformedDistribution(gaussian, [TanhTransform()])
    log_prob: Tensor = wanted.log_prob(sample.action)  # type: ignore[no-untyped-call] # torch's
    assert sample.log_prob.shape == (BATCH,)
    torch.testing.assert_close(sample.log_prob, log_prob, rtol=1e-4, atol=1e-3)
    assert sample.mean.equal(mean)
    assert sample.log_std.equal(log_std)
    other = torch.tanh(normal(BATCH, ACT, seed=2))
    log_prob = wanted.log_prob(other)  # type: ignore[no-untyped-call] # torch's
    torch.testing.assert_close(sample.log_prob_of(other), log_prob, rtol=1e-4, atol=1e-3)
    edge = torch.full((BATCH, ACT), -1.0, dtype=torch.float64)
    assert sample.log_prob_of(edge).isfinite().all()


def test_actions_are_reparameterised_with_the_generators_noise() -> None:
    policy, obs, z = actor(), normal(BATCH, OBS), normal(BATCH, Z, seed=1)
    mean, log_std = policy(obs, z)
    noise = torch.randn(BATCH, ACT, generator=generator(3))
    sample = policy.sample(obs, z, generator(3))
    torch.testing.assert_close(sample.action, torch.tanh(mean + log_std.exp() * noise))
    for gradient in torch.autograd.grad(sample.action.sum(), tuple(policy.net.parameters())):
        assert gradient.abs().sum() > 0


def test_the_distribution_of_actions() -> None:
    policy = actor()
    obs, z = (normal(1, size).expand(20_011, size) for size in (OBS, Z))
    with torch.no_grad():
        sample = policy.sample(obs, z, generator())
    pre_tanh = torch.atanh(sample.action)
    np.testing.assert_allclose(pre_tanh.mean(dim=0), sample.mean[0], atol=0.04)
    np.testing.assert_allclose(pre_tanh.std(dim=0), sample.log_std[0].exp(), rtol=0.03)


def test_acting_is_the_tanh_of_the_mean_without_a_gradient() -> None:
    policy, obs, z = actor(), normal(BATCH, OBS), normal(BATCH, Z, seed=1)
    action = policy.act(obs, z)
    torch.testing.assert_close(action, torch.tanh(policy(obs, z)[0]))
    assert not action.requires_grad


def test_the_actor_standardises_observations_and_takes_contexts_as_they_are() -> None:
    policy, obs, z = actor(), normal(BATCH, OBS), normal(BATCH, Z, seed=1)
    mean, std = statistics().obs
    out = perceptron(torch.cat([(obs - mean) / std, z], dim=1), policy.net)
    found = torch.cat(policy(obs, z), dim=1)
    wanted = torch.cat([out[:, :ACT], out[:, ACT:].clamp(-20, 0)], dim=1)
    torch.testing.assert_close(found, wanted, rtol=1e-5, atol=1e-6)


def test_the_log_standard_deviation_is_clamped() -> None:
    policy, z = actor(), normal(BATCH, Z)
    last_bias = list(policy.parameters())[-1]
    with torch.no_grad():
        last_bias.copy_(torch.tensor([0.0, 0.0, 50.0, -50.0]))
    _, log_std = policy(normal(BATCH, OBS), z)
    assert (log_std[:, 0] == 0.0).all()
    assert (log_std[:, 1] == -20.0).all()


@pytest.mark.parametrize("heads", [1, 2, 3])
def test_the_heads_of_a_critic_are_separate_networks(heads: int) -> None:
    stats = statistics().obs
    critic = Critic(stats, ACT + Z, HIDDEN, heads)
    obs, action, z = (normal(BATCH, size, seed=size).float() for size in (OBS, ACT, Z))
    found = critic(obs, action, z)
    assert found.shape == (heads, BATCH)
    start = torch.cat([(obs - stats[0]) / stats[1], action, z], dim=1)
    for head in range(heads):
        x = start
        for layer in range(3):
            weight, bias = critic.weights[layer][head], critic.biases[layer][head, 0]
            x = functional.linear(x, weight.T, bias)
            x = functional.relu(x) if layer < 2 else x
        torch.testing.assert_close(found[head], x[:, 0], rtol=1e-4, atol=1e-5)
    assert len(found[:, 0].unique()) == heads


@pytest.mark.parametrize("frozen", [False, True])
def test_a_critic_gives_the_same_in_blocks_of_rows(
    frozen: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    critic = Critic(statistics().obs, ACT, (8, 7), heads=2)
    obs, action = torch.randn(11, OBS), torch.randn(11, ACT)
    found = []
    for block in (11, 4):
        monkeypatch.setattr(networks, "BLOCK", block)
        given = action.clone().requires_grad_()
        layers = networks.frozen(critic.layers()) if frozen else None
        values = critic(obs, given, layers=layers)
        values.square().sum().backward()
        gradients = [parameter.grad for parameter in critic.parameters()]
        assert all((gradient is None) is frozen for gradient in gradients)
        found.append([values, given.grad, *(() if frozen else gradients)])
        critic.zero_grad()
    assert found[0][0].shape == (2, 11)
    torch.testing.assert_close(found[0], found[1])


@pytest.mark.parametrize(("precision", "wanted"), [("float32", [4, 4, 3]), ("bfloat16", [6, 5])])
def test_a_critics_blocks_are_of_its_precision(
    precision: Any, wanted: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    critic = Critic(statistics().obs, ACT, (8, 7), heads=2)
    sizes: list[int] = []
    values = networks._values

    def spied(rows: Tensor, *rest: Any) -> Tensor:
        sizes.append(len(rows))
        return values(rows, *rest)

    monkeypatch.setattr(networks, "_values", spied)
    monkeypatch.setattr(networks, "BLOCK", 4)
    monkeypatch.setattr(networks, "MLP_BLOCK", 6)
    with products_in(precision):
        critic(torch.randn(11, OBS), torch.randn(11, ACT))
    assert sizes == wanted


def test_a_critic_starts_like_torchs_layers() -> None:
    critic = Critic(statistics().obs, ACT + Z, (101, 103), heads=2)
    for weight, fan_in in zip(critic.weights, (OBS + ACT + Z, 101, 103), strict=True):
        bound = fan_in**-0.5
        assert 0.8 * bound < weight.abs().max() <= bound
        assert weight.shape[:2] == (2, fan_in)


def test_predictors_predict_standardised_rewards_and_changes() -> None:
    stats = statistics()
    predictors = Predictors(stats, ACT, Z, HIDDEN)
    obs, action = contexts()[0][..., :OBS], contexts()[0][..., OBS : OBS + ACT]
    z = normal(BATCH, 1, Z).float().expand(BATCH, LENGTH, Z)
    reward, change = predictors(obs, action, z)
    assert reward.shape == (BATCH, LENGTH, 1)
    assert change.shape == (BATCH, LENGTH, OBS)
    x = torch.cat([(obs - stats.obs[0]) / stats.obs[1], action, z], dim=-1)
    torch.testing.assert_close(reward, perceptron(x, predictors.reward_net))
    torch.testing.assert_close(change, perceptron(x, predictors.state_net))


def test_the_predictors_targets() -> None:
    stats = statistics()
    obs, _, reward, next_obs = torch.split(contexts()[0], [OBS, ACT, 1, OBS], dim=-1)
    found = Predictors(stats, ACT, Z, HIDDEN).targets(reward, obs, next_obs)
    mean, std = stats.target
    torch.testing.assert_close(found[0], (reward - mean[0]) / std[0])
    torch.testing.assert_close(found[1], (next_obs - obs - mean[1:]) / std[1:])
