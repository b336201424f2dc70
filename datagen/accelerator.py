"""The hardware, for learners of behaviour policies and of contexts alike."""

from __future__ import annotations

from typing import Any

import torch

from datagen.budgets import Precision


def best_precision(device: torch.device | str = "cpu") -> Precision:
    """bfloat16 where the hardware has units for its matrix products, float32 elsewhere.

    AVX-512 can multiply bfloat16 too, but slower than float32 (docs/fleet.md).
    """
    if torch.device(device).type == "cuda":
        return "bfloat16" if torch.cuda.is_bf16_supported(including_emulation=False) else "float32"
    # Older versions of torch cannot tell.
    capabilities: dict[str, Any] = getattr(torch.cpu, "get_capabilities", dict)()
    return "bfloat16" if capabilities.get("amx_bf16") else "float32"


def check_precision(precision: str, device: str) -> Precision:
    """A precision as it is, or for "auto" the best one of a device.

    Raises:
        ValueError: torch cannot use the device.
    """
    try:
        if device.partition(":")[0] not in ("cpu", "cuda"):
            raise RuntimeError("learning is on cpu or cuda")
        torch.empty(1, device=device)
    except (RuntimeError, AssertionError) as error:
        reason = str(error).splitlines()[0]
        raise ValueError(f"--device {device} cannot be used here: {reason}") from None
    if precision == "auto":
        return best_precision(device)
    return "bfloat16" if precision == "bfloat16" else "float32"
