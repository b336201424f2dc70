"""What learning curves far beyond a budget say of it."""

from __future__ import annotations

from pathlib import Path

import budget_curves
import numpy as np
import pytest
from budget_curves import Curves, enough_steps, long_budget

from datagen.budgets import budget


@pytest.mark.parametrize(
    ("env", "steps", "random", "first"),
    [("point_robot", 20_000, 2_000, 2_500), ("hopper_params", 800_000, 10_000, 20_000)],
)
def test_a_quarter_of_a_long_budget_begins_as_in_the_papers(
    env: str, steps: int, random: int, first: int
) -> None:
    found = long_budget(env, steps)
    assert (found.steps, found.random_steps) == (steps, random)
    assert (found.checkpoints[0], found.checkpoints[-1]) == (first, steps)
    assert found.sac == budget(env, "standard").sac


def test_steps_that_do_not_fit_are_refused() -> None:
    with pytest.raises(ValueError, match="--steps must be a multiple of 800, got 1000"):
        long_budget("point_robot", 1_000)


def test_shares_of_four_times_the_steps(tmp_path: Path) -> None:
    marks = np.arange(1, 13) * 100
    # A task that learns all it will in 200 steps, and one that needs 700.
    returns = np.array([np.clip(marks / 200, 0, 1), np.clip(marks / 700, 0, 1)]) * 10 - 5
    curves = Curves(np.array([3, 8]), np.array([-5.0, -5.0]), marks, returns)
    # Means of up to three checkpoints: 100; 100 and 200; 100 to 300 over those of four times them.
    worth = (np.clip(marks / 200, 0, 1) + np.clip(marks / 700, 0, 1)) * 5
    wanted = [worth[0] / worth[1:4].mean(), worth[:2].mean() / worth[5:8].mean()]
    wanted.append(worth[:3].mean() / worth[9:12].mean())
    assert list(curves.shares) == [100, 200, 300]
    np.testing.assert_allclose(list(curves.shares.values()), wanted)
    budget_curves.write(curves, tmp_path / "curves.csv")
    found = budget_curves.read(tmp_path / "curves.csv")
    for name in ("tasks", "random", "marks", "returns"):
        np.testing.assert_array_equal(getattr(found, name), getattr(curves, name))


def test_enough_is_enough_from_there_on() -> None:
    assert enough_steps({100: 0.95, 200: 0.8, 300: 0.91, 400: 0.99}) == 300
    assert enough_steps({100: 0.95, 200: 0.8}) is None
