"""The dry run's estimate: measured, and in proportion to the plan."""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path

import pytest
import torch

from datagen import estimate
from datagen.budgets import FleetSettings, budget
from datagen.estimate import (
    START_SECONDS,
    seconds_a_fleet_step,
    seconds_a_learning_step,
    seconds_a_rollout,
    seconds_of,
)
from datagen.plan import Plan


def test_a_learning_step_is_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(estimate, "MEASURED_SECONDS", 0.2)
    begin = time.perf_counter()
    found = seconds_a_learning_step("point_robot", budget("point_robot", "smoke"))
    # It ran at least 100 learning steps, and a step of it takes longer than a microsecond.
    assert 1e-6 < found < (time.perf_counter() - begin) / 100


def test_a_rollout_is_measured() -> None:
    assert 0 < seconds_a_rollout("point_robot", 2) < seconds_a_rollout("point_robot", 20_000)


def test_the_estimate_is_in_proportion(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(estimate, "seconds_a_learning_step", lambda env, budget: 0.01)
    monkeypatch.setattr(estimate, "seconds_a_rollout", lambda env, episodes: 0.5)
    paper = dataclasses.replace(budget("point_robot", "paper"), fleet=None)
    plan = Plan("point_robot", paper.groups(range(5)), paper, 0, tmp_path, workers=2)
    task = 2800 * 0.01 + 14 * 0.5
    assert seconds_of(plan, plan.tasks) == pytest.approx(START_SECONDS + 3 * task)
    assert seconds_of(plan, (1, 4)) == pytest.approx(START_SECONDS + task)
    alone = dataclasses.replace(plan, workers=1)
    assert seconds_of(alone, plan.tasks) == pytest.approx(START_SECONDS + 5 * task)


def test_a_step_of_a_fleet_is_measured_on_one_thread(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(estimate, "MEASURED_SECONDS", 0.2)
    fleet = FleetSettings(2, "float32")
    rows = dataclasses.replace(budget("point_robot", "smoke"), fleet=fleet)
    plan = Plan("point_robot", ((0, 1), (2,)), rows, 0, tmp_path, workers=1)
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        begin = time.perf_counter()
        found = seconds_a_fleet_step(plan)
        assert 1e-6 < found < (time.perf_counter() - begin) / 20
        assert torch.get_num_threads() == 1, "a worker has no more"
    finally:
        torch.set_num_threads(before)
    assert list(tmp_path.iterdir()) == []


def test_a_fleets_estimate_is_in_proportion(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(estimate, "seconds_a_fleet_step", lambda plan: 0.01)
    monkeypatch.setattr(estimate, "seconds_a_rollout", lambda env, episodes: 0.5)
    rows = budget("hopper_params", "smoke")
    plan = Plan("hopper_params", rows.groups(range(60)), rows, 0, tmp_path, workers=2)
    # Three groups of 20 on two workers are two rounds; then 30 tasks a worker are rolled out.
    every = seconds_of(plan, plan.tasks)
    assert every == pytest.approx(START_SECONDS + 2 * 200 * 0.01 + 30 * 2 * 0.5)
    # Two tasks of one group: that is trained as a whole, and the two are rolled out.
    assert seconds_of(plan, (3, 5)) == pytest.approx(START_SECONDS + 200 * 0.01 + 2 * 0.5)
