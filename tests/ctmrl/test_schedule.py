"""The schedule: ten collections before each run of K-means, and none in vain."""

from __future__ import annotations

import pytest

from ctmrl.schedule import COLLECTIONS, Schedule


def table(schedule: Schedule, steps: int) -> tuple[list[int], dict[int, list[int]]]:
    """Steps that run K-means, and the slots filled at each step that fills any."""
    runs = [step for step in range(steps) if schedule.ends_interval(step)]
    slots = {step: list(schedule.slots(step)) for step in range(steps)}
    return runs, {step: found for step, found in slots.items() if found}


def test_round_numbers() -> None:
    runs, slots = table(Schedule(0.3, 0.05, 1000), 1000)
    assert runs == list(range(300, 1000, 50))
    # The first ten between 20 % and 30 % of the run, then ten within each 5 %.
    assert {step: found for step, found in slots.items() if step <= 300} == {
        200 + 10 * (k + 1): [k] for k in range(10)
    }
    for start in range(300, 950, 50):
        inside = {step: found for step, found in slots.items() if start < step <= start + 50}
        assert inside == {start + 5 * (k + 1): [k] for k in range(10)}


@pytest.mark.parametrize("steps", [7, 13, 31, 101, 499])
@pytest.mark.parametrize(("warm_up", "refresh"), [(0.3, 0.05), (0.1, 0.2), (0.55, 0.01)])
def test_every_slot_is_filled_once_before_each_run(
    steps: int, warm_up: float, refresh: float
) -> None:
    schedule = Schedule(warm_up, refresh, steps)
    runs, slots = table(schedule, steps)
    assert runs[0] == schedule.start == max(round(warm_up * steps), 1)
    previous = -1
    for run in runs:
        filled = [k for step in range(previous + 1, run + 1) for k in slots.get(step, [])]
        assert filled == list(range(COLLECTIONS))
        previous = run


def test_a_run_too_short_for_its_warm_up_never_clusters() -> None:
    assert table(Schedule(1.0, 0.05, 20), 20)[0] == []
