"""Which tasks, where, how many rows and bytes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from datagen.budgets import FleetSettings, budget
from datagen.dataset import write_task
from datagen.plan import Plan, parse_shard, parse_tasks
from meta_envs import task_set
from tests.datagen.examples import task_data


@pytest.mark.parametrize(
    ("text", "rows"),
    [
        (None, tuple(range(50))),
        ("0-9,12", (*range(10), 12)),
        ("7", (7,)),
        (" 49 , 3-4 ", (3, 4, 49)),
        ("3,1-3,2", (1, 2, 3)),
        ("00", (0,)),
    ],
)
def test_tasks(text: str | None, rows: tuple[int, ...]) -> None:
    assert parse_tasks(text, task_set("point_robot_wind")) == rows


@pytest.mark.parametrize("text", ["", "x", "1,", "3-1", "-1", "1-", "1.5", "1-2-3", "0x1", "1;2"])
def test_a_text_that_names_no_tasks(text: str) -> None:
    with pytest.raises(ValueError, match="--tasks takes numbers and ranges such as 0-9,12, got"):
        parse_tasks(text, task_set("point_robot_wind"))


@pytest.mark.parametrize("text", ["50", "0-50", "999999999999999999999"])
def test_tasks_out_of_range(text: str) -> None:
    with pytest.raises(ValueError, match="point_robot_wind has tasks 0 to 49, got"):
        parse_tasks(text, task_set("point_robot_wind"))


def test_shards_share_whole_groups_out() -> None:
    groups = ((0, 1), (2,), (5, 6), (7, 8), (9,))
    shards = [parse_shard(f"{i}/3", groups) for i in range(3)]
    assert shards == [((0, 1), (7, 8)), ((2,), (9,)), ((5, 6),)]
    assert parse_shard(None, groups) == parse_shard("0/1", groups) == groups


@pytest.mark.parametrize("text", ["3/3", "0/0", "1", "a/b", "-1/2", "1/2/3", ""])
def test_a_text_that_is_no_shard(text: str) -> None:
    with pytest.raises(ValueError, match="--shard takes i/n with i from 0 to n - 1"):
        parse_shard(text, ((1,), (2,), (3,)))


def test_an_empty_shard() -> None:
    sentence = "--shard 2/3 is empty: of these tasks there are 2 groups, take n <= 2 or a smaller"
    with pytest.raises(ValueError, match=sentence):
        parse_shard("2/3", ((1, 2), (3,)))
    with pytest.raises(ValueError, match="there is 1 group, take n <= 1"):
        parse_shard("1/2", ((1, 2),))


@pytest.mark.parametrize(
    ("count", "size", "sizes"),
    [
        (40, 25, [20, 20]),
        (41, 20, [13, 14, 14]),
        (10, 10, [10]),
        (11, 10, [5, 6]),
        (3, 25, [3]),
        (5, 1, [1] * 5),
        (1, 9, [1]),
    ],
)
def test_groups_are_of_about_one_size(count: int, size: int, sizes: list[int]) -> None:
    tasks = tuple(range(2, 2 * count + 2, 2))
    rows = replace(budget("hopper_params", "smoke"), fleet=FleetSettings(size, "float32"))
    groups = rows.groups(tasks)
    assert [len(group) for group in groups] == sizes
    assert Plan("hopper_params", groups, rows, 0, Path(), 1).tasks == tasks


def test_without_a_fleet_each_task_is_alone() -> None:
    alone = replace(budget("point_robot", "smoke"), fleet=None)
    assert alone.groups((1, 4, 6)) == ((1,), (4,), (6,))


@pytest.mark.parametrize("env", ["point_robot_wind", "sparse_point_robot"])
def test_rows_and_bytes_are_those_of_a_file(env: str, tmp_path: Path) -> None:
    plan = Plan(env, ((0, 1),), budget(env, "smoke"), 0, tmp_path, 1)
    assert plan.rows == 4 * 2 * {"point_robot_wind": 25, "sparse_point_robot": 20}[env]
    sizes = []
    for episodes in (40, 400):
        path = tmp_path / "task_000.h5"
        data = task_data(0, env, episodes)
        write_task(path, data)
        sizes.append((len(data), path.stat().st_size))
    (rows, size), (more_rows, more_size) = sizes
    assert (more_size - size) / (more_rows - rows) == pytest.approx(plan.row_bytes, rel=0.003)
