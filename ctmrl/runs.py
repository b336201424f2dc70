"""A run's folder: what it holds, and how a run that was interrupted goes on in it."""

from __future__ import annotations

import csv
import fcntl
import io
import json
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ctmrl.errors import UsageError
from ctmrl.settings import LATER_SETTINGS, with_later_settings
from datagen.dataset import naming, write_whole

CONFIG, METRICS, CHECKPOINT, EVALUATION, LOGGERS = (
    "config.json",
    "metrics.csv",
    "checkpoint.pt",
    "evaluation.json",
    "loggers.json",
)

RUN_FILES = (
    EVALUATION,
    CHECKPOINT,
    METRICS,
    "tensorboard",
    "wandb",
    LOGGERS,
    "adaptation.png",
    "contexts.png",
    CONFIG,
)
"""All that a run's folder holds, in an order in which any beginning may be missing."""


class RunError(UsageError):
    """A run folder that cannot be used: which, why, and what to do."""


def to_json(content: object) -> bytes:
    """Readable JSON with a fixed order of keys; NaN is refused."""
    return (json.dumps(content, indent=1, sort_keys=True, allow_nan=False) + "\n").encode()


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON file of a run.

    Raises:
        RunError: it is missing or not JSON.
    """
    try:
        content = json.loads(path.read_bytes())
    except (FileNotFoundError, NotADirectoryError):
        raise RunError(
            f"{path.parent} is not a run's folder: it has no {path.name}; "
            "python -m ctmrl.train makes one"
        ) from None
    except (OSError, ValueError) as error:
        raise RunError(f"{path} cannot be read ({error}): {_instead_of(path)}") from None
    if not isinstance(content, dict):
        raise RunError(f"{path} is not of a run: {_instead_of(path)}")
    return content


def _instead_of(path: Path) -> str:
    """What to do where a file of a run is of no use."""
    if path.name == EVALUATION:
        return "delete it and give the same command again"
    return "train again with --restart"


def load_checkpoint(path: Path) -> dict[str, Tensor]:
    """Read a checkpoint: tensors by name, nothing else.

    Raises:
        RunError: it is missing or damaged.
    """
    try:
        state = torch.load(path, weights_only=True)
    except FileNotFoundError:
        raise RunError(f"{path.parent} has no {path.name} yet: train it first") from None
    except Exception as error:  # torch raises many kinds for damaged files
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise RunError(f"{path} is damaged ({reason}): train again with --restart") from None
    if not isinstance(state, dict) or not all(isinstance(v, Tensor) for v in state.values()):
        raise RunError(f"{path} is not a checkpoint of a run: train again with --restart")
    return state


@contextmanager
def fitting(path: Path) -> Iterator[None]:
    """Turn what goes wrong while a stored file is put to use into a RunError.

    Raises:
        RunError: it is sound, but not of this run or not of this version of the package.
    """
    try:
        yield
    except UsageError:
        raise
    except (KeyError, TypeError, AttributeError, ValueError, RuntimeError) as error:
        reason = " ".join(str(error).split()[:24]) or type(error).__name__
        raise RunError(f"{path} does not fit its run ({reason}): {_instead_of(path)}") from None


def begun_with(path: Path, name: str) -> Any:
    """A setting of the run that a folder holds; None where it holds none.

    Raises:
        RunError: what it holds cannot be read.
    """
    config = path / CONFIG
    settings = read_json(config).get("settings") if config.exists() else None
    with fitting(config):
        found = with_later_settings(settings).get(name) if isinstance(settings, dict) else None
    return found


def check_folder(path: Path, known: dict[str, Any], restart: bool) -> bool:
    """Refuse a folder that `RunFolder` would, before the data are read for it; changes nothing.

    Args:
        path: the folder, if it is there.
        known: the settings, but for top-level entries that are not known yet.
        restart: throw away the run that is there.

    Returns:
        Whether it holds the run, finished.

    Raises:
        RunError: the folder holds a run with other settings, something that is not a run, or a run
            at work; or it cannot be written to or made.
    """
    try:
        check_writable(next(there for there in (path, *path.parents) if there.exists()))
    except OSError as error:
        raise _unwritable(path, error) from None
    if not path.exists():
        return False
    lock = _locked(path)
    try:
        if not (path / CONFIG).exists():
            _refuse_others_files(path)
            return False
        if restart:
            _refuse_to_throw_away(path)
            return False
        there = read_json(path / CONFIG)
        _compare(path, {key: there[key] for key in known.keys() & there.keys()}, known)
        return (path / EVALUATION).exists()
    finally:
        os.close(lock)


def _unwritable(path: Path, error: OSError) -> RunError:
    return RunError(f"{path} cannot be written to ({error.strerror}): choose another --out")


def check_writable(folder: Path) -> None:
    """Raise an OSError unless files can be written in a folder; leaves none there."""
    tempfile.TemporaryFile(dir=folder).close()


def _locked(path: Path) -> int:
    """A handle of a folder, which is locked until it is closed."""
    try:
        handle = os.open(path, os.O_RDONLY | os.O_DIRECTORY)
    except OSError as error:
        raise _unwritable(path, error) from None
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(handle)
        raise RunError(f"another process is at work in {path}: wait for it") from None
    return handle


def _entries(path: Path) -> set[str]:
    """Names of all that is in a folder, but for what a process is writing."""
    names = (entry.name for entry in path.iterdir())
    return {name for name in names if not name.endswith(".partial")}


def _refuse_others_files(path: Path) -> None:
    if _entries(path):
        raise RunError(f"{path} holds files that are not of a run: choose another --out")


def _refuse_to_throw_away(path: Path) -> None:
    foreign = sorted(_entries(path) - set(RUN_FILES))
    if foreign:
        raise RunError(
            f"{path} also holds {foreign[0]}, which is not of a run: "
            "choose another --out, or move it away"
        )


def _compare(path: Path, there: dict[str, Any], asked: dict[str, Any]) -> None:
    # Through JSON, because a tuple comes back as a list.
    unsaid = flatten({"settings": LATER_SETTINGS})
    flat, wanted = (unsaid | flatten(one) for one in (there, json.loads(to_json(asked))))
    # Runs did not name it before; what they do not name is no difference.
    flat.setdefault("versions.mujoco", wanted.get("versions.mujoco"))
    # Settings first: the lists of tasks follow from them.
    for key in sorted(flat.keys() | wanted.keys(), key=lambda k: (not k.startswith("settings"), k)):
        if flat.get(key) != wanted.get(key):
            raise RunError(
                f"{path} holds a run with {key} = {flat.get(key)}, this one has "
                f"{wanted.get(key)}: choose another --out, or --restart to throw it away"
            )


class RunFolder:
    """The folder of one run, locked for as long as this object lives.

    Attributes:
        path: the folder.
    """

    def __init__(self, path: Path, settings: dict[str, Any], restart: bool) -> None:
        """Make the folder, or find it as an earlier process left it.

        Args:
            path: the folder.
            settings: all that decides the run's results; goes into config.json.
            restart: throw away the run that is there.

        Raises:
            RunError: the folder holds a run with other settings, something that is not a run, or
                a run at work.
        """
        self.path = path
        try:
            path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise _unwritable(path, error) from None
        self._lock = _locked(path)
        try:
            self._begin(settings, restart)
        except BaseException:
            self.close()
            raise

    def _begin(self, settings: dict[str, Any], restart: bool) -> None:
        # The lock is ours, so whatever others were writing here will never be finished.
        for left in (one for name in RUN_FILES for one in self.path.glob(f".{name}.*.partial")):
            if f".{os.getpid()}." not in left.name:
                left.unlink()
        config = self.path / CONFIG
        if restart and config.exists():
            self._throw_away()
        if config.exists():
            _compare(self.path, read_json(config), settings)
        else:
            _refuse_others_files(self.path)
            write_whole(config, to_json(settings))

    def close(self) -> None:
        """Let others use the folder."""
        os.close(self._lock)

    def abandon(self) -> None:
        """Leave nothing of a run that has no checkpoint yet, so that other settings may have it."""
        if not (self.path / CHECKPOINT).exists():
            self._throw_away()

    def _throw_away(self) -> None:
        _refuse_to_throw_away(self.path)
        for entry in (self.path / name for name in RUN_FILES):
            if entry.is_dir() and not entry.is_symlink():
                shutil.rmtree(entry)
            else:
                entry.unlink(missing_ok=True)

    @property
    def finished(self) -> bool:
        """Whether the run has been evaluated."""
        return (self.path / EVALUATION).exists()

    def checkpoint(self) -> dict[str, Tensor] | None:
        """The last checkpoint, None before the first."""
        path = self.path / CHECKPOINT
        return load_checkpoint(path) if path.exists() else None

    def save_checkpoint(self, state: dict[str, Tensor]) -> None:
        """Replace the checkpoint."""
        # Fresh strings and storages: a pickle's bytes depend on which objects are the same.
        fresh = {f"{key}": value.detach().cpu().clone() for key, value in sorted(state.items())}
        buffer = io.BytesIO()
        torch.save(fresh, buffer)
        write_whole(self.path / CHECKPOINT, buffer.getvalue())

    def rewind_metrics(self, step: int) -> None:
        """Forget the metrics of steps after `step`, which will be taken again.

        Raises:
            RunError: the file is damaged, or lacks the row of that step.
        """
        path = self.path / METRICS
        try:
            lines = path.read_text().split("\n")[:-1] if path.exists() else []
            steps = [int(line.partition(",")[0]) for line in lines[1:]]
        except ValueError as error:
            raise RunError(f"{path} is damaged ({error}): train again with --restart") from None
        kept = [line for line, of in zip(lines[1:], steps, strict=True) if of <= step]
        if step and step not in steps:
            raise RunError(
                f"{path} has no row of step {step}, which {CHECKPOINT} is of: "
                "put it back, or train again with --restart"
            )
        if path.exists():
            write_whole(path, "".join(f"{line}\n" for line in [*lines[:1], *kept]).encode())

    def append_metrics(self, row: dict[str, float | None]) -> None:
        """Add a row; the first one's keys are the columns, also for a later version's rows."""
        path = self.path / METRICS
        with naming(path), path.open("a+", newline="") as file:
            file.seek(0)
            columns = next(csv.reader(file), None)
            writer = csv.DictWriter(
                file, columns or list(row), extrasaction="ignore", lineterminator="\n"
            )
            if columns is None:
                writer.writeheader()
            writer.writerow(row)
            file.flush()
            os.fsync(file.fileno())

    def write_json(self, name: str, content: object) -> None:
        """Write a JSON file of the run."""
        write_whole(self.path / name, to_json(content))


def flatten(nested: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested dictionaries as one, with dotted keys."""
    flat: dict[str, Any] = {}
    for key, value in nested.items():
        if isinstance(value, dict):
            flat |= flatten(value, f"{prefix}{key}.")
        else:
            flat[prefix + key] = value
    return flat
