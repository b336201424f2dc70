"""The field's legacy folders: `goal_idx3/trj_evalsample0_step4800.npy`, one file an episode.

Each file is an array of objects with a row a step: observation, action, reward, next observation,
and perhaps more, which is not read. Pickles are interpreted, never run.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datagen.files import DatasetError, read_bytes, unreadable
from datagen.pickled_arrays import PickledArray, read_pickled_array

_TASK = re.compile(r"goal_idx(\d{1,6})")
_STOCHASTIC = re.compile(r"trj_[a-z]*sample(\d{1,9})_step(\d{1,9})\.npy")
_DETERMINISTIC = re.compile(r"trj_eval(\d{1,9})_step(\d{1,9})\.npy")
_MAGIC = b"\x93NUMPY"
_FIELDS = ("observation", "action", "reward", "next observation")
_REMEDY = "move the file away or fetch the folder again"
_MOST_HEADER = 10_000
_MOST_CHECKPOINT = 2**31 - 1


@dataclass(frozen=True)
class LegacyFile:
    """One episode's file.

    Attributes:
        path: the file.
        checkpoint: training steps of the policy that acted, from the file's name.
        number: of the episode among those of the checkpoint, from the file's name.
    """

    path: Path
    checkpoint: int
    number: int


@dataclass(frozen=True)
class LegacyTask:
    """The files of one task, each group by checkpoint and number.

    Attributes:
        task: the number in the folder's name.
        stochastic: episodes of the policy as it acts, `trj_evalsample*`.
        deterministic: episodes of its mean action, `trj_eval*`; often there are none.
    """

    task: int
    stochastic: tuple[LegacyFile, ...]
    deterministic: tuple[LegacyFile, ...]


@dataclass(frozen=True, eq=False)
class Episode:
    """One episode of T steps, float64.

    Attributes:
        observations: [T, W], W as in the file.
        actions: [T, A].
        rewards: [T].
        next_observations: [T, W].
    """

    observations: NDArray[np.float64]
    actions: NDArray[np.float64]
    rewards: NDArray[np.float64]
    next_observations: NDArray[np.float64]

    def __len__(self) -> int:
        """Number of steps, T."""
        return len(self.rewards)


def list_legacy(folder: Path) -> list[LegacyTask]:
    """The tasks of a legacy folder and their files, sorted.

    Raises:
        DatasetError: there is none, or a task has no stochastic episodes.
    """
    try:
        names = sorted(path for path in folder.iterdir() if path.is_dir())
        found = [
            LegacyTask(int(match[1]), _files(path, _STOCHASTIC), _files(path, _DETERMINISTIC))
            for path in names
            if (match := _TASK.fullmatch(path.name))
        ]
    except OSError as error:
        raise unreadable(folder, error) from error
    if not found:
        raise DatasetError(folder, "has no folder goal_idx0, goal_idx1, ...", "give another folder")
    found.sort(key=lambda one: one.task)
    for one, following in zip(found, [*found[1:], None], strict=True):
        if following and one.task == following.task:
            raise DatasetError(folder, f"has task {one.task} twice", "remove one of the folders")
        if not one.stochastic:
            place = folder / f"goal_idx{one.task}"
            raise DatasetError(place, "has no file trj_evalsample*_step*.npy", "remove the folder")
    return found


def _files(folder: Path, pattern: re.Pattern[str]) -> tuple[LegacyFile, ...]:
    matches = ((pattern.fullmatch(path.name), path) for path in sorted(folder.iterdir()))
    found = [LegacyFile(path, int(match[2]), int(match[1])) for match, path in matches if match]
    for one in found:
        if one.checkpoint > _MOST_CHECKPOINT:
            raise DatasetError(one.path, "is named after too late a step", "rename it")
    return tuple(sorted(found, key=lambda one: (one.checkpoint, one.number)))


def read_episode(path: Path) -> Episode:
    """Read one episode's file, without running its pickle.

    Raises:
        DatasetError: it is missing, damaged, malicious or no episode; the message says what.
    """
    content = read_bytes(path, _REMEDY)
    try:
        shape, start = _header(content)
        array = read_pickled_array(content[start:])
        if array.shape != shape:
            raise ValueError(f"its header says {list(shape)}, its pickle {list(array.shape)}")
        return _episode(array)
    except ValueError as error:
        raise DatasetError(path, str(error), _REMEDY) from error


def _header(content: bytes) -> tuple[tuple[int, ...], int]:
    """Shape of a stored array of objects, and where its pickle starts."""
    if not content.startswith(_MAGIC) or len(content) < 12:
        raise ValueError("is not a file of NumPy's (.npy)")
    size = 2 if content[6] == 1 else 4
    start = 8 + size
    length = int.from_bytes(content[8:start], "little")
    if content[6] not in (1, 2, 3) or length > _MOST_HEADER or start + length > len(content):
        raise ValueError("has a damaged header")
    text = content[start : start + length].decode("latin1").strip()
    try:
        header = ast.literal_eval(text)
    except (ValueError, SyntaxError, MemoryError, RecursionError) as error:
        raise ValueError("has a damaged header") from error
    if type(header) is not dict or header.keys() != {"descr", "fortran_order", "shape"}:
        raise ValueError("has a header that is not NumPy's")
    if header["descr"] not in ("|O", "O"):
        raise ValueError("holds no objects, as an episode's file does")
    shape = header["shape"]
    if type(shape) is not tuple or not all(type(one) is int for one in shape):
        raise ValueError("has a header without a shape")
    return shape, start + length


def _episode(array: PickledArray) -> Episode:
    """The steps of an array [T, 4] or wider."""
    if len(array.shape) != 2 or array.shape[0] < 1 or array.shape[1] < len(_FIELDS):
        raise ValueError(f"has the shape {list(array.shape)}, not a row a step with 4 values")
    if not array.is_object:
        raise ValueError("holds no objects, as an episode's file does")
    width = array.shape[1]
    fields = [_field(name, array.objects[column::width]) for column, name in enumerate(_FIELDS)]
    observations, actions, rewards, next_observations = fields
    if rewards.shape[1] != 1:
        raise ValueError(f"has rewards of {rewards.shape[1]} numbers")
    if observations.shape != next_observations.shape:
        raise ValueError("has observations and next observations of different sizes")
    return Episode(observations, actions, rewards[:, 0], next_observations)


def _field(name: str, cells: Sequence[Any]) -> NDArray[np.float64]:
    """One value of every step, [T, width]."""
    rows = [_numbers(cell) for cell in cells]
    width = -1 if rows[0] is None else len(rows[0])
    for step, row in enumerate(rows):
        if row is None:
            raise ValueError(f"has no numbers as the {name} of step {step}")
        if len(row) != width:
            raise ValueError(f"has {len(row)} numbers as the {name} of step {step}, {width} before")
    found = np.array(rows, dtype=np.float64)
    wrong = np.flatnonzero(~np.isfinite(found).all(axis=1))
    if len(wrong):
        raise ValueError(f"has a NaN or an infinity in the {name} of step {wrong[0]}")
    return found


def _numbers(cell: object) -> NDArray[np.float64] | None:
    """The numbers of one cell of the array, at least one, in a row; None if it has none."""
    if isinstance(cell, PickledArray):
        # Of more than one axis of length above 1, the order of the numbers would be a guess.
        long_axes = sum(size > 1 for size in cell.shape)
        if cell.numbers is None or not len(cell.numbers) or long_axes > 1:
            return None
        return cell.numbers.astype(np.float64)
    if isinstance(cell, float) or (isinstance(cell, int) and abs(cell) < 1e300):
        return np.array([cell], dtype=np.float64)
    return None
