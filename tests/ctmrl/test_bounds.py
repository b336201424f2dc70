"""Bounds whose gradient leads back inside."""

import pytest
import torch

from ctmrl.bounds import bounded
from ctmrl.networks import LOG_STD_RANGE, Actor

X = torch.tensor([-3.0, -1.0, -0.5, 0.0, 0.5, 2.0, 7.0])


def test_values_are_those_of_clamp() -> None:
    assert bounded(X, -1.0, 2.0).equal(X.clamp(-1.0, 2.0))


@pytest.mark.parametrize(
    ("gradient", "wanted"),
    [(1.0, [0, 1, 1, 1, 1, 1, 1]), (-1.0, [-1, -1, -1, -1, -1, -1, 0])],
)
def test_a_gradient_passes_unless_a_step_against_it_leads_further_out(
    gradient: float, wanted: list[float]
) -> None:
    x = X.clone().requires_grad_()
    (gradient * bounded(x, -1.0, 2.0)).sum().backward()  # type: ignore[no-untyped-call]
    assert x.grad is not None
    assert x.grad.tolist() == wanted


def test_inside_the_gradient_is_that_of_clamp_and_exact() -> None:
    x = torch.linspace(-0.9, 1.9, 50, dtype=torch.float64, requires_grad=True)
    weights = torch.randn(50, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    (found,) = torch.autograd.grad((weights * bounded(x, -1, 2).exp()).sum(), x)
    (wanted,) = torch.autograd.grad((weights * x.clamp(-1, 2).exp()).sum(), x)
    assert found.equal(wanted)
    assert torch.autograd.gradcheck(lambda inner: bounded(inner, -1.0, 2.0), x)


@pytest.mark.parametrize("start", [1.5, -21.5])
def test_what_begins_outside_comes_to_where_its_loss_wants_it(start: float) -> None:
    x = torch.tensor([start], requires_grad=True)
    optimizer = torch.optim.Adam([x], lr=0.05)
    for _ in range(2000):
        loss = (bounded(x, *LOG_STD_RANGE) + 3.0).square().sum()
        optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimizer.step()
    assert x.item() == pytest.approx(-3.0, abs=1e-3)


@pytest.mark.parametrize("start", [0.7, -20.5])
def test_nothing_winds_up_outside(start: float) -> None:
    x = torch.tensor([start], requires_grad=True)
    (bounded(x, *LOG_STD_RANGE) * (-1.0 if start > 0 else 1.0)).sum().backward()  # type: ignore[no-untyped-call]
    assert x.grad is not None
    assert x.grad.item() == 0.0


def test_a_policy_that_is_too_wide_everywhere_learns_the_spread_of_its_data() -> None:
    """With `clamp` its log standard deviation would stay at 0 whatever the data say."""
    torch.manual_seed(0)
    zeros, ones = torch.zeros(3), torch.ones(3)
    policy = Actor((zeros, ones), 2, (16,), 2)
    last_bias = list(policy.parameters())[-1]
    with torch.no_grad():
        last_bias[2:] = 1.5
    draw = torch.Generator().manual_seed(1)
    obs, z = torch.randn(256, 3, generator=draw), torch.randn(256, 2, generator=draw)
    action = torch.tanh(0.1 * torch.randn(256, 2, generator=draw))
    assert (policy(obs, z)[1] == 0).all()
    optimizer = torch.optim.Adam(policy.parameters(), lr=1e-2)
    for _ in range(300):
        loss = -policy.sample(obs, z, draw).log_prob_of(action).mean()
        optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimizer.step()
    assert policy(obs, z)[1].mean().item() == pytest.approx(-2.3, abs=0.3)
