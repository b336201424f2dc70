"""A legacy folder becomes a dataset with its values, or nothing."""

from __future__ import annotations

import os
import resource
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from datagen.check import Findings, check_folder
from datagen.dataset import DatasetError, open_dataset
from datagen.from_legacy import Import, from_legacy
from meta_envs import reference_returns, task_set
from tests.datagen.examples import CHECKPOINTS, task_data
from tests.datagen.legacy import write_legacy

ENV = "point_robot_wind"
TASKS = (0, 2, 3)


def convert(folder: Path, out: Path, env: str = ENV, tasks: str | None = None) -> dict[str, Any]:
    seen: list[int] = []
    index = from_legacy(Import(folder, env, out, tasks), seen.append, seen.append)
    imported = [record["task"] for record in index["tasks"]]
    assert seen == [len(imported), *imported]
    return index


@pytest.fixture
def legacy(tmp_path: Path) -> Path:
    for task in TASKS:
        write_legacy(tmp_path / "legacy", task_data(task))
    return tmp_path / "legacy"


def test_every_value_arrives(legacy: Path, tmp_path: Path) -> None:
    convert(legacy, tmp_path / "out")
    findings = Findings()
    assert check_folder(tmp_path / "out", findings) is not None
    assert (findings.faults, findings.warnings) == ([], [])
    dataset = open_dataset(tmp_path / "out")
    assert dataset.tasks.tolist() == list(TASKS)
    assert dataset.test_tasks.tolist() == [2]
    for task in TASKS:
        data, source = dataset.read(task), task_data(task)
        assert data.columns.keys() == source.columns.keys()
        for name, column in source.columns.items():
            assert np.array_equal(data.columns[name], column), name


def test_what_the_folder_does_not_say_is_computed_or_marked(legacy: Path, tmp_path: Path) -> None:
    index = convert(legacy, tmp_path / "out")
    assert (index["budget"], index["seed"]) == ("legacy", -1)
    assert index["config"] == {
        "source": "legacy", "checkpoints": list(CHECKPOINTS), "tasks_verified": True,
        "rewards_in_files": "as stepped", "observation_zeros_dropped": 0,
        "deterministic_known": False,
    }  # fmt: skip
    returns, data = index["tasks"][2]["returns"], task_data(3)
    total = data.rewards.reshape(4, 25).sum(axis=1, dtype=np.float64)
    assert returns["behavior"] == pytest.approx(
        {"200": total[:2].mean(), "1000": total[2:].mean()}, abs=1e-12
    )
    assert returns["deterministic"] == returns["behavior"]
    everywhere = reference_returns(task_set(ENV), 100)
    assert returns["expert"] == pytest.approx(everywhere["oracle"][3], abs=1e-9)
    assert returns["random"] == pytest.approx(everywhere["random"][3], abs=1.0)
    text = (tmp_path / "out" / "README.md").read_text()
    assert "Every step was computed anew" in text
    assert "the deterministic returns repeat the stochastic ones" in text
    assert "license: unknown\n" in text
    assert "datagen.collect" not in text, "it cannot be collected anew"


def test_deterministic_episodes_give_their_returns(tmp_path: Path) -> None:
    write_legacy(tmp_path / "legacy", task_data(3), deterministic=True)
    index = convert(tmp_path / "legacy", tmp_path / "out")
    assert index["config"]["deterministic_known"] is True
    total = task_data(3).rewards.reshape(4, 25).sum(axis=1, dtype=np.float64)
    returns = index["tasks"][0]["returns"]["deterministic"]
    assert returns == pytest.approx({"200": total[0], "1000": total[2]}, abs=1e-12)
    assert index["tasks"][0]["episodes"] == 4, "deterministic episodes are no data"


def test_dense_rewards_of_a_sparse_environment(tmp_path: Path) -> None:
    env, source = "sparse_point_robot", task_data(50, "sparse_point_robot")
    write_legacy(tmp_path / "legacy", source, column="dense_rewards")
    index = convert(tmp_path / "legacy", tmp_path / "out", env)
    assert index["config"]["rewards_in_files"] == "dense"
    data = open_dataset(tmp_path / "out").read(50)
    assert np.array_equal(data.columns["dense_rewards"], source.columns["dense_rewards"])
    assert data.rewards == pytest.approx(source.rewards, abs=1e-5)


