"""What an environment is: batched functions on states, shared by both shells."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray

from meta_envs.tasks import TaskSet

Floats = NDArray[np.float64]
Terms = dict[str, NDArray[Any]]
Controller = Callable[[Floats, Floats], Floats]


class Definition(ABC):
    """One environment, written once over arrays with a leading axis of n sub-environments.

    Shapes: states [n, S], actions [n, A] in [-1, 1], task params [n, P], observations [n, O].
    The single and the vector environment of `meta_envs.env` are thin shells over these functions,
    so a sub-environment's numbers do not depend on how many stand beside it.
    """

    name: ClassVar[str]
    """Short name, as in the registry."""
    horizon: ClassVar[int]
    """Steps until an episode is truncated."""
    observation_space: Box[np.float32]
    action_space: Box[np.float32]
    controllers: Mapping[str, Controller] = {}
    """Reference controllers, (states, params) -> actions; `oracle` is the exact optimum."""
    sparse: ClassVar[bool] = False
    """True if `reward` is sparse and its terms hold the `dense_reward` learners may use."""

    @abstractmethod
    def tasks(self) -> TaskSet:
        """The environment's tasks and their split."""

    @abstractmethod
    def initial_state(self, generators: Sequence[np.random.Generator]) -> Floats:
        """States at the start of an episode, [n, S], one generator a sub-environment."""

    @abstractmethod
    def advance(self, state: Floats, action: Floats, params: Floats) -> Floats:
        """Next states [n, S]."""

    @abstractmethod
    def observe(self, state: Floats) -> NDArray[np.float32]:
        """Observations, float32 [n, O]; the task is not among them."""

    @abstractmethod
    def reward(
        self, state: Floats, action: Floats, next_state: Floats, params: Floats
    ) -> tuple[Floats, Terms]:
        """Rewards [n] and their terms, a dict of arrays [n] that `info` carries every step.

        All of them are fresh arrays that the caller may write to, and no two share memory.
        """

    @abstractmethod
    def terminated(self, state: Floats) -> NDArray[np.bool_]:
        """Whether each state ends its episode for real, bool [n]; never for the time limit."""

    @abstractmethod
    def render(self, path: Floats, params: Floats) -> NDArray[np.uint8]:
        """Picture [height, width, 3] of one episode so far: its states [t, S], its task [P]."""
