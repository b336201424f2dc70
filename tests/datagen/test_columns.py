"""Every promise about the columns, broken one at a time."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from datagen.columns import COLUMNS, check_columns, content_digest
from tests.datagen.examples import independent_digest, task_data

Columns = dict[str, NDArray[Any]]
HORIZON = 25


def put(name: str, row: Any, value: Any) -> Callable[[Columns], None]:
    """An edit that sets one value of a column."""

    def edit(columns: Columns) -> None:
        columns[name][row] = value

    return edit


def replace(name: str, made: Callable[[NDArray[Any]], NDArray[Any]]) -> Callable[[Columns], None]:
    """An edit that replaces a column."""

    def edit(columns: Columns) -> None:
        columns[name] = made(columns[name])

    return edit


def drop_all_rows(columns: Columns) -> None:
    for name in columns:
        columns[name] = columns[name][:0]


def drop_first_episode(columns: Columns) -> None:
    for name in columns:
        columns[name] = columns[name][HORIZON:]


def drop_second_episode(columns: Columns) -> None:
    for name in columns:
        columns[name] = np.delete(columns[name], np.s_[HORIZON : 2 * HORIZON], axis=0)


def drop_last_row(columns: Columns) -> None:
    for name in columns:
        columns[name] = columns[name][:-1]


def both_flags(columns: Columns) -> None:
    columns["terminals"][HORIZON - 1] = True


def two_is_true(columns: Columns) -> None:
    columns["timeouts"].view(np.uint8)[HORIZON - 1] = 2


def no_array(columns: Any) -> None:
    columns["rewards"] = [0.0]


def swap_two_rows(columns: Columns) -> None:
    for name in ("observations", "next_observations"):
        columns[name][[3, 4]] = columns[name][[4, 3]]


BROKEN: list[tuple[Callable[[Columns], Any], str]] = [
    (lambda columns: columns.pop("timeouts"), "has no column timeouts"),
    (no_array, "has no column rewards"),
    (lambda columns: columns.update(extra=np.zeros(100)), "has a column 'extra' that does not"),
    (
        lambda columns: columns.update(dense_rewards=columns["rewards"]),
        "has a column 'dense_rewards' that does not belong",
    ),
    (replace("rewards", lambda c: c.astype("f8")), r"rewards is float64 \[100\], must be float32"),
    (replace("episode", lambda c: c.astype("i8")), "episode is int64"),
    (replace("actions", lambda c: c.astype(">f4")), "actions is >f4"),
    (replace("terminals", lambda c: c.astype("u1")), "terminals is uint8"),
    (replace("terminals", lambda c: c.astype(object)), "terminals is object"),
    (
        replace("actions", lambda c: c[:, :1]),
        r"actions is float32 \[100, 1\], must be float32 \[100, 2\]",
    ),
    (replace("observations", lambda c: c[:-1]), r"observations is float32 \[99, 2\]"),
    (replace("rewards", lambda c: c[:, None]), r"\[100, 1\], must be float32 \[100\]"),
    (replace("rewards", lambda c: c.reshape(())[None] if c.size == 1 else c[:50]), "must be"),
    (drop_all_rows, "has no transitions"),
    (put("rewards", 7, np.nan), "column rewards is NaN or infinite in row 7$"),
    (put("observations", (5, 1), np.inf), "observations is NaN or infinite in row 5$"),
    (
        put("next_observations", np.s_[8:10], -np.inf),
        r"next_observations is NaN or infinite in row 8 \(and in 1 more rows\)",
    ),
    (put("actions", (3, 0), np.nan), "actions is NaN or infinite in row 3"),
    (put("actions", (3, 1), np.nextafter(np.float32(1), np.float32(2))), r"outside \[-1, 1\]"),
    (put("actions", (3, 1), -1.5), r"actions is outside \[-1, 1\] in row 3"),
    (two_is_true, "timeouts is neither true nor false in row 24"),
    (put("checkpoint", np.s_[:HORIZON], -1), "checkpoint is negative in row 0"),
    (put("checkpoint", 30, 7), "checkpoint changes inside an episode in row 29"),
    (drop_first_episode, "column episode starts at 1, must start at 0"),
    (drop_second_episode, "episode goes from 0 to 2 in row 25, must stay or grow by one"),
    (put("episode", 60, 1), "episode goes from 2 to 1 in row 60"),
    (drop_last_row, "terminals and timeouts are false at an episode's end in row 98"),
    (put("timeouts", 24, False), "are false at an episode's end in row 24"),
    (put("timeouts", 30, True), "or timeouts is true inside an episode in row 30"),
    (put("terminals", 31, True), "or timeouts is true inside an episode in row 31"),
    (both_flags, "terminals is true together with timeouts in row 24"),
    (put("next_observations", (10, 0), 0.25), "next_observations is not what .* in row 10$"),
    (swap_two_rows, "next_observations is not what the episode's next row observes"),
]


@pytest.mark.parametrize(("edit", "fault"), BROKEN)
def test_a_broken_promise_is_named(edit: Callable[[Columns], Any], fault: str) -> None:
    columns = task_data(3).columns
    check_columns(columns, 2, 2, sparse=False)
    edit(columns)
    with pytest.raises(ValueError, match=fault):
        check_columns(columns, 2, 2, sparse=False)


def test_a_real_termination_ends_an_episode_too() -> None:
    columns = task_data(3).columns
    columns["timeouts"][HORIZON - 1] = False
    columns["terminals"][HORIZON - 1] = True
    check_columns(columns, 2, 2, sparse=False)


def test_episodes_may_differ_in_length_down_to_one_step() -> None:
    columns = {
        name: column[HORIZON - 1 : 2 * HORIZON] for name, column in task_data(3).columns.items()
    }
    check_columns(columns, 2, 2, sparse=False)
    check_columns({name: column[:1] for name, column in columns.items()}, 2, 2, sparse=False)


def test_sparse_environments_have_dense_rewards_too() -> None:
    columns = task_data(3, "sparse_point_robot").columns
    check_columns(columns, 2, 2, sparse=True)
    columns["dense_rewards"][4] = np.nan
    with pytest.raises(ValueError, match="dense_rewards is NaN or infinite in row 4"):
        check_columns(columns, 2, 2, sparse=True)
    del columns["dense_rewards"]
    with pytest.raises(ValueError, match="has no column dense_rewards"):
        check_columns(columns, 2, 2, sparse=True)


def test_the_content_hash_is_the_documented_one() -> None:
    data = task_data(3, "sparse_point_robot")
    assert list(data.columns) == list(COLUMNS)
    assert content_digest(data.columns, data.meta) == independent_digest(data.columns, data.meta)


def test_the_content_hash_depends_on_every_value() -> None:
    data = task_data(3)
    whole = content_digest(data.columns, data.meta)
    hashes = {whole, content_digest(data.columns, {**data.meta, "seed": 1})}
    for name, column in data.columns.items():
        column.view(np.uint8).reshape(-1)[-1] ^= 1
        hashes.add(content_digest(data.columns, data.meta))
        column.view(np.uint8).reshape(-1)[-1] ^= 1
        hashes.add(content_digest({**data.columns, name: column[:-1]}, data.meta))
    assert len(hashes) == 2 + 2 * len(data.columns)
    assert content_digest(data.columns, {**data.meta, "content_sha256": "x"}) == whole
    backwards = dict(reversed(data.columns.items()))
    assert content_digest(backwards, data.meta) == whole


def test_a_tasks_data_name_their_columns() -> None:
    data = task_data(3)
    assert len(data) == 4 * HORIZON
    for name, column in data.columns.items():
        assert getattr(data, name) is column
