"""Budgets: the protocol's numbers, and what does not fit is refused."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest

from datagen.budgets import BUDGETS, budget
from meta_envs import resolve
from tests.meta_envs.robots import POINT_ROBOTS


@pytest.mark.parametrize("env", ["point_robot", "PointRobotWind-v0", "sparse-point-robot"])
@pytest.mark.parametrize("name", ["paper", "standard"])
def test_point_robots_follow_the_protocol(env: str, name: str) -> None:
    found = budget(env, name)
    assert found.name == name
    assert (found.steps, found.random_steps, found.episodes) == (5000, 2000, 50)
    assert found.checkpoints == (
        2200, 2400, 2600, 2800, 3000, 3200, 3400, 3600, 3800, 4000, 4200, 4400, 4600, 4800,
    )  # fmt: skip
    assert found.total_episodes == 700


@pytest.mark.parametrize("env", POINT_ROBOTS)
def test_every_environment_has_the_three_budgets(env: str) -> None:
    assert list(BUDGETS[env]) == ["paper", "standard", "smoke"]
    for name, row in BUDGETS[env].items():
        assert row.name == name
        # Checkpoints fall between two bursts of updates, so that each policy has had updates.
        assert row.checkpoints[0] - row.random_steps >= 2 * row.sac.update_every


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
    with pytest.raises(ValueError, match=r"no budget 'huge' \(known: paper, standard, smoke\)"):
        budget("point-robot", "huge")
    with pytest.raises(ValueError, match="did you mean 'point_robot'"):
        budget("point_robott", "paper")
    monkeypatch.delitem(BUDGETS, resolve("point_robot").name)
    with pytest.raises(ValueError, match=r"point_robot has no budget 'paper' \(it has none\)"):
        budget("point_robot", "paper")
