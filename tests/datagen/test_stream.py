"""Reading in blocks: the same rows as all at once, as well checked, in bounded memory."""

from __future__ import annotations

import gc
import re
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from datagen.dataset import (
    QUALITIES,
    DatasetError,
    TaskData,
    open_dataset,
    task_file,
    write_index,
)
from datagen.files import file_digest
from datagen.stream import open_file, open_task
from tests.datagen.examples import (
    graded_data,
    hand_made_file,
    index_of,
    task_data,
    write_dataset,
    write_tasks,
)

CURVE = {100: -29.0, 200: -20.0, 300: -12.0, 400: -8.0, 500: -7.5, 600: -7.0}
LONGEST = 25
"""Steps of the longest episode."""


@pytest.fixture(scope="module")
def graded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two tasks with 42 episodes of 21 to 25 steps."""
    tasks = [graded_data(task, CURVE, episodes=7) for task in (1, 2)]
    return write_tasks(tmp_path_factory.mktemp("stream") / "point_robot_wind", tasks)


@pytest.mark.parametrize("quality", QUALITIES)
@pytest.mark.parametrize("episodes", [None, 1, 3])
def test_the_blocks_are_what_reading_at_once_gives(
    graded: Path, quality: Any, episodes: int | None
) -> None:
    dataset = open_dataset(graded).select(quality, episodes)
    for rows in (1, 24, 25, 60, 131, 10**6):
        whole = dataset.read(2)
        blocks = list(dataset.blocks(2, rows))
        for name, column in whole.columns.items():
            joined = np.concatenate([block.columns[name] for block in blocks])
            assert joined.dtype == column.dtype
            assert joined.tobytes() == column.tobytes()
        for block, after in zip(blocks, [*blocks[1:], None], strict=True):
            ends = block.terminals | block.timeouts
            assert ends[-1]
            assert len(block) <= rows or ends.sum() == 1
            # And not smaller than need be.
            if after is not None:
                first = int(np.flatnonzero(after.terminals | after.timeouts)[0]) + 1
                assert len(block) + first > rows
            assert (block.task, block.meta) == (2, whole.meta)
        if rows > 1000:
            assert len(blocks) == 1


def test_the_episodes_of_a_slice_without_its_transitions(graded: Path) -> None:
    dataset = open_dataset(graded)
    for part in (dataset, dataset.select("expert"), dataset.select("medium", 2)):
        data, found = part.read(1), part.episodes(1)
        starts = np.flatnonzero(np.diff(data.episode, prepend=-1))
        assert found.lengths.tolist() == np.bincount(data.episode).tolist()
        assert found.checkpoints.tolist() == data.checkpoint[starts].tolist()
        assert len(found) == data.episode[-1] + 1


def large_data(task: int, episodes: int) -> TaskData:
    """So many episodes, copies of ten, over the checkpoints of `CURVE`."""
    ten = task_data(task, episodes=10)
    repeats = episodes // 10
    columns = {
        name: np.tile(column, (repeats, *[1] * (column.ndim - 1)))
        for name, column in ten.columns.items()
    }
    columns["episode"] = np.repeat(np.arange(episodes, dtype=np.int32), LONGEST)
    marks = np.sort(np.resize(np.array(list(CURVE), dtype=np.int32), episodes))
    columns["checkpoint"] = np.repeat(marks, LONGEST)
    behavior = {str(mark): value for mark, value in CURVE.items()}
    stated = {"random": -30.0, "expert": -5.0, "behavior": behavior, "deterministic": behavior}
    return TaskData(task, columns, {**ten.meta, "returns": stated})


def peak_of(action: Callable[[], object]) -> int:
    """Most bytes that an action had in memory at once."""
    gc.collect()
    tracemalloc.start()
    try:
        action()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def test_memory_is_for_a_block_however_large_the_dataset_is(tmp_path: Path) -> None:
    rows, seen = 2**12, []

    def stream(folder: Path, select: Callable[[Any], Any] = lambda dataset: dataset) -> int:
        def read() -> None:
            dataset = select(open_dataset(folder))
            total = 0
            for task in dataset.tasks.tolist():
                for block in dataset.blocks(task, rows):
                    total += len(block)
            seen.append(total)

        return peak_of(read)

    folders = {}
    for name, episodes, tasks in (("one", 2_000, 1), ("large", 20_000, 1), ("many", 20_000, 3)):
        data = [large_data(task, episodes) for task in range(tasks)]
        folders[name] = write_tasks(tmp_path / name, data)
    sizes = {
        name: sum(path.stat().st_size for path in folder.glob("*.h5"))
        for name, folder in folders.items()
    }
    assert sizes["many"] > 50e6
    stream(folders["one"])  # what is imported and cached by the first use is no part of it
    peaks = {name: stream(folder) for name, folder in folders.items()}
    expert = stream(folders["many"], lambda dataset: dataset.select("expert", 1_000))
    assert seen == [50_000, 50_000, 500_000, 1_500_000, 3 * 2 * 1_000 * LONGEST]
    # Measured: 1.3 MB for 2 MB of data, 2.4 for 19 and 2.5 for 57. What grows with a task is where
    # its episodes begin.
    assert max(*peaks.values(), expert) < 4e6
    assert peaks["many"] < 1.3 * peaks["large"]
    # The measure sees what is not streamed:
    assert peak_of(lambda: open_dataset(folders["large"]).read(0)) > sizes["large"]


def test_less_than_one_row_and_foreign_tasks_are_refused_at_once(graded: Path) -> None:
    dataset = open_dataset(graded)
    with pytest.raises(ValueError, match="rows must be at least 1, got 0"):
        dataset.blocks(1, 0)
    for ask in (dataset.blocks, dataset.episodes):
        with pytest.raises(DatasetError, match="has no task 9, only 1, 2; "):
            ask(9)


def test_a_slice_a_task_does_not_have_is_one_sentence(graded: Path) -> None:
    dataset = open_dataset(graded).select("expert", 8)
    wanted = (
        f"{graded / 'task_001.h5'}: has 7 episodes of checkpoint 500, not the 8 asked for; "
        f"`python -m datagen.inspect {graded}` shows what the slices hold, choose another"
    )
    for ask in (dataset.read, dataset.episodes, lambda task: next(dataset.blocks(task))):
        with pytest.raises(DatasetError, match=f"^{re.escape(wanted)}$"):
            ask(1)


def test_a_damaged_file_is_refused_before_its_first_block(tmp_path: Path) -> None:
    folder = write_dataset(tmp_path / "point_robot_wind")
    dataset, path = open_dataset(folder), folder / task_file(3)
    content = path.read_bytes()
    for wrong, said in (
        (content[:-100] + b"x" + content[-99:], "its values are not those it was written with"),
        (content[:5000], f"is truncated to 5000 of its {len(content)} bytes"),
        ((folder / task_file(1)).read_bytes(), "is really the file of task 1, renamed or copied"),
        (b"", "is empty"),
    ):
        path.write_bytes(wrong)
        with pytest.raises(DatasetError, match=f"task_003.h5: {said}.*datagen.collect"):
            next(dataset.blocks(3))
    path.unlink()
    for ask in (dataset.episodes, lambda task: next(dataset.blocks(task))):
        with pytest.raises(DatasetError, match=r"task_003.h5: is missing; "):
            ask(3)


def message_of(action: Callable[[], object]) -> str | None:
    """Message of the DatasetError an action raises, None if it raises nothing."""
    try:
        action()
    except DatasetError as error:
        return str(error)
    return None


def test_episodes_of_a_damaged_file_are_an_error_too(tmp_path: Path) -> None:
    folder = write_dataset(tmp_path / "point_robot_wind")
    dataset, path = open_dataset(folder), folder / task_file(3)
    content = path.read_bytes()
    draw = np.random.default_rng(0)
    refused = 0
    for _ in range(100):
        changed = bytearray(content)
        at = int(draw.integers(0, 4000))
        changed[at : at + 40] = draw.bytes(40)
        path.write_bytes(changed)
        message = message_of(lambda: dataset.episodes(3))
        if message is not None:
            refused += 1
            assert message.startswith(f"{path}: ")
    # What lies in the values of other columns is not looked at here.
    assert 20 < refused < 100
    path.write_bytes((folder / task_file(1)).read_bytes())
    with pytest.raises(DatasetError, match="is really the file of task 1, renamed; "):
        dataset.episodes(3)


def renumbered(file: h5py.File) -> None:
    file["episode"][50:] += 1


def unfinished(file: h5py.File) -> None:
    file["timeouts"][74] = False


def outside(file: h5py.File) -> None:
    file["actions"][80, 1] = 1.5


@pytest.mark.parametrize(
    ("edit", "fault"),
    [
        (renumbered, "column episode is 3 in row 50, must start at 0 and stay or grow by one"),
        (unfinished, "column terminals and timeouts are false at an episode's end in row 24"),
        (outside, r"column actions is outside \[-1, 1\] in row 5"),
    ],
)
def test_a_true_hash_of_a_file_that_breaks_a_promise(
    edit: Callable[[h5py.File], None], fault: str, tmp_path: Path
) -> None:
    folder = write_dataset(tmp_path / "point_robot_wind", (3,))
    data = task_data(3)
    hand_made_file(folder / task_file(3), data.columns, {**data.meta, "format_version": 1}, edit)
    index = index_of(folder, "point_robot_wind", (3,), 4, 0)
    assert index["tasks"][0]["sha256"] == file_digest(folder / task_file(3))
    write_index(folder, index)
    with pytest.raises(DatasetError, match=f"task_003.h5: {fault}"):
        list(open_dataset(folder).blocks(3, 25))


@pytest.mark.parametrize("name", ["episode", "rewards"])
def test_columns_of_different_lengths_are_refused(name: str, tmp_path: Path) -> None:
    data, path = task_data(3), tmp_path / task_file(3)
    shorter = {**data.columns, name: data.columns[name][:-1]}
    hand_made_file(path, shorter, data.meta)
    with (
        open_file(path, "no matter") as handle,
        pytest.raises(DatasetError, match=r"has columns of the lengths .*, of one length"),
        open_task(path, handle, {}),
    ):
        pass
