"""Gradient steps on a GPU: the host draws, and what is left is one CUDA graph."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from ctmrl.data import Transitions
from ctmrl.numbers import NumbersAhead, Source
from datagen.accelerator import Recorded


class Given(NamedTuple):
    """What the data give a step of B tasks.

    Attributes:
        contexts: [sets, B, n, O + A + 1 + O], transitions (s, a, r, s').
        batch: for the actor-critic, task by task; of each task as many rows as all of the step's
            batches have.
        params: [B, P], true parameters of the tasks.
    """

    contexts: Tensor
    batch: Transitions
    params: Tensor


Step = Callable[[Given, Source], dict[str, Tensor]]
"""A step: scalars by metric name; it changes parameters and the like in place."""


class RecordedStep:
    """A step that reads memory that stays where it is, recorded once for each phase of a run.

    It is what `datagen.accelerator.Recorded` asks for, if the step does the same operations each
    time in a phase, waits for no value, and takes random numbers from its source alone.
    """

    def __init__(self, step: Step, generator: torch.Generator, device: torch.device) -> None:
        """Set up; nothing is called.

        Args:
            step: what to call.
            generator: of its random numbers, on the host.
            device: where it computes.
        """
        self._step, self._generator, self._device = step, generator, device
        self._given: Given | None = None
        self._phase: object = None
        self.renew()

    def renew(self) -> None:
        """Record anew: the step has changed, or tensors were replaced, as optimisers' are."""
        self._numbers = NumbersAhead(self._generator, self._device)
        self._recorded = Recorded(self._call, self._device)

    def __call__(self, given: Given, phase: object) -> dict[str, Tensor]:
        """Take a step.

        Args:
            given: what the data give it; copied.
            phase: of the run; in another one the step is made of other operations.
        """
        if phase != self._phase:
            self._phase = phase
            self.renew()
        if self._given is None:
            self._given = Given(
                given.contexts.clone(),
                Transitions(*(one.clone() for one in given.batch)),
                given.params.clone(),
            )
        else:
            for fixed, value in zip(_tensors(self._given), _tensors(given), strict=True):
                fixed.copy_(value)
        self._numbers.draw()
        self._recorded()
        # The next step writes over the values.
        return dict(zip(self._names, self._values.clone().unbind(), strict=True))

    def _call(self) -> None:
        assert self._given is not None
        self._numbers.rewind()
        metrics = self._step(self._given, self._numbers)
        self._names, self._values = tuple(metrics), torch.stack(list(metrics.values()))


def _tensors(given: Given) -> tuple[Tensor, ...]:
    return (given.contexts, *given.batch, given.params)
