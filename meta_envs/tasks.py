"""TaskSet: the tasks of a meta-environment and which of them are for training."""

from __future__ import annotations

import difflib
import hashlib
import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Sampler = Callable[[np.random.Generator, int], NDArray[np.float64]]

DEFAULT_SPLIT = "interpolate"
"""Name of the split every task set has."""
MOST_NAMES = 6
"""Names that an error message lists; of more parameters it says where they are."""


def interleaved_test_tasks(n_train: int, n_test: int) -> NDArray[np.int64]:
    """Test tasks of the field's interpolating split: every g-th task, g = n_train / n_test + 1."""
    gap = n_train // n_test + 1
    return np.arange(0, n_train + n_test, gap, dtype=np.int64) + gap // 2


def _frozen(values: ArrayLike, dtype: type[np.generic]) -> NDArray[Any]:
    """A read-only copy."""
    array = np.array(values, dtype=dtype)
    array.setflags(write=False)
    return array


def _listed(names: Sequence[str]) -> str:
    """Names for an error message."""
    more = len(names) - MOST_NAMES
    rest = f" and {more} more of TaskSet.param_names" if more > 0 else ""
    return ", ".join(names[:MOST_NAMES]) + rest


def _is_finite_number(value: object) -> bool:
    if isinstance(value, bool) or not isinstance(value, int | float | np.integer | np.floating):
        return False
    try:
        return math.isfinite(value)
    except OverflowError:
        return False


@dataclass(frozen=True, eq=False)
class Split:
    """Which tasks are for training and which for the meta-test.

    The two need not be all tasks, and where a family has only two tasks they may be the same.

    Attributes:
        train_tasks: int64 [n_train], sorted rows, a read-only copy of what was given.
        test_tasks: int64 [n_test], the same.
    """

    train_tasks: NDArray[np.int64]
    test_tasks: NDArray[np.int64]

    def __post_init__(self) -> None:
        """Keep read-only copies of the rows."""
        for name in ("train_tasks", "test_tasks"):
            object.__setattr__(self, name, _frozen(getattr(self, name), np.int64))

    def __reduce__(self) -> tuple[Any, ...]:
        """Copies are made anew, for a copied array could be written to."""
        return Split, (self.train_tasks, self.test_tasks)


