"""The stages of a collection: which jobs they run where, and what they say of them."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from datagen import ray_jobs, stages
from datagen.collect_task import collect_task
from datagen.fleet.training import FleetJob, train_fleet
from datagen.job import Job
from datagen.plan import Plan
from datagen.progress import CollectionDisplay
from datagen.stages import collect_tasks, train_groups
from datagen.workers import Event, WorkerError
from tests.datagen.fleet.fleets import TINY

GROUPS = ((0, 1), (2, 3), (5,))
PLAN = Plan("point_robot_wind", GROUPS, TINY, 0, Path(), 7)
RETURNS = {"random": -3.0, "expert": -1.0, "behavior": {"60": -2.0}}


def jobs_of(plan: Plan) -> list[Job]:
    return [
        Job(plan.env, task, plan.budget, plan.seed, plan.folder, group)
        for group in plan.groups
        for task in group
    ]


class Runner:
    """In place of both `run_jobs`: remembers how it was called, and every job is done at once."""

    def __init__(self, fails: int | None = None) -> None:
        self.fails = fails
        self.calls: list[tuple[Any, ...]] = []

    def __call__(
        self, work: Callable[..., Any], jobs: Sequence[Any], workers: int, *gpus: int
    ) -> Iterator[Event[Any]]:
        self.calls.append((work, jobs, workers, *gpus))
        return self.events(jobs)

    def events(self, jobs: Sequence[Any]) -> Iterator[Event[Any]]:
        for index, job in enumerate(jobs):
            yield Event(index, "started")
            yield Event(index, "step", 40)
            if index == self.fails:
                raise WorkerError(index, "it burns")
            yield Event(index, "done", None if isinstance(job, FleetJob) else RETURNS)


def display(out: io.StringIO) -> CollectionDisplay:
    console = Console(file=out, force_terminal=True, width=100, color_system=None)
    return CollectionDisplay(console, 5, 5, TINY)


def test_only_groups_with_a_missing_task_are_trained(monkeypatch: pytest.MonkeyPatch) -> None:
    runner = Runner()
    monkeypatch.setattr(stages, "run_jobs", runner)
    jobs = jobs_of(PLAN)
    with display(io.StringIO()) as shown:
        train_groups(jobs, [jobs[1], jobs[4]], PLAN, shown)
    fleets = [FleetJob(tuple(jobs[:2])), FleetJob((jobs[4],))]
    assert runner.calls == [(train_fleet, fleets, 7)]


def test_every_task_wanted_is_made(monkeypatch: pytest.MonkeyPatch) -> None:
    runner, out = Runner(), io.StringIO()
    monkeypatch.setattr(stages, "run_jobs", runner)
    jobs = jobs_of(PLAN)
    with display(out) as shown:
        collect_tasks(jobs[2:4], PLAN, shown)
    assert runner.calls == [(collect_task, jobs[2:4], 7)]
    assert "task 2 (1/5): behaviour -2.00" in out.getvalue()
    assert "task 3 (2/5): behaviour -2.00" in out.getvalue()


@pytest.mark.parametrize(("device", "gpus"), [("cpu", 0), ("cuda", 1), ("cuda:3", 1)])
def test_ray_gives_a_device_to_a_training_alone(
    device: str, gpus: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    runner = Runner()
    monkeypatch.setattr(ray_jobs, "run_jobs", runner)
    plan = replace(PLAN, device=device, ray="auto")
    jobs = jobs_of(plan)
    with display(io.StringIO()) as shown:
        train_groups(jobs, jobs[4:], plan, shown)
        collect_tasks(jobs[4:], plan, shown)
    fleets = [FleetJob((jobs[4],), device.removesuffix(":3"))]
    assert runner.calls == [(train_fleet, fleets, 7, gpus), (collect_task, jobs[4:], 7, 0)]


def test_a_failure_names_its_tasks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stages, "run_jobs", Runner(fails=1))
    jobs = jobs_of(PLAN)
    with display(io.StringIO()) as shown:
        with pytest.raises(WorkerError, match=r"^tasks 2-3: it burns$"):
            train_groups(jobs, jobs, PLAN, shown)
        with pytest.raises(WorkerError, match=r"^task 1: it burns$"):
            collect_tasks(jobs, PLAN, shown)
