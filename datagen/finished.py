"""What a collection finds finished in a dataset's folder, and the index it makes of that."""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from datagen.card import CARD_FILE, card
from datagen.dataset import DatasetError, task_file, task_of, write_index
from datagen.files import digest, machine, read_bytes, unreadable, write_whole
from datagen.job import STATE_FILES
from datagen.task_files import parse_task

_PARTIAL = re.compile(r"\.(.+)\.([^.]*)\.(\d+)\.partial")

_RECORDED = ("task", "split", "params", "returns", "group")
"""Keys of a file's meta that its record in the index repeats, where they are there."""


@dataclass(frozen=True)
class Finished:
    """A whole, verified task file.

    Attributes:
        path: the file.
        meta: what it says of itself.
        record: its record for the index.
    """

    path: Path
    meta: dict[str, Any]
    record: dict[str, Any]


def read_finished(path: Path) -> Finished:
    """Read and verify one task's file.

    Raises:
        DatasetError: it is damaged.
    """
    content = read_bytes(path, "delete it")
    data = parse_task(path, content, {})
    record = {
        **{key: data.meta[key] for key in _RECORDED if key in data.meta},
        "file": path.name,
        "bytes": len(content),
        "sha256": digest(content),
        "transitions": len(data),
        "episodes": int(data.episode[-1]) + 1,
    }
    return Finished(path, data.meta, record)


def task_paths(folder: Path) -> list[Path]:
    """Paths of all task files in a folder, by task; none if there is no folder.

    Raises:
        DatasetError: the folder cannot be read.
    """
    found = ((task_of(path), path) for path in _listed(folder))
    return [path for task, path in sorted((t, p) for t, p in found if t is not None)]


def _listed(folder: Path) -> list[Path]:
    """What is in a folder; nothing if there is no folder."""
    try:
        return list(folder.iterdir()) if folder.is_dir() else []
    except OSError as error:
        raise unreadable(folder, error) from error


def scan(folder: Path, origin: Mapping[str, Any]) -> dict[int, Finished]:
    """Read every task file of a folder, and make sure that it belongs to a dataset.

    Args:
        folder: the dataset's folder, or none yet.
        origin: what the files of the dataset share, as `datagen.job.origin` has it; without
            `versions`, these are compared among the files only.

    Returns:
        The finished tasks in order.

    Raises:
        DatasetError: a file is damaged, or was collected in another way.
    """
    shared = dict(origin)
    found = {}
    for path in task_paths(folder):
        one = read_finished(path)
        check_origin(one, shared)
        shared.setdefault("versions", one.meta["versions"])
        found[int(one.meta["task"])] = one
    return found


def check_origin(one: Finished, origin: Mapping[str, Any]) -> None:
    """Raise a DatasetError that names the first difference of a file from what was asked for."""
    found = difference({key: one.meta.get(key) for key in origin}, origin)
    if found:
        remedy = "give the same options as then, choose another --out, or delete the file"
        raise DatasetError(one.path, f"was collected with {found}", remedy)


def difference(there: Mapping[str, Any], asked: Mapping[str, Any]) -> str:
    """The first difference of an origin from what was asked for, `seed 5, not 6`; "" if none."""
    theirs, ours = dict(_leaves(there)), dict(_leaves(asked))
    for key in sorted({*theirs, *ours}):
        if theirs.get(key) != ours.get(key):
            return f"{key} {_value(theirs, key)}, not {_value(ours, key)}"
    return ""


def _leaves(value: object, name: str = "") -> Iterator[tuple[str, object]]:
    """The values of nested objects by their path, such as `config.sac.gamma`."""
    if not isinstance(value, Mapping):
        yield name, value
        return
    for key, below in value.items():
        yield from _leaves(below, f"{name}.{key}" if name else str(key))


def _value(leaves: Mapping[str, object], key: str) -> str:
    return repr(leaves[key]) if key in leaves else "nothing of that name"


def without_versions(origin: Mapping[str, Any]) -> dict[str, Any]:
    """An origin that files collected with other versions of the packages share."""
    return {key: value for key, value in origin.items() if key != "versions"}


def remove_stale(folder: Path, over: Collection[str] = ()) -> None:
    """Delete files and folders that writers that are no more left half written.

    Whether a writer on another machine lives cannot be told from here, so what it left stays.

    Args:
        folder: what they are in.
        over: names of files that nobody writes any more, on whatever machine.

    Raises:
        DatasetError: the folder cannot be read, or something in it cannot be deleted.
    """
    for path in _listed(folder):
        match = _PARTIAL.fullmatch(path.name)
        if match and (match[1] in over or (match[2] == machine() and not _alive(int(match[3])))):
            _remove(path)


def _remove(path: Path) -> None:
    """Delete a file, a link, or a folder with all that is in it, unless another process does."""
    try:
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink()
    except FileNotFoundError:
        pass
    except OSError as error:
        fault = f"is half written and cannot be deleted ({error.strerror or error})"
        raise DatasetError(path, fault, "delete it") from error


def remove_states(folder: Path) -> None:
    """Delete the files of fleets' trainings whose tasks all have a file by now.

    One with a task that has none stays: another shard trains it, or it was interrupted.
    """
    paths = list(folder.glob(STATE_FILES))
    if not paths:
        return
    # Loads torch.
    from datagen.fleet.state import group_of

    for path in paths:
        group = group_of(path)
        if group and all((folder / task_file(task)).exists() for task in group):
            path.unlink(missing_ok=True)


def _alive(pid: int) -> bool:
    if pid == os.getpid():
        return False
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except OSError:
        pass
    return True


def write_summary(folder: Path, origin: Mapping[str, Any]) -> dict[str, Any]:
    """Write `dataset.json` and the card from the task files that are there.

    Args:
        folder: with at least one task file.
        origin: as for `scan`; the versions are those of the files.

    Returns:
        The index.

    Raises:
        DatasetError: a task file is damaged or was collected in another way.
        OSError: the disk is full.
    """
    asked = without_versions(origin)
    while True:
        found = scan(folder, asked)
        some = next(iter(found.values()))
        index = {
            **asked,
            "versions": some.meta["versions"],
            "tasks": [one.record for one in found.values()],
        }
        write_index(folder, index)
        write_whole(folder / CARD_FILE, card(index).encode())
        # Another shard that finished meanwhile may have written its index before this one.
        if task_paths(folder) == [one.path for one in found.values()]:
            return index
