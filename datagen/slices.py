"""Slices of a dataset: a part of the checkpoints, and fewer episodes of each of them.

What a quality means is decided task by task, from the returns of the behaviour policy at its
checkpoints that `meta` and the index hold. With R the return at a checkpoint, the *share* of a
checkpoint is (R - random) / (best - random), where best is the largest R of the task: 0 is as good
as random actions, 1 is the best the task's own policy ever did. Of n checkpoints

- `mixed` is all of them;
- `early` the first third, n / 3 rounded up, whatever their returns;
- `medium` those with a share from 0.2 to 0.8, that is, around half-way from random to best;
- `expert` those with a share of at least 0.9, but only the last n / 3, rounded up, of them.

A checkpoint can be both early and, where learning is fast, medium or expert; it is never both
medium and expert. A task whose policy never did better than random has no medium and no expert
checkpoint, and one that learned in a single leap has no medium one.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from datagen.columns import TaskData

Quality = Literal["mixed", "medium", "expert", "early"]
"""Which of the checkpoints; the module says how each is defined."""
QUALITIES: tuple[Quality, ...] = get_args(Quality)
MEDIUM_SHARES = (0.2, 0.8)
"""Least and largest share of a medium checkpoint, both included."""
EXPERT_SHARE = 0.9
"""Least share of an expert checkpoint."""
PART = 3
"""`early` is the first of this many parts of the checkpoints; `expert` is never more of them."""


@dataclass(frozen=True)
class Slice:
    """Which rows of each task are read.

    Attributes:
        quality: which checkpoints.
        episodes: the first this many of each of them, all if None. The slice of fewer episodes is
            a part of the slice of more.

    Raises:
        ValueError: no such quality, or less than one episode.
    """

    quality: Quality = "mixed"
    episodes: int | None = None

    def __post_init__(self) -> None:
        """Check the values."""
        if self.quality not in QUALITIES:
            raise ValueError(f"no quality {self.quality!r} (known: {', '.join(QUALITIES)})")
        if self.episodes is not None and self.episodes < 1:
            raise ValueError(f"episodes must be at least 1, got {self.episodes}")

    @property
    def whole(self) -> bool:
        """Whether it is all there is."""
        return self == Slice()


def shares(returns: Mapping[str, Any]) -> dict[int, float]:
    """How far each checkpoint has come from random actions to the task's best checkpoint.

    Args:
        returns: of a task's meta or record.

    Returns:
        Share by checkpoint, checkpoints rising; no share at all where none beats random actions.
    """
    by_checkpoint = dict(zip(_marks(returns), returns["behavior"].values(), strict=True))
    random, best = returns["random"], max(by_checkpoint.values())
    if best <= random:
        return {}
    return {
        mark: float((by_checkpoint[mark] - random) / (best - random))
        for mark in sorted(by_checkpoint)
    }


def chosen_checkpoints(returns: Mapping[str, Any], quality: Quality) -> tuple[int, ...]:
    """The checkpoints of a quality, rising; the module says how each is defined.

    Args:
        returns: of a task's meta or record.
        quality: which checkpoints.
    """
    marks = sorted(_marks(returns))
    third = math.ceil(len(marks) / PART)
    found = shares(returns)
    if quality == "mixed":
        return tuple(marks)
    if quality == "early":
        return tuple(marks[:third])
    if quality == "medium":
        low, high = MEDIUM_SHARES
        return tuple(mark for mark, share in found.items() if low <= share <= high)
    good = [mark for mark, share in found.items() if share >= EXPERT_SHARE]
    return tuple(good[-third:])


def _marks(returns: Mapping[str, Any]) -> list[int]:
    """The checkpoints that have returns, in the order they are listed in."""
    try:
        return [int(mark) for mark in returns["behavior"]]
    except ValueError as error:
        raise ValueError(f"has returns of a checkpoint that is no number ({error})") from None


def chosen_episodes(
    checkpoints: NDArray[np.int32], returns: Mapping[str, Any], part: Slice
) -> NDArray[np.int64]:
    """The episodes of a slice, rising, int64 [K].

    Args:
        checkpoints: of each episode, [E].
        returns: of the task's meta.
        part: the slice.

    Raises:
        ValueError: there are none, or fewer of a checkpoint than the slice wants.
    """
    keep = np.ones(len(checkpoints), dtype=np.bool_)
    if part.quality != "mixed":
        wanted = chosen_checkpoints(returns, part.quality)
        keep = np.isin(checkpoints, wanted)
        if not wanted:
            raise ValueError(f"has no {part.quality} checkpoint: {_why_none(returns)}")
        if not keep.any():
            marks = ", ".join(map(str, wanted))
            raise ValueError(f"has no episodes of its {part.quality} checkpoints, {marks}")
    if part.episodes is None:
        return np.flatnonzero(keep)
    firsts = []
    for mark in np.unique(checkpoints[keep]):
        own = np.flatnonzero(checkpoints == mark)
        if len(own) < part.episodes:
            raise ValueError(
                f"has {len(own)} episodes of checkpoint {mark}, not the {part.episodes} asked for"
            )
        firsts.append(own[: part.episodes])
    return np.sort(np.concatenate(firsts))


def _why_none(returns: Mapping[str, Any]) -> str:
    found = shares(returns)
    if not found:
        return f"none of its {len(returns['behavior'])} did better than random actions"
    low, high = MEDIUM_SHARES
    text = ", ".join(f"{share:.2f}" for share in found.values())
    return f"none is {low} to {high} of the way from random actions to its best one, but {text}"


def slice_meta(
    meta: Mapping[str, Any], part: Slice, checkpoints: NDArray[np.int32]
) -> dict[str, Any]:
    """A task's meta for a slice of its rows: as it is, with a key `slice` that says which.

    Args:
        meta: of the whole task.
        part: the slice.
        checkpoints: of its episodes, [K].
    """
    if part.whole:
        return dict(meta)
    marks = np.unique(checkpoints).tolist()
    stated = {"quality": part.quality, "episodes": part.episodes, "checkpoints": marks}
    return {**meta, "slice": stated}


def take(data: TaskData, part: Slice) -> TaskData:
    """The rows of a slice of a task, episodes numbered anew from 0; `data` itself if that is all.

    Raises:
        ValueError: there are none, or fewer of a checkpoint than the slice wants.
    """
    if part.whole:
        return data
    starts = np.flatnonzero(np.diff(data.episode, prepend=-1))
    chosen = chosen_episodes(data.checkpoint[starts], data.meta["returns"], part)
    lengths = np.diff(np.append(starts, len(data)))[chosen]
    # Row r of the slice is row r of the task, shifted by what was left out before its episode.
    shift = starts[chosen] - (np.cumsum(lengths) - lengths)
    rows = np.arange(lengths.sum()) + np.repeat(shift, lengths)
    columns = {name: column[rows] for name, column in data.columns.items()}
    columns["episode"] = np.repeat(np.arange(len(chosen), dtype=np.int32), lengths)
    return TaskData(
        data.task, columns, slice_meta(data.meta, part, data.checkpoint[starts[chosen]])
    )
