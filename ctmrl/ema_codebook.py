"""A codebook of moving averages: each code is a sum of contexts over their number, both decaying.

It differs from `ctmrl.codebook.Codebook`, which follows the source paper, in that no gradient
reaches the codes and that every code, matched or not, is made anew at every update.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from ctmrl.codebook import Placed, kmeans
from ctmrl.cqvae import count, match

SMOOTHING = 1e-5
"""Laplace smoothing of the codes' sizes, which keeps the division finite for a code of size 0."""


class EMACodebook(Placed):
    """N codes of size Z.

    Attributes:
        codes: [N, Z].
        sizes: [N], moving number of contexts that match a code at an update.
        sums: [N, Z], moving sum of those contexts.
    """

    codes: Tensor
    sizes: Tensor
    sums: Tensor

    def __init__(self, n_codes: int, z_dim: int, generator: torch.Generator) -> None:
        """Start from random unit vectors, which are not used before K-means places the codes."""
        super().__init__()
        start = functional.normalize(torch.randn(n_codes, z_dim, generator=generator), dim=1)
        self.register_buffer("codes", start)
        self.register_buffer("sizes", torch.zeros(n_codes))
        self.register_buffer("sums", start.clone())

    def match(self, contexts: Tensor) -> Tensor:
        """Index of the code nearest to each context by cosine, [B, Z] -> int64 [B].

        A code of length 0 has cosine 0 with everything, so that a dead code, which shrinks to
        nothing, never makes the cosine 0 / 0.
        """
        return match(contexts.detach(), self.codes)

    @torch.no_grad()
    def update(self, contexts: Tensor, matched: Tensor, decay: float) -> None:
        """Decay all sizes and sums, add the contexts to those of their codes, remake all codes.

        Args:
            contexts: [B, Z].
            matched: int64 [B], from `match`.
            decay: share of the old sizes and sums that stays.
        """
        counts = count(matched, len(self.codes))
        sums = torch.zeros_like(self.sums).index_add_(0, matched, contexts)
        self.sizes.mul_(decay).add_(counts, alpha=1 - decay)
        self.sums.mul_(decay).add_(sums, alpha=1 - decay)
        total = self.sizes.sum()
        smooth = (self.sizes + SMOOTHING) / (total + len(self.codes) * SMOOTHING) * total
        self.codes.copy_(self.sums / smooth[:, None])

    @torch.no_grad()
    def place(self, contexts: Tensor, seed: int) -> None:
        """Put the codes at the K-means centres of collected contexts [n, Z].

        As released, a code's size becomes the number of its contexts but its sum the one centre, so
        that the codes are short at first and grow to their length within some fifty updates.
        """
        centres = _unit_centres(contexts, len(self.codes), seed)
        counts = count(match(contexts, centres), len(centres))
        self.codes.copy_(centres)
        self.sums.copy_(centres)
        # A centre that repeats another has no contexts; over a size of 0 its sum would be huge.
        self.sizes.copy_(counts.clamp_min(1))
        self.placed.fill_(True)

    @torch.no_grad()
    def refresh(self, contexts: Tensor, decay: float, seed: int) -> None:
        """Update once by K-means centres of collected contexts [n, Z], as if they were contexts."""
        centres = _unit_centres(contexts, len(self.codes), seed)
        self.update(centres, self.match(centres), decay)


def _unit_centres(contexts: Tensor, n_codes: int, seed: int) -> Tensor:
    return functional.normalize(kmeans(contexts, n_codes, seed), dim=1)
