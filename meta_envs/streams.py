"""Random streams: one generator a sub-environment."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import overload

import numpy as np
from gymnasium.utils import seeding


class Streams(Sequence[np.random.Generator]):
    """Generators made on first use, since many environments never draw a number.

    A sub-environment's stream is the one a single environment with its seed has, and only its own
    draws move it on.
    """

    def __init__(self, seeds: Sequence[int | None]) -> None:
        """Streams from seeds, one each; None is a seed from the operating system."""
        self._seeds = list(seeds)
        self._rows: Sequence[int] = range(len(self._seeds))
        self._made: dict[int, np.random.Generator] = {}

    def __len__(self) -> int:
        """Number of streams."""
        return len(self._rows)

    @overload
    def __getitem__(self, index: int) -> np.random.Generator: ...
    @overload
    def __getitem__(self, index: slice) -> Streams: ...
    def __getitem__(self, index: int | slice) -> np.random.Generator | Streams:
        """One generator, or some streams that stay shared with these."""
        if isinstance(index, slice):
            return self.of(self._rows[index])
        row = self._rows[index]
        if row not in self._made:
            self._made[row] = seeding.np_random(self._seeds[row])[0]
        return self._made[row]

    def __iter__(self) -> Iterator[np.random.Generator]:
        """The generators in their order."""
        return (self._made.get(row) or self[place] for place, row in enumerate(self._rows))

    def of(self, rows: Sequence[int]) -> Streams:
        """The streams of these sub-environments; a draw from one is a draw from the original."""
        some = Streams.__new__(Streams)
        some._seeds, some._made, some._rows = self._seeds, self._made, rows
        return some

    def reseed(self, row: int, seed: int | None) -> None:
        """Start one sub-environment's stream anew; without a seed it goes on as it is."""
        if seed is not None:
            self._seeds[row] = seed
            self._made.pop(row, None)
