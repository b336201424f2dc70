"""A dataset as Minari datasets, one a task, whose environment Minari recovers with its task."""

from __future__ import annotations

import copy
import re
import shutil
import warnings
from collections.abc import Callable, Iterator, Sequence
from importlib import metadata
from pathlib import Path
from types import ModuleType
from typing import Any

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec

from datagen.dataset import Dataset, DatasetError, TaskData
from meta_envs import resolve
from meta_envs.registry import definition

ROOT_NAMESPACE = "ctmrl"
"""First part of the default namespace; the second is the field's name of the environment."""
AUTHOR = "The CTMRL benchmark's maintainers"
_NAMESPACE = re.compile(r"[-_A-Za-z0-9]+(/[-_A-Za-z0-9]+)*")


class MissingPackageError(ValueError):
    """An optional package is not installed; the message says which and how to get it."""


def load_minari() -> ModuleType:
    """Minari, which is an optional extra.

    Raises:
        MissingPackageError: it, or something it needs itself, is not installed.
    """
    try:
        import minari
    except ImportError as error:
        raise MissingPackageError(
            f"to-minari needs the package minari ({error}): run `pip install 'ctmrl[minari]'`"
        ) from error
    module: ModuleType = minari
    return module


def default_namespace(env: str) -> str:
    """Namespace of an environment's tasks, such as `ctmrl/point-robot-wind`."""
    return f"{ROOT_NAMESPACE}/{resolve(env).alias}"


def minari_id(namespace: str, task: int) -> str:
    """Name of a task's Minari dataset, such as `ctmrl/point-robot-wind/task-003-v0`."""
    return f"{namespace}/task-{task:03d}-v0"


def task_spec(env: str, task: int) -> EnvSpec:
    """What `gymnasium.make` needs to make an environment on one task, as JSON keeps it.

    Args:
        env: any of the environment's names.
        task: row of its task set.
    """
    spec = copy.deepcopy(gymnasium.spec(resolve(env).id))
    spec.kwargs = {**spec.kwargs, "task": task}
    return spec


def episode_slices(data: TaskData) -> Iterator[slice]:
    """The rows of each episode, in order."""
    ends = np.flatnonzero(data.terminals | data.timeouts) + 1
    start = 0
    for end in ends.tolist():
        yield slice(start, end)
        start = end


def episode_arrays(data: TaskData, rows: slice) -> dict[str, Any]:
    """One episode of T steps as Minari has it: T + 1 observations, and T of all the rest.

    The dense rewards of a sparse environment are an info, which Minari has T + 1 of, like
    observations; the first, of the reset, is 0.
    """
    last = data.next_observations[rows.stop - 1 : rows.stop]
    found: dict[str, Any] = {
        "observations": np.concatenate([data.observations[rows], last]),
        "actions": data.actions[rows],
        "rewards": data.rewards[rows],
        "terminations": data.terminals[rows],
        "truncations": data.timeouts[rows],
    }
    if "dense_rewards" in data.columns:
        dense = data.columns["dense_rewards"][rows]
        found["infos"] = {"dense_reward": np.concatenate([np.zeros(1, dense.dtype), dense])}
    return found


def to_minari(
    dataset: Dataset, tasks: Sequence[int], namespace: str | None, done: Callable[[int], None]
) -> list[str]:
    """Export tasks of a dataset to Minari's own folder, each whole or not at all.

    Args:
        dataset: an opened dataset.
        tasks: those to export.
        namespace: where in Minari they go; `default_namespace` if None.
        done: told each task that is written.

    Returns:
        The names of the Minari datasets, in the order of `tasks`.

    Raises:
        MissingPackageError: Minari is not installed.
        DatasetError: a task's file is damaged, or Minari has a dataset of this name.
        ValueError: the namespace is malformed.
        OSError: the disk is full or Minari's folder has no place.
    """
    place = default_namespace(dataset.env) if namespace is None else namespace
    if not _NAMESPACE.fullmatch(place) or len(place) < 2:
        raise ValueError(f"--namespace takes letters, digits, -, _ and / between, got '{place}'")
    minari = load_minari()
    from minari.storage import get_dataset_path

    names = {task: minari_id(place, task) for task in tasks}
    for task, name in names.items():
        dataset.entry(task)
        path = Path(get_dataset_path(name))
        if path.exists():
            remedy = f"run `minari delete {name}` or choose another --namespace"
            raise DatasetError(path, "is there already", remedy)
    for task, name in names.items():
        data = dataset.read(task)
        try:
            _write(minari, dataset, data, name)
        except BaseException:
            shutil.rmtree(get_dataset_path(name), ignore_errors=True)
            raise
        done(task)
    return list(names.values())


def _write(minari: ModuleType, dataset: Dataset, data: TaskData, name: str) -> None:
    """One Minari dataset."""
    from minari.data_collector import EpisodeBuffer

    index, spec = dataset.index, task_spec(dataset.env, data.task)
    slices = list(episode_slices(data))
    legacy = index["config"].get("source") == "legacy"
    with warnings.catch_warnings():
        # It recommends an e-mail address and a link to the code, which a dataset does not have.
        warnings.simplefilter("ignore", UserWarning)
        made = minari.create_dataset_from_buffers(
            name,
            (EpisodeBuffer(id=k, **episode_arrays(data, rows)) for k, rows in enumerate(slices)),
            env=spec,
            eval_env=spec,
            algorithm_name="unknown" if legacy else "SAC",
            author=AUTHOR,
            ref_min_score=float(data.meta["returns"]["random"]),
            ref_max_score=float(data.meta["returns"]["expert"]),
            num_episodes_average_score=_reference_episodes(dataset),
            description=_description(dataset, data),
            requirements=[f"ctmrl>={metadata.version('ctmrl')}"],
            data_format="hdf5",
        )
    # Minari keeps these beside the episode, where its filters can see them.
    marks = ({"checkpoint": int(data.checkpoint[rows.start])} for rows in slices)
    made.storage.update_episode_metadata(marks)


def _reference_episodes(dataset: Dataset) -> int:
    """Episodes behind the random policy's return."""
    default = definition(dataset.env).random_episodes
    return int(dataset.index["config"].get("reference_episodes", default))


def _description(dataset: Dataset, data: TaskData) -> str:
    index = dataset.index
    params = zip(index["param_names"], data.meta["params"], strict=True)
    named = ", ".join(f"{name} {value:.6g}" for name, value in params)
    return (
        f"Task {data.task} ({data.meta['split']}) of {index['env_id']}: {named}. Budget "
        f"{index['budget']}, seed {index['seed']}. The reference scores are the returns of "
        "the random policy and of the best known one on this task. Exported from the dataset with "
        f"the SHA-256 {dataset.hash}."
    )
