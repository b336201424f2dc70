"""Small valid datasets of random behaviour, for tests that need one."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from datagen.dataset import COLUMNS, TaskData, task_file, write_index, write_task
from datagen.files import file_digest
from meta_envs import MetaVectorEnv, resolve, task_set

CHECKPOINTS = (200, 1000)


def task_data(
    task: int, env: str = "point_robot_wind", episodes: int = 4, seed: int = 0
) -> TaskData:
    """Episodes of uniform random actions on one task, half of them for each checkpoint."""
    row = resolve(env)
    tasks = task_set(env)
    many = MetaVectorEnv(
        env, tasks=[task] * episodes, autoreset_mode=AutoresetMode.DISABLED, task_set=tasks
    )
    generator = np.random.default_rng([seed, task])
    size = (episodes, *(many.single_action_space.shape or ()))
    steps: dict[str, list[NDArray[Any]]] = {name: [] for name in COLUMNS}
    obs, _ = many.reset(seed=seed)
    for _ in range(row.horizon):
        action = generator.uniform(-1.0, 1.0, size).astype(np.float32)
        next_obs, reward, terminated, truncated, info = many.step(action)
        number = np.arange(episodes)
        values = [obs, action, reward, next_obs, terminated, truncated, number]
        values += [np.repeat(CHECKPOINTS, episodes)[::2][:episodes], info.get("dense_reward")]
        for name, value in zip(COLUMNS, values, strict=True):
            steps[name].append(np.asarray(value))
        obs = next_obs
    if not many.definition.sparse:
        del steps["dense_rewards"]
    columns = {
        name: np.swapaxes(np.stack(values), 0, 1)
        .reshape(row.horizon * episodes, *values[0].shape[1:])
        .astype(COLUMNS[name])
        for name, values in steps.items()
    }
    return TaskData(task, columns, _meta(env, task, seed, columns["rewards"], episodes))


def _meta(
    env: str, task: int, seed: int, rewards: NDArray[np.float32], episodes: int
) -> dict[str, Any]:
    tasks = task_set(env)
    total = rewards.reshape(episodes, -1).sum(axis=1, dtype=np.float64)
    by_checkpoint = {
        str(checkpoint): float(np.mean(part))
        for checkpoint, part in zip(CHECKPOINTS, np.split(total, 2), strict=True)
    }
    return {
        "format_version": 1,
        "env": env,
        "env_id": resolve(env).id,
        "task": task,
        "params": tasks.params[task].tolist(),
        "param_names": list(tasks.param_names),
        "task_hash": tasks.hash,
        "split": tasks.split_of(task),
        "seed": seed,
        "config": {"policy": "random", "episodes": episodes},
        "versions": {"numpy": np.__version__},
        "returns": {
            "random": float(total.mean()),
            "expert": -5.0,
            "behavior": by_checkpoint,
            "deterministic": dict(by_checkpoint),
        },
    }


def write_dataset(
    folder: Path,
    tasks: Sequence[int] = (0, 1, 2, 3),
    env: str = "point_robot_wind",
    episodes: int = 4,
    seed: int = 0,
) -> Path:
    """Write a whole dataset with these tasks into a folder, which is made; returns the folder."""
    folder.mkdir(parents=True, exist_ok=True)
    for task in tasks:
        write_task(folder / task_file(task), task_data(task, env, episodes, seed))
    write_index(folder, index_of(folder, env, tasks, episodes, seed))
    return folder


def index_of(
    folder: Path, env: str, tasks: Sequence[int], episodes: int, seed: int
) -> dict[str, Any]:
    """The index of task files that are already written."""
    records = []
    for task in sorted(tasks):
        path = folder / task_file(task)
        data = task_data(task, env, episodes, seed)
        records.append(
            {
                **{key: data.meta[key] for key in ("task", "split", "params", "returns")},
                "file": path.name,
                "bytes": path.stat().st_size,
                "sha256": file_digest(path),
                "transitions": len(data),
                "episodes": episodes,
            }
        )
    shared = ("env", "env_id", "param_names", "task_hash", "config", "versions", "seed")
    return {
        **{key: data.meta[key] for key in shared},
        "format_version": 1,
        "budget": "smoke",
        "tasks": records,
    }


def graded_data(
    task: int, returns: dict[int, float], episodes: int = 3, random: float = -30.0
) -> TaskData:
    """A task with these returns at its checkpoints, and episodes of 21 to 25 steps for each.

    Args:
        task: row of the robot in the wind's task set.
        returns: of the stochastic policy by checkpoint, rising.
        episodes: of each checkpoint.
        random: return of the random policy.
    """
    data = task_data(task, episodes=2 * -(-episodes * len(returns) // 2))
    lengths = [25 - number % 5 for number in range(episodes * len(returns))]
    rows = np.concatenate([25 * k + np.arange(length) for k, length in enumerate(lengths)])
    columns = {name: column[rows] for name, column in data.columns.items()}
    last = np.cumsum(lengths) - 1
    columns["terminals"][last] = ~columns["timeouts"][last]
    marks = np.repeat(np.array(list(returns), dtype=np.int32), episodes)
    columns["checkpoint"] = np.repeat(marks, lengths)
    by_checkpoint = {str(mark): value for mark, value in returns.items()}
    stated = {
        "random": random,
        "expert": -5.0,
        "behavior": by_checkpoint,
        "deterministic": dict(by_checkpoint),
    }
    return TaskData(task, columns, {**data.meta, "returns": stated})


def write_tasks(folder: Path, tasks: Sequence[TaskData]) -> Path:
    """Write a dataset of any tasks of the robot in the wind; returns the folder, which is made."""
    folder.mkdir(parents=True, exist_ok=True)
    for data in tasks:
        write_task(folder / task_file(data.task), data)
    index = index_of(folder, "point_robot_wind", [data.task for data in tasks], 4, 0)
    by_task = {data.task: data for data in tasks}
    for record in index["tasks"]:
        data = by_task[record["task"]]
        record["returns"] = data.meta["returns"]
        record["transitions"] = len(data)
        record["episodes"] = int(data.episode[-1]) + 1
    write_index(folder, index)
    return folder


def independent_digest(columns: dict[str, NDArray[Any]], meta: dict[str, Any]) -> str:
    """`content_sha256` after docs/dataset_format.md, without the code under test."""
    total = hashlib.sha256()
    for name, column in columns.items():
        total.update((json.dumps([name, column.dtype.str, list(column.shape)]) + "\n").encode())
        total.update(column.tobytes())
    rest = {key: value for key, value in meta.items() if key != "content_sha256"}
    total.update((json.dumps(rest, sort_keys=True, indent=1) + "\n").encode())
    return total.hexdigest()


def hand_made_file(
    path: Path,
    columns: dict[str, NDArray[Any]],
    meta: dict[str, Any],
    edit: Callable[[h5py.File], None] = lambda file: None,
) -> Path:
    """A task's file with a true hash, written without the code under test, whatever is in it."""
    sealed = {**meta, "content_sha256": independent_digest(columns, meta)}
    with h5py.File(path, "w", libver=("v108", "latest")) as file:
        for name, column in columns.items():
            file.create_dataset(name, data=column)
        text = (json.dumps(sealed, sort_keys=True, indent=1) + "\n").encode()
        file.attrs.create("meta", np.array(text, dtype=f"S{len(text)}"))
        edit(file)
    return path
