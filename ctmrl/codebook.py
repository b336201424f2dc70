"""The codebook of CQ-VAE: codes, their moving update, and K-means that places them."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Self

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from ctmrl.cqvae import cosine, count, match, moving_update
from ctmrl.errors import UsageError


def check_codes(codes: int, tasks: int) -> None:
    """Check that a codebook fits the number of training tasks.

    Raises:
        UsageError: not fewer codes than training tasks, or none.
    """
    if not 1 <= codes < tasks:
        raise UsageError(
            f"--codes must be at least 1 and less than the {tasks} training tasks, got {codes}"
        )


def kmeans(contexts: Tensor, n_codes: int, seed: int) -> Tensor:
    """Cluster contexts by direction, the metric codes are matched by.

    Args:
        contexts: [n, Z], n >= n_codes.
        n_codes: N.
        seed: of the initial centres.

    Returns:
        [N, Z]: the mean of each cluster's contexts (not of their directions, because a code also
        stands in for its contexts in the predictors).
    """
    # Imported here: it takes a second, and only runs that use K-means need it.
    from sklearn.cluster import KMeans
    from sklearn.exceptions import ConvergenceWarning
    from threadpoolctl import threadpool_limits

    directions = functional.normalize(contexts, dim=1, eps=1e-6).cpu().numpy().astype(np.float64)
    # It would take all cores: torch's threads are not those of its libraries.
    with warnings.catch_warnings(), threadpool_limits(1):
        # Fewer distinct contexts than codes: the surplus centres repeat others, which is right.
        warnings.simplefilter("ignore", ConvergenceWarning)
        labels = KMeans(n_codes, n_init=4, random_state=seed).fit_predict(directions)
    found = torch.from_numpy(labels).long().to(contexts.device)
    counts = count(found, n_codes)
    sums = contexts.new_zeros(n_codes, contexts.shape[1]).index_add_(0, found, contexts)
    means = sums / counts.clamp_min(1)[:, None]
    fallback = contexts[torch.arange(n_codes) % len(contexts)]
    return torch.where(counts[:, None] > 0, means, fallback)


class Placed(nn.Module):
    """What codebooks have in common.

    Attributes:
        placed: bool scalar, whether the codes are in use; on the host whatever device the codes are
            on, because it decides what a step does.
    """

    placed: Tensor

    def __init__(self) -> None:
        """They are not in use."""
        super().__init__()
        self.register_buffer("placed", torch.zeros((), dtype=torch.bool))

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        placed = self.placed
        super()._apply(fn, recurse)  # type: ignore[no-untyped-call] # torch's own
        self.placed = placed
        return self


class Codebook(Placed):
    """N codes of size Z, a parameter that Equation (2) moves and the losses' gradients refine."""

    def __init__(self, n_codes: int, z_dim: int, generator: torch.Generator) -> None:
        """Start from random unit vectors; K-means places them later, unless it is switched off."""
        super().__init__()
        start = functional.normalize(torch.randn(n_codes, z_dim, generator=generator), dim=1)
        self.codes = nn.Parameter(start)

    def match(self, contexts: Tensor) -> Tensor:
        """Equation (1): index of each context's code, int64 [B]."""
        return match(contexts.detach(), self.codes.detach())

    @torch.no_grad()
    def update(self, contexts: Tensor, matched: Tensor, eta: float) -> None:
        """Equation (2), in place."""
        self.codes.copy_(moving_update(self.codes, contexts, matched, eta))

    @torch.no_grad()
    def place(self, contexts: Tensor, seed: int) -> None:
        """Put the codes at the K-means centres of collected contexts [n, Z]."""
        self.codes.copy_(kmeans(contexts, len(self.codes), seed))
        self.placed.fill_(True)

    @torch.no_grad()
    def refresh(self, contexts: Tensor, eta: float, seed: int) -> None:
        """Cluster collected contexts [n, Z] and move the codes towards the centres.

        Each centre is matched and moves its code by Equations (1) and (2). A code that none of the
        contexts matches is dead; it takes the place of a centre that is farthest from its own code.
        """
        centres = kmeans(contexts, len(self.codes), seed)
        self.update(centres, self.match(centres), eta)
        used = count(self.match(contexts), len(self.codes)) > 0
        dead = torch.nonzero(~used)[:, 0]
        if len(dead):
            nearest = cosine(centres, self.codes[used]).max(dim=1).values
            lonely = nearest.argsort(stable=True)[: len(dead)]
            self.codes[dead[: len(lonely)]] = centres[lonely]


SHARE = "codes/share/"
"""What the names of the codes' shares begin with; a code's index follows."""


def usage(matched: Tensor, n_codes: int) -> dict[str, Tensor]:
    """Metrics of how the tasks of a batch use the codes: perplexity, and the share of each code."""
    shares = count(matched, n_codes) / len(matched)
    named = {f"{SHARE}{index}": share for index, share in enumerate(shares.unbind())}
    return {"codes/perplexity": perplexity(matched, n_codes), **named}


def perplexity(matched: Tensor, n_codes: int) -> Tensor:
    """How many codes are in use, exp of the entropy of the assignment; 1 to N."""
    share = count(matched, n_codes) / len(matched)
    found: Tensor = torch.special.entr(share).sum().exp()
    return found
