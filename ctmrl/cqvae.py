"""Equations (1) to (10) of the source paper, one function each: pure functions of tensors.

B tasks in the batch, T transitions of a task, Z the size of a context, N codes.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from ctmrl.numbers import Source, uniform

EPSILON = 1e-6
"""Least norm a vector is divided by, so that a zero vector has cosine 0 and not NaN."""


def cosine(a: Tensor, b: Tensor) -> Tensor:
    """All pairs' cosine similarities: [n, Z], [m, Z] -> [n, m]."""
    return (
        functional.normalize(a, dim=-1, eps=EPSILON)
        @ functional.normalize(b, dim=-1, eps=EPSILON).T
    )


def match(contexts: Tensor, codes: Tensor) -> Tensor:
    """Equation (1): index of the code nearest to each context by cosine, [B, Z] -> int64 [B]."""
    return cosine(contexts, codes).argmax(dim=1)


def count(matched: Tensor, n_codes: int) -> Tensor:
    """How many of some codes, int64 [B], are each of the N: int64 [N]."""
    return (matched[:, None] == torch.arange(n_codes, device=matched.device)).sum(dim=0)


def moving_update(codes: Tensor, contexts: Tensor, matched: Tensor, eta: float) -> Tensor:
    """Equation (2): C_new = (1 - eta) C_old + eta c, for matched codes only.

    Where several contexts match one code, c is their mean, so that their order does not matter.

    Args:
        codes: [N, Z].
        contexts: [B, Z].
        matched: int64 [B], from `match`.
        eta: learning rate of the codes.

    Returns:
        Updated codes [N, Z]; unmatched ones are unchanged.
    """
    counts = count(matched, len(codes))
    sums = torch.zeros_like(codes).index_add_(0, matched, contexts)
    means = sums / counts.clamp_min(1)[:, None]
    return torch.where(counts[:, None] > 0, (1 - eta) * codes + eta * means, codes)


def code_contrast_loss(contexts: Tensor, codes: Tensor, matched: Tensor, tau: float) -> Tensor:
    """Equation (3), L_C: minus the sum over tasks of the matched code's log softmax of cos / tau.

    Args:
        contexts: [B, Z].
        codes: [N, Z].
        matched: int64 [B], from `match`.
        tau: temperature.

    Returns:
        Scalar, a sum over the B tasks as printed.
    """
    return functional.cross_entropy(cosine(contexts, codes) / tau, matched, reduction="sum")


def reward_prediction_loss(predicted: Tensor, reward: Tensor, squared: bool = False) -> Tensor:
    """Equations (4) and (7), L_r: sum over t of the norms of the error, [*, T, 1] -> [*].

    With `squared`, of their squares, as the released code has it.
    """
    return _norms(predicted - reward, squared).sum(dim=-1)


def state_prediction_loss(predicted: Tensor, next_obs: Tensor, squared: bool = False) -> Tensor:
    """Equations (5) and (8), L_s: sum over t of the norms of the error, [*, T, O] -> [*].

    With `squared`, of their squares, as the released code has it.
    """
    return _norms(predicted - next_obs, squared).sum(dim=-1)


def prediction_loss(reward_loss: Tensor, state_loss: Tensor) -> Tensor:
    """Equations (6) and (9), L_pre = L_r + L_s with equal weight."""
    return reward_loss + state_loss


def _norms(error: Tensor, squared: bool) -> Tensor:
    squares = error.square().sum(dim=-1)
    # A norm's gradient at exactly zero error is NaN without the small term.
    return squares if squared else (squares + 1e-12).sqrt()


def hard_contrast_loss(
    anchors: Tensor, positives: Tensor, groups: Tensor, negatives: Tensor, tau: float, n_codes: int
) -> Tensor:
    """Equation (10), L_contra: tell apart the tasks that match the same code.

    Args:
        anchors: c^{spe,anchor}, [B, Z].
        positives: c^{spe,+} of the same tasks from other trajectories, [B, Z].
        groups: int64 [B], code each task matches.
        negatives: bool [B, B]; row k marks the tasks l != k whose positives stand in the
            denominator of task k, from `hard_negatives`.
        tau: temperature.
        n_codes: N; codes without a task contribute nothing but count in 1/N, as printed.

    Returns:
        Scalar, (1/N) sum over codes of the mean over the code's tasks.
    """
    logits = cosine(anchors, positives) / tau
    own = torch.eye(len(anchors), dtype=torch.bool, device=anchors.device)
    masked = logits.masked_fill(~(negatives | own), -torch.inf)
    per_task = masked.logsumexp(dim=1) - logits.diagonal()
    return (per_task / count(groups, n_codes)[groups]).sum() / n_codes


def hard_negatives(groups: Tensor, extra: int, generator: Source) -> Tensor:
    """Which tasks are negatives of which: those of the same code, or M random ones for singletons.

    Args:
        groups: int64 [B], code each task matches.
        extra: M, tasks drawn for a task that is alone with its code (all others if there are
            fewer).
        generator: of the draw.

    Returns:
        bool [B, B], False on the diagonal.
    """
    n = len(groups)
    own = torch.eye(n, dtype=torch.bool, device=groups.device)
    same = (groups[:, None] == groups[None, :]) & ~own
    keys = uniform(generator, n, n).masked_fill(own, 2.0)
    m = min(extra, n - 1)
    drawn = torch.zeros_like(own)
    drawn.scatter_(1, keys.topk(m, dim=1, largest=False).indices, True)
    alone = ~same.any(dim=1)
    return torch.where(alone[:, None], drawn, same)
