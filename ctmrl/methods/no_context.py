"""The floor: an actor-critic that is told nothing of its task."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from ctmrl.methods.base import MethodConfig, Reference
from ctmrl.networks import BlindEncoder, Encoder, Statistics


@dataclass(frozen=True)
class NoContextConfig(MethodConfig):
    """`z_dim` zeros stand in for a context; the other options of contexts change nothing."""


class NoContext(Reference):
    """One policy for all tasks: what is left of a method whose contexts say nothing."""

    note: ClassVar[str] = "reference, contexts are 0"

    def build_encoder(self, config: MethodConfig, statistics: Statistics) -> Encoder:
        """No encoder."""
        return BlindEncoder(config.z_dim)