def test_the_same_folder_gives_the_same_bytes(legacy: Path, tmp_path: Path) -> None:
    convert(legacy, tmp_path / "a", tasks="2-3")
    (tmp_path / "b").mkdir()
    convert(legacy, tmp_path / "b", "point-robot-wind", tasks="2,3")
    names = sorted(path.name for path in (tmp_path / "a").iterdir())
    assert names == ["README.md", "dataset.json", "task_002.h5", "task_003.h5"]
    for name in names:
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()


def refused(legacy: Path, out: Path, fault: str, env: str = ENV, tasks: str | None = None) -> None:
    with pytest.raises(DatasetError, match=fault):
        convert(legacy, out, env, tasks)
    assert not out.exists()
    assert not list(out.parent.glob(".*"))


def test_a_malicious_file_is_refused_and_not_run(legacy: Path, tmp_path: Path) -> None:
    class Evil:
        def __reduce__(self) -> tuple[Any, ...]:
            return os.mkdir, (str(tmp_path / "run"),)

    path = legacy / "goal_idx2" / "trj_evalsample1_step1000.npy"
    rows = np.load(path, allow_pickle=True)
    rows[3, 2] = Evil()
    np.save(path, rows)
    refused(legacy, tmp_path / "out", rf"{path.name}: its pickle asks for '\w+\.mkdir'")
    assert not (tmp_path / "run").exists()


def test_what_does_not_fit_is_refused(legacy: Path, tmp_path: Path) -> None:
    refused(tmp_path / "none", tmp_path / "out", "none: is no folder")
    refused(legacy, tmp_path / "out", "has 25 steps, an episode of point_robot", "point_robot")
    fault = "goal_idx2: is a task that half_cheetah_dir does not have, with 0 to 1; choose another"
    refused(legacy, tmp_path / "out", fault, "half_cheetah_dir")
    refused(legacy, tmp_path / "out", "goal_idx1: is not there; choose other --tasks", tasks="1")
    path = legacy / "goal_idx3" / "trj_evalsample0_step200.npy"
    path.write_bytes(path.read_bytes()[:-9])
    refused(legacy, tmp_path / "out", f"goal_idx3/{path.name}: its pickle")


def test_tasks_with_other_checkpoints_are_refused(legacy: Path, tmp_path: Path) -> None:
    for path in (legacy / "goal_idx2").glob("*_step200.npy"):
        path.unlink()
    fault = "goal_idx2: has other checkpoints than goal_idx0: only one of the two has 200; choose"
    refused(legacy, tmp_path / "out", fault)
    convert(legacy, tmp_path / "out", tasks="0,3")
    convert(legacy, tmp_path / "alone", tasks="2")


def test_what_is_there_is_not_touched(legacy: Path, tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "kept.txt").write_text("kept")
    with pytest.raises(DatasetError, match="is there already; delete it or choose another --out"):
        convert(legacy, tmp_path / "out")
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["kept.txt"]


def test_what_a_killed_import_left_is_removed(legacy: Path, tmp_path: Path) -> None:
    code = (
        "import os, signal\nfrom pathlib import Path\n"
        "from datagen.from_legacy import Import, from_legacy\n"
        "def done(task): os.kill(os.getpid(), signal.SIGKILL)\n"
        f"wanted = Import(Path({str(legacy)!r}), {ENV!r}, Path({str(tmp_path / 'out')!r}))\n"
        "from_legacy(wanted, print, done)"
    )
    killed = subprocess.run([sys.executable, "-c", code], capture_output=True, check=False)
    assert killed.returncode == -signal.SIGKILL
    (left,) = tmp_path.glob(".out.*.partial")
    assert [path.name for path in left.iterdir()] == ["task_000.h5"]
    convert(legacy, tmp_path / "out")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["legacy", "out"]


def test_a_full_disk_leaves_nothing(legacy: Path, tmp_path: Path) -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2_000, hard))
    try:
        with pytest.raises(OSError, match="File too large"):
            convert(legacy, tmp_path / "out")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["legacy"]
