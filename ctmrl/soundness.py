"""What tells a run that diverges: quantities that are not finite, a Q that no reward explains."""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from torch import Tensor

from ctmrl.errors import Diverged

EXPLODED = 100.0
"""How many times what the rewards can add up to a Q may be."""


def q_limit(reward: float, entropy: float, gamma: float) -> float:
    """The largest |Q| that is not taken for an explosion.

    Rewards of at most r and a bonus of at most c add up to (r + c) / (1 - gamma); networks that
    have learnt nothing yet give values around 1. A hundred times the larger is of no policy.

    Args:
        reward: the largest |r| of the data.
        entropy: what a policy's entropy adds to a reward, its weight times a nat for each action.
        gamma: discount factor; 1 sets no limit.
    """
    most = (reward + entropy) / (1 - gamma) if gamma < 1 else math.inf
    return EXPLODED * max(most, 1.0)


@torch.no_grad()
def check_sound(step: int, quantities: Mapping[str, Tensor], limits: Mapping[str, float]) -> None:
    """Check that quantities are finite and within their limits.

    Args:
        step: at which they came about, for the sentence.
        quantities: tensors of any shape by name, in the order they came about.
        limits: largest absolute value of those that have one.

    Raises:
        Diverged: the first one that is not, as a clause.
    """
    largest = torch.stack(torch._foreach_norm(list(quantities.values()), math.inf)).tolist()
    for name, value in zip(quantities, largest, strict=True):
        limit = limits.get(name, math.inf)
        if not math.isfinite(value):
            raise Diverged(f"{name} is {value} at step {step}")
        if value > limit:
            raise Diverged(f"{name} is {value:.3g} at step {step}, beyond its limit {limit:.3g}")
