"""The dataset format: write it, read it, verify it. Imports neither torch nor Stable-Baselines3.

A dataset is a folder with one HDF5 file a task (`task_003.h5`) and an index, `dataset.json`.
docs/dataset_format.md describes both for those who write their own loader.
"""

from __future__ import annotations

import hashlib
import os
import stat
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from io import BufferedReader
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datagen.columns import COLUMNS, TaskData
from datagen.files import (
    INDEX_FILE,
    DatasetError,
    canonical_json,
    collect_command,
    digest,
    file_size,
    naming,
    parse_canonical,
    read_bytes,
    task_file,
    task_of,
    unreadable,
    write_whole,
)
from datagen.records import FORMAT_VERSION, check_index, check_version
from datagen.slices import QUALITIES, Quality, Slice, take
from datagen.stream import BLOCK_ROWS, Episodes, no_slice, open_file, open_task
from datagen.task_files import NOT_WRITTEN, parse_task, read_task, remake, write_task
from meta_envs import task_set

__all__ = [
    "COLUMNS",
    "FORMAT_VERSION",
    "INDEX_FILE",
    "QUALITIES",
    "Dataset",
    "DatasetError",
    "Episodes",
    "Quality",
    "Slice",
    "TaskData",
    "collect_command",
    "naming",
    "open_dataset",
    "read_task",
    "task_file",
    "task_of",
    "write_index",
    "write_task",
    "write_whole",
]


def write_index(folder: Path, index: dict[str, Any]) -> None:
    """Write a dataset's index, `dataset.json`, whole or not at all.

    Args:
        folder: the dataset.
        index: all of its keys but `sha256`, which is computed; docs/dataset_format.md lists them.

    Raises:
        DatasetError: a key is missing or wrong; nothing was written.
        OSError: the disk is full or the folder is missing; an index that was there stays.
    """
    path = folder / INDEX_FILE
    try:
        rest = {key: value for key, value in index.items() if key != "sha256"}
        checked = parse_canonical(canonical_json(rest).encode())
        check_index(checked)
    except (ValueError, TypeError) as error:
        raise DatasetError(path, str(error), NOT_WRITTEN) from error
    checked["sha256"] = digest(canonical_json(checked))
    write_whole(path, canonical_json(checked).encode())


