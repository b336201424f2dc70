"""TaskSet: the tasks of a meta-environment and which of them are for training."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Sampler = Callable[[np.random.Generator, int], NDArray[np.float64]]


def interleaved_test_tasks(n_train: int, n_test: int) -> NDArray[np.int64]:
    """Test tasks of the field's interpolating split: every g-th task, g = n_train / n_test + 1."""
    gap = n_train // n_test + 1
    return np.arange(0, n_train + n_test, gap, dtype=np.int64) + gap // 2


@dataclass(frozen=True, eq=False)
class TaskSet:
    """A fixed, ordered set of tasks.

    Attributes:
        env: short name of the environment the tasks belong to.
        param_names: what each parameter is, P names.
        params: float64 [n_tasks, P], one row a task, a read-only copy of what was given.
        test_tasks: int64 [n_test], sorted rows of the meta-test tasks, a read-only copy; all others
            are for training.
        sampler: draws n fresh rows from the distribution the tasks come from.

    Raises:
        ValueError: params of another shape or not finite; test tasks unsorted or out of range.
    """

    env: str
    param_names: tuple[str, ...]
    params: NDArray[np.float64]
    test_tasks: NDArray[np.int64]
    sampler: Sampler = field(repr=False)

    def __post_init__(self) -> None:
        """Check the contents and keep read-only copies of the arrays."""
        params = np.array(self.params, dtype=np.float64)
        if params.ndim != 2 or params.shape[1] != len(self.param_names):
            raise ValueError(
                f"{self.env}: params must be [n_tasks, {len(self.param_names)}], got {params.shape}"
            )
        if not np.isfinite(params).all():
            raise ValueError(f"{self.env}: params must be finite")
        rows = np.array(self.test_tasks, dtype=np.int64)
        inside = (rows >= 0) & (rows < len(params))
        if rows.ndim != 1 or not inside.all() or (np.diff(rows) <= 0).any():
            raise ValueError(
                f"{self.env}: test_tasks must be sorted rows between 0 and {len(params) - 1}"
            )
        for name, array in (("params", params), ("test_tasks", rows)):
            array.setflags(write=False)
            object.__setattr__(self, name, array)

    def __len__(self) -> int:
        """Number of tasks."""
        return len(self.params)

    @property
    def train_tasks(self) -> NDArray[np.int64]:
        """Sorted rows of the meta-training tasks, int64 [n_train]."""
        return np.setdiff1d(np.arange(len(self)), self.test_tasks)

    @property
    def hash(self) -> str:
        """SHA-256 over the environment, the parameters (to nine decimals) and the split."""
        # Nine decimals, because the last bits of sin and cos differ between platforms.
        content = {
            "env": self.env,
            "param_names": self.param_names,
            "params": (np.round(self.params, 9) + 0.0).tolist(),
            "test_tasks": self.test_tasks.tolist(),
        }
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()

    def check_task(self, task: object) -> int:
        """Return `task` as a row of this set, or raise a ValueError that names the valid rows."""
        if not isinstance(task, int | np.integer) or isinstance(task, bool):
            raise ValueError(
                f"{self.env}: task must be an integer, got {task!r} ({type(task).__name__})"
            )
        if not 0 <= task < len(self):
            raise ValueError(f"{self.env} has tasks 0 to {len(self) - 1}, got task={int(task)}")
        return int(task)

    def sample(self, n_tasks: int, seed: int) -> TaskSet:
        """Draw fresh tasks, all of them test tasks, from the distribution of this set.

        Args:
            n_tasks: how many, at least 1.
            seed: of a private generator, non-negative; the same seed gives the same tasks.

        Raises:
            ValueError: either argument out of range.
        """
        for name, value, least in (("n_tasks", n_tasks, 1), ("seed", seed, 0)):
            if not isinstance(value, int | np.integer) or isinstance(value, bool) or value < least:
                raise ValueError(
                    f"{self.env}: {name} must be an integer of at least {least}, got {value!r}"
                )
        params = self.sampler(np.random.default_rng(seed), n_tasks)
        return TaskSet(self.env, self.param_names, params, np.arange(n_tasks), self.sampler)
