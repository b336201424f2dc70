"""The dry run's estimate: measured, and in proportion to the plan."""

from __future__ import annotations

import dataclasses
import time
from itertools import pairwise
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
    state_bytes,
)
from datagen.fleet.training import train_fleet
from datagen.plan import Plan
from tests.datagen.fleet.fleets import TINY, work


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


@pytest.mark.parametrize("hidden", [(5,), (64, 64)])
def test_what_a_training_stores_is_as_much_as_is_said(
    hidden: tuple[int, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Memory is most of it with the small networks, the networks are with the large ones.
    few = dataclasses.replace(TINY, checkpoints=(40, 50, 60))
    rows = dataclasses.replace(few, sac=dataclasses.replace(few.sac, hidden=hidden))
    stored = [0]

    def store(path: Path, tensors: dict[str, torch.Tensor], about: object) -> None:
        stored.append(sum(tensor.nbytes for tensor in tensors.values()))

    monkeypatch.setattr("datagen.fleet.training.save_state", store)
    train_fleet(work(tmp_path, (2, 4), rows=rows))
    assert len(stored) == 4
    plan = Plan("point_robot_wind", ((2, 4),), rows, 0, tmp_path, workers=1)
    most = max(old + new for old, new in pairwise(stored))
    assert 0.85 < most / state_bytes(plan, (2,)) <= 1


def test_the_groups_that_are_trained_at_once_store_the_most(tmp_path: Path) -> None:
    rows = budget("walker_params", "standard")
    plan = Plan("walker_params", rows.groups(range(40)), rows, 0, tmp_path, workers=2)
    # A file of 20 tasks has 360,000 steps of 42 numbers, the one before 340,000; and networks.
    memory = 2 * 20 * (360_000 + 340_000) * 42 * 4
    assert 1 < state_bytes(plan, plan.tasks) / memory < 1.02
    alone = dataclasses.replace(plan, workers=1)
    assert 0.5 < state_bytes(alone, plan.tasks) / memory < 0.52
    assert state_bytes(plan, (3, 5)) < state_bytes(alone, plan.tasks)
    assert state_bytes(plan, ()) == 0
    apart = dataclasses.replace(plan, budget=dataclasses.replace(rows, fleet=None))
    assert state_bytes(apart, plan.tasks) == 0
