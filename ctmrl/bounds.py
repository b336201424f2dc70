"""Bounds on what a network puts out that its training can always lead back inside."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor


def bounded(x: Tensor, low: float, high: float) -> Tensor:
    """The clamp of x to [low, high], whose gradient can lead back inside but never further out.

    `torch.clamp` has no gradient outside its bounds, so what has once left them can stay there
    whatever the loss says. Here a gradient passes outside, too, where a step against it leads x
    back; inside, both are the same.

    Args:
        x: of any shape.
        low: lower bound.
        high: upper bound.
    """
    result: Tensor = _Bounded.apply(x, low, high)  # type: ignore[no-untyped-call]
    return result


class _Bounded(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, low: float, high: float) -> Tensor:
        ctx.save_for_backward(x)
        ctx.bounds = low, high
        return x.clamp(low, high)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None, None]:
        (x,), (gradient,), (low, high) = ctx.saved_tensors, gradients, ctx.bounds
        further_out = ((x < low) & (gradient > 0)) | ((x > high) & (gradient < 0))
        return gradient.masked_fill(further_out, 0.0), None, None
