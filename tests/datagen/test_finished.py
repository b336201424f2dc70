"""What is finished in a folder: verified, of one origin, and summed up in an index."""

from __future__ import annotations

import errno
import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from datagen import finished
from datagen.budgets import budget
from datagen.dataset import DatasetError, TaskData, open_dataset, task_file, write_index, write_task
from datagen.files import machine
from datagen.finished import remove_stale, remove_states, scan, without_versions, write_summary
from datagen.fleet.state import save_state
from datagen.job import group_file, origin
from tests.datagen.examples import task_data

ENV = "point_robot_wind"
ORIGIN = origin(ENV, budget(ENV, "smoke"), 0)


def put(folder: Path, task: int, **changes: Any) -> Path:
    """Write a task's file that says it was collected with the smoke budget, but for `changes`."""
    made = task_data(task)
    path = folder / task_file(task)
    write_task(path, TaskData(task, made.columns, {**made.meta, **ORIGIN, **changes}))
    return path


def test_a_folder_that_is_not_there_is_empty(tmp_path: Path) -> None:
    assert scan(tmp_path / "none", ORIGIN) == {}
    remove_stale(tmp_path / "none")


def test_finished_tasks_are_found_in_order(tmp_path: Path) -> None:
    for task in (11, 2, 5):
        put(tmp_path, task)
    (tmp_path / "task_7.h5").write_text("not a task file's name")
    found = scan(tmp_path, ORIGIN)
    assert list(found) == [2, 5, 11]
    assert found[2].record["split"] == "test"
    assert found[2].record["transitions"] == 100
    assert found[2].record["bytes"] == (tmp_path / "task_002.h5").stat().st_size


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"seed": 3}, "was collected with seed 3, not 0; "),
        ({"budget": "paper"}, "was collected with budget 'paper', not 'smoke'; "),
        (
            {"config": {**ORIGIN["config"], "sac": {**ORIGIN["config"]["sac"], "gamma": 0.5}}},
            r"was collected with config\.sac\.gamma 0\.5, not 0\.9; ",
        ),
        (
            {"config": {**ORIGIN["config"], "beta": 1}},
            r"was collected with config\.beta 1, not nothing of that name; ",
        ),
        (
            {
                "config": {
                    **ORIGIN["config"],
                    "fleet": {**ORIGIN["config"]["fleet"], "device": "cuda"},
                }
            },
            r"was collected with config\.fleet\.device 'cuda', not 'cpu'; ",
        ),
        (
            {"versions": {**ORIGIN["versions"], "torch": "1.0"}},
            r"was collected with versions\.torch '1\.0', not '",
        ),
    ],
)
def test_a_difference_is_named(tmp_path: Path, changes: dict[str, Any], sentence: str) -> None:
    put(tmp_path, 1, **changes)
    with pytest.raises(DatasetError, match=sentence + ".*choose another --out, or delete"):
        scan(tmp_path, ORIGIN)


def test_versions_are_compared_among_the_files_where_none_are_asked_for(tmp_path: Path) -> None:
    for task in (1, 2):
        put(tmp_path, task, versions={"torch": "1.0"})
    assert list(scan(tmp_path, without_versions(ORIGIN))) == [1, 2]
    put(tmp_path, 3, versions={"torch": "1.1"})
    with pytest.raises(DatasetError, match=r"task_003\.h5: was .* versions\.torch '1\.1', not"):
        scan(tmp_path, without_versions(ORIGIN))


def test_a_damaged_file_is_an_error(tmp_path: Path) -> None:
    path = put(tmp_path, 1)
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(DatasetError, match=r"task_001\.h5: is truncated .* delete it and run"):
        scan(tmp_path, ORIGIN)


