"""The single file in D4RL's style: every value, rows of one length, and whole or absent."""

from __future__ import annotations

import json
import resource
from pathlib import Path

import h5py
import numpy as np
import pytest

from datagen.dataset import Dataset, DatasetError, open_dataset
from datagen.to_d4rl import d4rl_file, to_d4rl
from meta_envs import task_set
from tests.datagen.examples import write_dataset

TASKS = (0, 2, 3)


@pytest.fixture(scope="module", params=["point_robot_wind", "sparse_point_robot"])
def dataset(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return open_dataset(write_dataset(tmp_path_factory.mktemp("d4rl"), TASKS, request.param))


def test_every_value_arrives(dataset: Dataset, tmp_path: Path) -> None:
    seen: list[int] = []
    path = to_d4rl(dataset, TASKS, tmp_path / "new", seen.append)
    assert seen == list(TASKS)
    assert [one.name for one in (tmp_path / "new").iterdir()] == [d4rl_file(dataset)]
    with h5py.File(path) as file:
        columns = {name: file[name][...] for name in file}
    sources = [dataset.read(task) for task in TASKS]
    assert columns.keys() == {*sources[0].columns, "task"}
    for name in set(columns) - {"task", "episode"}:
        wanted = np.concatenate([source.columns[name] for source in sources])
        assert columns[name].dtype == wanted.dtype
        assert np.array_equal(columns[name], wanted), name
    lengths = [len(source) for source in sources]
    assert np.array_equal(columns["task"], np.repeat(TASKS, lengths))
    ends = columns["terminals"] | columns["timeouts"]
    assert np.array_equal(columns["episode"], np.cumsum(ends) - ends), "numbered through the file"


def test_attributes_say_where_it_comes_from(dataset: Dataset, tmp_path: Path) -> None:
    path = to_d4rl(dataset, [3, 0], tmp_path, lambda task: None)
    with h5py.File(path) as file:
        attributes = dict(file.attrs)
    tasks = task_set(dataset.env)
    assert attributes["env_id"] == tasks_id(dataset)
    assert attributes["dataset_sha256"] == dataset.hash
    assert attributes["tasks"].tolist() == [3, 0]
    assert attributes["param_names"].tolist() == list(tasks.param_names)
    assert np.array_equal(attributes["task_params"], tasks.params[[3, 0]])
    assert attributes["task_splits"].tolist() == ["train", "train"]
    returns = [dataset.entry(task)["returns"] for task in (3, 0)]
    assert attributes["ref_min_scores"].tolist() == [one["random"] for one in returns]
    assert attributes["ref_max_scores"].tolist() == [one["expert"] for one in returns]
    assert json.loads(attributes["config"]) == dataset.index["config"]


def tasks_id(dataset: Dataset) -> str:
    return {"point_robot_wind": "PointRobotWind-v0", "sparse_point_robot": "SparsePointRobot-v0"}[
        dataset.env
    ]


def test_the_same_dataset_gives_the_same_bytes(dataset: Dataset, tmp_path: Path) -> None:
    paths = [to_d4rl(dataset, TASKS, tmp_path / name, lambda task: None) for name in "ab"]
    assert paths[0].read_bytes() == paths[1].read_bytes()


def test_an_export_that_is_there_is_kept(dataset: Dataset, tmp_path: Path) -> None:
    (tmp_path / d4rl_file(dataset)).write_text("kept")
    with pytest.raises(DatasetError, match="is there already; delete it or choose another --out"):
        to_d4rl(dataset, TASKS, tmp_path, lambda task: None)
    assert (tmp_path / d4rl_file(dataset)).read_text() == "kept"


def test_a_damaged_task_leaves_nothing(tmp_path: Path) -> None:
    folder = write_dataset(tmp_path / "data", TASKS)
    content = bytearray((folder / "task_002.h5").read_bytes())
    content[-100] ^= 1
    (folder / "task_002.h5").write_bytes(content)
    with pytest.raises(DatasetError, match=r"task_002\.h5"):
        to_d4rl(open_dataset(folder, verify=False), TASKS, tmp_path / "out", lambda task: None)
    assert list((tmp_path / "out").iterdir()) == []


def test_a_task_the_dataset_lacks_writes_nothing(dataset: Dataset, tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="has no task 1"):
        to_d4rl(dataset, [1], tmp_path / "out", lambda task: None)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("limit", [0, 1_000, 100_000])
def test_a_full_disk_leaves_nothing(limit: int, dataset: Dataset, tmp_path: Path) -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, hard))
    try:
        with pytest.raises(OSError, match="File too large"):
            to_d4rl(dataset, TASKS, tmp_path, lambda task: None)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert list(tmp_path.iterdir()) == []