@dataclass(frozen=True, eq=False)
class Dataset:
    """An opened dataset, or a slice of one; made by `open_dataset` and by `select`.

        dataset = open_dataset("datasets/point_robot_wind")
        expert = dataset.select("expert", episodes=10)
        for task in expert.train_tasks:
            data = expert.read(task)  # all of it at once, or
            for block in expert.blocks(task):  # a few megabytes at a time
                ...

    Attributes:
        path: its folder.
        index: content of `dataset.json`.
        env: short name of the environment.
        tasks: the tasks it has, sorted rows of the environment's task set, int64 [n].
        train_tasks: those of them that are for meta-training, sorted, int64.
        test_tasks: those that are for meta-testing, sorted, int64: the others, or where an
            environment trains and tests on the same tasks, the same.
        params: parameters of `tasks`, float64 [n, P].
        part: which rows of each task are read; all by default.
    """

    path: Path
    index: dict[str, Any]
    env: str
    tasks: NDArray[np.int64]
    train_tasks: NDArray[np.int64]
    test_tasks: NDArray[np.int64]
    params: NDArray[np.float64]
    part: Slice = field(default=Slice(), kw_only=True)

    @property
    def hash(self) -> str:
        """SHA-256 that stands for every byte of the whole dataset, hexadecimal."""
        return str(self.index["sha256"])

    def select(
        self,
        quality: Quality | None = None,
        episodes: int | None = None,
        tasks: Sequence[int] | NDArray[np.int64] | None = None,
    ) -> Dataset:
        """A slice of the dataset: nothing is read or copied, `read` and `blocks` give less.

        A task's returns decide which of its checkpoints have which quality. With R the return of
        the stochastic policy at a checkpoint and (R - random) / (best - random) its share, of n
        checkpoints

        - "mixed" is all;
        - "early" the first n / 3, rounded up;
        - "medium" those with a share from 0.2 to 0.8;
        - "expert" the last n / 3, rounded up, of those with a share of at least 0.9, or all of
          these if they are fewer.

        Args:
            quality: one of `QUALITIES`; as it is if None.
            episodes: the first this many of each checkpoint, so that the slice of fewer is a part
                of the slice of more; as it is if None.
            tasks: some of `tasks`; as they are if None.

        Raises:
            ValueError: no such quality, less than one episode, or no task.
            DatasetError: the dataset does not have one of the tasks. That a task does not have
                what is asked for is found when it is read.
        """
        part = Slice(
            self.part.quality if quality is None else quality,
            self.part.episodes if episodes is None else episodes,
        )
        if tasks is None:
            return replace(self, part=part)
        for task in tasks:
            self.entry(int(task))
        if not len(tasks):
            raise ValueError("select at least one task")
        keep = np.isin(self.tasks, tasks)
        kept = self.tasks[keep]
        return replace(
            self,
            tasks=kept,
            train_tasks=np.intersect1d(self.train_tasks, kept),
            test_tasks=np.intersect1d(self.test_tasks, kept),
            params=self.params[keep],
            part=part,
        )

    def entry(self, task: int) -> dict[str, Any]:
        """The record of a task in `dataset.json`.

        Raises:
            DatasetError: the dataset, or this slice of it, does not have the task.
        """
        for record in self.index["tasks"]:
            if record["task"] == task and task in self.tasks:
                return dict(record)
            if record["task"] == task:
                fault = f"its task {task} is not in this slice, only {self._listed()}"
                raise DatasetError(self.path, fault, "select it too")
        command = collect_command(self.path, self.index, task)
        raise DatasetError(
            self.path,
            f"has no task {task}, only {self._listed()}",
            f"choose one of these or run `{command}`",
        )

    def _listed(self) -> str:
        return ", ".join(map(str, self.tasks))

    def read(self, task: int) -> TaskData:
        """Read a task, or its slice, and verify the whole file, its hash included.

        Returns:
            The rows. Those of a slice have their episodes numbered anew from 0 and say in
            `meta["slice"]` what they are.

        Raises:
            DatasetError: the dataset does not have the task, its file is not as recorded, or
                nothing of it is in the slice.
        """
        record = self.entry(task)
        path = self.path / record["file"]
        remedy = remake(path, self.index)
        if file_size(path, remedy) != record["bytes"]:
            raise self._diagnosis(path, record)
        content = read_bytes(path, remedy)
        if digest(content) != record["sha256"]:
            raise self._diagnosis(path, record)
        data = parse_task(path, content, self.index)
        self._compare(path, record, data.meta, len(data), int(data.episode[-1]) + 1)
        try:
            return take(data, self.part)
        except ValueError as error:
            raise no_slice(path, error) from error

    def blocks(self, task: int, rows: int = BLOCK_ROWS) -> Iterator[TaskData]:
        """Read a task, or its slice, a block at a time: memory for one block is enough.

        The file is compared with its recorded size and hash before the first block, and each
        block is checked like a file that is read. One after the other the blocks are what `read`
        returns.

        Args:
            task: one of `tasks`.
            rows: most rows of a block. Blocks are of whole episodes: one that has more is a block
                of its own.

        Raises:
            ValueError: less than one row.
            DatasetError: as `read`.
        """
        if rows < 1:
            raise ValueError(f"rows must be at least 1, got {rows}")
        return self._blocks(self.entry(task), rows)

    def _blocks(self, record: Mapping[str, Any], rows: int) -> Iterator[TaskData]:
        path = self.path / record["file"]
        with open_file(path, remake(path, self.index)) as handle:
            self._verify(path, handle, record)
            with open_task(path, handle, self.index) as stream:
                lengths = stream.episodes.lengths
                self._compare(path, record, stream.meta, int(lengths.sum()), len(lengths))
                yield from stream.blocks(self.part, rows)

    def episodes(self, task: int) -> Episodes:
        """The episodes of a task, or of its slice, without reading or verifying transitions.

        Raises:
            DatasetError: the dataset does not have the task, its file is damaged, or nothing of
                it is in the slice.
        """
        path = self.path / self.entry(task)["file"]
        with (
            open_file(path, remake(path, self.index)) as handle,
            open_task(path, handle, self.index) as stream,
        ):
            chosen = stream.chosen(self.part)
            return Episodes(stream.episodes.lengths[chosen], stream.episodes.checkpoints[chosen])

    def _compare(
        self, path: Path, record: Mapping[str, Any], meta: Mapping[str, Any], rows: int, count: int
    ) -> None:
        """Raise a DatasetError where a file is another than its record in the index says."""
        found = {
            **{key: meta[key] for key in ("env", "split", "params", "returns")},
            "transitions": rows,
            "episodes": count,
        }
        for key, value in found.items():
            if value != {"env": self.env, **record}[key]:
                fault = f"differs from {INDEX_FILE} in its {key}"
                raise DatasetError(path, fault, remake(path, self.index))

    def verify(self, task: int) -> None:
        """Compare a task's file with its recorded size and hash, without reading its columns.

        Raises:
            DatasetError: the dataset does not have the task, or its file is not as recorded.
        """
        record = self.entry(task)
        path = self.path / record["file"]
        with open_file(path, remake(path, self.index)) as handle:
            self._verify(path, handle, record)

    def _verify(self, path: Path, handle: BufferedReader, record: Mapping[str, Any]) -> None:
        """Compare an open file with its record."""
        try:
            same = handle.seek(0, os.SEEK_END) == record["bytes"]
            handle.seek(0)
            same = same and hashlib.file_digest(handle, "sha256").hexdigest() == record["sha256"]
        except OSError as error:
            raise unreadable(path, error) from error
        if not same:
            raise self._diagnosis(path, record)

    def _diagnosis(self, path: Path, record: Mapping[str, Any]) -> DatasetError:
        """The error for a file that is not the recorded one: what it is instead."""
        remedy = remake(path, self.index)
        size = file_size(path, remedy)
        if size > 2 * record["bytes"] + 2**20:
            fault = f"is a foreign file of {size} bytes, must have {record['bytes']}"
            return DatasetError(path, fault, remedy)
        content = read_bytes(path, remedy)
        own = digest(content)
        for other in self.index["tasks"]:
            if other["sha256"] == own:
                fault = f"is really the file of task {other['task']}, renamed or copied"
                return DatasetError(path, fault, remedy)
        difference = (
            f"{size} bytes with the SHA-256 {own[:12]}..., recorded are {record['bytes']} with "
            f"{record['sha256'][:12]}..."
        )
        try:
            # Under a name that speaks of no task: a valid file of any task is to be recognised.
            meta = parse_task(path.with_name("any.h5"), content, {}).meta
        except DatasetError as error:
            return DatasetError(path, f"{error.fault} ({difference})", remedy)
        fault = f"is a valid file of task {meta['task']} of {meta['env']}, but not the recorded one"
        either = f"if {INDEX_FILE} is what is out of place, replace that, otherwise {remedy}"
        return DatasetError(path, f"{fault} ({difference})", either)


