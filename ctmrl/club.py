"""CLUB: a bound on what encodings tell about the behaviour policy, as CSRO uses it."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from ctmrl.networks import Standardize, mlp


class BehaviorModel(nn.Module):
    """q(e | s, a): what a transition's encoding is when only state and action are known.

    A diagonal Gaussian. Both heads pass through tanh, as in the field's code, so the variance stays
    within softplus(-1) = 0.313 and softplus(1) = 1.313.
    """

    def __init__(
        self, statistics: tuple[Tensor, Tensor], hidden: tuple[int, ...], z_dim: int
    ) -> None:
        """Build the network; `statistics` are of (s, a), each [O + A]."""
        super().__init__()
        self.standardize = Standardize(*statistics)
        self.net = mlp(len(statistics[0]), hidden, 2 * z_dim)

    def forward(self, state_action: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and variance, each [*, Z], for (s, a), [*, O + A]."""
        out = torch.tanh(self.net(self.standardize(state_action)))
        mean, raw_variance = out.chunk(2, dim=-1)
        return mean, functional.softplus(raw_variance)


def likelihood_loss(encodings: Tensor, mean: Tensor, variance: Tensor) -> Tensor:
    """What fits q: (e - mean)^2 / (2 variance) + log(variance) / 2, averaged over everything.

    Args:
        encodings: [*, Z].
        mean: of q, [*, Z].
        variance: of q, [*, Z].

    Returns:
        Scalar, q's negative log-likelihood a coordinate but for a constant.
    """
    return ((encodings - mean).square() / variance + variance.log()).mean() / 2


def club_loss(encodings: Tensor, mean: Tensor, variance: Tensor) -> Tensor:
    """How much better q explains a transition's own encoding than the others of its task.

    The mean over transitions t of -(e_t - mean_t)^2 / variance_t minus the mean over all n^2 pairs
    (t, t') of a task of -(e_t' - mean_t)^2 / variance_t. The pairs cost O(n): the mean over t' of
    (e_t' - mean_t)^2 is the variance of the task's encodings plus (their mean - mean_t)^2.

    Args:
        encodings: of a task's n transitions, [B, n, Z].
        mean: of q, [B, n, Z].
        variance: of q, [B, n, Z].

    Returns:
        Scalar; to minimise it keeps s and a out of the encodings.
    """
    own = (encodings - mean).square()
    centre = encodings.mean(dim=-2, keepdim=True)
    spread = (encodings - centre).square().mean(dim=-2, keepdim=True)
    others = spread + (centre - mean).square()
    return ((others - own) / variance).mean()
