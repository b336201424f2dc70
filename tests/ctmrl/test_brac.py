"""Behaviour regularisation: the dual divergence, its penalties and its multiplier."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor, nn

from ctmrl import brac
from ctmrl.networks import mlp
from tests.ctmrl.examples import ACT, generator, normal

SAMPLES = 13


def softplus(x: float) -> float:
    return math.log(1 + math.exp(x))


def test_a_critic_of_0_everywhere() -> None:
    zero = torch.zeros(SAMPLES)
    found = brac.dual_divergence(zero, zero)
    assert found.shape == (SAMPLES,)
    assert found.tolist() == pytest.approx([math.log(math.log(2)) - math.log(2) + 1] * SAMPLES)
    assert found[0].item() == pytest.approx(-0.0596, abs=1e-4)


def test_the_divergence_against_a_loop() -> None:
    at_policy, at_data = normal(SAMPLES), normal(SAMPLES, seed=1)
    found = brac.dual_divergence(at_policy, at_data)
    for k in range(SAMPLES):
        x, y = at_policy[k].item(), at_data[k].item()
        wanted = math.log(softplus(x) + 1e-8) - softplus(y) + 1
        assert found[k].item() == pytest.approx(wanted, rel=1e-10)


def test_the_divergence_is_finite_far_out() -> None:
    far = torch.tensor([-1e4, 1e4])
    assert brac.dual_divergence(far, far.flip(0)).isfinite().all()


def test_the_value_penalty_against_a_loop() -> None:
    between = 2 * normal(SAMPLES)
    wanted = sum(5 * max(math.sqrt(1e-8 + c**2) - 1, 0) ** 2 for c in between.tolist()) / SAMPLES
    assert brac.value_penalty(between).item() == pytest.approx(wanted, rel=1e-10)
    assert brac.value_penalty(torch.full((SAMPLES,), -0.99)).item() == 0.0


def test_the_gradient_penalty_against_differences() -> None:
    actions = normal(SAMPLES, ACT).requires_grad_()

    def critic(a: Tensor) -> Tensor:
        return torch.sin(3 * a[:, 0]) + a[:, 1] ** 2

    total, step = 0.0, 1e-6
    for k in range(SAMPLES):
        slopes = []
        for axis in range(ACT):
            shift = torch.zeros(SAMPLES, ACT, dtype=torch.float64)
            shift[k, axis] = step
            with torch.no_grad():
                rise = critic(actions + shift)[k] - critic(actions - shift)[k]
            slopes.append(rise.item() / (2 * step))
        total += 5 * max(math.hypot(*slopes) - 1, 0) ** 2 / SAMPLES
    found = brac.gradient_penalty(critic(actions), actions)
    assert found.item() == pytest.approx(total, rel=1e-5)
    assert total > 0.1


def test_the_gradient_penalty_trains_the_critic() -> None:
    weight = torch.full((ACT,), 3.0, dtype=torch.float64, requires_grad=True)
    actions = normal(SAMPLES, ACT).requires_grad_()
    penalty = brac.gradient_penalty(actions @ weight, actions)
    # The slope of a linear critic is its weight w, so d/dw 5 (|w| - 1)^2 = 10 (|w| - 1) w / |w|.
    length = math.sqrt(18)
    (gradient,) = torch.autograd.grad(penalty, weight)
    assert gradient.tolist() == pytest.approx([10 * (length - 1) * 3 / length] * ACT)


def test_the_dual_critic_maximises_the_divergence() -> None:
    found = brac.dual_critic_loss(torch.tensor([1.0, 2.0, 6.0]), torch.tensor(0.5))
    assert found.item() == pytest.approx(0.5 - 3.0)


def test_the_multiplier_grows_by_what_the_divergence_is_above_its_target() -> None:
    multiplier = brac.Multiplier(50.0, 2000.0, 0.05, wind_up=False)
    for step in range(1, 8):
        multiplier.update(torch.full((SAMPLES,), 0.55))
        assert multiplier.coefficient().item() == pytest.approx(50.0 + 0.5 * step, rel=1e-6)
    multiplier.update(torch.tensor([0.0, 0.1, 0.05]))
    assert multiplier.value.item() == pytest.approx(53.5, rel=1e-6)


@pytest.mark.parametrize(("wind_up", "value"), [(True, 56.0), (False, 51.0)])
def test_winding_up_is_a_switch(wind_up: bool, value: float) -> None:
    multiplier = brac.Multiplier(50.0, 51.0, 0.05, wind_up)
    for _ in range(12):
        multiplier.update(torch.full((SAMPLES,), 0.55))
    assert multiplier.coefficient().item() == 51.0
    assert multiplier.value.item() == pytest.approx(value, rel=1e-5)
    for _ in range(2):
        multiplier.update(torch.full((SAMPLES,), -0.45))
    assert multiplier.coefficient().item() == pytest.approx(51.0 if wind_up else 50.0, rel=1e-5)


@pytest.mark.parametrize(("wind_up", "value"), [(True, -4.5), (False, 0.0)])
def test_the_multiplier_is_never_used_below_0(wind_up: bool, value: float) -> None:
    multiplier = brac.Multiplier(0.5, 51.0, 0.05, wind_up)
    for _ in range(10):
        multiplier.update(torch.full((SAMPLES,), -0.45))
    assert multiplier.coefficient().item() == 0.0
    assert multiplier.value.item() == pytest.approx(value, abs=1e-5)


def test_the_multiplier_takes_no_gradient() -> None:
    multiplier = brac.Multiplier(0.5, 51.0, 0.05, wind_up=False)
    multiplier.update(torch.full((SAMPLES,), 0.5, requires_grad=True))
    assert not multiplier.value.requires_grad


def estimate(shift: float) -> float:
    """KL(N(shift, 1), N(0, 1)) as a freshly trained dual critic without a penalty sees it."""
    critic: nn.Module = mlp(1, (16,), 1)
    optimizer = torch.optim.Adam(critic.parameters(), lr=1e-2)
    draw, found = generator(1), []
    for step in range(400):
        policy, data = torch.randn(2, 512, 1, generator=draw)
        divergence = brac.dual_divergence(critic(policy + shift)[:, 0], critic(data)[:, 0])
        loss = brac.dual_critic_loss(divergence, torch.zeros(()))
        optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimizer.step()
        if step >= 300:
            found.append(divergence.mean().item())
    return sum(found) / len(found)


def test_the_trained_dual_critic_estimates_the_kl_divergence() -> None:
    found = [estimate(shift) for shift in (0.0, 0.7, 1.4)]
    # The divergence of two normal distributions of deviation 1 is half their distance squared.
    assert found == pytest.approx([0.0, 0.245, 0.98], abs=0.12)
    assert found[0] < found[1] < found[2]
