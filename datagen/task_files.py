"""One task's file, written and read with everything the format promises checked."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from datagen.columns import TaskData, check_columns, content_digest
from datagen.files import (
    DatasetError,
    canonical_json,
    collect_command,
    digest,
    parse_canonical,
    read_bytes,
    task_file,
    task_of,
    write_whole,
)
from datagen.hdf5 import decode, encode
from datagen.records import FORMAT_VERSION, check_meta, check_version
from meta_envs.registry import definition

NOT_WRITTEN = "nothing was written, correct what was to be written"
"""What a DatasetError says about data that break a promise before they are on the disk."""


def write_task(path: Path, data: TaskData) -> None:
    """Write a task's file whole or not at all; the same data give the same bytes.

    Args:
        path: the file, named by `task_file(data.task)`, in a folder that is there.
        data: checked like a file that is read. `format_version` and `content_sha256` are set in
            the `meta` that is written, whatever they are in `data.meta`.

    Raises:
        DatasetError: the data break a promise of the format; nothing was written.
        OSError: the disk is full or the folder is missing; a file that was there stays.
    """
    try:
        meta = parse_canonical(canonical_json(data.meta).encode())
        meta["format_version"] = FORMAT_VERSION
        check_task_data(TaskData(data.task, data.columns, meta))
        if path.name != task_file(data.task):
            raise ValueError(f"must be called {task_file(data.task)}")
    except (ValueError, TypeError) as error:
        raise DatasetError(path, str(error), NOT_WRITTEN) from error
    meta["content_sha256"] = content_digest(data.columns, meta)
    write_whole(path, encode(data.columns, meta))


def read_task(path: Path, sha256: str | None = None) -> TaskData:
    """Read and verify one task's file.

    Args:
        path: the file, in a dataset or alone.
        sha256: of the whole file, if it is known.

    Raises:
        DatasetError: the file is not exactly what `write_task` writes.
    """
    path = Path(path)
    content = read_bytes(path, f"run {_quoted(path, {})} to make it")
    if sha256 is not None and digest(content) != sha256:
        fault = f"has the SHA-256 {digest(content)[:12]}..., must have {sha256[:12]}..."
        raise DatasetError(path, fault, remake(path, {}))
    return parse_task(path, content, {})


def parse_task(path: Path, content: bytes, source: Mapping[str, Any]) -> TaskData:
    """The verified data of a file's bytes; `source` is the index, if there is one."""
    known = dict(source)
    try:
        columns, meta = decode(content)
        known = {**meta, **source}
        check_version(meta)
        if meta.get("content_sha256") != content_digest(columns, meta):
            raise ValueError("its values are not those it was written with: it is damaged")
        data = TaskData(meta.get("task", -1), columns, meta)
        check_task_data(data)
    except ValueError as error:
        raise DatasetError(path, str(error), remake(path, known)) from error
    if task_of(path) not in (None, data.task):
        fault = f"is really the file of task {data.task}, renamed"
        raise DatasetError(path, fault, remake(path, known))
    return data


def check_task_data(data: TaskData) -> None:
    """Raise a ValueError unless meta and columns keep every promise of the format."""
    tasks = check_meta(data.meta)
    if data.task != data.meta["task"]:
        raise ValueError(f"is of task {data.task}, but its meta of task {data.meta['task']}")
    env = definition(tasks.env)
    obs_dim, act_dim = env.observation_space.shape[0], env.action_space.shape[0]
    check_columns(data.columns, obs_dim, act_dim, env.sparse)


def _quoted(path: Path, source: Mapping[str, Any]) -> str:
    return f"`{collect_command(path.parent, source, task_of(path))}`"


def remake(path: Path, source: Mapping[str, Any]) -> str:
    """What to do about a bad file of a dataset."""
    return f"delete it and run {_quoted(path, source)}, or fetch it again"
