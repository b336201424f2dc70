"""Settings of the numerical libraries that a run's repeatability rests on."""

from __future__ import annotations

import os

import torch


def settle_threads(threads: int) -> None:
    """Use so many threads, deterministic kernels, and no denormal numbers (they are slow)."""
    torch.set_num_threads(threads)
    torch.use_deterministic_algorithms(True)
    # What a GPU's matrix products need for it.
    os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")
    # Nothing here reads memory before it is written, so it need not be filled first.
    torch.utils.deterministic.fill_uninitialized_memory = False  # type: ignore[attr-defined]
    torch.set_flush_denormal(True)
