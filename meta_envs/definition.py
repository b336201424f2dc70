"""What an environment is: batched functions on states, shared by both shells."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar, Self

import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray

from meta_envs.tasks import TaskSet

Floats = NDArray[np.float64]
Terms = dict[str, NDArray[Any]]
Controller = Callable[[Floats, Floats], Floats]


class Simulation(ABC):
    """Moves the states of one shell's sub-environments on; every shell has one of its own.

    What `step` returns depends on its arguments and on the tasks alone, never on earlier calls.
    """

    @abstractmethod
    def set_params(self, params: Floats) -> None:
        """Put sub-environment i on the task of row i, params [n, P]."""

    @abstractmethod
    def step(self, state: Floats, action: Floats, rows: NDArray[np.bool_] | None = None) -> Floats:
        """Next states, a fresh array [n, S].

        Args:
            state: states [n, S].
            action: actions [n, A] in [-1, 1].
            rows: bool [n], whose next state is wanted; all by default. The others' are finite.
        """


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
    render_fps: int = 10
    """Pictures a second at which an episode looks natural."""
    random_episodes: ClassVar[int] = 1000
    """Episodes a task behind the random policy's return, unless a caller says otherwise."""

    def __deepcopy__(self, memo: dict[int, Any]) -> Self:
        """Itself: copies of an environment share it, for it holds nothing of an episode."""
        return self

    @abstractmethod
    def tasks(self) -> TaskSet:
        """The environment's tasks and their split."""

    @abstractmethod
    def initial_state(self, generators: Sequence[np.random.Generator]) -> Floats:
        """States at the start of an episode, [n, S], one generator a sub-environment."""

    @abstractmethod
    def advance(self, state: Floats, action: Floats, params: Floats) -> Floats:
        """Next states [n, S]."""

    def simulation(self, num_envs: int, threads: int = 1) -> Simulation:
        """What moves the states of one shell on; here `advance`, without threads.

        Args:
            num_envs: number of sub-environments.
            threads: native threads that share them, where the environment can use any.
        """
        return _Advancing(self)

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


class _Advancing(Simulation):
    """Calls `advance` with the parameters it was given."""

    def __init__(self, definition: Definition) -> None:
        self._advance = definition.advance

    def set_params(self, params: Floats) -> None:
        self._params = params

    def step(self, state: Floats, action: Floats, rows: NDArray[np.bool_] | None = None) -> Floats:
        return self._advance(state, action, self._params)
