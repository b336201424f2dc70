"""The replay memory: what goes in comes out, task by task."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from gymnasium import spaces

from datagen.fleet.memory import FleetMemory
from tests.datagen.fleet.fleets import generators

OBS, ACTS = 3, 2
OBS_SPACE = spaces.Box(-np.inf, np.inf, (OBS,), np.float32)
ACTION_SPACE = spaces.Box(-1, 1, (ACTS,), np.float32)


def memory(steps: int, tasks: int = 2, first: int = 0) -> FleetMemory:
    return FleetMemory(
        steps * tasks,
        OBS_SPACE,
        ACTION_SPACE,
        n_envs=tasks,
        generators=generators(tasks, first),
        optimize_memory_usage=False,
    )


def numbered(step: int, task: int) -> np.ndarray[Any, np.dtype[np.float32]]:
    """A row in which every number says which step, task and place it is of."""
    return (1000 * step + 100 * task + np.arange(2 * OBS + ACTS + 1)).astype(np.float32)


def add(
    to: FleetMemory,
    step: int,
    done: tuple[bool, ...] | None = None,
    infos: list[dict[str, Any]] | None = None,
) -> None:
    rows = np.stack([numbered(step, task) for task in range(to.n_envs)])
    parts = np.split(rows, [OBS, OBS + ACTS, 2 * OBS + ACTS], axis=1)
    over = np.zeros(to.n_envs, np.bool_) if done is None else np.array(done)
    said = infos or [{} for _ in range(to.n_envs)]
    to.add(parts[0], parts[2], parts[1], parts[3][:, 0], over, said)


def test_what_was_added_is_what_is_sampled() -> None:
    held = memory(4)
    for step in range(4):
        add(held, step)
    batch = held.sample(200)
    shapes = [(2, 200, size) for size in (OBS, ACTS, OBS, 1, 1)]
    assert [tuple(part.shape) for part in batch[:5]] == shapes
    assert all(part.dtype == torch.float32 for part in batch[:5])
    parts = [batch.observations, batch.actions, batch.next_observations, batch.rewards]
    rows = torch.cat(parts, dim=2).numpy()
    seen = set()
    for task in range(2):
        for row in rows[task]:
            step = int(row[0]) // 1000
            np.testing.assert_array_equal(row, numbered(step, task))
            seen.add((task, step))
    assert seen == {(task, step) for task in range(2) for step in range(4)}
    assert not batch.dones.any()


def test_only_what_is_there_is_sampled() -> None:
    held = memory(50)
    for step in range(3):
        add(held, step)
        assert held.size() == held.pos == step + 1
        assert held.sample(100).observations[:, :, 0].max() == 1000 * step + 100
    counts = np.bincount((held.sample(6000).observations[0, :, 0] / 1000).int())
    # Each of three rows in a third of the draws; a standard deviation is 37.
    np.testing.assert_allclose(counts, 2000, atol=200)


def test_a_time_limit_is_no_end_and_a_terminal_is() -> None:
    held = memory(5, tasks=1)
    add(held, 0)
    add(held, 1, (True,), [{"TimeLimit.truncated": True}])
    add(held, 2, (True,), [{"TimeLimit.truncated": False}])
    add(held, 3, (True,), [{}])
    add(held, 4, (False,), [{"TimeLimit.truncated": False}])
    batch = held.sample(300)
    ends = {
        int(obs // 1000): float(done)
        for obs, done in zip(batch.observations[0, :, 0], batch.dones[0, :, 0], strict=True)
    }
    assert ends == {0: 0.0, 1: 0.0, 2: 1.0, 3: 1.0, 4: 0.0}


def test_the_ends_are_each_tasks_own() -> None:
    held = memory(1)
    add(held, 0, (False, True), [{}, {"TimeLimit.truncated": False}])
    assert held.sample(1).dones[:, 0, 0].tolist() == [0.0, 1.0]


def test_a_tasks_samples_do_not_depend_on_the_others() -> None:
    three, one = memory(9, tasks=3), memory(9, tasks=1, first=1)
    for step in range(9):
        add(three, step)
        add(one, step)
    many, alone = three.sample(64), one.sample(64)
    # Task 1 is task 0 where it is alone; its rows say 100 less then.
    drawn = (many.observations[:, :, 0] // 1000).int()
    assert torch.equal(drawn[1], (alone.observations[0, :, 0] // 1000).int())
    assert not torch.equal(drawn[0], drawn[1])
    assert not torch.equal(drawn, (three.sample(64).observations[:, :, 0] // 1000).int())


def test_rows_are_drawn_into_an_array_and_split_where_they_are() -> None:
    held, again = memory(9), memory(9)
    for step in range(9):
        add(held, step)
        add(again, step)
    into = np.zeros((2, 64, 2 * OBS + ACTS + 2), np.float32)
    held.draw(into)
    parts, wanted = held.split(torch.from_numpy(into)), again.sample(64)
    for part, one in zip(parts[:5], wanted[:5], strict=True):
        assert torch.equal(part, one)
    into[:] = 5.0
    assert all((part == 5.0).all() for part in parts[:5])


def test_steps_are_not_shared() -> None:
    with pytest.raises(NotImplementedError, match="tasks have steps of their own"):
        memory(1)._get_samples(np.zeros(1, np.int64))


def test_it_never_overwrites() -> None:
    held = memory(2)
    add(held, 0)
    add(held, 1)
    with pytest.raises(ValueError, match="the replay memory is full: it holds 2 steps a task"):
        add(held, 2)
    assert held.sample(50).observations.max() < 2000


def test_it_holds_at_least_what_was_asked_for() -> None:
    made = FleetMemory(7, OBS_SPACE, ACTION_SPACE, n_envs=3, generators=generators(3))
    assert made.buffer_size == 3
    assert made.rows.shape == (3, 3, 2 * OBS + ACTS + 2)


def test_added_arrays_are_copied() -> None:
    held, obs = memory(1, tasks=1), np.ones((1, OBS), np.float32)
    held.add(obs, obs, np.zeros((1, ACTS), np.float32), np.zeros(1), np.zeros(1, np.bool_), [{}])
    obs[:] = 5.0
    batch = held.sample(1)
    assert batch.observations.tolist() == [[[1.0] * OBS]]
    batch.observations[:] = 7.0
    assert held.sample(1).observations.tolist() == [[[1.0] * OBS]]
