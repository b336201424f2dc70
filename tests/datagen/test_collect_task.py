"""The work on one task: what is in its file, and what that does and does not depend on."""

from __future__ import annotations

import resource
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from datagen.budgets import budget
from datagen.collect_task import collect_task, references
from datagen.dataset import TaskData, read_task
from datagen.job import Job, origin
from meta_envs import reference_returns, task_set

ENV = "sparse_point_robot"
TASK = 2
JOB = Job(ENV, TASK, replace(budget(ENV, "smoke"), fleet=None), 7, Path())


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the file of task 2."""
    made = tmp_path_factory.mktemp("job")
    collect_task(replace(JOB, folder=made))
    return made


@pytest.fixture(scope="module")
def data(folder: Path) -> TaskData:
    return read_task(folder / "task_002.h5")


def test_the_file_says_where_it_comes_from(data: TaskData) -> None:
    tasks = task_set(ENV)
    shared = origin(ENV, JOB.budget, 7)
    assert {key: data.meta[key] for key in shared} == shared
    assert data.meta["env_id"] == "SparsePointRobot-v0"
    assert data.meta["task_hash"] == tasks.hash
    assert data.meta["params"] == tasks.params[TASK].tolist()
    assert data.meta["split"] == ("test" if TASK in tasks.test_tasks else "train") == "test"
    assert data.meta["budget"] == "smoke"
    assert data.meta["seed"] == 7


def test_every_checkpoint_has_its_episodes(data: TaskData) -> None:
    assert len(data) == 2 * 4 * 20
    starts = data.columns["episode"].reshape(8, 20)[:, 0]
    assert starts.tolist() == list(range(8))
    assert data.checkpoint.reshape(8, 20)[:, 0].tolist() == [80] * 4 + [100] * 4


def test_the_returns_are_those_of_the_rows(data: TaskData) -> None:
    sums = data.rewards.astype(np.float64).reshape(2, 4, 20).sum(axis=2)
    returns = data.meta["returns"]
    assert returns["behavior"] == pytest.approx(dict(zip(["80", "100"], sums.mean(1), strict=True)))
    assert set(returns["deterministic"]) == {"80", "100"}
    assert returns["expert"] == pytest.approx(reference_returns(task_set(ENV))["oracle"][TASK])


def test_the_rewards_are_sparse_and_the_dense_ones_beside_them(data: TaskData) -> None:
    away = np.linalg.norm(data.next_observations - task_set(ENV).params[TASK], axis=1)
    np.testing.assert_allclose(data.columns["dense_rewards"], -away, atol=1e-5)
    np.testing.assert_allclose(data.rewards, np.maximum(1 - away / 0.2, 0), atol=1e-5)


def test_made_again_it_has_the_same_bytes(folder: Path, tmp_path: Path) -> None:
    np.random.seed(5)  # noqa: NPY002 - the global state must not matter
    collect_task(replace(JOB, folder=tmp_path))
    same = [(path / "task_002.h5").read_bytes() for path in (folder, tmp_path)]
    assert same[0] == same[1]


def test_a_full_disk_leaves_nothing(tmp_path: Path) -> None:
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, limits[1]))
    try:
        with pytest.raises(OSError, match="File too large"):
            collect_task(replace(JOB, folder=tmp_path))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert list(tmp_path.iterdir()) == []


def test_another_seed_or_task_has_other_rows(data: TaskData, tmp_path: Path) -> None:
    for job in (replace(JOB, seed=8), replace(JOB, task=3)):
        collect_task(replace(job, folder=tmp_path))
        other = read_task(tmp_path / f"task_{job.task:03d}.h5")
        assert not np.array_equal(other.actions, data.actions)


def test_references_are_of_this_task_alone() -> None:
    found = references(Job("point_robot_wind", 3, budget("point_robot_wind", "paper"), 0, Path()))
    every = reference_returns(task_set("point_robot_wind"))
    assert set(found) == {"random", "oracle", "wind_blind"}
    assert found["oracle"] == pytest.approx(every["oracle"][3])
    assert found["wind_blind"] == pytest.approx(every["wind_blind"][3])
    # Each is the mean of 1,000 episodes with a standard deviation of about 5.
    assert found["random"] == pytest.approx(every["random"][3], abs=1.0)
