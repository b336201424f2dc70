"""Checks of what users hand to the environments: a fault is one sentence that names it."""

from __future__ import annotations

import operator
from collections.abc import Mapping, Sequence
from typing import Any, SupportsIndex

import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import ArrayLike, NDArray

from meta_envs.definition import Floats
from meta_envs.tasks import TaskSet

# As arrays, since a ufunc converts a Python number on every call.
_LOW, _HIGH = np.array(-1.0), np.array(1.0)


def check_options(options: Mapping[str, Any] | None, known: tuple[str, ...]) -> Mapping[str, Any]:
    """Return the options of `reset`, or raise a ValueError that names an unknown one."""
    unknown = sorted(set(options or ()) - set(known))
    if unknown:
        raise ValueError(f"reset has no option {unknown[0]!r} (known: {', '.join(known)})")
    return options or {}


def check_render_mode(render_mode: str | None) -> str | None:
    """Return "rgb_array" or None; anything else is a ValueError."""
    if render_mode not in (None, "rgb_array"):
        raise ValueError(f"render_mode must be 'rgb_array' or None, got {render_mode!r}")
    return render_mode


def check_autoreset_mode(mode: AutoresetMode | str) -> AutoresetMode:
    """Return the mode, also from its value; anything else is a ValueError."""
    try:
        return AutoresetMode(mode)
    except ValueError:
        values = ", ".join(known.value for known in AutoresetMode)
        raise ValueError(f"autoreset_mode must be one of {values}, got {mode!r}") from None


def check_positive(name: str, value: SupportsIndex) -> int:
    """Return a count of at least 1; anything else is a ValueError that names it."""
    try:
        count = operator.index(value)
    except TypeError:
        count = 0
    if count < 1 or isinstance(value, bool):
        raise ValueError(f"{name} must be an integer of at least 1, got {value!r}")
    return count


def check_task_set(name: str, tasks: TaskSet) -> TaskSet:
    """Return the tasks if they are those of environment `name`, or raise a ValueError."""
    if not isinstance(tasks, TaskSet):
        raise ValueError(f"task_set must be a TaskSet, got {type(tasks).__name__}")
    if tasks.env != name:
        raise ValueError(f"task_set belongs to '{tasks.env}', not to '{name}'")
    return tasks


def check_rows(tasks: Any, task_set: TaskSet) -> NDArray[np.int64]:
    """Return a sequence of tasks as rows of the task set, or raise a ValueError."""
    if isinstance(tasks, str) or not isinstance(tasks, Sequence | np.ndarray | range):
        raise ValueError(f"{task_set.env}: tasks must be a sequence of integers, got {tasks!r}")
    if not len(tasks):
        raise ValueError(f"{task_set.env}: tasks is empty; at least one task is needed")
    if isinstance(tasks, np.ndarray) and tasks.ndim == 1 and tasks.dtype.kind in "iu":
        outside = tasks[(tasks < 0) | (tasks >= len(task_set))]
        if not outside.size:
            return tasks.astype(np.int64)
    return np.array([task_set.check_task(task) for task in tasks], dtype=np.int64)


def check_seeds(seed: Any, num_envs: int) -> list[int | None]:
    """Return one seed a sub-environment: seed + i from an integer, or a list's own entries."""
    if isinstance(seed, int | np.integer):
        seeds: list[Any] = [int(seed) + i for i in range(num_envs)]
    elif isinstance(seed, Sequence | np.ndarray) and not isinstance(seed, str):
        seeds = [int(one) if isinstance(one, np.integer) else one for one in seed]
    else:
        raise ValueError(f"seed must be an integer or one for each sub-environment, got {seed!r}")
    if len(seeds) != num_envs:
        raise ValueError(f"seed: {num_envs} are needed, one a sub-environment, got {len(seeds)}")
    for one in seeds:
        if one is not None and not (isinstance(one, int) and one >= 0):
            raise ValueError(f"seed must be a non-negative integer, got {one!r}")
    return seeds


def check_asked(tasks: Any, task_set: TaskSet, num_envs: int) -> NDArray[np.int64]:
    """Return the option "task", one for all or one for each, or raise a ValueError."""
    wanted = tasks if isinstance(tasks, Sequence | np.ndarray) else [tasks] * num_envs
    rows = check_rows(wanted, task_set)
    if len(rows) != num_envs:
        raise ValueError(f"option 'task' needs {num_envs} tasks, got {len(rows)}")
    return rows


def check_mask(name: str, mask: Any, num_envs: int) -> NDArray[np.bool_]:
    """Return a mask, bool [num_envs], or raise a ValueError that names it."""
    if (
        not isinstance(mask, np.ndarray)
        or mask.dtype != np.bool_
        or mask.shape != (num_envs,)
        or not mask.any()
    ):
        raise ValueError(
            f"{name} must be a bool array of shape ({num_envs},) with at least one True, "
            f"got {mask!r}"
        )
    return mask


def check_action(action: ArrayLike, shape: tuple[int, ...]) -> Floats:
    """Return a fresh float64 copy of the actions, clipped to [-1, 1].

    Raises:
        ValueError: not numbers, a wrong shape or a NaN. Infinities are clipped like any number.
    """
    try:
        given = np.asarray(action, dtype=np.float64)
    except (TypeError, ValueError):
        raise ValueError(f"action must be numbers of shape {shape}, got {action!r}") from None
    if given.shape != shape:
        raise ValueError(f"action must have shape {shape}, got {given.shape}")
    clipped: Floats = np.maximum(given, _LOW)
    np.minimum(clipped, _HIGH, out=clipped)
    # After the clipping every number is finite, so their sum is NaN just where one of them is.
    if np.isnan(np.add.reduce(clipped, axis=None)):
        where = tuple(int(i) for i in np.argwhere(np.isnan(clipped))[0])
        raise ValueError(f"action holds NaN, first at index {where}")
    return clipped
