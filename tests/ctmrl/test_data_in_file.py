"""Training data in a file: the same results, and memory for a part of them is enough."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from ctmrl.config import RunConfig
from ctmrl.data import OfflineData
from ctmrl.meta_train import Learner
from ctmrl.table import Room
from datagen.dataset import TaskData, open_dataset, task_file, write_index, write_task
from tests.ctmrl.examples import with_dual_steps
from tests.ctmrl.test_meta_train import STEPS, assert_same, config_of, frozen, train
from tests.datagen.examples import index_of, task_data

TILES, TASKS = 4_500, (0, 1, 3, 4)


@pytest.fixture(params=[("ctmrl", 0), ("ctmrl", 1), ("focal", 1), ("ctmrl", 3)], ids=str)
def config(request: pytest.FixtureRequest) -> RunConfig:
    """With so many steps of the dual critic; 0 is without one."""
    method, steps = request.param
    return with_dual_steps(config_of(method), max(steps, 1), steps > 0)


@pytest.fixture
def file_data(wind_path: Path, tmp_path: Path) -> OfflineData:
    """`wind_data`, in a file."""
    dataset = open_dataset(wind_path)
    return OfflineData(dataset, dataset.train_tasks, room=Room(0, tmp_path))


def test_they_train_to_the_same_bytes(
    config: RunConfig, wind_data: OfflineData, file_data: OfflineData
) -> None:
    memory, file = Learner(config, wind_data), Learner(config, file_data)
    assert train(file, 7) == train(memory, 7)
    resumed = Learner(config, file_data)
    resumed.load(frozen(file.state()))
    for learner in (memory, file, resumed):
        train(learner, STEPS - 7)
    assert_same(file.state(), memory.state())
    assert_same(resumed.state(), memory.state())


def test_a_step_reads_the_rows_of_the_next_one_ahead(
    config: RunConfig, file_data: OfflineData, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[Tensor] = []
    ahead: list[Tensor] = []

    def spied(draw: Callable[..., Tensor]) -> Callable[..., Tensor]:
        def draw_and_tell(*words: Any) -> Tensor:
            drawn.append(draw(*words))
            return drawn[-1]

        return draw_and_tell

    for name in ("context_rows", "batch_rows"):
        monkeypatch.setattr(file_data, name, spied(getattr(file_data, name)))
    monkeypatch.setattr(file_data, "page_in", ahead.append)
    learner, foreseen = Learner(config, file_data), 0
    for _ in range(STEPS):
        before = ahead.copy()
        drawn.clear()
        ahead.clear()
        learner.update()
        # Contexts and batch of this step, then those of the next.
        assert len(ahead) == 2
        assert all(map(torch.equal, drawn[-2:], ahead))
        # Unless contexts are collected for K-means before the step, which no one foresees.
        if before and len(drawn) == 4:
            foreseen += 1
            assert all(map(torch.equal, drawn[:2], before))
    assert foreseen == (3 if config.method == "ctmrl" else STEPS - 1)


def test_data_in_memory_are_not_read_ahead(
    wind_data: OfflineData, monkeypatch: pytest.MonkeyPatch
) -> None:
    learner, ahead = Learner(config_of(), wind_data), list[Tensor]()
    monkeypatch.setattr(wind_data, "page_in", ahead.append)
    learner.update()
    assert not ahead


@pytest.fixture(scope="module")
def large_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four tasks of 675,000 rows, the same 150 again and again: a table of 108 MB."""
    folder = tmp_path_factory.mktemp("large")
    counts = {}
    for task in TASKS:
        data = task_data(task, episodes=6)
        columns = {
            name: np.tile(column, (TILES, *(1,) * (column.ndim - 1)))
            for name, column in data.columns.items()
        }
        columns["episode"] = np.repeat(np.arange(6 * TILES, dtype=np.int32), 25)
        write_task(folder / task_file(task), TaskData(task, columns, data.meta))
        counts[task] = {"episodes": 6 * TILES, "transitions": len(columns["rewards"])}
    index = index_of(folder, "point_robot_wind", TASKS, 6, 0)
    for record in index["tasks"]:
        record |= counts[record["task"]]
    write_index(folder, index)
    return folder


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="only Linux tells and limits it")
@pytest.mark.parametrize(
    ("gigabytes", "megabytes", "fits"), [(0, 60, True), (1, 60, False), (1, 160, True)]
)
def test_memory_for_a_part_is_enough_in_a_file_and_for_one_table_otherwise(
    gigabytes: int, megabytes: int, fits: bool, wind_path: Path, large_path: Path, tmp_path: Path
) -> None:
    words = [wind_path, large_path, tmp_path, gigabytes, megabytes]
    done = subprocess.run(
        [sys.executable, "-m", "tests.ctmrl.bounded_memory", *map(str, words)],
        cwd=Path(__file__).parents[2],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    if fits:
        # What a context sees (s, a, r, s'), and what else is learned from: r, terminal, rank.
        assert int(done.stdout) == 4 * 675_000 * (2 + 2 + 1 + 2 + 1 + 1 + 1) * 4
    else:
        assert done.stdout == (
            "the training data take 0.11 GB as a table, more memory than there is: "
            "--memory 0 keeps them in a file"
        )
