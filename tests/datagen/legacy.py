"""Legacy folders made of known data, for the tests of what reads them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datagen.dataset import TaskData

Rewards = Callable[[TaskData], NDArray[Any]]


def rows_of(data: TaskData, rows: slice, rewards: NDArray[Any]) -> NDArray[np.object_]:
    """An episode as the field stores it, [T, 4] objects: float64 arrays, and plain floats."""
    length = rows.stop - rows.start
    found = np.empty((length, 4), dtype=object)
    for step in range(length):
        row = rows.start + step
        found[step, 0] = data.observations[row].astype(np.float64)
        found[step, 1] = data.actions[row]
        found[step, 2] = float(rewards[row])
        found[step, 3] = data.next_observations[row].astype(np.float64)
    return found


def write_legacy(
    folder: Path, data: TaskData, column: str = "rewards", deterministic: bool = False
) -> Path:
    """Write all episodes of a task, numbered within their checkpoint.

    Args:
        folder: the legacy folder, made if it is not there.
        data: the task; every episode has the same length.
        column: the rewards that are stored.
        deterministic: store the first episode of a checkpoint as a deterministic one too.
    """
    place = folder / f"goal_idx{data.task}"
    place.mkdir(parents=True)
    ends = np.flatnonzero(data.terminals | data.timeouts) + 1
    starts = [0, *ends[:-1].tolist()]
    numbers: dict[int, int] = {}
    for start, end in zip(starts, ends.tolist(), strict=True):
        mark = int(data.checkpoint[start])
        number = numbers.setdefault(mark, 0)
        numbers[mark] += 1
        rows = rows_of(data, slice(start, end), data.columns[column])
        np.save(place / f"trj_evalsample{number}_step{mark}.npy", rows)
        if deterministic and not number:
            np.save(place / f"trj_eval{number}_step{mark}.npy", rows)
    return folder
