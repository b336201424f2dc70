"""CLUB: its closed form against the sum over all pairs, and q against torch's own normal."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor, nn
from torch.distributions import Normal
from torch.nn import functional

from ctmrl.club import BehaviorModel, club_loss, likelihood_loss
from tests.ctmrl.examples import ACT, BATCH, LENGTH, OBS, Z, generator, normal


def inputs(dtype: torch.dtype = torch.float64) -> tuple[Tensor, Tensor, Tensor]:
    """Encodings of each task around a place of its own, and q's means and variances."""
    encodings = torch.tanh(normal(BATCH, LENGTH, Z) + normal(BATCH, 1, Z, seed=1))
    mean = torch.tanh(normal(BATCH, LENGTH, Z, seed=2))
    variance = functional.softplus(torch.tanh(normal(BATCH, LENGTH, Z, seed=3)))
    return encodings.to(dtype), mean.to(dtype), variance.to(dtype)


def by_pairs(encodings: Tensor, mean: Tensor, variance: Tensor) -> Tensor:
    """The definition: own transitions minus all n^2 pairs within a task, each pair formed."""
    own = torch.stack([-(encodings[i] - mean[i]).square() / variance[i] for i in range(BATCH)])
    pairs = [
        -(encodings[i, other] - mean[i]).square() / variance[i]
        for i in range(BATCH)
        for other in range(LENGTH)
    ]
    return own.mean() - torch.stack(pairs).mean()


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-12), (torch.float32, 1e-5)])
def test_the_closed_form_is_the_sum_over_all_pairs(dtype: torch.dtype, tolerance: float) -> None:
    found = club_loss(*inputs(dtype))
    wanted = by_pairs(*inputs()).item()
    assert abs(wanted) > 0.05
    assert found.item() == pytest.approx(wanted, rel=tolerance)


def test_its_gradient_is_that_of_the_pairs() -> None:
    encodings, mean, variance = (value.requires_grad_() for value in inputs())
    found = torch.autograd.grad(club_loss(encodings, mean, variance), [encodings, mean, variance])
    wanted = torch.autograd.grad(by_pairs(encodings, mean, variance), [encodings, mean, variance])
    for one, other in zip(found, wanted, strict=True):
        torch.testing.assert_close(one, other)


def test_it_is_zero_where_q_knows_nothing_and_positive_where_it_knows() -> None:
    encodings, _, variance = inputs()
    one_for_all = torch.full_like(encodings, 0.3)
    same = torch.ones_like(encodings)
    assert club_loss(encodings, one_for_all, same).item() == pytest.approx(0.0, abs=1e-12)
    # Where q is exact what remains is the pairs' term, twice the encodings' variance.
    spread = 2 * encodings.var(dim=1, correction=0).mean().item()
    assert club_loss(encodings, encodings, same).item() == pytest.approx(spread)
    assert club_loss(encodings, encodings, variance) > 0
    assert club_loss(encodings[:, :1], encodings[:, :1] + 1, same[:, :1]).item() == 0.0


def test_a_step_against_its_gradient_hides_what_q_knew() -> None:
    state = normal(BATCH, LENGTH, Z)
    encodings = (0.5 * state).requires_grad_()
    mean, variance = 0.4 * state, torch.full_like(state, 0.7)
    before = club_loss(encodings, mean, variance)
    (gradient,) = torch.autograd.grad(before, encodings)
    assert club_loss(encodings - 100 * gradient, mean, variance) < before


def test_the_likelihood_is_torchs() -> None:
    encodings, mean, variance = inputs()
    q = Normal(mean, variance.sqrt())
    log_prob = q.log_prob(encodings)  # type: ignore[no-untyped-call]
    wanted = -log_prob.mean() - 0.5 * math.log(2 * math.pi)
    torch.testing.assert_close(likelihood_loss(encodings, mean, variance), wanted)


def build() -> BehaviorModel:
    draw = generator()
    statistics = torch.randn(OBS + ACT, generator=draw), 0.5 + torch.rand(OBS + ACT, generator=draw)
    return BehaviorModel(statistics, (23, 19), Z)


def test_q_is_a_bounded_gaussian_of_state_and_action() -> None:
    model, x = build(), 30 * normal(BATCH, LENGTH, OBS + ACT).float()
    mean, variance = model(x)
    assert mean.shape == variance.shape == (BATCH, LENGTH, Z)
    layers = [layer for layer in model.net if isinstance(layer, nn.Linear)]
    assert [layer.out_features for layer in layers] == [23, 19, 2 * Z]
    hidden = (x - model.standardize.mean) * model.standardize.scale
    for layer in layers[:-1]:
        hidden = torch.relu(functional.linear(hidden, layer.weight, layer.bias))
    out = torch.tanh(functional.linear(hidden, layers[-1].weight, layers[-1].bias))
    torch.testing.assert_close(mean, out[..., :Z])
    torch.testing.assert_close(variance, torch.log(1 + out[..., Z:].exp()))
    assert 0.3132 < variance.min() < 0.5
    assert 1.0 < variance.max() < 1.3133


def test_q_learns_what_there_is_to_know() -> None:
    model, x = build(), normal(97, OBS + ACT).float()
    encodings = torch.tanh(x[:, :1] - x[:, 1:2]).expand(-1, Z) * 0.8
    optimizer = torch.optim.Adam(model.parameters(), lr=1e-2)
    for _ in range(200):
        optimizer.zero_grad()
        likelihood_loss(encodings, *model(x)).backward()  # type: ignore[no-untyped-call]
        optimizer.step()
    mean, variance = model(x)
    assert (encodings - mean).abs().mean() < 0.1
    # The variance is at its lower bound.
    assert variance.mean() < 0.33
