"""Budgets: the protocol's numbers, and what does not fit is refused."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from datagen.budgets import BUDGETS, FleetSettings, budget, other_options
from meta_envs import resolve
from tests.meta_envs.robots import MUJOCO_ROBOTS, POINT_ROBOTS


@pytest.mark.parametrize("env", ["point_robot", "PointRobotWind-v0", "sparse-point-robot"])
@pytest.mark.parametrize("name", ["paper", "standard", "quick"])
def test_point_robots_follow_the_protocol(env: str, name: str) -> None:
    found = budget(env, name)
    assert found.name == name
    assert (found.steps, found.random_steps, found.episodes) == (5000, 2000, 50)
    assert found.checkpoints == (
        2200, 2400, 2600, 2800, 3000, 3200, 3400, 3600, 3800, 4000, 4200, 4400, 4600, 4800,
    )  # fmt: skip
    assert found.total_episodes == 700


@pytest.mark.parametrize("env", [*POINT_ROBOTS, *MUJOCO_ROBOTS])
def test_every_environment_has_the_four_budgets(env: str) -> None:
    assert list(BUDGETS[env]) == ["paper", "standard", "quick", "smoke"]
    for name, row in BUDGETS[env].items():
        assert row.name == name
        # Checkpoints fall between two bursts of updates, so that each policy has had updates.
        assert row.checkpoints[0] - row.random_steps >= 2 * row.sac.update_every
        assert row.fleet is not None
        assert row.fleet.precision == "auto"


@pytest.mark.parametrize("env", MUJOCO_ROBOTS)
@pytest.mark.parametrize("name", ["standard", "quick"])
def test_robots_follow_the_protocol_at_fewer_steps(env: str, name: str) -> None:
    field, found = budget(env, "paper"), budget(env, name)
    assert name == "standard" or found.steps == 40_000
    assert (field.steps, field.random_steps, field.episodes) == (1_000_000, 50_000, 50)
    # The same shares of the training: random steps, early checkpoints and late ones.
    marks, theirs = np.array(found.checkpoints), np.array(field.checkpoints)
    np.testing.assert_array_equal(marks * field.steps, theirs * found.steps)
    assert found.random_steps * field.steps == field.random_steps * found.steps
    shared = ("gamma", "tau", "update_every", "initial_temperature")
    for name in shared:
        assert getattr(found.sac, name) == getattr(field.sac, name)


def test_config_is_json_and_has_every_number() -> None:
    found = budget("point_robot", "paper", episodes=7)
    config = found.config()
    assert json.loads(json.dumps(config)) == config
    assert config["episodes"] == 7
    assert config["checkpoints"][-1] == 4800
    assert set(config["sac"]) == {
        "hidden", "learning_rate", "batch_size", "gamma", "tau", "update_every",
        "initial_temperature",
    }  # fmt: skip


def test_config_names_the_fleet_only_where_there_is_one() -> None:
    assert "fleet" not in replace(budget("point_robot", "paper"), fleet=None).config()
    config = budget("hopper_params", "smoke").config()
    assert config["fleet"] == {"size": 25, "precision": "auto", "device": "cpu"}
    assert json.loads(json.dumps(config)) == config
    with pytest.raises(ValueError, match="a fleet has at least 1 task, got 0"):
        FleetSettings(0, "float32")


@pytest.mark.parametrize(
    ("env", "fleet", "options"),
    [
        ("point_robot", None, ["--engine", "sb3"]),
        ("point_robot", FleetSettings(25, "float32"), []),
        ("point_robot", FleetSettings(4, "float32"), ["--fleet-size", "4"]),
        ("ant-goal", None, ["--engine", "sb3"]),
        ("ant-goal", FleetSettings(25, "bfloat16"), []),
        ("ant-goal", FleetSettings(4, "float32"), ["--fleet-size", "4"]),
    ],
)
def test_options_that_a_budget_alone_does_not_say(
    env: str, fleet: FleetSettings | None, options: list[str]
) -> None:
    # The precision is always said: by default it is the machine's.
    precision = ["--precision", fleet.precision] if fleet else []
    config = replace(budget(env, "smoke"), fleet=fleet).config()
    assert other_options(env, "smoke", config) == [*options, *precision]
    if fleet:
        other = replace(budget(env, "smoke"), fleet=replace(fleet, device="cuda")).config()
        # There, a command takes all tasks by itself, so their number is always said.
        size = ["--fleet-size", str(fleet.size)]
        assert other_options(env, "smoke", other) == [*size, *precision, "--device", "cuda"]
    config["episodes"] = 13
    assert other_options(env, "smoke", config) == ["--episodes", "13", *options, *precision]


def test_options_of_a_config_that_is_none() -> None:
    with pytest.raises(KeyError):
        other_options("ant_goal", "smoke", {})
    with pytest.raises(ValueError, match="has no budget 'huge'"):
        other_options("ant_goal", "huge", {"episodes": 3})


@pytest.mark.parametrize(
    ("changes", "fault"),
    [
        ({"checkpoints": ()}, "checkpoints must rise"),
        ({"checkpoints": (100, 90)}, "checkpoints must rise"),
        ({"checkpoints": (60, 80)}, "checkpoints must rise from above 60"),
        ({"checkpoints": (80, 120)}, "the last checkpoint, 120, is after 100 steps"),
        ({"episodes": 0}, "episodes must be at least 1, got 0"),
    ],
)
def test_numbers_that_do_not_fit_are_refused(changes: dict[str, object], fault: str) -> None:
    with pytest.raises(ValueError, match=fault):
        replace(budget("point_robot", "smoke"), **changes)  # type: ignore[arg-type]  # wrong on purpose


def test_unknown_names_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(
        ValueError, match=r"no budget 'huge' \(known: paper, standard, quick, smoke\)"
    ):
        budget("point-robot", "huge")
    with pytest.raises(ValueError, match="did you mean 'point_robot'"):
        budget("point_robott", "paper")
    monkeypatch.delitem(BUDGETS, resolve("point_robot").name)
    with pytest.raises(ValueError, match=r"point_robot has no budget 'paper' \(it has none\)"):
        budget("point_robot", "paper")
