"""One task's file read a block at a time, for data that do not fit into memory."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from io import BufferedReader
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datagen.columns import TaskData
from datagen.files import DatasetError, file_size, task_of, unreadable
from datagen.hdf5 import ColumnFile, opened
from datagen.records import check_meta
from datagen.slices import Slice, chosen_episodes, slice_meta
from datagen.task_files import check_task_data, remake

BLOCK_ROWS = 2**16
"""Rows of a block where nothing else is asked for: 2 MB on a point robot, 13 MB on an ant."""


@dataclass(frozen=True, eq=False)
class Episodes:
    """The episodes of a task, or of a slice of it, without their transitions.

    Attributes:
        lengths: transitions of each, int64 [E].
        checkpoints: training steps of the policy that acted in each, int32 [E].
    """

    lengths: NDArray[np.int64]
    checkpoints: NDArray[np.int32]

    def __len__(self) -> int:
        """Number of episodes, E."""
        return len(self.lengths)


@contextmanager
def open_file(path: Path, remedy: str) -> Iterator[BufferedReader]:
    """Open a regular file for reading.

    Raises:
        DatasetError: it is missing, something else than a file, or out of reach.
    """
    file_size(path, remedy)
    try:
        handle = path.open("rb")
    except OSError as error:
        raise unreadable(path, error) from error
    with handle:
        yield handle


@contextmanager
def open_task(
    path: Path, handle: BufferedReader, source: Mapping[str, Any]
) -> Iterator[TaskStream]:
    """Open a task's file without reading its transitions.

    Args:
        path: of the file, for messages.
        handle: the file, open for reading; it stays open.
        source: the index, for messages.

    Raises:
        DatasetError: it is not a task's file, or not of the task it is named after.
    """
    with ExitStack() as stack:
        with _faults(path, source):
            file = stack.enter_context(opened(handle))
            check_meta(file.meta)
            episodes = _episodes(file)
        task = int(file.meta["task"])
        if task_of(path) not in (None, task):
            fault = f"is really the file of task {task}, renamed"
            raise DatasetError(path, fault, remake(path, source))
        yield TaskStream(path, task, file, source, episodes)


@dataclass(frozen=True, eq=False)
class TaskStream:
    """A task's open file; made by `open_task`.

    Attributes:
        path: of the file, for messages.
        task: row of the environment's task set.
        file: its columns on the disk.
        source: the index, for messages.
        episodes: all of its episodes.
    """

    path: Path
    task: int
    file: ColumnFile
    source: Mapping[str, Any]
    episodes: Episodes

    @property
    def meta(self) -> dict[str, Any]:
        """What the file says about its data."""
        return self.file.meta

    def chosen(self, part: Slice) -> NDArray[np.int64]:
        """Numbers of the episodes of a slice, rising, int64 [K].

        Raises:
            DatasetError: there are none, or fewer of a checkpoint than the slice wants.
        """
        try:
            return chosen_episodes(self.episodes.checkpoints, self.meta["returns"], part)
        except ValueError as error:
            raise no_slice(self.path, error) from error

    def blocks(self, part: Slice, rows: int) -> Iterator[TaskData]:
        """The rows of a slice, in blocks of whole episodes, numbered through from 0.

        Args:
            part: the slice.
            rows: most rows of a block, unless a single episode has more.

        Raises:
            DatasetError: the slice is empty, or a block breaks a promise of the format.
        """
        chosen = self.chosen(part)
        meta = slice_meta(self.meta, part, self.episodes.checkpoints[chosen])
        lengths = self.episodes.lengths[chosen]
        starts = (np.cumsum(self.episodes.lengths) - self.episodes.lengths)[chosen]
        for first, end in _groups(lengths, rows):
            spans = _spans(starts[first:end], lengths[first:end])
            number = np.repeat(np.arange(end - first, dtype=np.int32), lengths[first:end])
            with _faults(self.path, self.source):
                columns = {name: self._read(name, spans) for name in self.file.columns}
                columns["episode"] = number
                check_task_data(TaskData(self.task, columns, self.meta))
            columns["episode"] = number + np.int32(first)
            yield TaskData(self.task, columns, meta)

    def _read(self, name: str, spans: list[tuple[int, int]]) -> NDArray[Any]:
        parts = [self.file.read(name, start, stop) for start, stop in spans]
        return parts[0] if len(parts) == 1 else np.concatenate(parts)


def no_slice(path: Path, error: ValueError) -> DatasetError:
    """The DatasetError for a slice that a task does not have."""
    remedy = f"`python -m datagen.inspect {path.parent}` shows what the slices hold, choose another"
    return DatasetError(path, str(error), remedy)


@contextmanager
def _faults(path: Path, source: Mapping[str, Any]) -> Iterator[None]:
    """Turn a ValueError about a file's content into a DatasetError."""
    try:
        yield
    except ValueError as error:
        raise DatasetError(path, str(error), remake(path, source)) from error


def _episodes(file: ColumnFile) -> Episodes:
    """Where a file's episodes begin, from two of its columns, a block of rows at a time.

    Raises:
        ValueError: a column is missing or shorter than another, or episodes are not numbered
            without a gap.
    """
    sizes = {name: column.shape[:1] for name, column in file.columns.items()}
    if {"episode", "checkpoint"} - sizes.keys() or len(set(sizes.values())) != 1:
        raise ValueError(f"has columns of the lengths {sizes}, must have all, of one length")
    (total,) = sizes["episode"]
    if not total:
        raise ValueError("has no transitions")
    starts, marks, previous = [], [], -1
    for begin in range(0, total, BLOCK_ROWS):
        end = min(begin + BLOCK_ROWS, total)
        number = file.read("episode", begin, end).astype(np.int64)
        step = np.diff(number, prepend=previous)
        wrong = np.flatnonzero((step != 0) & (step != 1))
        if len(wrong):
            raise ValueError(
                f"column episode is {number[wrong[0]]} in row {begin + wrong[0]}, must start at 0 "
                "and stay or grow by one"
            )
        new = np.flatnonzero(step)
        starts.append(begin + new)
        marks.append(file.read("checkpoint", begin, end)[new])
        previous = int(number[-1])
    lengths = np.diff(np.concatenate([*starts, [total]]))
    return Episodes(lengths, np.concatenate(marks))


def _groups(lengths: NDArray[np.int64], rows: int) -> Iterator[tuple[int, int]]:
    """Runs of episodes, first to end, of at most so many rows together, or of one episode."""
    ends, first = np.cumsum(lengths), 0
    while first < len(lengths):
        full = ends[first] - lengths[first] + rows
        end = max(int(np.searchsorted(ends, full, side="right")), first + 1)
        yield first, end
        first = end


def _spans(starts: NDArray[np.int64], lengths: NDArray[np.int64]) -> list[tuple[int, int]]:
    """Rows of some episodes, rising, as few spans from start to stop as there are gaps."""
    ends = starts + lengths
    gaps = np.flatnonzero(starts[1:] != ends[:-1]) + 1
    firsts, lasts = starts[np.append(0, gaps)], ends[np.append(gaps, len(ends)) - 1]
    return [(int(a), int(b)) for a, b in zip(firsts, lasts, strict=True)]
