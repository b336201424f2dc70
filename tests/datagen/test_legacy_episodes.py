"""Episodes of legacy folders become rows, and must be those of the task they claim."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from datagen.dataset import DatasetError
from datagen.legacy_episodes import Source, probe, to_columns
from datagen.legacy_files import Episode, LegacyFile, LegacyTask
from tests.datagen.examples import task_data
from tests.datagen.legacy import rows_of

WIND = Source("point_robot_wind", 2, 0, "as stepped")
HOPPER = Source("hopper_params", 11, 0, "as stepped")


def point_episode(task: int = 3, env: str = "point_robot_wind", column: str = "rewards") -> Episode:
    """The first episode of the example data, all steps."""
    data = task_data(task, env, episodes=2)
    end = int(np.flatnonzero(data.timeouts)[0]) + 1
    return Episode(
        data.observations[:end].astype(np.float64),
        data.actions[:end].astype(np.float64),
        data.columns[column][:end].astype(np.float64),
        data.next_observations[:end].astype(np.float64),
    )


def any_episode(length: int, obs_dim: int, act_dim: int, zeros: int = 0) -> Episode:
    """Random numbers, with zeros at the end of the observations."""
    generator = np.random.default_rng(0)
    path = np.zeros((length + 1, obs_dim + zeros))
    path[:, :obs_dim] = generator.normal(size=(length + 1, obs_dim))
    actions = generator.uniform(-1, 1, (length, act_dim))
    return Episode(path[:-1], actions, generator.normal(size=length), path[1:])


def test_a_whole_episode_ends_in_a_timeout() -> None:
    episode = point_episode()
    columns = to_columns(episode, 3, 4800, WIND)
    data = task_data(3, episodes=2)
    for name in ("observations", "actions", "rewards", "next_observations", "terminals"):
        assert columns[name].dtype == data.columns[name].dtype
        assert np.array_equal(columns[name], data.columns[name][:25])
    assert np.flatnonzero(columns["timeouts"]).tolist() == [24]
    assert set(columns["checkpoint"].tolist()) == {4800}
    assert set(columns["episode"].tolist()) == {0}


@pytest.mark.parametrize(
    ("source", "length", "actions", "terminal"),
    [
        (HOPPER, 200, 3, False),
        (HOPPER, 31, 3, True),
        (Source("half_cheetah_vel", 20, 0, "as stepped"), 31, 6, False),
    ],
)
def test_only_tasks_that_can_end_end_in_a_terminal(
    source: Source, length: int, actions: int, terminal: bool
) -> None:
    columns = to_columns(any_episode(length, source.width, actions), 0, 100, source)
    last = np.arange(length) == length - 1
    assert np.array_equal(columns["terminals"], last & terminal)
    assert np.array_equal(columns["timeouts"], last & (not terminal))


def test_zeros_the_environment_does_not_have_are_dropped() -> None:
    source = Source("ant_goal", 113, 84, "as stepped")
    episode = any_episode(5, 29, 8, zeros=84)
    columns = to_columns(episode, 0, 100, source)
    assert np.array_equal(columns["observations"], episode.observations[:, :29].astype("<f4"))
    episode.next_observations[3, 50] = 1e-3
    with pytest.raises(ValueError, match="113 numbers, ant_goal of 29, and not all of the others"):
        to_columns(episode, 0, 100, source)


def test_what_does_not_fit_is_refused() -> None:
    good = any_episode(6, 11, 3)
    torn = good.next_observations.copy()
    torn[2] += 1
    with pytest.raises(ValueError, match="does not go on after step 2"):
        to_columns(replace(good, next_observations=torn), 0, 100, HOPPER)
    wide = good.actions.copy()
    wide[4, 1] = -1.001
    with pytest.raises(ValueError, match=r"an action outside \[-1, 1\] in step 4"):
        to_columns(replace(good, actions=wide), 0, 100, HOPPER)
    with pytest.raises(ValueError, match="has actions of 6 numbers, hopper_params of 3"):
        to_columns(any_episode(6, 11, 6), 0, 100, HOPPER)
    with pytest.raises(ValueError, match="observations of 12 numbers, other files of 11"):
        to_columns(any_episode(6, 12, 3), 0, 100, HOPPER)
    with pytest.raises(ValueError, match="has 201 steps, an episode of hopper_params at most 200"):
        to_columns(any_episode(201, 11, 3), 0, 100, HOPPER)


def test_an_episode_of_another_task_is_refused() -> None:
    with pytest.raises(ValueError, match="is not of task 4 of point_robot_wind: the next obser"):
        to_columns(point_episode(3), 4, 100, WIND)
    source = Source("point_robot", 2, 0, "as stepped")
    with pytest.raises(ValueError, match="is not of task 4 of point_robot: the reward of step 0"):
        to_columns(point_episode(3, "point_robot"), 4, 100, source)


@pytest.mark.parametrize("stored", ["rewards", "dense_rewards"])
def test_a_sparse_environment_gets_both_rewards(stored: str, tmp_path: Path) -> None:
    env = "sparse_point_robot"
    episode, data = point_episode(50, env, stored), task_data(50, env, episodes=2)
    path = tmp_path / "trj_evalsample0_step100.npy"
    np.save(path, rows_of(data, slice(0, len(episode)), data.columns[stored]))
    source = probe(env, LegacyTask(50, (LegacyFile(path, 100, 0),), ()))
    assert source.rewards == ("dense" if stored == "dense_rewards" else "as stepped")
    columns = to_columns(episode, 50, 100, source)
    for name in ("rewards", "dense_rewards"):
        assert columns[name].dtype == np.float32
        assert columns[name] == pytest.approx(data.columns[name][:20], abs=1e-5)
    assert np.array_equal(columns[stored], data.columns[stored][:20])


def test_a_folder_of_another_environment_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "trj_evalsample0_step100.npy"
    data = task_data(3, episodes=2)
    np.save(path, rows_of(data, slice(0, 25), data.rewards))
    task = LegacyTask(3, (LegacyFile(path, 100, 0),), ())
    assert probe("point_robot_wind", task) == WIND
    with pytest.raises(DatasetError, match="observations of 2 numbers, ant_goal of 29; choose"):
        probe("ant_goal", task)
