"""A legacy folder of the field made a dataset: what it does not say is computed or marked unknown.

The folder says which step of an episode came after which and after how many training steps the
policy acted. It does not say which task a number stands for, why an episode ended, or what else
the collection was. docs/exchange.md says how each gap is filled.
"""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import metadata
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from datagen.dataset import COLUMNS, FORMAT_VERSION, DatasetError, TaskData, task_file, write_task
from datagen.files import IMPORTED, partial_of, sync_folder
from datagen.finished import remove_stale, write_summary
from datagen.legacy_episodes import Columns, Source, probe, to_columns
from datagen.legacy_files import LegacyFile, LegacyTask, list_legacy, read_episode
from datagen.plan import parse_tasks
from datagen.rollout import episode_returns, join
from meta_envs import TaskSet, reference_returns, resolve, task_set

UNKNOWN_SEED = -1
"""What the index says of the seed of a collection that did not record it."""
_PACKAGES = ("numpy", "h5py", "gymnasium", "mujoco")


@dataclass(frozen=True)
class Import:
    """What is imported where.

    Attributes:
        folder: the legacy folder, with `goal_idx0` and so on.
        env: short name of the environment it belongs to.
        out: the dataset's folder, which must not be there yet, or be empty.
        tasks: tasks to import, as `parse_tasks` takes them; all in the folder by default.
    """

    folder: Path
    env: str
    out: Path
    tasks: str | None = None


def from_legacy(
    wanted: Import, begin: Callable[[int], None], done: Callable[[int], None]
) -> dict[str, Any]:
    """Import a legacy folder, whole or not at all.

    Args:
        wanted: what and where.
        begin: told the number of tasks before the first.
        done: told each task that is finished.

    Returns:
        The index of the dataset.

    Raises:
        DatasetError: a file is damaged, malicious, or does not fit the environment or its task.
        ValueError: `tasks` is wrong.
        OSError: the disk is full or `out` has no place.
    """
    env = resolve(wanted.env).name
    if not wanted.folder.is_dir():
        raise DatasetError(wanted.folder, "is no folder", "give the one with goal_idx0 in it")
    found = _chosen(list_legacy(wanted.folder), wanted, task_set(env))
    _check_checkpoints(found, wanted.folder)
    source = probe(env, found[0])
    deterministic = all(
        _checkpoints(one.deterministic) >= _checkpoints(one.stochastic) for one in found
    )
    shared = _origin(source, found, deterministic)
    begin(len(found))
    with _whole_folder(wanted.out) as folder:
        for one in found:
            write_task(folder / task_file(one.task), _task_data(one, source, shared, deterministic))
            done(one.task)
        return write_summary(folder, shared)


def _chosen(found: Sequence[LegacyTask], wanted: Import, tasks: TaskSet) -> list[LegacyTask]:
    beyond = [one.task for one in found if one.task >= len(tasks)]
    if beyond:
        place = wanted.folder / f"goal_idx{beyond[0]}"
        fault = f"is a task that {tasks.env} does not have, with 0 to {len(tasks) - 1}"
        raise DatasetError(place, fault, "choose another --env")
    there = {one.task: one for one in found}
    asked = tuple(there) if wanted.tasks is None else parse_tasks(wanted.tasks, tasks)
    for task in asked:
        if task not in there:
            place = wanted.folder / f"goal_idx{task}"
            raise DatasetError(place, "is not there", "choose other --tasks")
    return [there[task] for task in asked]


def _check_checkpoints(found: Sequence[LegacyTask], folder: Path) -> None:
    """Raise a DatasetError that names a task with other checkpoints than the first one has."""
    first, *others = found
    for other in others:
        differ = _checkpoints(first.stochastic) ^ _checkpoints(other.stochastic)
        if differ:
            place, marks = folder / f"goal_idx{other.task}", ", ".join(map(str, sorted(differ)))
            fault = (
                f"has other checkpoints than goal_idx{first.task}: only one of the two has {marks}"
            )
            raise DatasetError(place, fault, "choose other --tasks")


