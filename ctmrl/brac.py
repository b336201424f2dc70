"""Behaviour regularisation [BRAC] with the dual form of the KL divergence."""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor
from torch.nn import functional

Penalty = Literal["value", "gradient"]
EPSILON = 1e-8


def dual_divergence(at_policy: Tensor, at_data: Tensor) -> Tensor:
    """Dual estimate of KL(pi || behaviour): log softplus(c(a_pi)) - softplus(c(a)) + 1, per sample.

    Args:
        at_policy: dual critic at the policy's actions, [n].
        at_data: dual critic at the data's actions, [n].
    """
    return torch.log(functional.softplus(at_policy) + EPSILON) - functional.softplus(at_data) + 1


def value_penalty(between: Tensor) -> Tensor:
    """The field's code: 5 mean(max(|c| - 1, 0)^2) of the critic's value between the actions.

    Args:
        between: dual critic at actions between policy and data, [n].
    """
    return 5.0 * (torch.sqrt(EPSILON + between.square()) - 1).clamp_min(0).square().mean()


def gradient_penalty(between: Tensor, actions: Tensor) -> Tensor:
    """The BRAC paper: 5 mean(max(||dc/da|| - 1, 0)^2) at actions between policy and data.

    Args:
        between: dual critic at those actions, [n], with its graph.
        actions: the actions, [n, A], that require gradients.
    """
    (slope,) = torch.autograd.grad(between.sum(), actions, create_graph=True)
    norm = torch.sqrt(EPSILON + slope.square().sum(dim=1))
    return 5.0 * (norm - 1).clamp_min(0).square().mean()


def dual_critic_loss(divergence: Tensor, penalty: Tensor) -> Tensor:
    """Minus the mean divergence, plus the penalty that keeps the critic smooth."""
    return penalty - divergence.mean()


class Multiplier:
    """Lagrange multiplier of the divergence: it grows while the divergence is above its target.

    Attributes:
        value: lambda, a scalar tensor that is changed in place.
    """

    def __init__(self, initial: float, maximum: float, target: float, wind_up: bool) -> None:
        """Set up the multiplier.

        Args:
            initial: lambda at the start.
            maximum: largest value used.
            target: divergence at which lambda stands still.
            wind_up: let lambda leave [0, maximum] and be clipped on use alone, as the field's code
                does; it can then take long to come back.
        """
        self.value = torch.tensor(initial)
        self.maximum, self.target, self.wind_up = maximum, target, wind_up

    def coefficient(self) -> Tensor:
        """The multiplier as it is used, in [0, maximum]."""
        return self.value.clamp(0.0, self.maximum)

    def update(self, divergence: Tensor) -> None:
        """One step of gradient ascent with learning rate 1."""
        value = self.value + divergence.detach().mean() - self.target
        self.value.copy_(value if self.wind_up else value.clamp(0.0, self.maximum))
