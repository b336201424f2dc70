"""Small inputs whose sizes are all different and prime, so that nothing broadcasts unnoticed."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray
from torch import Tensor

from ctmrl.config import MetaTrainConfig, RunConfig
from ctmrl.data import OfflineData, Transitions
from ctmrl.methods.base import Dimensions
from ctmrl.methods.ctmrl import CTMRL, CTMRLConfig
from ctmrl.networks import Statistics
from ctmrl.presets import preset
from datagen.dataset import (
    COLUMNS,
    Dataset,
    Episodes,
    TaskData,
    task_file,
    write_index,
    write_task,
)
from meta_envs import MetaVectorEnv
from tests.datagen.examples import index_of, task_data

OBS, ACT, Z, CODES, TASKS, BATCH, LENGTH, PARAMS = 3, 2, 7, 5, 17, 11, 13, 31
"""O, A, Z, N, training tasks, B, T and P wherever a test does not need others."""


def generator(seed: int = 0) -> torch.Generator:
    """A private generator."""
    return torch.Generator().manual_seed(seed)


def normal(*shape: int, seed: int = 0) -> Tensor:
    """Standard normal numbers in double precision."""
    return torch.randn(*shape, generator=generator(seed), dtype=torch.float64)


def statistics(next_obs: bool = True, seed: int = 0) -> Statistics:
    """Statistics that are neither 0 nor 1 anywhere."""
    draw = generator(seed)
    sizes = (OBS, OBS + ACT + 1 + OBS * next_obs, 1 + OBS, PARAMS)
    return Statistics(
        *(
            (torch.randn(size, generator=draw), 0.5 + torch.rand(size, generator=draw))
            for size in sizes
        )
    )


def dimensions(steps: int = 100) -> Dimensions:
    """Sizes of the examples here."""
    return Dimensions(obs=OBS, act=ACT, tasks=TASKS, steps=steps)


def contexts(sets: int = 2, tasks: int = BATCH, seed: int = 0) -> Tensor:
    """Transitions (s, a, r, s') that differ from task to task, [sets, tasks, T, 2 O + A + 1]."""
    draw = generator(seed)
    width = 2 * OBS + ACT + 1
    shift = 2 * torch.randn(tasks, 1, width, generator=draw)
    return torch.randn(sets, tasks, LENGTH, width, generator=draw) + shift


def batch(n: int = 19, seed: int = 0) -> Transitions:
    """Transitions for an actor-critic, every third one terminal."""
    draw = generator(seed)
    return Transitions(
        obs=torch.randn(n, OBS, generator=draw),
        action=torch.rand(n, ACT, generator=draw) * 1.8 - 0.9,
        reward=torch.randn(n, generator=draw),
        next_obs=torch.randn(n, OBS, generator=draw),
        terminal=(torch.arange(n) % 3 == 0).float(),
        rank=(torch.arange(n) % 5).float() / 5,
    )


def ctmrl(seed: int = 0, steps: int = 100, **changes: Any) -> CTMRL:
    """An untrained CTMRL of small networks; the weights depend on the seed alone."""
    small = CTMRLConfig(z_dim=Z, encoder_hidden=(23,), predictor_hidden=(29,), codes=CODES)
    config = dataclasses.replace(small, **changes)
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        return CTMRL(config, statistics(config.next_obs_in_context), dimensions(steps))


def with_switches(method: CTMRL, **changes: Any) -> CTMRL:
    """A copy of a method with other settings and the same weights."""
    twin = copy.deepcopy(method)
    twin.config = dataclasses.replace(method.config, **changes)
    return twin


def smoke(steps: int = 20, method: str = "ctmrl", **changes: Any) -> RunConfig:
    """The smoke preset on the robot in the wind."""
    config = preset("point_robot_wind", method, "smoke", **changes)
    training: MetaTrainConfig = dataclasses.replace(config.training, steps=steps)
    return dataclasses.replace(config, training=training)


def with_dual_steps(config: RunConfig, steps: int, brac: bool = True) -> RunConfig:
    """A run with so many steps of the dual critic; `brac` is whether it has one."""
    changed = dataclasses.replace(
        config.actor_critic, behavior_regularization=brac, dual_steps=steps
    )
    return dataclasses.replace(config, actor_critic=changed)


@dataclass(frozen=True, eq=False)
class HandMade(Dataset):
    """A dataset that is not on a disk, for what no environment here produces.

    Attributes:
        tables: the tasks' data.
    """

    tables: Mapping[int, TaskData]

    def blocks(self, task: int, rows: int = 2**16) -> Iterator[TaskData]:
        """The task's data, an episode a block."""
        del rows
        data = self.tables[task]
        for number in range(int(data.episode[-1]) + 1):
            own = {name: column[data.episode == number] for name, column in data.columns.items()}
            yield TaskData(task, own, {})

    def episodes(self, task: int) -> Episodes:
        """The task's episodes."""
        lengths = np.bincount(self.tables[task].episode)
        return Episodes(lengths, np.zeros(len(lengths), dtype=np.int32))


def hand_made(lengths: Mapping[int, Sequence[int]]) -> HandMade:
    """Episodes of these lengths for each task; a row's observation is (task, episode, step).

    Odd episodes end in a terminal, even ones in a timeout. The rewards are 1000 task + 10 episode
    + step / 10, the dense rewards minus that. A task's parameters are (task, -task).
    """
    tables = {task: _table(task, episodes) for task, episodes in lengths.items()}
    tasks = np.array(sorted(lengths), dtype=np.int64)
    params = np.stack([tasks, -tasks], axis=1).astype(np.float64)
    return HandMade(Path("nowhere"), {}, "none", tasks, tasks, tasks[:0], params, tables)


def _table(task: int, episodes: Sequence[int]) -> TaskData:
    number = np.repeat(np.arange(len(episodes)), episodes)
    step = np.concatenate([np.arange(length) for length in episodes])
    last = step == np.repeat(episodes, episodes) - 1
    obs = np.stack([np.full(len(step), task), number, step], axis=1).astype(np.float32)
    rewards = (1000 * task + 10 * number + step / 10).astype(np.float32)
    columns: dict[str, NDArray[Any]] = {
        "observations": obs,
        "actions": np.stack([np.sin(rewards), np.cos(rewards)], axis=1).astype(np.float32),
        "rewards": rewards,
        "next_observations": obs + np.array([0, 0, 1], dtype=np.float32),
        "terminals": last & (number % 2 == 1),
        "timeouts": last & (number % 2 == 0),
        "episode": number.astype(np.int32),
        "checkpoint": np.zeros(len(step), dtype=np.int32),
        "dense_rewards": -rewards,
    }
    return TaskData(task, columns, {})


def open_hand_made(lengths: Mapping[int, Sequence[int]], terminals: bool = False) -> OfflineData:
    """The same, as the learner sees it."""
    return OfflineData(hand_made(lengths), np.array(list(lengths)), terminals)


def good_task(task: int, episodes: int, seed: int) -> TaskData:
    """Noisy mixtures, from all oracle to all wind-blind, of the two controllers in the wind."""
    env = "point_robot_wind"
    many = MetaVectorEnv(env, tasks=[task] * episodes, autoreset_mode=AutoresetMode.DISABLED)
    controllers = many.definition.controllers
    draw = np.random.default_rng([seed, task])
    share = np.linspace(0.0, 1.0, episodes)[:, None]
    steps: dict[str, list[NDArray[Any]]] = {name: [] for name in COLUMNS if "dense" not in name}
    obs, _ = many.reset(seed=seed)
    for _ in range(many.horizon):
        oracle, blind = (
            controllers[name](many.state, many.params) for name in ("oracle", "wind_blind")
        )
        wanted = share * oracle + (1 - share) * blind + draw.normal(0.0, 0.4, oracle.shape)
        action = np.clip(wanted, -1.0, 1.0).astype(np.float32)
        next_obs, reward, terminated, truncated, _ = many.step(action)
        values = [obs, action, reward, next_obs, terminated, truncated]
        values += [np.arange(episodes), np.full(episodes, 100)]
        for name, value in zip(steps, values, strict=True):
            steps[name].append(np.asarray(value))
        obs = next_obs
    columns = {
        name: np.swapaxes(np.stack(values), 0, 1)
        .reshape(many.horizon * episodes, *values[0].shape[1:])
        .astype(COLUMNS[name])
        for name, values in steps.items()
    }
    return TaskData(task, columns, task_data(task, env, 2).meta)


def write_good_dataset(folder: Path, tasks: Sequence[int], episodes: int, seed: int = 0) -> Path:
    """A dataset in the wind that a learner can learn from; returns the folder, which is made."""
    folder.mkdir(parents=True)
    for task in tasks:
        write_task(folder / task_file(task), good_task(task, episodes, seed))
    index = index_of(folder, "point_robot_wind", tasks, 2, 0)
    for record in index["tasks"]:
        record |= {"episodes": episodes, "transitions": episodes * 25}
    write_index(folder, index)
    return folder


def record(
    method: str = "ctmrl", seed: int = 0, groups: Sequence[str] = ("seen", "unseen")
) -> dict[str, Any]:
    """An evaluation's record on five tasks a group, with round numbers."""
    draw = np.random.default_rng([seed, len(method)])
    return {
        "env": "point_robot_wind",
        "method": method,
        "seed": seed,
        "evaluation_seed": seed,
        "protocol": {
            "random_episodes": 2,
            "policy_episodes": 1,
            "scored_episodes": 1,
            "repetitions": 3,
        },
        "param_names": ["wind_x", "wind_y"],
        "groups": {
            name: {
                "tasks": [10 * number + k for k in range(5)],
                "params": np.random.default_rng(number).uniform(-0.05, 0.05, (5, 2)).tolist(),
                "return": -8.0 - seed - number,
                "score": 100.0 * (22.0 - seed - number) / 25.0,
                "task_returns": [-8.0 - seed - number] * 5,
                "repetition_returns": [-8.0 - seed - number] * 3,
                "curve": draw.uniform(-12.0, -8.0, (4, 5)).tolist(),
                "references": {
                    "random": -30.0,
                    "oracle": -5.0,
                    "wind_blind": -6.0,
                    "best_behavior": -5.5,
                },
                "contexts": draw.normal(size=(5, Z)).tolist(),
                "codes": draw.integers(0, 3, 5).tolist() if method == "ctmrl" else None,
            }
            for number, name in enumerate(groups)
        },
    }