@dataclass(frozen=True, eq=False)
class TaskSet:
    """A fixed, ordered set of tasks.

    Attributes:
        env: short name of the environment the tasks belong to.
        param_names: what each parameter is, P names.
        params: float64 [n_tasks, P], one row a task, a read-only copy of what was given.
        test_tasks: int64 [n_test], sorted rows of the default split's meta-test tasks, a read-only
            copy; all others are for training, unless `splits` says otherwise.
        sampler: draws n fresh rows from the distribution the tasks come from.
        splits: every split by its name, read-only: "interpolate", the default one, comes first,
            and "extrapolate" is there where the field has one. Give the others only; give the
            default one too where its training tasks are not simply all that are not tested.
        bounds: lowest and highest possible value of parameters that have any, by their names.
        choices: the only possible values of parameters that have any, by their names.

    Raises:
        ValueError: params of another shape, not finite, out of bounds or none of the choices; rows
            of a split unsorted or out of range; bounds or choices of a parameter that is not there.
    """

    env: str
    param_names: tuple[str, ...]
    params: NDArray[np.float64]
    test_tasks: NDArray[np.int64]
    sampler: Sampler = field(repr=False)
    splits: Mapping[str, Split] = field(default_factory=dict, repr=False)
    bounds: Mapping[str, tuple[float, float]] = field(default_factory=dict, repr=False)
    choices: Mapping[str, tuple[float, ...]] = field(default_factory=dict, repr=False)

    def __post_init__(self) -> None:
        """Check the contents and keep read-only copies of them."""
        params = _frozen(self.params, np.float64)
        if params.ndim != 2 or params.shape[1] != len(self.param_names):
            raise ValueError(
                f"{self.env}: params must be [n_tasks, {len(self.param_names)}], got {params.shape}"
            )
        if not np.isfinite(params).all():
            raise ValueError(f"{self.env}: params must be finite")
        for name in (*self.bounds, *self.choices):
            self._check_name(name)
        object.__setattr__(self, "params", params)
        object.__setattr__(self, "bounds", MappingProxyType(dict(self.bounds)))
        object.__setattr__(self, "choices", MappingProxyType(dict(self.choices)))
        self._check_bounds()
        self._check_choices()
        object.__setattr__(self, "test_tasks", _frozen(self.test_tasks, np.int64))
        self._check_rows("test_tasks", self.test_tasks)
        object.__setattr__(self, "splits", MappingProxyType(self._every_split()))

    def _every_split(self) -> dict[str, Split]:
        rest = np.setdiff1d(np.arange(len(self)), self.test_tasks)
        splits = {DEFAULT_SPLIT: Split(rest, self.test_tasks), **self.splits}
        for name, split in splits.items():
            for kind in ("train_tasks", "test_tasks"):
                self._check_rows(f"{kind} of split '{name}'", getattr(split, kind))
        if not np.array_equal(splits[DEFAULT_SPLIT].test_tasks, self.test_tasks):
            raise ValueError(f"{self.env}: test_tasks are not those of split '{DEFAULT_SPLIT}'")
        return splits

    def _check_rows(self, what: str, rows: NDArray[np.int64]) -> None:
        inside = (rows >= 0) & (rows < len(self))
        if rows.ndim != 1 or not inside.all() or (np.diff(rows) <= 0).any():
            raise ValueError(
                f"{self.env}: {what} must be sorted rows between 0 and {len(self) - 1}"
            )

    def _check_bounds(self) -> None:
        for name, (low, high) in self.bounds.items():
            values = self.params[:, self.param_names.index(name)]
            outside = values[(values < low) | (values > high)]
            if outside.size:
                raise ValueError(
                    f"{self.env}: task parameter {name} must be between {low:g} and {high:g}, "
                    f"got {outside[0]:g}"
                )

    def _check_choices(self) -> None:
        for name, allowed in self.choices.items():
            values = self.params[:, self.param_names.index(name)]
            others = values[~np.isin(values, allowed)]
            if others.size:
                raise ValueError(
                    f"{self.env}: task parameter {name} must be "
                    f"{' or '.join(f'{value:g}' for value in allowed)}, got {others[0]:g}"
                )

    def _check_name(self, name: object) -> None:
        if name not in self.param_names:
            near = difflib.get_close_matches(str(name), self.param_names, n=1)
            hint = f"; did you mean '{near[0]}'?" if near else ""
            raise ValueError(
                f"{self.env}: no task parameter '{name}'{hint} (known: {_listed(self.param_names)})"
            )

    def __reduce__(self) -> tuple[Any, ...]:
        """Copies are made anew, for a copied array could be written to."""
        given = (self.env, self.param_names, self.params, self.test_tasks, self.sampler)
        mappings = (self.splits, self.bounds, self.choices)
        return TaskSet, (*given, *map(dict, mappings))

    def __len__(self) -> int:
        """Number of tasks."""
        return len(self.params)

    @property
    def train_tasks(self) -> NDArray[np.int64]:
        """Sorted rows of the default split's meta-training tasks, int64 [n_train], read-only."""
        return self.splits[DEFAULT_SPLIT].train_tasks

    def split_of(self, task: int) -> str:
        """The default split's side that a task's data are on, "train" where it is on both."""
        alone = task in self.test_tasks and task not in self.train_tasks
        return "test" if alone else "train"

    @property
    def hash(self) -> str:
        """SHA-256 over the environment, the parameters (to nine decimals) and the splits."""
        # Nine decimals, because the last bits of sin and cos differ between platforms.
        content: dict[str, Any] = {
            "env": self.env,
            "param_names": self.param_names,
            "params": (np.round(self.params, 9) + 0.0).tolist(),
            "test_tasks": self.test_tasks.tolist(),
        }
        rest = np.setdiff1d(np.arange(len(self)), self.test_tasks)
        # A plain set is hashed without its one split, as it was before splits had names.
        if len(self.splits) > 1 or not np.array_equal(self.train_tasks, rest):
            content["splits"] = {
                name: [split.train_tasks.tolist(), split.test_tasks.tolist()]
                for name, split in self.splits.items()
            }
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()

    def check_task(self, task: object) -> int:
        """Return `task` as a row of this set, or raise a ValueError that names the valid rows."""
        if not isinstance(task, int | np.integer) or isinstance(task, bool):
            raise ValueError(
                f"{self.env}: task must be an integer, got {task!r} ({type(task).__name__})"
            )
        if not 0 <= task < len(self):
            valid = f"tasks 0 to {len(self) - 1}" if len(self) > 1 else "only task 0 here"
            raise ValueError(f"{self.env} has {valid}, got task={int(task)}")
        return int(task)

    def sample(self, seed: int, n_tasks: int) -> TaskSet:
        """Draw fresh tasks, all of them test tasks, from the distribution of this set.

        Args:
            seed: of a private generator, non-negative; the same seed gives the same tasks.
            n_tasks: how many, at least 1.

        Raises:
            ValueError: either argument out of range.
        """
        for name, value, least in (("n_tasks", n_tasks, 1), ("seed", seed, 0)):
            if not isinstance(value, int | np.integer) or isinstance(value, bool) or value < least:
                raise ValueError(
                    f"{self.env}: {name} must be an integer of at least {least}, got {value!r}"
                )
        return self._others(self.sampler(np.random.default_rng(seed), n_tasks))

    def with_params(
        self, task_params: Mapping[str, float] | Sequence[Mapping[str, float]]
    ) -> TaskSet:
        """Tasks of one's own in this environment, all of them test tasks.

        Args:
            task_params: a number for every name in `param_names`; a sequence of such mappings gives
                one task each.

        Raises:
            ValueError: a name unknown (the message has the nearest) or missing, a value that is no
                finite number, is out of bounds or is none of the choices.
        """
        given = [task_params] if isinstance(task_params, Mapping) else task_params
        if not isinstance(given, list | tuple) or not given:
            raise ValueError(
                f"{self.env}: task_params must be a mapping from {_listed(self.param_names)} "
                f"to numbers, or a sequence of such mappings, got {task_params!r}"
            )
        return self._others(np.array([self._row(one) for one in given]))

    def _row(self, task_params: object) -> list[float]:
        if not isinstance(task_params, Mapping):
            raise ValueError(f"{self.env}: task_params must be a mapping, got {task_params!r}")
        for name in task_params:
            self._check_name(name)
        missing = [name for name in self.param_names if name not in task_params]
        if missing:
            raise ValueError(
                f"{self.env}: task_params lacks {_listed(missing)} "
                f"(needed: {_listed(self.param_names)})"
            )
        for name, value in task_params.items():
            if not _is_finite_number(value):
                raise ValueError(
                    f"{self.env}: task parameter {name} must be a finite number, got {value!r}"
                )
        return [float(task_params[name]) for name in self.param_names]

    def _others(self, params: NDArray[np.float64]) -> TaskSet:
        """Other tasks of the same environment, all of them test tasks."""
        rows = np.arange(len(params))
        return replace(self, params=params, test_tasks=rows, splits={})
