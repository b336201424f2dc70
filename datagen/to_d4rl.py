"""A dataset as one HDF5 file in D4RL's style, for code that takes a single file.

All tasks are in the one file, with a column `task`: a dataset's own files are already files of
D4RL's layout with a task each, so only the single file is something one cannot have without an
export. `episode` is numbered through the file. Everything else is an attribute, because D4RL's
loader takes every HDF5 dataset it finds for a column.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import h5py
import numpy as np

from datagen.columns import COLUMNS, SPARSE_COLUMN
from datagen.dataset import Dataset, DatasetError
from datagen.files import canonical_json, partial_of, sync_folder
from meta_envs.registry import definition

_EXTRA = {"task": np.dtype("<i4")}


def d4rl_file(dataset: Dataset) -> str:
    """Name of the file a dataset is exported to, such as `point_robot_wind.hdf5`."""
    return f"{dataset.env}.hdf5"


def to_d4rl(
    dataset: Dataset, tasks: Sequence[int], folder: Path, done: Callable[[int], None]
) -> Path:
    """Write tasks of a dataset to one file, whole or not at all; one task is in memory at a time.

    Args:
        dataset: an opened dataset.
        tasks: those to export, in the order of the file.
        folder: where the file goes; it is made if it is not there.
        done: told each task that is written.

    Returns:
        The file.

    Raises:
        DatasetError: a task's file is damaged, or the export is there already.
        OSError: the disk is full or `folder` has no place.
    """
    path = folder / d4rl_file(dataset)
    if os.path.lexists(path):
        raise DatasetError(path, "is there already", "delete it or choose another --out")
    records = [dataset.entry(task) for task in tasks]
    folder.mkdir(parents=True, exist_ok=True)
    partial = partial_of(path)
    try:
        _reserve(partial, sum(record["bytes"] for record in records) + 2**20)
        offsets = _lay_out(partial, dataset, records)
        with partial.open("rb+") as file:
            _write_columns(file, offsets, dataset, tasks, done)
            file.flush()
            os.fsync(file.fileno())
        partial.replace(path)
        sync_folder(folder)
    finally:
        partial.unlink(missing_ok=True)
    return path


def _reserve(path: Path, size: int) -> None:
    """Raise an OSError unless a file of this size can be made.

    The HDF5 library crashes where it cannot write or close a file. So it writes only the first few
    kilobytes, where there is room for them, and the columns are written without it.
    """
    if shutil.disk_usage(path.parent).free < size:
        raise OSError(f"{path.parent}: {size / 1e6:.0f} MB are needed and not free, make room")
    with path.open("wb") as file:
        file.truncate(size)


def _lay_out(path: Path, dataset: Dataset, records: Sequence[dict[str, Any]]) -> dict[str, int]:
    """Make the file with its attributes and with columns that are yet to be filled.

    Returns:
        Where in the file each column starts, in bytes.
    """
    env = definition(dataset.env)
    obs_shape, act_shape = env.observation_space.shape, env.action_space.shape
    shapes = {"observations": obs_shape, "next_observations": obs_shape, "actions": act_shape}
    rows = sum(record["transitions"] for record in records)
    settings = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    settings.set_alloc_time(h5py.h5d.ALLOC_TIME_EARLY)
    settings.set_fill_time(h5py.h5d.FILL_TIME_NEVER)
    settings.set_obj_track_times(False)
    offsets = {}
    with h5py.File(path, "w", libver=("v108", "v108")) as file:
        _describe(file, dataset, records)
        for name, dtype in {**COLUMNS, **_EXTRA}.items():
            if env.sparse or name != SPARSE_COLUMN:
                kind = h5py.h5t.py_create(dtype, logical=True)
                space = h5py.h5s.create_simple((rows, *shapes.get(name, ())))
                column = h5py.h5d.create(file.id, name.encode(), kind, space, settings)
                offsets[name] = int(column.get_offset())
    return offsets


def _describe(file: h5py.File, dataset: Dataset, records: Sequence[dict[str, Any]]) -> None:
    """The attributes: where the rows come from, and arrays with an element a task."""
    index = dataset.index
    for name in ("env", "env_id", "budget", "seed", "task_hash"):
        file.attrs[name] = index[name]
    file.attrs["dataset_sha256"] = dataset.hash
    file.attrs["config"] = canonical_json(index["config"])
    file.attrs["versions"] = canonical_json(index["versions"])
    texts = h5py.string_dtype()
    file.attrs.create("param_names", index["param_names"], dtype=texts)
    file.attrs.create("task_splits", [record["split"] for record in records], dtype=texts)
    file.attrs["tasks"] = np.array([record["task"] for record in records], dtype=np.int32)
    file.attrs["task_params"] = np.array([record["params"] for record in records])
    for name, key in (("ref_min_scores", "random"), ("ref_max_scores", "expert")):
        file.attrs[name] = np.array([record["returns"][key] for record in records], np.float64)


def _write_columns(
    file: BinaryIO,
    offsets: Mapping[str, int],
    dataset: Dataset,
    tasks: Sequence[int],
    done: Callable[[int], None],
) -> None:
    """Fill the columns task by task."""
    ends, episodes = dict(offsets), 0
    for task in tasks:
        data = dataset.read(task)
        columns = {
            **data.columns,
            "episode": data.episode + np.int32(episodes),
            "task": np.full(len(data), task, _EXTRA["task"]),
        }
        for name, column in columns.items():
            file.seek(ends[name])
            ends[name] += file.write(np.ascontiguousarray(column).data)
        episodes += int(data.episode[-1]) + 1
        done(task)
