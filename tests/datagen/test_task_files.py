"""One task's file: round trip, determinism, and 400 ways to damage it."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from datagen.columns import TaskData
from datagen.files import DatasetError, digest
from datagen.task_files import read_task, write_task
from tests.datagen.examples import hand_made_file, task_data, write_dataset

WRITE = """
import sys
from pathlib import Path
sys.path.insert(0, sys.argv[1])
from tests.datagen.examples import write_dataset
write_dataset(Path(sys.argv[2]), tasks=(3,))
"""


def same(first: TaskData, second: TaskData) -> bool:
    """Whether two reads gave the same values, bit for bit."""
    return (
        (first.task, first.meta, list(first.columns))
        == (second.task, second.meta, list(second.columns))
    ) and all(
        first.columns[name].tobytes() == second.columns[name].tobytes() for name in first.columns
    )


@pytest.mark.parametrize("env", ["point_robot", "point_robot_wind", "sparse_point_robot"])
def test_what_is_written_is_read(tmp_path: Path, env: str) -> None:
    path = tmp_path / "task_003.h5"
    data = task_data(3, env)
    write_task(path, data)
    found = read_task(path, digest(path.read_bytes()))
    hashed = {**data.meta, "content_sha256": found.meta["content_sha256"]}
    assert same(found, TaskData(3, data.columns, hashed))
    write_task(path.with_name("again_task_003.h5").with_name("task_003.h5"), found)
    assert same(read_task(path), found)


def test_the_same_data_give_the_same_bytes(tmp_path: Path) -> None:
    first, second = tmp_path / "a", tmp_path / "b"
    write_dataset(first, tasks=(3,))
    root = str(Path(__file__).parents[2])
    subprocess.run([sys.executable, "-c", WRITE, root, str(second)], check=True)
    for name in ("task_003.h5", "dataset.json"):
        assert (first / name).read_bytes() == (second / name).read_bytes()
    write_task(first / "task_003.h5", task_data(3))
    assert (first / "task_003.h5").read_bytes() == (second / "task_003.h5").read_bytes()


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        (lambda d: TaskData(4, d.columns, d.meta), "is of task 4, but its meta of task 3"),
        (lambda d: TaskData(3, {**d.columns, "rewards": d.rewards * np.nan}, d.meta), "is NaN"),
        (lambda d: TaskData(3, d.columns, {**d.meta, "seed": None}), "'seed' None"),
        (lambda d: TaskData(3, d.columns, {**d.meta, "x": np.inf}), "not JSON compliant"),
        (lambda d: TaskData(3, d.columns, {**d.meta, "x": Path()}), "no place in JSON"),
        (lambda d: TaskData(3, d.columns, {}), "has no key 'env'"),
    ],
)
def test_wrong_data_are_not_written(
    tmp_path: Path, change: Callable[[TaskData], TaskData], fault: str
) -> None:
    path = tmp_path / "task_003.h5"
    with pytest.raises(DatasetError, match=f"task_003.h5: .*{fault}.*; nothing was written"):
        write_task(path, change(task_data(3)))
    assert os.listdir(tmp_path) == []


def test_a_wrong_name_is_not_written(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=r"must be called task_003.h5"):
        write_task(tmp_path / "task_004.h5", task_data(3))


def test_a_missing_file_is_a_dataset_error(tmp_path: Path) -> None:
    path = tmp_path / "sparse_point_robot" / "task_007.h5"
    remedy = (
        "run `python -m datagen.collect --env sparse_point_robot --tasks 7 --out .*` to make it"
    )
    with pytest.raises(DatasetError, match=f"task_007.h5: is missing; {remedy}"):
        read_task(path)


def test_a_known_hash_is_compared(tmp_path: Path) -> None:
    path = tmp_path / "task_003.h5"
    write_task(path, task_data(3))
    with pytest.raises(DatasetError, match=r"has the SHA-256 .*, must have 000000000000\.\.\."):
        read_task(path, "0" * 64)


def test_a_renamed_file_is_not_taken_for_another_task(tmp_path: Path) -> None:
    path = tmp_path / "task_003.h5"
    write_task(path, task_data(3))
    path.rename(tmp_path / "task_004.h5")
    with pytest.raises(DatasetError, match=r"is really the file of task 3, renamed; .*--tasks 4"):
        read_task(tmp_path / "task_004.h5")
    (tmp_path / "task_004.h5").rename(tmp_path / "mine.h5")
    assert read_task(tmp_path / "mine.h5").task == 3


def test_another_version_is_told_from_damage(tmp_path: Path) -> None:
    data = task_data(3)
    path = hand_made_file(
        tmp_path / "task_003.h5", data.columns, {**data.meta, "format_version": 2}
    )
    message = (
        "is of format version 2, this program reads version 1; delete it and run "
        "`python -m datagen.collect --env point_robot_wind --tasks 3 --seed 0 --out "
    )
    with pytest.raises(DatasetError, match=message):
        read_task(path)


def test_a_true_hash_does_not_excuse_wrong_content(tmp_path: Path) -> None:
    data = task_data(3)
    path = tmp_path / "task_003.h5"
    hand_made_file(path, data.columns, data.meta)
    assert len(read_task(path)) == 100
    data.columns["actions"][3] = 2.0
    with pytest.raises(DatasetError, match=r"actions is outside \[-1, 1\] in row 3; delete it"):
        read_task(hand_made_file(path, data.columns, data.meta))
    hand_made_file(path, task_data(3).columns, {**data.meta, "task_hash": "0"})
    with pytest.raises(DatasetError, match="another version of point_robot_wind"):
        read_task(path)
    missing = {name: c for name, c in task_data(3).columns.items() if name != "timeouts"}
    with pytest.raises(DatasetError, match="has no column timeouts"):
        read_task(hand_made_file(path, missing, data.meta))


def damaged(content: bytes, generator: np.random.Generator) -> bytes:
    """A file's bytes with one random accident."""
    found = bytearray(content)
    start = int(generator.integers(len(content)))
    length = int(generator.integers(1, 600))
    kind = generator.integers(6)
    if kind == 0:
        found[start] ^= 1 << int(generator.integers(8))
    elif kind == 1:
        for place in generator.integers(0, len(content), 5):
            found[place] = int(generator.integers(256))
    elif kind == 2:
        found[start : start + length] = bytes(len(found[start : start + length]))
    elif kind == 3:
        del found[start:]
    elif kind == 4:
        found += generator.bytes(length)
    else:
        del found[start : start + length]
        found += bytes(len(content) - len(found))
    return bytes(found)


def test_a_damaged_file_is_refused_or_its_damage_is_without_effect(tmp_path: Path) -> None:
    path = write_dataset(tmp_path / "point_robot_wind", tasks=(3,)) / "task_003.h5"
    whole, content = read_task(path), path.read_bytes()
    generator = np.random.default_rng(0)
    messages = []
    for _ in range(400):
        path.write_bytes(damaged(content, generator))
        try:
            assert same(read_task(path), whole)
        except DatasetError as error:
            messages.append(str(error))
    assert len(messages) > 350
    for message in messages:
        assert message.startswith(f"{path}: ")
        assert "; delete it and run `python -m datagen.collect --env point_robot_wind" in message


def test_nothing_is_left_open_and_nothing_returned_is_shared(tmp_path: Path) -> None:
    path = tmp_path / "task_003.h5"
    write_task(path, task_data(3))
    before: Any = set(os.listdir("/proc/self/fd")) if Path("/proc/self/fd").exists() else None
    first = read_task(path)
    if before is not None:
        assert set(os.listdir("/proc/self/fd")) == before
    first.rewards[:] = 0.0
    assert not (read_task(path).rewards == 0.0).any()
