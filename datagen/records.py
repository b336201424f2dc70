"""What must be true of a task's `meta` and of a dataset's index: keys, types, identity."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from datagen.files import task_file
from meta_envs import TaskSet, resolve, task_set

FORMAT_VERSION = 1
"""Version of the format, in every file and every index; other versions are refused."""

_IDENTITY: dict[str, type] = {"env": str, "env_id": str, "param_names": list, "task_hash": str}
_ORIGIN: dict[str, type] = {"seed": int, "config": dict, "versions": dict}
_TASK: dict[str, type] = {"task": int, "split": str, "params": list, "returns": dict}
_FILE: dict[str, type] = {
    "file": str,
    "bytes": int,
    "sha256": str,
    "transitions": int,
    "episodes": int,
}
_JSON_NAMES = {str: "a text", int: "an integer", list: "a list", dict: "an object"}
_HEX = frozenset("0123456789abcdef")


def check_version(record: Mapping[str, Any]) -> None:
    """Raise a ValueError unless a meta or an index is of this version of the format."""
    version = record.get("format_version")
    if version != FORMAT_VERSION or isinstance(version, bool):
        raise ValueError(
            f"is of format version {version!a}, this program reads version {FORMAT_VERSION}"
        )


def check_meta(meta: Mapping[str, Any]) -> TaskSet:
    """Check a task's meta, all but its content's hash.

    Returns:
        The environment's tasks.

    Raises:
        ValueError: what is wrong with it.
    """
    check_version(meta)
    _check_types(meta, {**_IDENTITY, **_ORIGIN, **_TASK}, "meta")
    tasks = _check_environment(meta)
    _check_task(meta, tasks)
    return tasks


def check_index(index: Mapping[str, Any]) -> TaskSet:
    """Check a dataset's index, all but its own hash.

    Returns:
        The environment's tasks.

    Raises:
        ValueError: what is wrong with it.
    """
    check_version(index)
    _check_types(index, {**_IDENTITY, **_ORIGIN, "budget": str, "tasks": list}, "the index")
    tasks = _check_environment(index)
    previous = -1
    for record in index["tasks"]:
        if not isinstance(record, Mapping):
            raise ValueError("has a task that is not a record")
        _check_types(record, {**_TASK, **_FILE}, "a task's record")
        _check_task(record, tasks)
        if record["task"] <= previous:
            raise ValueError(f"task {record['task']} is twice in it or not in order")
        previous = record["task"]
        _check_file(record)
    if previous < 0:
        raise ValueError("has no tasks")
    return tasks


def _check_types(record: Mapping[str, Any], types: Mapping[str, type], what: str) -> None:
    for key, wanted in types.items():
        if key not in record:
            raise ValueError(f"{what} has no key '{key}'")
        if not isinstance(record[key], wanted) or isinstance(record[key], bool):
            raise ValueError(f"{what} has '{key}' {record[key]!a}, not {_JSON_NAMES[wanted]}")


def _check_environment(record: Mapping[str, Any]) -> TaskSet:
    """Compare the environment and its tasks with the installed ones."""
    row = resolve(record["env"])
    if (record["env"], record["env_id"]) != (row.name, row.id):
        raise ValueError(
            f"its environment is {record['env']!a}, {record['env_id']!a}, "
            f"here that is '{row.name}', '{row.id}'"
        )
    tasks = task_set(row.name)
    if record["task_hash"] != tasks.hash:
        raise ValueError(
            f"belongs to another version of {row.name}: its tasks have the hash "
            f"{record['task_hash'][:12]!a}, those installed {tasks.hash[:12]!r}"
        )
    if record["param_names"] != list(tasks.param_names):
        raise ValueError(
            f"names the parameters {record['param_names']!a}, not {list(tasks.param_names)}"
        )
    return tasks


def _check_task(record: Mapping[str, Any], tasks: TaskSet) -> None:
    """Compare a task's row, parameters and split with the task set, and look at its returns."""
    task = tasks.check_task(record["task"])
    params = record["params"]
    wanted = tasks.params[task]
    if (
        len(params) != len(wanted)
        or not all(_is_number(value) for value in params)
        # The task set's hash is of nine decimals: the last bits differ between platforms.
        or (np.abs(np.asarray(params, np.float64) - wanted) > 1e-8).any()
    ):
        raise ValueError(f"task {task} has the parameters {params!a}, not {wanted.tolist()}")
    split = tasks.split_of(task)
    if record["split"] != split:
        raise ValueError(f"task {task} is in split {record['split']!a}, not '{split}'")
    _check_returns(record["returns"], task)


def _check_returns(returns: Mapping[str, Any], task: int) -> None:
    for key in ("random", "expert"):
        if not _is_number(returns.get(key)):
            raise ValueError(f"task {task} has no number '{key}' among its returns")
    for key in ("behavior", "deterministic"):
        values = returns.get(key)
        numbers = isinstance(values, Mapping) and all(map(_is_number, values.values()))
        if not numbers or not values:
            raise ValueError(f"task {task} has no object of numbers '{key}' among its returns")


def _check_file(record: Mapping[str, Any]) -> None:
    if record["file"] != task_file(record["task"]):
        raise ValueError(
            f"task {record['task']} is said to be in {record['file']!a}, "
            f"not {task_file(record['task'])}"
        )
    if len(record["sha256"]) != 64 or not _HEX.issuperset(record["sha256"]):
        raise ValueError(f"task {record['task']} has the malformed hash {record['sha256']!a}")
    for key in ("bytes", "transitions", "episodes"):
        if record[key] < 1:
            raise ValueError(f"task {record['task']} has {record[key]} {key}")


def _is_number(value: object) -> bool:
    # The comparison refuses NaN and infinities, and integers too large to be floats.
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e300
