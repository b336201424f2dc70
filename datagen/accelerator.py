"""The hardware, for learners of behaviour policies and of contexts alike.

Which precision it multiplies fast, and a function that a GPU records once, as a CUDA graph, and
then replays without Python.
"""

from __future__ import annotations

import functools
import time
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from datagen.budgets import Precision

WARM_UP = 3
"""Calls before a recording, as many as torch's documentation has."""
TURNS = 9
"""Of which the least time counts, so that a busy machine does not."""
LEAST_GAIN = 1.5
"""Times as fast as float32 that AVX-512's bfloat16 must be; 2.2, 4.4 and less than 1 were seen."""


def best_precision(device: torch.device | str = "cpu") -> Precision:
    """bfloat16 where the hardware multiplies it faster than float32, float32 elsewhere.

    AMX always does. AVX-512's instructions for it do on some processors (AMD's) and not on others
    (docs/fleet.md), so where they are all there is, both are timed, once a process.
    """
    if torch.device(device).type == "cuda":
        return "bfloat16" if torch.cuda.is_bf16_supported(including_emulation=False) else "float32"
    # Older versions of torch cannot tell.
    capabilities: dict[str, Any] = getattr(torch.cpu, "get_capabilities", dict)()
    fast = capabilities.get("amx_bf16") or (
        capabilities.get("avx512_bf16") and bfloat16_gain() > LEAST_GAIN
    )
    return "bfloat16" if fast else "float32"


@functools.cache
def bfloat16_gain() -> float:
    """How many times as fast as in float32 a processor multiplies matrices in bfloat16."""
    least = dict.fromkeys((torch.float32, torch.bfloat16), float("inf"))
    for _ in range(TURNS):
        for dtype in least:
            rows, weight = torch.ones(2048, 256, dtype=dtype), torch.ones(256, 256, dtype=dtype)
            start = time.perf_counter()
            rows @ weight
            least[dtype] = min(least[dtype], time.perf_counter() - start)
    return least[torch.float32] / least[torch.bfloat16]


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


class Inlet:
    """A tensor that stays where it is, for numbers that come from the host."""

    def __init__(self, shape: tuple[int, ...], device: torch.device) -> None:
        """Set aside its memory."""
        self.tensor = torch.zeros(shape, device=device)

    def fill(self, write: Callable[[NDArray[np.float32]], None]) -> None:
        """Give it what a function writes to an array of its shape, without waiting for a GPU."""
        if self.tensor.device.type == "cpu":
            write(self.tensor.numpy())
            return
        # Torch gives pinned memory away again only when the copies from it are over.
        staged = torch.empty(self.tensor.shape, pin_memory=True)
        write(staged.numpy())
        self.tensor.copy_(staged, non_blocking=True)


def recorded(function: Callable[[], None], device: torch.device) -> Callable[[], None]:
    """A function as it is on a processor, and recorded where its device is a GPU."""
    return Recorded(function, device) if device.type == "cuda" else function


class Recorded:
    """A function of a GPU's tensors that is recorded as a CUDA graph, and then replayed.

    It must do the same operations on the same memory each time: it takes and returns nothing, draws
    no random numbers, and waits for no value. A call is always exactly one of the function: the
    first few run as they are, on a stream aside, which is the warm-up that a recording needs, and
    recording itself computes nothing.
    """

    def __init__(self, function: Callable[[], None], device: torch.device) -> None:
        """Set up; nothing is called.

        Args:
            function: what to call.
            device: the GPU it computes on.
        """
        self._function, self._device = function, device
        self._aside = torch.cuda.Stream(device)  # type: ignore[no-untyped-call] # torch's own
        self._calls = 0
        self._graph: torch.cuda.CUDAGraph | None = None

    def __call__(self) -> None:
        """Call the function once."""
        self._calls += 1
        if self._calls <= WARM_UP:
            self._warm_up()
            return
        if self._graph is None:
            self._graph = torch.cuda.CUDAGraph()
            with torch.cuda.graph(self._graph, stream=self._aside):
                self._function()
        self._graph.replay()

    def _warm_up(self) -> None:
        main = torch.cuda.current_stream(self._device)
        self._aside.wait_stream(main)
        with torch.cuda.stream(self._aside), warnings.catch_warnings():
            # Optimisers that can be recorded warn where they are not.
            warnings.filterwarnings("ignore", ".*capturable=True", UserWarning)
            self._function()
        main.wait_stream(self._aside)