@contextmanager
def _whole_folder(out: Path) -> Iterator[Path]:
    """A folder to write to that takes the place of `out` once all is well, and else vanishes."""
    if os.path.lexists(out) and (not out.is_dir() or any(out.iterdir())):
        raise DatasetError(out, "is there already", "delete it or choose another --out")
    place = Path(os.path.abspath(out))
    remove_stale(place.parent)
    partial = partial_of(place)
    partial.mkdir(parents=True)
    try:
        yield partial
        if place.is_dir():
            place.rmdir()
        partial.rename(place)
        sync_folder(place.parent)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def _checkpoints(files: Sequence[LegacyFile]) -> set[int]:
    return {one.checkpoint for one in files}


def _origin(source: Source, found: Sequence[LegacyTask], deterministic: bool) -> dict[str, Any]:
    """What all files of the dataset share; see `datagen.job.origin`."""
    row, tasks = resolve(source.env), task_set(source.env)
    every = [one for task in found for one in task.stochastic]
    versions = {name: metadata.version(name).partition("+")[0] for name in _PACKAGES}
    return {
        "format_version": FORMAT_VERSION,
        "env": row.name,
        "env_id": row.id,
        "param_names": list(tasks.param_names),
        "task_hash": tasks.hash,
        "budget": IMPORTED,
        "seed": UNKNOWN_SEED,
        "config": {
            "source": IMPORTED,
            "checkpoints": sorted(_checkpoints(every)),
            "tasks_verified": source.verifiable,
            "rewards_in_files": source.rewards,
            "observation_zeros_dropped": source.surplus,
            "deterministic_known": deterministic,
        },
        "versions": {"python": ".".join(map(str, sys.version_info[:3])), **versions},
    }


def _task_data(
    one: LegacyTask, source: Source, shared: Mapping[str, Any], deterministic: bool
) -> TaskData:
    """All episodes of a task and what is known of them."""
    tasks = task_set(source.env)
    columns, behavior = _read(one.task, one.stochastic, source)
    known = dict(behavior)
    if deterministic:
        checkpoints = _checkpoints(one.stochastic)
        same = [file for file in one.deterministic if file.checkpoint in checkpoints]
        known = _read(one.task, same, source)[1]
    anchors = _references(source.env, one.task)
    meta = {
        **shared,
        "task": one.task,
        "params": tasks.params[one.task].tolist(),
        "split": tasks.split_of(one.task),
        "returns": {
            "random": anchors["random"],
            "expert": anchors.get("oracle", max(known.values())),
            "behavior": behavior,
            "deterministic": known,
        },
    }
    return TaskData(one.task, columns, meta)


def _read(
    task: int, files: Sequence[LegacyFile], source: Source
) -> tuple[Columns, dict[str, float]]:
    """Columns of some episodes, and the mean return of each checkpoint."""
    parts, returns = [], {}
    for checkpoint, group in groupby(files, key=lambda one: one.checkpoint):
        episodes = []
        for file in group:
            try:
                episodes.append(to_columns(read_episode(file.path), task, checkpoint, source))
            except DatasetError:
                raise
            except ValueError as error:
                remedy = "move the file away or choose another --env"
                raise DatasetError(file.path, str(error), remedy) from error
        parts.append(join(episodes))
        returns[str(checkpoint)] = float(episode_returns(parts[-1]).mean())
    columns = join(parts)
    return {name: columns[name] for name in COLUMNS if name in columns}, returns


def _references(env: str, task: int) -> dict[str, float]:
    """Returns of the reference controllers, which do not depend on the other tasks imported."""
    tasks = task_set(env)
    row = tasks.params[task : task + 1].copy()
    alone = TaskSet(tasks.env, tasks.param_names, row, np.array([0]), tasks.sampler)
    return {name: float(values[0]) for name, values in reference_returns(alone, seed=task).items()}
