"""FOCAL's distance metric loss, which several methods share."""

from __future__ import annotations

import torch
from torch import Tensor


def focal_metric_loss(z: Tensor) -> Tensor:
    """Push the contexts of different tasks apart: mean over pairs of 1 / (m_ij + 0.1).

    m_ij is the mean over coordinates of (z_i - z_j)^2. [FOCAL]'s pull between contexts of one task
    does not occur, because a batch holds each task once.

    Args:
        z: one context a task, [B, Z], B >= 2.

    Returns:
        Scalar in (0, 10].
    """
    i, j = torch.triu_indices(len(z), len(z), offset=1, device=z.device)
    distance = (z[i] - z[j]).square().mean(dim=1)
    # The field's code divides by the number of pairs plus 1e-3.
    return (1.0 / (distance + 0.1)).sum() / (len(i) + 1e-3)
