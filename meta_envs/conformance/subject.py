"""What a conformance check is given, and how it says what is wrong."""

from __future__ import annotations

import importlib
import inspect
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from meta_envs import registry
from meta_envs.definition import Definition
from meta_envs.registry import ENVIRONMENTS, Row
from meta_envs.tasks import TaskSet

NAMED = re.compile(r"\w+(\.\w+)*(?<!\.py):\w+")
"""`module:Class`, the module as in an import."""
SHORT_NAME = re.compile("[a-z][a-z0-9_]*")


class NonConformityError(Exception):
    """What an environment does that it must not; the message says it in one sentence."""


class NotApplicableError(Exception):
    """Why a check cannot be made here."""


def require(condition: bool | np.bool_, otherwise: str) -> None:
    """Raise a NonConformityError that says `otherwise` unless the condition holds."""
    if not condition:
        raise NonConformityError(otherwise)


def require_same(one: Any, other: Any, otherwise: str) -> None:
    """Raise a NonConformityError unless two arrays are of one type and shape and equal in bits."""
    first, second = np.asarray(one), np.asarray(other)
    same_kind = (first.dtype, first.shape) == (second.dtype, second.shape)
    if not same_kind:
        raise NonConformityError(
            f"{otherwise}: {first.dtype} {list(first.shape)} and "
            f"{second.dtype} {list(second.shape)}"
        )
    if first.tobytes() != second.tobytes():
        where = np.argwhere(np.atleast_1d(first != second))
        place = f", first at index {tuple(where[0].tolist())}" if len(where) else ""
        raise NonConformityError(f"{otherwise}{place}")


@dataclass(frozen=True)
class Subject:
    """The environment that is checked.

    Attributes:
        row: its row of the registry.
    """

    row: Row

    @property
    def definition(self) -> Definition:
        """Its batched functions, one instance for the whole process."""
        return registry.definition(self.row.name)

    @property
    def task_set(self) -> TaskSet:
        """Its own tasks."""
        return registry.task_set(self.row.name)

    def make(self, **kwargs: Any) -> Any:
        """A single environment, by `gymnasium.make` and without its passive checker."""
        return gymnasium.make(self.row.id, disable_env_checker=True, **kwargs)

    def make_vec(self, **kwargs: Any) -> Any:
        """Sub-environments side by side, by `gymnasium.make_vec`, on one thread by default."""
        return gymnasium.make_vec(
            self.row.id, vectorization_mode="vector_entry_point", **{"threads": 1, **kwargs}
        )

    def tasks(self, count: int) -> list[int]:
        """So many tasks, spread evenly over all; some twice where there are not so many."""
        n_tasks = len(self.task_set)
        spread = np.linspace(0, n_tasks - 1, min(count, n_tasks)).round().astype(int)
        return [int(task) for task in np.resize(spread, count)]

    def actions(self, steps: int, num_envs: int, seed: int = 8) -> NDArray[np.float32]:
        """Actions [steps, num_envs, A], with values beyond the box and infinities among them."""
        shape = (steps, num_envs, *(self.definition.action_space.shape))
        actions = np.random.default_rng(seed).uniform(-1.5, 1.5, shape)
        actions[::5, ::3, 0] = np.inf
        actions[::7, ::2, -1] = -np.inf
        return actions.astype(np.float32)


@contextmanager
def subject(env: str) -> Iterator[Subject]:
    """A registered environment, or anybody's Definition, which is registered meanwhile.

    Args:
        env: any of a registered environment's names, or `module:Class` of a Definition.

    Raises:
        ValueError: there is no such thing; the message says what is missing.
    """
    if ":" not in env:
        yield Subject(registry.resolve(env))
        return
    row = _row_of(env)
    known = ENVIRONMENTS.get(row.name)
    if known is not None and known.definition == env:
        yield Subject(known)
        return
    if known is not None or row.id in gymnasium.registry:
        raise ValueError(f"{env}: there is a '{row.name}' already; give yours another name")
    with lent(row):
        yield Subject(row)


@contextmanager
def lent(row: Row) -> Iterator[None]:
    """Register an environment for as long as the context lasts."""
    registry.register(row)
    try:
        yield
    finally:
        registry.unregister(row)


def _row_of(env: str) -> Row:
    """The row that a Definition would have in the registry."""
    if not NAMED.fullmatch(env):
        raise ValueError(f"{env}: write module:Class, such as my_package.my_robot:MyRobot")
    module, _, attribute = env.partition(":")
    try:
        made = getattr(importlib.import_module(module), attribute, None)
    except ModuleNotFoundError as error:
        raise ValueError(f"{env}: there is no module '{error.name}' on Python's path") from None
    # Whatever else the module raises is its author's mistake.
    except Exception as error:
        reason = f"{type(error).__name__}: {error}"
        raise ValueError(f"{env}: importing '{module}' ends in {reason}") from error
    if made is None:
        raise ValueError(f"{env}: module '{module}' has no '{attribute}'")
    if not (inspect.isclass(made) and issubclass(made, Definition)):
        raise ValueError(f"{env}: this is not a subclass of meta_envs.definition.Definition")
    for name, kind in (("name", str), ("horizon", int)):
        if not isinstance(getattr(made, name, None), kind):
            raise ValueError(f"{env}: it must have a class variable '{name}' ({kind.__name__})")
    if not SHORT_NAME.fullmatch(made.name):
        raise ValueError(
            f"{env}: its name must be lower-case letters, digits and underscores, such as "
            f"'my_robot', got '{made.name}'"
        )
    camel = "".join(part.capitalize() for part in made.name.split("_"))
    return Row(made.name, f"{camel}-v0", made.name.replace("_", "-"), env, made.horizon, "")