def test_what_dead_writers_left_is_removed(tmp_path: Path) -> None:
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    stale = tmp_path / f".task_003.h5.{machine()}.{ended.pid}.partial"
    living = tmp_path / f".task_004.h5.{machine()}.{os.getppid()}.partial"
    # A dead process here may be a living one there, and the other way round.
    elsewhere = [
        tmp_path / f".task_{task:03d}.h5.elsewhere.{pid}.partial"
        for task, pid in ((5, ended.pid), (6, os.getpid()))
    ]
    other = tmp_path / ".hidden.partial"
    paths = (stale, living, *elsewhere, other)
    for path in paths:
        path.write_text("half")
    remove_stale(tmp_path)
    assert [path.exists() for path in paths] == [False, True, True, True, True]
    remove_stale(tmp_path, {"task_006.h5"})
    assert [path.exists() for path in paths] == [False, True, True, False, True]


def test_a_folder_that_a_dead_writer_left_is_removed(tmp_path: Path) -> None:
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    folder, link = (tmp_path / f".{name}.{machine()}.{ended.pid}.partial" for name in ("a", "b"))
    put_in = tmp_path / "kept"
    for place in (folder, put_in):
        place.mkdir()
        (place / "task_000.h5").write_text("half")
    link.symlink_to(put_in)
    remove_stale(tmp_path)
    assert list(tmp_path.iterdir()) == [put_in]
    assert [path.name for path in put_in.iterdir()] == ["task_000.h5"]


@pytest.mark.parametrize("use", [remove_stale, lambda folder: scan(folder, ORIGIN)])
def test_a_folder_that_cannot_be_read_is_an_error(
    use: Callable[[Path], object], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(folder: Path) -> None:
        raise PermissionError(errno.EACCES, "Permission denied", str(folder))

    monkeypatch.setattr(Path, "iterdir", refuse)
    with pytest.raises(DatasetError) as caught:
        use(tmp_path)
    sentence = "cannot be read (Permission denied); check its permissions and the disk"
    assert str(caught.value) == f"{tmp_path}: {sentence}"


def test_what_cannot_be_deleted_is_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(path: Path) -> None:
        raise PermissionError(errno.EPERM, "Operation not permitted", str(path))

    path = tmp_path / ".task_003.h5.elsewhere.1.partial"
    path.write_text("half")
    monkeypatch.setattr(Path, "unlink", refuse)
    with pytest.raises(DatasetError, match=r"deleted \(Operation not permitted\); delete it$"):
        remove_stale(tmp_path, {"task_003.h5"})


def test_trainings_of_finished_tasks_are_removed(tmp_path: Path) -> None:
    put(tmp_path, 1)
    put(tmp_path, 2)
    done, also, half = (group_file(tmp_path, group) for group in ((1,), (1, 2), (2, 3)))
    for path, group in ((done, [1]), (also, [1, 2]), (half, [2, 3])):
        save_state(path, {}, {"origin": {"group": group}})
    damaged = group_file(tmp_path, (2,))
    damaged.write_text("x")
    remove_states(tmp_path)
    assert [path.exists() for path in (done, also, half, damaged)] == [False, False, True, True]


def test_the_summary_is_a_dataset_with_a_card(tmp_path: Path) -> None:
    for task in (3, 1, 2):
        put(tmp_path, task)
    index = write_summary(tmp_path, ORIGIN)
    dataset = open_dataset(tmp_path)
    assert dataset.tasks.tolist() == [1, 2, 3]
    assert dataset.read(3).meta["task"] == 3
    assert dataset.index["tasks"] == json.loads(json.dumps(index["tasks"]))
    assert "on 3 of its 50 tasks" in (tmp_path / "README.md").read_text()
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    write_summary(tmp_path, ORIGIN)
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_a_task_that_another_shard_finished_meanwhile_is_in_the_index(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    put(tmp_path, 1)
    late = iter([2, 3])

    def write_index_slowly(folder: Path, index: dict[str, Any]) -> None:
        original(folder, index)
        for task in late:
            put(folder, task)
            break

    original = write_index
    monkeypatch.setattr(finished, "write_index", write_index_slowly)
    write_summary(tmp_path, ORIGIN)
    assert open_dataset(tmp_path).tasks.tolist() == [1, 2, 3]
    assert "on 3 of its 50 tasks" in (tmp_path / "README.md").read_text()
