"""FOCAL's metric loss against a double loop."""

from __future__ import annotations

import pytest
import torch

from ctmrl.metric import focal_metric_loss
from tests.ctmrl.examples import BATCH, Z, normal


def test_the_metric_loss_against_a_double_loop() -> None:
    z = normal(BATCH, Z)
    total, pairs = 0.0, 0
    for i in range(BATCH):
        for j in range(i + 1, BATCH):
            distance = sum((z[i, k] - z[j, k]).item() ** 2 for k in range(Z)) / Z
            total += 1 / (distance + 0.1)
            pairs += 1
    assert pairs == BATCH * (BATCH - 1) // 2
    assert focal_metric_loss(z).item() == pytest.approx(total / (pairs + 1e-3), rel=1e-12)


def test_equal_contexts_are_the_worst_and_far_ones_the_best() -> None:
    equal = focal_metric_loss(torch.ones(BATCH, Z, dtype=torch.float64)).item()
    assert equal == pytest.approx(10 * 55 / 55.001, rel=1e-9)
    corners = torch.tensor([[-1.0], [1.0]], dtype=torch.float64).expand(2, Z)
    assert focal_metric_loss(corners).item() == pytest.approx(1 / 4.1 / 1.001, rel=1e-9)


def test_the_metric_loss_pushes_contexts_apart() -> None:
    z = normal(BATCH, Z).requires_grad_()
    (gradient,) = torch.autograd.grad(focal_metric_loss(z), z)
    before, after = torch.pdist(z), torch.pdist(z - 0.1 * gradient)
    assert after.mean() > before.mean()
    assert focal_metric_loss(z - 0.1 * gradient) < focal_metric_loss(z)


def test_equal_contexts_have_a_finite_gradient() -> None:
    z = torch.zeros(BATCH, Z, requires_grad=True)
    (gradient,) = torch.autograd.grad(focal_metric_loss(z), z)
    assert gradient.isfinite().all()
