"""The two stages of a collection, training fleets and making the tasks' files, as jobs."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import closing
from typing import Protocol, TypeVar

from datagen.collect_task import collect_task
from datagen.groups import rows_text
from datagen.job import Job
from datagen.plan import Plan
from datagen.progress import CollectionDisplay
from datagen.workers import Event, WorkerError, run_jobs


class _HasTasks(Protocol):
    @property
    def tasks(self) -> tuple[int, ...]: ...


J = TypeVar("J", bound=_HasTasks)
R = TypeVar("R")


def train_groups(
    jobs: Sequence[Job], wanted: Sequence[Job], plan: Plan, display: CollectionDisplay
) -> None:
    """Train the groups of all wanted tasks, as far as that has not been done.

    Args:
        jobs: of all tasks of the plan.
        wanted: of those whose files are missing.
        plan: where it is done.
        display: told what happens.

    Raises:
        DatasetError: the file of a group is damaged or of another training.
        WorkerError: a group could not be trained.
    """
    from datagen.fleet.training import FleetJob, check_group, train_fleet

    groups = {job.group for job in wanted}
    # Ray gives each of its processes a device of its own, which is the first one they see.
    device = plan.device.partition(":")[0] if plan.ray else plan.device
    fleets = [
        FleetJob(tuple(job for job in jobs if job.group == group), device)
        for group in plan.groups
        if group in groups
    ]
    for fleet in fleets:
        check_group(fleet)
    missing = {job.task for job in wanted}
    for fleet, event in _events(train_fleet, fleets, plan, int(device.startswith("cuda"))):
        # Some of a group may be finished, where a file of it was lost.
        tasks = tuple(task for task in fleet.tasks if task in missing)
        if event.kind == "started":
            display.started(tasks)
        elif event.kind == "done":
            display.trained(tasks)
        elif isinstance(event.value, int):
            display.step(tasks, event.value)


def collect_tasks(jobs: Sequence[Job], plan: Plan, display: CollectionDisplay) -> None:
    """Make the tasks' files; without a fleet, their policies are trained first.

    Args:
        jobs: of the tasks.
        plan: where it is done.
        display: told what happens.

    Raises:
        WorkerError: a task could not be done.
    """
    for job, event in _events(collect_task, jobs, plan):
        if event.kind == "started":
            display.started(job.tasks)
        elif isinstance(event.value, int):
            display.step(job.tasks, event.value)
        elif event.value is not None:
            display.done(job.task, event.value)


def _events(
    work: Callable[[J, Callable[[int], None]], R], jobs: Sequence[J], plan: Plan, gpus: int = 0
) -> Iterator[tuple[J, Event[R]]]:
    """Run jobs; each event with its job, and a failure with its tasks' numbers."""
    try:
        with closing(_run(work, jobs, plan, gpus)) as events:
            for event in events:
                yield jobs[event.index], event
    except WorkerError as error:
        where = rows_text(jobs[error.index].tasks)
        noun = "task" if len(jobs[error.index].tasks) == 1 else "tasks"
        raise WorkerError(error.index, f"{noun} {where}: {error}") from None


def _run(
    work: Callable[[J, Callable[[int], None]], R], jobs: Sequence[J], plan: Plan, gpus: int
) -> Generator[Event[R], None, None]:
    if plan.ray is None:
        return run_jobs(work, jobs, plan.workers)
    from datagen import ray_jobs

    return ray_jobs.run_jobs(work, jobs, plan.workers, gpus)
