"""Settings of the numerical libraries that a run's repeatability rests on."""

from __future__ import annotations

import torch


def settle_threads(threads: int) -> None:
    """Use so many threads, deterministic kernels, and no denormal numbers (they are slow)."""
    torch.set_num_threads(threads)
    torch.use_deterministic_algorithms(True)
    # Nothing here reads memory before it is written, so it need not be filled first.
    torch.utils.deterministic.fill_uninitialized_memory = False  # type: ignore[attr-defined]
    torch.set_flush_denormal(True)
