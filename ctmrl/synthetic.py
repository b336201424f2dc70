"""Random numbers in the shape of a dataset, to measure speed where there is none."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from datagen.dataset import COLUMNS, Dataset, Episodes, TaskData
from meta_envs import MetaVectorEnv, resolve, task_set


@dataclass(frozen=True, eq=False, kw_only=True)
class SyntheticDataset(Dataset):
    """A dataset that is on no disk; nothing can be learnt from it.

    Attributes:
        sizes: of an observation and of an action.
        horizon: steps of each episode.
        episode_count: of each task.
        seed: of all numbers.
    """

    sizes: tuple[int, int]
    horizon: int
    episode_count: int
    seed: int

    def read(self, task: int) -> TaskData:
        """The task's data: normal observations and rewards, uniform actions, no real end."""
        draw = np.random.default_rng([self.seed, task])
        n, (obs, act) = self.horizon * self.episode_count, self.sizes
        values = {
            "observations": draw.normal(size=(n, obs)),
            "actions": draw.uniform(-1, 1, (n, act)),
            # Tasks differ by their rewards.
            "rewards": draw.normal(size=n) + draw.normal(),
            "next_observations": draw.normal(size=(n, obs)),
            "terminals": np.zeros(n),
            "timeouts": np.arange(1, n + 1) % self.horizon == 0,
            "episode": np.repeat(np.arange(self.episode_count), self.horizon),
            "checkpoint": np.zeros(n),
        }
        columns = {name: value.astype(COLUMNS[name]) for name, value in values.items()}
        return TaskData(task, columns, {})

    def episodes(self, task: int) -> Episodes:
        """The task's episodes, all of one length."""
        count = self.episode_count
        return Episodes(np.full(count, self.horizon), np.zeros(count, dtype=np.int32))

    def blocks(self, task: int, rows: int = 0) -> Iterator[TaskData]:
        """The task's data, which are in memory anyway, as one block whatever the rows."""
        yield self.read(task)


def synthetic_dataset(env: str, episodes: int, seed: int = 0) -> SyntheticDataset:
    """Random numbers for every task of an environment.

    Args:
        env: short name; it decides the tasks, their split, the sizes and the episodes' length.
        episodes: of each task.
        seed: of all numbers.
    """
    one = MetaVectorEnv(env, tasks=[0])
    spaces = (one.single_observation_space, one.single_action_space)
    obs, act = (len(space.sample()) for space in spaces)
    one.close()
    tasks = task_set(env)
    return SyntheticDataset(
        Path("synthetic"),
        {},
        env,
        np.arange(len(tasks.params)),
        tasks.train_tasks,
        tasks.test_tasks,
        tasks.params,
        sizes=(obs, act),
        horizon=resolve(env).horizon,
        episode_count=episodes,
        seed=seed,
    )
