"""The dataset format: write it, read it, verify it. Imports neither torch nor Stable-Baselines3.

A dataset is a folder with one HDF5 file a task (`task_003.h5`) and an index, `dataset.json`.
docs/dataset_format.md describes both for those who write their own loader.
"""

from __future__ import annotations

import stat
from collections.abc import Mapping
from dataclasses import dataclass
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
    file_digest,
    file_size,
    parse_canonical,
    read_bytes,
    task_file,
    task_of,
    unreadable,
    write_whole,
)
from datagen.records import FORMAT_VERSION, check_index, check_version
from datagen.task_files import NOT_WRITTEN, parse_task, read_task, remake, write_task

__all__ = [
    "COLUMNS",
    "FORMAT_VERSION",
    "INDEX_FILE",
    "Dataset",
    "DatasetError",
    "TaskData",
    "collect_command",
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
    """An opened dataset; made by `open_dataset`.

    Attributes:
        path: its folder.
        index: content of `dataset.json`.
        env: short name of the environment.
        tasks: the tasks it has, sorted rows of the environment's task set, int64 [n].
        train_tasks: those of them that are for meta-training, sorted, int64.
        test_tasks: the others, for meta-testing, sorted, int64.
        params: parameters of `tasks`, float64 [n, P].
    """

    path: Path
    index: dict[str, Any]
    env: str
    tasks: NDArray[np.int64]
    train_tasks: NDArray[np.int64]
    test_tasks: NDArray[np.int64]
    params: NDArray[np.float64]

    @property
    def hash(self) -> str:
        """SHA-256 that stands for every byte of the dataset, hexadecimal."""
        return str(self.index["sha256"])

    def entry(self, task: int) -> dict[str, Any]:
        """The record of a task in `dataset.json`.

        Raises:
            DatasetError: the dataset does not have the task.
        """
        for record in self.index["tasks"]:
            if record["task"] == task:
                return dict(record)
        command = collect_command(self.path, self.index, task)
        raise DatasetError(
            self.path,
            f"has no task {task}, only {', '.join(map(str, self.tasks))}",
            f"choose one of these or run `{command}`",
        )

    def read(self, task: int) -> TaskData:
        """Read a task and verify it, its hash included.

        Raises:
            DatasetError: the dataset does not have the task, or its file is not as recorded.
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
        found = {
            **{key: data.meta[key] for key in ("env", "split", "params", "returns")},
            "transitions": len(data),
            "episodes": int(data.episode[-1]) + 1,
        }
        for key, value in found.items():
            if value != {"env": self.env, **record}[key]:
                raise DatasetError(path, f"differs from {INDEX_FILE} in its {key}", remedy)
        return data

    def verify(self, task: int) -> None:
        """Compare a task's file with its recorded size and hash, without reading its columns.

        Raises:
            DatasetError: the dataset does not have the task, or its file is not as recorded.
        """
        record = self.entry(task)
        path = self.path / record["file"]
        same = file_size(path, remake(path, self.index)) == record["bytes"]
        try:
            same = same and file_digest(path) == record["sha256"]
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
    train, test = (
        np.array([r["task"] for r in index["tasks"] if r["split"] == split], dtype=np.int64)
        for split in ("train", "test")
    )
    dataset = Dataset(
        path=folder,
        index=index,
        env=index["env"],
        tasks=np.union1d(train, test),
        train_tasks=train,
        test_tasks=test,
        params=np.array([record["params"] for record in index["tasks"]], dtype=np.float64),
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
