"""The ceiling of every context encoder: an actor-critic that is told the true task."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from torch import Tensor

from ctmrl.methods.base import MethodConfig, Reference
from ctmrl.networks import BlindEncoder, Encoder, Standardize, Statistics


@dataclass(frozen=True)
class OracleTaskConfig(MethodConfig):
    """The options of contexts change nothing: z is as large as a task has parameters."""


class TrueTask(BlindEncoder):
    """Gives the task's parameters, standardised over the training tasks, for a context."""

    def __init__(self, statistics: tuple[Tensor, Tensor]) -> None:
        """Keep the parameters' mean and standard deviation, each [P]."""
        super().__init__(len(statistics[0]))
        self.standardize = Standardize(*statistics)

    def told(self, z: Tensor, params: Tensor) -> Tensor:
        """Standardised parameters [*, P], from before the first transition on."""
        found: Tensor = self.standardize(params)
        return found


class OracleTask(Reference):
    """The true task for a context, in training and in the meta-test."""

    note: ClassVar[str] = "reference, given the true task"

    def build_encoder(self, config: MethodConfig, statistics: Statistics) -> Encoder:
        """No encoder: the parameters."""
        return TrueTask(statistics.params)
