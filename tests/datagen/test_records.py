"""Every promise about meta and index, broken one at a time."""

from __future__ import annotations

import copy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from datagen.records import FORMAT_VERSION, check_index, check_meta
from tests.datagen.examples import index_of, task_data, write_dataset

Record = dict[str, Any]
Edit = Callable[[Record], Any]


def put(*keys_and_value: Any) -> Edit:
    """An edit that sets a value, given the keys that lead to it and then the value itself."""
    *keys, last, value = keys_and_value

    def edit(record: Record) -> None:
        for key in keys:
            record = record[key]
        record[last] = value

    return edit


SHARED: list[tuple[Edit, str]] = [
    (put("format_version", 2), "is of format version 2, this program reads version 1"),
    (put("format_version", True), "is of format version True"),
    (put("format_version", "1"), "is of format version '1'"),
    (lambda r: r.pop("format_version"), "is of format version None"),
    (lambda r: r.pop("seed"), "has no key 'seed'"),
    (put("seed", 1.5), "has 'seed' 1.5, not an integer"),
    (put("seed", True), "has 'seed' True, not an integer"),
    (put("config", []), r"has 'config' \[\], not an object"),
    (put("env", None), "has 'env' None, not a text"),
    (put("env", "point_robot_wint"), "no environment 'point_robot_wint'; did you mean"),
    (put("env", "PointRobotWind-v0"), "here that is 'point_robot_wind', 'PointRobotWind-v0'"),
    (
        put("env_id", "PointRobotWind-v1"),
        "its environment is 'point_robot_wind', 'PointRobotWind-v1'",
    ),
    (put("task_hash", "0" * 64), "another version of point_robot_wind: its tasks have the hash"),
    (put("param_names", ["wind_y", "wind_x"]), r"names the parameters \['wind_y', 'wind_x'\]"),
]

META: list[tuple[Edit, str]] = [
    (put("task", 50), "point_robot_wind has tasks 0 to 49, got task=50"),
    (put("task", -1), "point_robot_wind has tasks 0 to 49, got task=-1"),
    (put("task", "3"), "has 'task' '3', not an integer"),
    (put("task", 4), "task 4 has the parameters"),
    (put("params", [0.0]), r"task 3 has the parameters \[0.0\], not \[-0.004"),
    (put("params", ["a", "b"]), "task 3 has the parameters"),
    (put("params", [[1.0], [2.0]]), "task 3 has the parameters"),
    (put("params", [10**400, 1]), "task 3 has the parameters"),
    (put("split", "test"), "task 3 is in split 'test', not 'train'"),
    (put("returns", "random", None), "task 3 has no number 'random' among its returns"),
    (lambda r: r["returns"].pop("expert"), "task 3 has no number 'expert' among its returns"),
    (put("returns", "expert", True), "has no number 'expert'"),
    (put("returns", "expert", float("nan")), "has no number 'expert'"),
    (put("returns", "behavior", [1.0]), "has no object of numbers 'behavior'"),
    (put("returns", "deterministic", "200", "high"), "no object of numbers 'deterministic'"),
    (put("returns", "deterministic", {}), "no object of numbers 'deterministic'"),
]

INDEX: list[tuple[Edit, str]] = [
    (put("budget", 3), "has 'budget' 3, not a text"),
    (put("tasks", {}), "has 'tasks' {}, not a list"),
    (put("tasks", []), "has no tasks"),
    (put("tasks", 1, "task_001.h5"), "has a task that is not a record"),
    (lambda r: r["tasks"].reverse(), "task 2 is twice in it or not in order"),
    (lambda r: r["tasks"].append(r["tasks"][3]), "task 3 is twice in it or not in order"),
    (lambda r: r["tasks"][0].pop("sha256"), "a task's record has no key 'sha256'"),
    (put("tasks", 0, "sha256", "X" * 64), "task 0 has the malformed hash"),
    (put("tasks", 0, "sha256", "ab"), "task 0 has the malformed hash 'ab'"),
    (put("tasks", 2, "file", "../task_002.h5"), r"said to be in '../task_002.h5', not task_002.h5"),
    (put("tasks", 2, "bytes", 0), "task 2 has 0 bytes"),
    (put("tasks", 2, "transitions", -5), "task 2 has -5 transitions"),
    (put("tasks", 2, "episodes", 1.0), "has 'episodes' 1.0, not an integer"),
    (put("tasks", 2, "split", "train"), "task 2 is in split 'train', not 'test'"),
    (put("tasks", 2, "returns", "random", "x"), "task 2 has no number 'random'"),
]


@pytest.fixture(scope="module")
def index(tmp_path_factory: pytest.TempPathFactory) -> Record:
    folder = write_dataset(tmp_path_factory.mktemp("records") / "point_robot_wind")
    made: Record = index_of(folder, "point_robot_wind", range(4), 4, 0)
    return made


@pytest.mark.parametrize(("edit", "fault"), SHARED + META)
def test_a_wrong_meta_is_named(edit: Edit, fault: str) -> None:
    meta = task_data(3).meta
    assert check_meta(meta).env == "point_robot_wind"
    edit(meta)
    with pytest.raises(ValueError, match=fault):
        check_meta(meta)


@pytest.mark.parametrize(("edit", "fault"), SHARED + INDEX)
def test_a_wrong_index_is_named(index: Record, edit: Edit, fault: str) -> None:
    record = copy.deepcopy(index)
    assert check_index(record).env == "point_robot_wind"
    edit(record)
    with pytest.raises(ValueError, match=fault):
        check_index(record)


def test_parameters_may_differ_in_their_last_bits(index: Record) -> None:
    record = copy.deepcopy(index)
    record["tasks"][0]["params"][0] *= 1 + 1e-15
    check_index(record)


def test_further_keys_are_welcome(index: Record) -> None:
    check_index({**index, "note": "collected on a rainy day"})
    check_meta({**task_data(3).meta, "seconds": 12})


def test_the_version_is_one() -> None:
    assert FORMAT_VERSION == 1


def test_the_example_lies_where_it_says(tmp_path: Path) -> None:
    folder = write_dataset(tmp_path / "point_robot_wind", tasks=(5, 1))
    assert sorted(path.name for path in folder.iterdir()) == [
        "dataset.json",
        "task_001.h5",
        "task_005.h5",
    ]
