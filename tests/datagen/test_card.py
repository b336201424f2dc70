"""The card: from the index alone, true, and with a command that makes the dataset again."""

from __future__ import annotations

import json
import re
import shlex
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import tyro

from datagen.budgets import FleetSettings, budget
from datagen.card import card, mean_returns, named_checkpoints, remake_commands
from datagen.collect import CollectConfig, plan_of
from datagen.job import origin
from tests.datagen.examples import index_of, write_dataset


@pytest.fixture(scope="module")
def index(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """The index of four tasks, of which task 2 is a test task."""
    env, tasks = "point_robot_wind", (0, 1, 2, 3)
    folder = write_dataset(tmp_path_factory.mktemp("card"), tasks, env)
    made = origin(env, replace(budget(env, "smoke"), fleet=None), 0)
    return {**made, "tasks": index_of(folder, env, tasks, 4, 0)["tasks"]}


def test_the_same_index_gives_the_same_card(index: dict[str, Any]) -> None:
    again = json.loads(json.dumps(index, sort_keys=True))
    assert card(index) == card(again)
    assert card({**index, "sha256": "0" * 64}) == card(index)


def test_front_matter_lists_every_file_in_its_split(index: dict[str, Any]) -> None:
    _, front, rest = card(index).split("---\n", 2)
    assert "license: mit\n" in front
    assert "- reinforcement-learning\n" in front
    assert "- n<1K\n" in front
    assert rest.startswith("\n# PointRobotWind-v0")
    train, test = front.split("  - split: test\n")
    assert re.findall(r"task_\d+\.h5", train) == ["task_000.h5", "task_001.h5", "task_003.h5"]
    assert re.findall(r"task_\d+\.h5", test) == ["task_002.h5"]


def test_numbers_of_the_table_are_those_of_the_index(index: dict[str, Any]) -> None:
    text = card(index)
    train = [record for record in index["tasks"] if record["split"] == "train"]
    assert len(train) == 3
    size = sum(record["bytes"] for record in train)
    assert f"| bytes | {size:,} | {index['tasks'][2]['bytes']:,} |" in text
    assert "| transitions | 300 | 100 |" in text
    random = sum(record["returns"]["random"] for record in train) / 3
    of_test = index["tasks"][2]["returns"]["random"]
    assert f"| return: random policy | {random:.2f} | {of_test:.2f} |" in text
    assert "| return: expert | -5.00 | -5.00 |" in text
    assert "middle checkpoint" not in text, "there are only two"
    assert "| `observations` | float32 | N x 2 |" in text
    assert "dense_rewards" not in text
    assert "| `gamma` | 0.9 |" in text


def test_a_card_without_test_tasks(index: dict[str, Any]) -> None:
    text = card({**index, "tasks": index["tasks"][:2]})
    assert "split: test" not in text
    assert "|  | train tasks |\n" in text


def test_the_command_has_what_differs_from_the_defaults(index: dict[str, Any]) -> None:
    start = "python -m datagen.collect --env point_robot_wind --budget smoke"
    assert remake_commands(index) == [f"{start} --engine sb3 --tasks 0-3 --seed 0"]
    every = [{"task": task} for task in range(50)]
    whole = {**index, "tasks": every, "seed": 4}
    assert remake_commands(whole) == [f"{start} --engine sb3 --seed 4"]
    thin = {**index, "tasks": every, "config": {**index["config"], "episodes": 12}}
    assert remake_commands(thin) == [f"{start} --episodes 12 --engine sb3 --seed 0"]


def fleet_index(env: str, fleet: FleetSettings | None) -> dict[str, Any]:
    """The head of an index, and two tasks by their numbers."""
    made = origin(env, replace(budget(env, "smoke"), fleet=fleet), 0)
    return {**made, "tasks": [{"task": 4}, {"task": 5}]}


@pytest.mark.parametrize(
    ("env", "fleet", "options"),
    [
        ("point_robot_wind", None, "--engine sb3 "),
        ("point_robot_wind", FleetSettings(25, "float32"), "--precision float32 "),
        ("point_robot_wind", FleetSettings(7, "bfloat16"), "--fleet-size 7 --precision bfloat16 "),
        ("hopper_params", FleetSettings(25, "bfloat16"), "--precision bfloat16 "),
        ("hopper_params", FleetSettings(3, "float32"), "--fleet-size 3 --precision float32 "),
        ("hopper_params", None, "--engine sb3 "),
    ],
)
def test_the_command_says_how_the_policies_were_trained(
    env: str, fleet: FleetSettings | None, options: str
) -> None:
    (command,) = remake_commands(fleet_index(env, fleet))
    start = f"python -m datagen.collect --env {env} --budget smoke "
    assert command == f"{start}{options}--tasks 4-5 --seed 0"
    # And the command is understood, and means the same.
    config = tyro.cli(CollectConfig, args=shlex.split(command)[3:])
    assert plan_of(config).budget == replace(budget(env, "smoke"), fleet=fleet)


def test_a_command_for_each_group_where_one_for_all_would_make_others() -> None:
    index = fleet_index("hopper_params", FleetSettings(2, "float32"))
    index["tasks"] = [{"task": task, "group": "3,6-7" if task > 2 else "1-2"} for task in (1, 2, 6)]
    start = (
        "python -m datagen.collect --env hopper_params --budget smoke --fleet-size 2 --precision"
    )
    ends = ("--tasks 1-2 --seed 0", "--tasks 3,6-7 --seed 0")
    assert remake_commands(index) == [f"{start} float32 {end}" for end in ends]
    index["tasks"][2]["group"] = "6"
    assert remake_commands(index) == [f"{start} float32 --tasks {t} --seed 0" for t in ("1-2", "6")]
    index["tasks"] = [
        {"task": 1, "group": "1"},
        {"task": 2, "group": "2-3"},
        {"task": 3, "group": "2-3"},
    ]
    assert remake_commands(index) == [f"{start} float32 --tasks 1-3 --seed 0"]


def test_a_fleets_settings_are_in_the_card(index: dict[str, Any]) -> None:
    config = {**index["config"], "fleet": {"size": 1500, "precision": "float32", "device": "cpu"}}
    text = card({**index, "config": config})
    assert "| `fleet` | device cpu, precision float32, size 1,500 |\n" in text
    assert card(json.loads(json.dumps({**index, "config": config}, sort_keys=True))) == text


def test_the_card_says_what_the_expert_is(index: dict[str, Any]) -> None:
    start = "means over tasks; the expert is"
    assert f"{start} the exact optimum.\n" in card(index)
    robots = {**index, **origin("hopper_params", budget("hopper_params", "standard"), 0)}
    of_18 = "the task's best deterministic checkpoint, the best of 18 that played one episode each"
    assert f"{start} {of_18}, so it is optimistic.\n" in card(robots)


def record(behavior: dict[str, float], **more: float) -> dict[str, Any]:
    deterministic = {mark: value + 1 for mark, value in behavior.items()}
    returns = {"random": -30.0, "expert": -5.0, **more}
    return {"returns": {**returns, "behavior": behavior, "deterministic": deterministic}}


def test_mean_returns() -> None:
    one = record({"1000": -9.0, "200": -20.0, "400": -8.0})
    two = record({"1000": -6.0, "200": -10.0, "400": -10.0}, expert=-4.0)
    assert mean_returns([one, two]) == {
        "random": -30.0, "first": -15.0, "middle": -9.0, "last": -7.5,
        "best": -7.0, "best deterministic": -6.0, "expert": -4.5,
    }  # fmt: skip


def test_checkpoints_are_ordered_as_numbers() -> None:
    assert named_checkpoints(record({"1000": 0, "200": 0, "400": 0})) == {
        "first": "200", "middle": "400", "last": "1000",
    }  # fmt: skip
    assert named_checkpoints(record({"1000": 0, "200": 0})) == {"first": "200", "last": "1000"}
    assert named_checkpoints(record({"200": 0})) == {"last": "200"}


def test_nothing_of_this_machine_is_in_it(index: dict[str, Any], tmp_path: Path) -> None:
    assert str(tmp_path.parent) not in card(index)
    assert not re.search(r"\b20\d\d-\d\d-\d\d\b|\d\d:\d\d", card(index))


@pytest.mark.parametrize(
    ("rows", "category"),
    [(999, "n<1K"), (1_000, "1K<n<10K"), (10**6, "1M<n<10M"), (18_000_000, "10M<n<100M")],
)
def test_the_size_is_one_of_hugging_faces(rows: int, category: str, index: dict[str, Any]) -> None:
    records = [{**record, "transitions": 0} for record in index["tasks"]]
    records[0]["transitions"] = rows
    assert f"size_categories:\n- {category}\n" in card({**index, "tasks": records})
