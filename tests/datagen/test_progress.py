"""What a collection shows: the lines, the bars, the estimate."""

from __future__ import annotations

import io
import re
from dataclasses import replace

import pytest
from rich.console import Console

from datagen.budgets import budget
from datagen.progress import CollectionDisplay, TimeLeft, duration

PAPER = replace(budget("point_robot", "paper"), fleet=None)
RETURNS = {"random": -28.8, "expert": -5.1, "behavior": {"4800": -6.914}, "deterministic": {}}


class Clock:
    """A clock that stands still until it is moved."""

    now = 100.0

    def __call__(self) -> float:
        return self.now


def test_time_left_follows_the_updates() -> None:
    clock = Clock()
    left = TimeLeft(4, PAPER, clock)
    clock.now += 1.0
    left.step(0, 2000)
    assert left.seconds() is None, "random steps say nothing about the time of updates"
    clock.now += 9.0
    left.step(0, 2000 + 1400)
    # An eighth of all updates took ten seconds.
    assert left.seconds() == pytest.approx(70.0)
    clock.now += 10.0
    left.done(0)
    assert left.seconds() == pytest.approx(60.0)
    for task in (1, 2, 3):
        left.done(task)
    assert left.seconds() == 0.0


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(0.2, "0 s"), (12, "12 s"), (89, "89 s"), (90, "2 min"), (5399, "90 min"), (9000, "2.5 h")],
)
def test_duration(seconds: float, text: str) -> None:
    assert duration(seconds) == text


def collect_two_of_three(console: Console) -> None:
    with CollectionDisplay(console, 3, 2, PAPER) as display:
        for task in (3, 8):
            display.started((task,))
            for step in (1000, 3000, 4800):
                display.step((task,), step)
            display.done(task, RETURNS)


def test_a_line_a_task_off_the_terminal() -> None:
    out = io.StringIO()
    collect_two_of_three(Console(file=out, width=40))
    first, last = out.getvalue().splitlines()
    numbers = r"behaviour -6\.91, random -28\.80, expert -5\.10; 0 s"
    assert re.fullmatch(rf"task 3 \(2/3\): {numbers}, about 0 s left", first)
    assert re.fullmatch(rf"task 8 \(3/3\): {numbers}", last)


def test_a_group_of_tasks_is_trained_first() -> None:
    out, rows = io.StringIO(), budget("hopper_params", "smoke")
    console = Console(file=out, force_terminal=True, width=100, color_system=None)
    returns = {**RETURNS, "behavior": {"400": 31.5}}
    with CollectionDisplay(console, 3, 3, rows) as display:
        display.started((3, 4, 8))
        display.step((3, 4, 8), 300)
        assert display._progress is not None
        display._progress.refresh()
        training = out.getvalue()
        display.step((3, 4, 8), 400)
        display.trained((3, 4, 8))
        for task in (3, 4, 8):
            display.started((task,))
            display.done(task, returns)
    assert re.search(r"tasks 3 to 8 +\S+ +300/400 +learning", training)
    for count, task in enumerate((3, 4, 8), start=1):
        assert f"task {task} ({count}/3): behaviour 31.50" in out.getvalue()


def test_a_line_a_tenth_of_a_groups_training_off_the_terminal() -> None:
    out, rows = io.StringIO(), budget("hopper_params", "smoke")
    with CollectionDisplay(Console(file=out, width=40), 3, 3, rows) as display:
        display.started((3, 4, 8))
        for step in (20, 39, 40, 50, 290, 400):
            display.step((3, 4, 8), step)
    first, second, last = out.getvalue().splitlines()
    assert first == "tasks 3 to 8: step 40 of 400", "random steps tell no time"
    assert re.fullmatch(r"tasks 3 to 8: step 290 of 400, about \d+ s left", second)
    assert re.fullmatch(r"tasks 3 to 8: step 400 of 400, about \d+ s left", last)


def test_a_fleets_training_is_not_all_of_its_time() -> None:
    clock, rows = Clock(), budget("hopper_params", "smoke")
    left = TimeLeft(2, rows, clock)
    clock.now += 10.0
    for task in (0, 1):
        left.step(task, 300)
    # Half of the updates, which are four fifths of everything.
    assert left.seconds() == pytest.approx(15.0)
    for task in (0, 1):
        left.step(task, 400)
    assert left.seconds() == pytest.approx(2.5)


def test_bars_on_a_terminal() -> None:
    out = io.StringIO()
    console = Console(file=out, force_terminal=True, width=100, color_system=None)
    with CollectionDisplay(console, 3, 2, PAPER) as display:
        display.started((3,))
        display.step((3,), 1000)
        display.started((8,))
        display.step((8,), 4800)
        assert display._progress is not None
        display._progress.refresh()
        shown = out.getvalue()
        display.done(8, RETURNS)
        display._progress.refresh()
    assert re.search(r"tasks +\S+ +1/3 +about 0 s left", shown)
    assert re.search(r"task 3 +\S+ +1000/4800 +random steps", shown)
    assert re.search(r"task 8 +\S+ +4800/4800 +rolling out", shown)
    assert "task 8 (2/3): behaviour -6.91" in out.getvalue()
