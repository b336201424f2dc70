"""Random numbers of gradient steps: from the host's generator, whatever device computes with them.

So a run draws the same tasks, transitions and noise on every device.
"""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from datagen.accelerator import Inlet

Kind = Literal["uniform", "normal"]


class Numbers:
    """Numbers that are drawn when they are asked for."""

    def __init__(self, generator: torch.Generator, device: torch.device) -> None:
        """Set up.

        Args:
            generator: of all draws, on the host.
            device: where the numbers are wanted.
        """
        self.generator, self.device = generator, device

    def take(self, kind: Kind, shape: tuple[int, ...]) -> Tensor:
        """Float32 numbers, uniform in [0, 1) or standard normal."""
        draw = torch.rand if kind == "uniform" else torch.randn
        return draw(shape, generator=self.generator).to(self.device)


class NumbersAhead(Numbers):
    """The same numbers, drawn before a step that takes them from memory that stays where it is.

    The first step finds nothing there, and draws as it asks. All others must ask for the same.
    """

    def __init__(self, generator: torch.Generator, device: torch.device) -> None:
        """Set up; nothing is known of the step."""
        super().__init__(generator, device)
        self._known: list[tuple[Kind, Inlet]] = []
        self._taken = 0
        self._complete = False

    def draw(self) -> None:
        """Draw all that the next step asks for, in its order."""
        self._complete = bool(self._known)
        for kind, inlet in self._known:
            self._fill(kind, inlet)

    def rewind(self) -> None:
        """A step begins."""
        self._taken = 0

    def take(self, kind: Kind, shape: tuple[int, ...]) -> Tensor:
        """Those of the step's next place.

        Raises:
            RuntimeError: the step does not ask for what earlier ones did.
        """
        if not self._complete:
            self._known.append((kind, Inlet(shape, self.device)))
            self._fill(*self._known[-1])
        if self._taken == len(self._known):
            raise RuntimeError("a recorded step asks for more random numbers than before")
        there, inlet = self._known[self._taken]
        self._taken += 1
        if there != kind or inlet.tensor.shape != shape:
            raise RuntimeError("a recorded step asks for other random numbers than before")
        return inlet.tensor

    def _fill(self, kind: Kind, inlet: Inlet) -> None:
        def write(array: NDArray[np.float32]) -> None:
            into: Any = torch.from_numpy(array)
            if kind == "uniform":
                into.uniform_(generator=self.generator)
            else:
                into.normal_(generator=self.generator)

        inlet.fill(write)


Source = torch.Generator | Numbers
"""Where random numbers come from: a generator alone is the host's, for the host."""


def uniform(source: Source, *shape: int) -> Tensor:
    """Float32 numbers in [0, 1)."""
    if isinstance(source, torch.Generator):
        return torch.rand(shape, generator=source)
    return source.take("uniform", shape)


def normal(source: Source, *shape: int) -> Tensor:
    """Standard normal float32 numbers."""
    if isinstance(source, torch.Generator):
        return torch.randn(shape, generator=source)
    return source.take("normal", shape)
