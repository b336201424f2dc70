"""What a collection shows while it runs: bars on a terminal, lines elsewhere.

The lines: one a task, and one every tenth of the training of a group of tasks.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from types import TracebackType
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn

from datagen.budgets import Budget

FLEET_ROLLOUTS = 0.2
"""A guess at the part of a fleet's collection that comes after its training, for the time left."""


class TimeLeft:
    """Estimate of the time a collection still needs, from the updates done so far.

    Updates take nearly all of the time; the random steps before them are passed over quickly.
    """

    def __init__(
        self, jobs: int, budget: Budget, clock: Callable[[], float] = time.monotonic
    ) -> None:
        """Start the clock.

        Args:
            jobs: tasks to collect.
            budget: of each.
            clock: seconds from any moment on.
        """
        self._clock, self._begun = clock, clock()
        self._jobs, self._budget = jobs, budget
        self._parts: dict[int, float] = {}

    def step(self, task: int, step: int) -> None:
        """A task is at a training step."""
        part = max(0.0, (step - self._budget.random_steps) / self._budget.updates)
        self._parts[task] = part * (1.0 - FLEET_ROLLOUTS if self._budget.fleet else 1.0)

    def done(self, task: int) -> None:
        """A task is finished."""
        self._parts[task] = 1.0

    def seconds(self) -> float | None:
        """Seconds left; None while there is nothing to go by."""
        part = sum(self._parts.values()) / self._jobs
        if part < 0.002:
            return None
        return (self._clock() - self._begun) * (1.0 - part) / part


def duration(seconds: float) -> str:
    """A length of time for people, such as `40 s`, `12 min`, `3.5 h`."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    if seconds < 5400:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.1f} h"


def _name(tasks: tuple[int, ...]) -> str:
    return f"task {tasks[0]}" if len(tasks) == 1 else f"tasks {tasks[0]} to {tasks[-1]}"


class CollectionDisplay:
    """Progress of a collection; a context manager."""

    def __init__(self, console: Console, total: int, jobs: int, budget: Budget) -> None:
        """Set up.

        Args:
            console: where to show it.
            total: tasks asked for, finished ones among them.
            jobs: tasks to collect now.
            budget: of each.
        """
        self._console, self._budget = console, budget
        self._total, self._finished = total, total - jobs
        self._left = TimeLeft(jobs, budget)
        self._starts: dict[int, float] = {}
        self._bars: dict[int, TaskID] = {}
        self._tenths: dict[int, int] = {}
        self._progress: Progress | None = None
        if console.is_terminal:
            self._progress = Progress(
                TextColumn("{task.description}"),
                BarColumn(),
                MofNCompleteColumn(),
                TextColumn("{task.fields[note]}"),
                console=console,
                transient=True,
            )
            self._overall = self._progress.add_task(
                "tasks", total=total, completed=self._finished, note=""
            )

    def __enter__(self) -> CollectionDisplay:
        """Start the bars, on a terminal."""
        if self._progress:
            self._progress.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Take the bars away."""
        if self._progress:
            self._progress.stop()

    def started(self, tasks: tuple[int, ...]) -> None:
        """A worker has taken a task, or a group of them to train."""
        for task in tasks:
            self._starts[task] = time.monotonic()
        if self._progress:
            self._bars[tasks[0]] = self._progress.add_task(
                _name(tasks), total=self._budget.checkpoints[-1], note="starting"
            )

    def step(self, tasks: tuple[int, ...], step: int) -> None:
        """The training of these tasks is at this step of each."""
        for task in tasks:
            self._left.step(task, step)
        if self._progress:
            note = "random steps" if step <= self._budget.random_steps else "learning"
            if step >= self._budget.checkpoints[-1]:
                note = "rolling out"
            self._progress.update(self._bars[tasks[0]], completed=step, note=note)
            self._show_overall()
        elif len(tasks) > 1:
            self._print_tenth(tasks, step)

    def _print_tenth(self, tasks: tuple[int, ...], step: int) -> None:
        last = self._budget.checkpoints[-1]
        tenth = 10 * step // last
        if tenth > self._tenths.get(tasks[0], 0):
            self._tenths[tasks[0]] = tenth
            line = f"{_name(tasks)}: step {step} of {last}{self._rest()}"
            self._console.print(line, soft_wrap=True, highlight=False)

    def trained(self, tasks: tuple[int, ...]) -> None:
        """A group is trained; its tasks are rolled out next, each alone."""
        if self._progress:
            self._progress.remove_task(self._bars.pop(tasks[0]))

    def done(self, task: int, returns: dict[str, Any]) -> None:
        """A task's file is written; `returns` are those of its meta."""
        self._left.done(task)
        self._finished += 1
        if self._progress:
            self._progress.remove_task(self._bars.pop(task))
            self._show_overall()
        self._console.print(self._line(task, returns), soft_wrap=True, highlight=False)

    def _line(self, task: int, returns: dict[str, Any]) -> str:
        last = returns["behavior"][str(self._budget.checkpoints[-1])]
        took = duration(time.monotonic() - self._starts.pop(task))
        return (
            f"task {task} ({self._finished}/{self._total}): behaviour {last:.2f}, random "
            f"{returns['random']:.2f}, expert {returns['expert']:.2f}; {took}{self._rest()}"
        )

    def _rest(self) -> str:
        seconds = self._left.seconds()
        if seconds is None or self._finished == self._total:
            return ""
        return f", about {duration(seconds)} left"

    def _show_overall(self) -> None:
        if self._progress:
            note = self._rest().removeprefix(", ")
            self._progress.update(self._overall, completed=self._finished, note=note)
