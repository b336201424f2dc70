"""What a method is: how contexts are made from transitions, and what trains that."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import torch
from torch import Tensor, nn

from ctmrl.networks import ContextEncoder, Encoder, Statistics
from ctmrl.numbers import Source


@dataclass(frozen=True)
class MethodConfig:
    """Hyper-parameters of the context that every method has; a method's own config adds to it."""

    z_dim: int = 20
    """Size of a context."""
    encoder_hidden: tuple[int, ...] = (64, 64)
    """Widths of the encoder's hidden layers."""
    encoder_lr: float = 1e-3
    """Learning rate of the encoder and all that is trained with it, at the start."""
    next_obs_in_context: bool = True
    """Whether the encoder sees s' beside s, a and r."""
    dense_reward_in_context: bool = False
    """On a sparse environment, let contexts see the dense reward, in training and in the meta-test,
    as some of the field's scripts do; scores stay sparse."""
    standardize_contexts: bool = False
    """Standardise contexts before actor and critics get them, by running statistics over training
    tasks. Tasks' contexts lie close together, and networks learn little from what hardly differs
    beside observations, which have a spread of 1."""


class Dimensions(NamedTuple):
    """Sizes a method builds its networks from.

    Attributes:
        obs: O.
        act: A.
        tasks: number of training tasks.
        steps: gradient steps of the whole run.
    """

    obs: int
    act: int
    tasks: int
    steps: int


class Method(nn.Module, ABC):
    """A context-learning method. Everything else - data, actor-critic, meta-test - is shared.

    Subclasses own their networks; all their parameters are trained by one optimiser with
    `config.encoder_lr`, on the loss that `context_loss` returns.
    """

    context_sets = 1
    """Contexts from different episodes each step needs of a task."""
    note: ClassVar[str] = ""
    """What stands behind the method's name in every table, where a reader must know it."""
    explores: ClassVar[bool] = True
    """Whether exploration can change what the policy is told."""

    def __init__(self, config: MethodConfig, statistics: Statistics, dims: Dimensions) -> None:
        """Build the encoder; initial weights come from torch's global generator."""
        super().__init__()
        self.dims = dims
        self.encoder = self.build_encoder(config, statistics)

    def build_encoder(self, config: MethodConfig, statistics: Statistics) -> Encoder:
        """What makes contexts; its `z_dim` is the size of all contexts."""
        return ContextEncoder(
            statistics.context,
            self.dims.obs,
            config.encoder_hidden,
            config.z_dim,
            config.dense_reward_in_context,
            config.standardize_contexts,
        )

    @abstractmethod
    def context_loss(
        self, contexts: Tensor, encodings: Tensor, generator: Source
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """The loss that trains the encoder.

        Args:
            contexts: [context_sets, B, n, O + A + 1 + O], transitions (s, a, r, s').
            encodings: of the transitions, [context_sets, B, n, Z], with gradients; their means are
                the task-specific contexts.
            generator: of all draws.

        Returns:
            Scalar loss, and scalars by metric name (the same names every step).
        """

    def before_step(self, step: int, all_contexts: Callable[[], Tensor]) -> None:
        """Do what a schedule asks for before gradient step `step`, 0..dims.steps-1.

        Args:
            step: the step about to be taken.
            all_contexts: draws one fresh task-specific context of every training task, [T, Z].
        """

    @property
    def phase(self) -> object:
        """What decides of which operations a step is made; none may depend on values of tensors.

        Where it changes, a step that was recorded for a GPU is recorded anew.
        """
        return None

    @property
    def codes(self) -> Tensor | None:
        """The cross-task contexts, [N, Z]; None where a method has none, or none in use yet."""
        return None

    def code_of(self, z: Tensor) -> Tensor | None:
        """Code of each context [*, Z], int64 [*]; None where `codes` is."""
        return None


class Reference(Method):
    """A line to read methods against: it learns no contexts, and `note` says so in every table."""

    explores = False

    @abstractmethod
    def build_encoder(self, config: MethodConfig, statistics: Statistics) -> Encoder:
        """What stands in for contexts, without parameters to train."""

    def context_loss(
        self, contexts: Tensor, encodings: Tensor, generator: Source
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """0, for there is nothing to train."""
        return torch.zeros((), device=contexts.device), {}
