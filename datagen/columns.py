"""The columns of a task's file: what they are and what must be true of them."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datagen.files import canonical_json

COLUMNS: dict[str, np.dtype[Any]] = {
    "observations": np.dtype("<f4"),
    "actions": np.dtype("<f4"),
    "rewards": np.dtype("<f4"),
    "next_observations": np.dtype("<f4"),
    "terminals": np.dtype("?"),
    "timeouts": np.dtype("?"),
    "episode": np.dtype("<i4"),
    "checkpoint": np.dtype("<i4"),
    "dense_rewards": np.dtype("<f4"),
}
"""Every column and its dtype, in the order of the file and of the content's hash."""
SPARSE_COLUMN = "dense_rewards"
"""Only datasets of sparse environments have it, and all of them do."""


@dataclass(frozen=True, eq=False)
class TaskData:
    """The transitions of one task, N rows in the order they were made.

    Attributes:
        task: row of the environment's task set.
        columns: arrays of equal length N by name; `COLUMNS` has the names and dtypes.
        meta: where the data come from, plain JSON values; docs/dataset_format.md lists the keys.
    """

    task: int
    columns: dict[str, NDArray[Any]]
    meta: dict[str, Any]

    def __len__(self) -> int:
        """Number of transitions, N."""
        return len(self.columns["rewards"])

    @property
    def observations(self) -> NDArray[np.float32]:
        """Observations before the action, float32 [N, O]."""
        return self.columns["observations"]

    @property
    def actions(self) -> NDArray[np.float32]:
        """Actions in [-1, 1], float32 [N, A]."""
        return self.columns["actions"]

    @property
    def rewards(self) -> NDArray[np.float32]:
        """Rewards of the environment, float32 [N]."""
        return self.columns["rewards"]

    @property
    def next_observations(self) -> NDArray[np.float32]:
        """Observations after the action, never those of a fresh episode, float32 [N, O]."""
        return self.columns["next_observations"]

    @property
    def terminals(self) -> NDArray[np.bool_]:
        """True where the task itself ended the episode, bool [N]."""
        return self.columns["terminals"]

    @property
    def timeouts(self) -> NDArray[np.bool_]:
        """True where the time limit ended the episode, bool [N]."""
        return self.columns["timeouts"]

    @property
    def episode(self) -> NDArray[np.int32]:
        """Number of the episode, from 0, int32 [N]."""
        return self.columns["episode"]

    @property
    def checkpoint(self) -> NDArray[np.int32]:
        """Training steps the behaviour policy had behind it, int32 [N]."""
        return self.columns["checkpoint"]


def content_digest(columns: Mapping[str, NDArray[Any]], meta: Mapping[str, Any]) -> str:
    """SHA-256 of the columns and of `meta` without its own `content_sha256`, hexadecimal."""
    total = hashlib.sha256()
    for name in (name for name in COLUMNS if name in columns):
        column = np.ascontiguousarray(columns[name])
        head = json.dumps([name, column.dtype.str, list(column.shape)])
        total.update(f"{head}\n".encode())
        total.update(column.data)
    rest = {key: value for key, value in meta.items() if key != "content_sha256"}
    total.update(canonical_json(rest).encode())
    return total.hexdigest()


def check_columns(
    columns: Mapping[str, NDArray[Any]], obs_dim: int, act_dim: int, sparse: bool
) -> None:
    """Check everything the format promises of a task's columns.

    Args:
        columns: by name.
        obs_dim: size of an observation, O.
        act_dim: size of an action, A.
        sparse: whether the environment is, that is, `dense_rewards` must be there.

    Raises:
        ValueError: the first promise that is broken, and where.
    """
    wanted = [name for name in COLUMNS if sparse or name != SPARSE_COLUMN]
    for name in columns:
        if name not in wanted:
            raise ValueError(f"has a column {name!a} that does not belong there")
    for name in wanted:
        if not isinstance(columns.get(name), np.ndarray):
            raise ValueError(f"has no column {name}")
    length = len(columns["rewards"])
    widths = {"observations": (obs_dim,), "next_observations": (obs_dim,), "actions": (act_dim,)}
    for name, column in columns.items():
        shape = (length, *widths.get(name, ()))
        if column.dtype != COLUMNS[name] or column.shape != shape:
            raise ValueError(
                f"column {name} is {column.dtype} {list(column.shape)}, "
                f"must be {COLUMNS[name]} {list(shape)}"
            )
    if length < 1:
        raise ValueError("has no transitions")
    _check_values(columns)
    _check_episodes(columns)


def _check_values(columns: Mapping[str, NDArray[Any]]) -> None:
    for name, column in columns.items():
        if column.dtype.kind == "f":
            _check_rows(name, "is NaN or infinite", ~np.isfinite(column))
        elif column.dtype.kind == "b":
            _check_rows(name, "is neither true nor false", column.view(np.uint8) > 1)
    _check_rows("actions", "is outside [-1, 1]", np.abs(columns["actions"]) > 1)
    _check_rows("checkpoint", "is negative", columns["checkpoint"] < 0)


def _check_rows(name: str, fault: str, wrong: NDArray[np.bool_]) -> None:
    """Raise a ValueError that names the first row where `wrong`, [N] or [N, width], is true."""
    rows = np.flatnonzero(wrong if wrong.ndim == 1 else wrong.any(axis=1))
    if len(rows):
        more = f" (and in {len(rows) - 1} more rows)" if len(rows) > 1 else ""
        raise ValueError(f"column {name} {fault} in row {rows[0]}{more}")


def _check_episodes(columns: Mapping[str, NDArray[Any]]) -> None:
    """Episodes are numbered without a gap, whole, ended by one flag, and made by one policy."""
    episode, checkpoint = columns["episode"], columns["checkpoint"]
    terminals, timeouts = columns["terminals"], columns["timeouts"]
    if episode[0] != 0:
        raise ValueError(f"column episode starts at {episode[0]}, must start at 0")
    step = np.diff(episode.astype(np.int64))
    start = np.flatnonzero((step != 0) & (step != 1))
    if len(start):
        raise ValueError(
            f"column episode goes from {episode[start[0]]} to {episode[start[0] + 1]} in row "
            f"{start[0] + 1}, must stay or grow by one"
        )
    last = np.append(step == 1, True)
    _check_rows("terminals", "is true together with timeouts", terminals & timeouts)
    _check_rows(
        "terminals", "or timeouts is true inside an episode", ~last & (terminals | timeouts)
    )
    _check_rows(
        "terminals", "and timeouts are false at an episode's end", last & ~(terminals | timeouts)
    )
    inside = ~last[:-1]
    _check_rows("checkpoint", "changes inside an episode", inside & (np.diff(checkpoint) != 0))
    follows = columns["next_observations"][:-1] == columns["observations"][1:]
    _check_rows(
        "next_observations",
        "is not what the episode's next row observes",
        inside[:, None] & ~follows,
    )
