"""Minari: names, environment and arrays of an export; the slow test exports and loads for real."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from datagen.columns import TaskData
from datagen.dataset import open_dataset
from datagen.to_minari import (
    MissingPackageError,
    default_namespace,
    episode_arrays,
    episode_slices,
    load_minari,
    minari_id,
    task_spec,
    to_minari,
)
from meta_envs import task_set
from tests.datagen.environments import other_environment, run
from tests.datagen.examples import task_data, write_dataset


def test_names_have_the_environment_and_the_task() -> None:
    assert default_namespace("point_robot_wind") == "ctmrl/point-robot-wind"
    assert minari_id("mine", 3) == "mine/task-003-v0"


def test_the_environment_is_recovered_with_its_task_from_json() -> None:
    text = task_spec("point_robot_wind", 7).to_json()
    # In a process that has not imported meta_envs, as a reader of the Minari dataset's.
    code = (
        "import gymnasium, sys; from gymnasium.envs.registration import EnvSpec; "
        "env = gymnasium.make(EnvSpec.from_json(sys.argv[1])); env.reset(seed=0); "
        "obs = env.step(env.action_space.high * 0)[0]; "
        "print(env.unwrapped.task, env.spec.max_episode_steps, *obs.tolist())"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, text], capture_output=True, text=True, check=True
    )
    task, limit, *wind = done.stdout.split()
    assert (task, limit) == ("7", "25")
    assert [float(one) for one in wind] == pytest.approx(task_set("point_robot_wind").params[7])


def test_the_spec_of_one_task_leaves_the_registry_alone() -> None:
    assert task_spec("ant_goal", 3).kwargs == {"name": "ant_goal", "task": 3}
    assert task_spec("ant_goal", 5).kwargs == {"name": "ant_goal", "task": 5}
    import gymnasium

    assert gymnasium.spec("AntGoal-v0").kwargs == {"name": "ant_goal"}


def uneven() -> TaskData:
    """The example data cut to episodes of 25, 3 and 25 steps, of which the second terminates."""
    data = task_data(3, "sparse_point_robot")
    rows = np.r_[0:20, 20:23, 40:60]
    columns = {name: column[rows].copy() for name, column in data.columns.items()}
    columns["terminals"][22] = True
    return TaskData(3, columns, data.meta)


def test_episodes_are_cut_at_both_kinds_of_end() -> None:
    data = uneven()
    slices = list(episode_slices(data))
    assert slices == [slice(0, 20), slice(20, 23), slice(23, 43)]
    first, second, _ = (episode_arrays(data, rows) for rows in slices)
    assert np.array_equal(first["observations"][:-1], data.observations[:20])
    assert np.array_equal(first["observations"][-1], data.next_observations[19])
    assert (first["terminations"].any(), first["truncations"].tolist()) == (
        False,
        [False] * 19 + [True],
    )
    assert second["terminations"].tolist() == [False, False, True]
    assert not second["truncations"].any()
    assert np.array_equal(second["rewards"], data.rewards[20:23])
    dense = second["infos"]["dense_reward"]
    assert dense.tolist() == [0.0, *data.columns["dense_rewards"][20:23].tolist()]


def test_without_minari_a_sentence_names_the_package(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "minari", None)
    with pytest.raises(MissingPackageError, match=r"needs the package minari .*'ctmrl\[minari\]'"):
        load_minari()


@pytest.mark.parametrize("namespace", ["", "a", "a b", "../a", "a//b", "/a", "a/"])
def test_a_malformed_namespace_is_refused(namespace: str, tmp_path: Path) -> None:
    dataset = open_dataset(write_dataset(tmp_path / "data", [0]))
    with pytest.raises(ValueError, match="--namespace takes letters"):
        to_minari(dataset, [0], namespace, lambda task: None)


CHECK = """
import sys
import h5py, json, minari, numpy as np

name, path, task = sys.argv[1:]
dataset = minari.load_dataset(name)
with h5py.File(path) as file:
    meta, columns = json.loads(file.attrs["meta"]), {key: file[key][...] for key in file}
start = 0
for episode, kept in zip(dataset, dataset.storage.get_episode_metadata(range(len(dataset)))):
    rows = slice(start, start + len(episode))
    assert episode.observations.shape[0] == len(episode) + 1
    assert np.array_equal(episode.observations[:-1], columns["observations"][rows])
    assert np.array_equal(episode.observations[1:], columns["next_observations"][rows])
    for ours, theirs in (("actions", "actions"), ("rewards", "rewards"),
                         ("terminals", "terminations"), ("timeouts", "truncations")):
        values = getattr(episode, theirs)
        assert np.array_equal(values, columns[ours][rows]) and values.dtype == columns[ours].dtype
    if "dense_rewards" in columns:
        dense = episode.infos["dense_reward"]
        assert np.array_equal(dense[1:], columns["dense_rewards"][rows])
    assert set(columns["checkpoint"][rows]) == {kept["checkpoint"]}
    start = rows.stop
assert start == len(columns["rewards"]) == dataset.total_steps
env = dataset.recover_environment()
assert env.unwrapped.task == int(task) and env.spec.id == meta["env_id"]
assert env.observation_space == dataset.observation_space
obs, _ = env.reset(seed=0)
assert np.array_equal(obs, columns["observations"][0])
for row in range(5):
    obs, reward, *_ = env.step(columns["actions"][row])
    assert np.array_equal(obs, columns["next_observations"][row])
    assert np.float32(reward) == columns["rewards"][row]
low, high = meta["returns"]["random"], meta["returns"]["expert"]
assert abs(minari.get_normalized_score(dataset, np.array([(low + high) / 2]))[0] - 0.5) < 1e-9
print(len(dataset), "episodes")
"""


@pytest.mark.slow
def test_minari_loads_an_export_and_recovers_the_environment(tmp_path: Path) -> None:
    python = other_environment(tmp_path / "venv", "minari[hdf5]>=0.5.4", "pillow")
    variables = {"MINARI_DATASETS_PATH": str(tmp_path / "minari")}
    export = "import sys; from datagen.exchange import main; sys.exit(main(sys.argv[1:]))"
    for env, alias in (
        ("point_robot_wind", "point-robot-wind"),
        ("sparse_point_robot", "sparse-point-robot"),
    ):
        folder = write_dataset(tmp_path / env, [2, 3], env)
        said = run(python, export, "to-minari", str(folder), **variables)
        assert f"minari.load_dataset('ctmrl/{alias}/task-002-v0')" in said
        for task in (2, 3):
            name, path = f"ctmrl/{alias}/task-{task:03d}-v0", folder / f"task_{task:03d}.h5"
            said = run(python, CHECK, name, str(path), str(task), **variables)
            assert said == "4 episodes\n"
    again = subprocess.run(
        [python, "-c", export, "to-minari", str(folder), "--tasks", "3"],
        capture_output=True, text=True, env={**variables},
    )  # fmt: skip
    assert again.returncode == 2
    assert (
        "is there already; run `minari delete ctmrl/sparse-point-robot/task-003-v0`" in again.stderr
    )