def open_dataset(path: Path | str, verify: bool = True) -> Dataset:
    """Open a dataset.

    Args:
        path: its folder.
        verify: compare the size and the SHA-256 of every file with the index now; otherwise a file
            is compared when it is read.

    Raises:
        DatasetError: no dataset, or one that is incomplete, damaged, of another version of the
            format or of another version of the tasks.
    """
    folder = Path(path)
    index = _read_index(folder)
    records = index["tasks"]
    tasks = np.array([record["task"] for record in records], dtype=np.int64)
    learned = np.array([record["split"] == "train" for record in records], dtype=bool)
    dataset = Dataset(
        path=folder,
        index=index,
        env=index["env"],
        tasks=tasks,
        train_tasks=tasks[learned],
        test_tasks=np.intersect1d(tasks, task_set(index["env"]).test_tasks),
        params=np.array([record["params"] for record in records], dtype=np.float64),
    )
    if verify:
        for task in dataset.tasks.tolist():
            dataset.verify(task)
    return dataset


def _read_index(folder: Path) -> dict[str, Any]:
    path = folder / INDEX_FILE
    collect = f"run `{collect_command(folder, {})}`"
    try:
        kind = stat.S_IFMT(folder.stat().st_mode)
    except (FileNotFoundError, NotADirectoryError):
        other = f"{collect}, or give another folder"
        raise DatasetError(folder, "no dataset is there", other) from None
    except OSError as error:
        raise unreadable(folder, error) from error
    if kind != stat.S_IFDIR:
        raise DatasetError(folder, "is a file, not a dataset's folder", "give the folder")
    content = read_bytes(path, f"{collect} to finish the dataset, or fetch it again")
    index: dict[str, Any] = {}
    try:
        index = parse_canonical(content)
        check_version(index)
        rest = {key: value for key, value in index.items() if key != "sha256"}
        if index.get("sha256") != digest(canonical_json(rest)):
            raise ValueError("does not have the hash it states: it was edited or damaged")
        check_index(index)
    except ValueError as error:
        again = f"`{collect_command(folder, index)}`"
        remedy = f"run {again}, which keeps intact task files, or fetch the dataset again"
        raise DatasetError(path, str(error), remedy) from error
    return index
