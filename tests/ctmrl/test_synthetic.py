"""Random numbers in the shape of a dataset."""

from __future__ import annotations

import numpy as np
import pytest

from ctmrl.data import OfflineData
from ctmrl.synthetic import synthetic_dataset
from datagen.dataset import COLUMNS
from meta_envs import task_set


@pytest.mark.parametrize(("env", "sizes"), [("point_robot", (2, 2)), ("half_cheetah_vel", (20, 6))])
def test_it_has_the_environments_tasks_sizes_and_episodes(env: str, sizes: tuple[int, int]) -> None:
    dataset, tasks = synthetic_dataset(env, episodes=3), task_set(env)
    assert dataset.train_tasks.tolist() == tasks.train_tasks.tolist()
    assert dataset.test_tasks.tolist() == tasks.test_tasks.tolist()
    data = dataset.read(5)
    assert (data.observations.shape[1], data.actions.shape[1]) == sizes
    for name, column in data.columns.items():
        assert column.dtype == COLUMNS[name]
        assert np.isfinite(column).all()
    assert np.bincount(data.episode).tolist() == [dataset.horizon] * 3
    assert np.flatnonzero(data.timeouts).tolist() == [k * dataset.horizon - 1 for k in (1, 2, 3)]
    assert np.abs(data.actions).max() <= 1.0


def test_a_learner_can_be_given_it() -> None:
    dataset = synthetic_dataset("point_robot", episodes=3)
    data = OfflineData(dataset, dataset.train_tasks)
    assert (len(data), data.episodes) == (80, 3)


def test_the_seed_and_the_task_decide_its_numbers() -> None:
    read = [
        synthetic_dataset("point_robot", 2, seed).read(task).observations.tobytes()
        for seed, task in ((0, 0), (0, 0), (1, 0), (0, 1))
    ]
    assert read[0] == read[1]
    assert len(set(read)) == 3
