"""Files that are whole or absent, canonical JSON, and the errors of a dataset's files."""

from __future__ import annotations

import hashlib
import json
import os
import platform
import shlex
import stat
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from datagen.budgets import other_options
from datagen.groups import trained_groups
from meta_envs import resolve

INDEX_FILE = "dataset.json"
"""Name of a dataset's index, beside its task files."""

IMPORTED = "legacy"
"""What the index of an imported dataset has for a budget."""


class DatasetError(ValueError):
    """A dataset's file is missing, damaged or foreign; the message says which, what, and a remedy.

    Attributes:
        path: the file or folder.
        fault: what is wrong with it.
        remedy: what to do about it.
    """

    def __init__(self, path: Path, fault: str, remedy: str) -> None:
        """Join the three parts to one sentence."""
        super().__init__(path, fault, remedy)
        self.path = path
        self.fault = fault
        self.remedy = remedy

    def __str__(self) -> str:
        """`<path>: <fault>; <remedy>`."""
        return f"{self.path}: {self.fault}; {self.remedy}"


def task_file(task: int) -> str:
    """Name of a task's file inside its dataset, such as `task_003.h5`."""
    return f"task_{task:03d}.h5"


def task_of(path: Path) -> int | None:
    """The task a file's name speaks of, None if it is not the name of a task file."""
    digits = path.name.removeprefix("task_").removesuffix(".h5")
    if digits.isascii() and digits.isdigit() and path.name == task_file(int(digits)):
        return int(digits)
    return None


def collect_command(folder: Path, source: Mapping[str, Any], task: int | None = None) -> str:
    """The command that collects a dataset, or one task of it, in place.

    Args:
        folder: the dataset's folder.
        source: an index or a task's `meta`, as far as known; its `env`, `budget` and `seed` are
            used, and its episodes where they are not the budget's own. Without a known `env` the
            folder's name is.
        task: the one task to collect; all by default. A fleet's is collected with the group it was
            trained in, where that is known, since only that gives the same bytes again.
    """
    env = _short_name(source.get("env")) or _short_name(folder.absolute().name) or "ENVIRONMENT"
    if source.get("budget") == IMPORTED:
        words = ["python", "-m", "datagen.exchange", "from-legacy", "FOLDER", "--env", env]
        return shlex.join([*words, "--out", str(folder)])
    words = ["python", "-m", "datagen.collect", "--env", env]
    if task is not None:
        words += ["--tasks", _trained_with(task, source)]
    for key in ("budget", "seed"):
        if isinstance(source.get(key), str | int):
            words += [f"--{key}", str(source[key])]
    words += _other_options(env, source)
    return shlex.join([*words, "--out", str(folder)])


def _trained_with(task: int, source: Mapping[str, Any]) -> str:
    """The group of a fleet's task, where an index or its own meta says it, or the task alone."""
    try:
        return str(source["group"]) if "group" in source else trained_groups(source)[task]
    except (KeyError, TypeError, ValueError):
        return str(task)


def _other_options(env: str, source: Mapping[str, Any]) -> list[str]:
    """The options that repeat what is not the budget's own, where both are known."""
    try:
        return other_options(env, source["budget"], source["config"])
    except (AttributeError, KeyError, TypeError, ValueError):
        return []


def _short_name(name: object) -> str | None:
    """Short name of the environment something is called after, None if there is none."""
    try:
        return resolve(str(name)).name
    except ValueError:
        return None


def _plain(value: object) -> object:
    """NumPy's scalars and arrays as Python's, for the JSON encoder."""
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} has no place in JSON")


def canonical_json(value: object) -> str:
    """The one JSON text of a value: sorted keys, indented by one, ASCII, a newline at the end.

    Raises:
        ValueError: NaN or an infinity.
        TypeError: something JSON does not know; NumPy's scalars and arrays are allowed.
    """
    # The round trip turns every key into a string before they are sorted: 100 before 20, as when
    # the text is read again.
    plain = json.loads(json.dumps(value, default=_plain, allow_nan=False))
    return json.dumps(plain, sort_keys=True, indent=1, allow_nan=False) + "\n"


def parse_canonical(content: bytes) -> dict[str, Any]:
    """Parse a JSON object that must be in its canonical form, byte for byte.

    Raises:
        ValueError: it is not, and why.
    """
    try:
        value = json.loads(content.decode("ascii"))
        canonical = isinstance(value, dict) and canonical_json(value).encode() == content
    except UnicodeDecodeError as error:
        raise ValueError("holds bytes that are not text") from error
    except json.JSONDecodeError as error:
        raise ValueError(f"is not JSON ({error})") from error
    except (ValueError, RecursionError) as error:
        raise ValueError(f"holds a value JSON should not have ({error})") from error
    if not canonical:
        raise ValueError("is not as it was written: it was edited or damaged")
    return dict(value)


def digest(content: bytes | str) -> str:
    """SHA-256 of bytes or of a text in UTF-8, hexadecimal."""
    return hashlib.sha256(content.encode() if isinstance(content, str) else content).hexdigest()


def file_digest(path: Path) -> str:
    """SHA-256 of a file, read in pieces, hexadecimal.

    Raises:
        OSError: it cannot be read.
    """
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def file_size(path: Path, remedy: str) -> int:
    """Size of a regular file in bytes.

    Raises:
        DatasetError: it is missing, something else than a file, or out of reach.
    """
    try:
        status = path.stat()
    except FileNotFoundError:
        raise DatasetError(path, "is missing", remedy) from None
    except OSError as error:
        raise unreadable(path, error) from error
    if not stat.S_ISREG(status.st_mode):
        kind = "a folder" if stat.S_ISDIR(status.st_mode) else "a device, a pipe or a socket"
        raise DatasetError(path, f"is {kind}, not a file", f"move it away and {remedy}")
    return status.st_size


def read_bytes(path: Path, remedy: str) -> bytes:
    """A whole regular file.

    Raises:
        DatasetError: it is missing, something else than a file, or out of reach.
    """
    file_size(path, remedy)
    try:
        return path.read_bytes()
    except OSError as error:
        raise unreadable(path, error) from error


def unreadable(path: Path, error: OSError) -> DatasetError:
    """The DatasetError for a file the system refuses to read."""
    reason = error.strerror or str(error)
    return DatasetError(path, f"cannot be read ({reason})", "check its permissions and the disk")


def machine() -> str:
    """This machine's name, without dots."""
    return platform.node().replace(".", "-")


def partial_of(path: Path) -> Path:
    """Where this process writes a file, or a folder, until it is whole."""
    return path.with_name(f".{path.name}.{machine()}.{os.getpid()}.partial")


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Let an OSError name the file: one of a handle, such as a full disk's, does not.

    Raises:
        OSError: what it was.
    """
    try:
        yield
    except OSError as error:
        if error.filename is None:
            error.filename = str(path)
        raise


def write_whole(path: Path, content: bytes) -> None:
    """Write a file so that it is whole or absent, whatever happens in between.

    Raises:
        OSError: the disk is full or the folder is not there; a file that was there stays.
    """
    partial = partial_of(path)
    try:
        with naming(path), partial.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        partial.replace(path)
    except BaseException:
        partial.unlink(missing_ok=True)
        raise
    sync_folder(path.parent)


def sync_folder(folder: Path) -> None:
    """Make a rename in the folder last through a power cut, where the system has a way to."""
    if os.name != "posix":
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
