"""What a collection is asked to do: which tasks, where, and what that will cost."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from datagen.budgets import Budget
from datagen.columns import COLUMNS
from meta_envs import TaskSet, resolve
from meta_envs.registry import definition

_SPAN = re.compile(r"(\d+)(?:-(\d+))?")
_SHARD = re.compile(r"(\d+)/(\d+)")


@dataclass(frozen=True)
class Plan:
    """A collection.

    Attributes:
        env: short name of the environment.
        groups: rows of its task set to have in the end, rising; those of a group are trained side
            by side.
        budget: how much of each.
        seed: of the dataset.
        folder: the dataset's.
        workers: processes at most.
        device: where a fleet learns, torch's name for it.
        policies: folder for a fleet's last policies as files of Stable-Baselines3's, or None.
        ray: address of the Ray cluster that does the work, or None for processes of this machine.
    """

    env: str
    groups: tuple[tuple[int, ...], ...]
    budget: Budget
    seed: int
    folder: Path
    workers: int
    device: str = "cpu"
    policies: Path | None = None
    ray: str | None = None

    @property
    def tasks(self) -> tuple[int, ...]:
        """The tasks of all groups."""
        return tuple(task for group in self.groups for task in group)

    @property
    def rows(self) -> int:
        """Transitions of a task, at most: episodes may end early in some environments."""
        return self.budget.total_episodes * resolve(self.env).horizon

    @property
    def row_bytes(self) -> int:
        """Bytes of a transition in a file."""
        env = definition(self.env)
        widths = {
            "observations": env.observation_space.shape[0],
            "next_observations": env.observation_space.shape[0],
            "actions": env.action_space.shape[0],
        }
        return sum(
            dtype.itemsize * widths.get(name, 1)
            for name, dtype in COLUMNS.items()
            if env.sparse or name != "dense_rewards"
        )


def parse_tasks(text: str | None, tasks: TaskSet) -> tuple[int, ...]:
    """Rows that a text such as `0-9,12` names, rising and each once; all of them for None.

    Raises:
        ValueError: the text is something else, or a row is out of range.
    """
    if text is None:
        return tuple(range(len(tasks)))
    rows: set[int] = set()
    for part in text.split(","):
        match = _SPAN.fullmatch(part.strip())
        first = int(match[1]) if match else 1
        last = int(match[2] or first) if match else 0
        if first > last:
            raise ValueError(f"--tasks takes numbers and ranges such as 0-9,12, got '{text}'")
        if last >= len(tasks):
            raise ValueError(f"--tasks: {tasks.env} has tasks 0 to {len(tasks) - 1}, got '{text}'")
        rows.update(range(first, last + 1))
    return tuple(sorted(rows))


def parse_shard(text: str | None, groups: Sequence[tuple[int, ...]]) -> tuple[tuple[int, ...], ...]:
    """The groups of shard `i/n`, every n-th from the i-th on; all of them for None.

    Groups stay whole, so that the shards together make the bytes that one collection makes.

    Raises:
        ValueError: the text is something else, i is not below n, or the shard is empty.
    """
    if text is None:
        return tuple(groups)
    match = _SHARD.fullmatch(text.strip())
    index, count = (int(match[1]), int(match[2])) if match else (0, 0)
    if index >= count:
        raise ValueError(f"--shard takes i/n with i from 0 to n - 1, such as 0/8, got '{text}'")
    if index >= len(groups):
        there = "is 1 group" if len(groups) == 1 else f"are {len(groups)} groups"
        raise ValueError(
            f"--shard {text} is empty: of these tasks there {there}, take n <= {len(groups)} or a "
            "smaller --fleet-size"
        )
    return tuple(groups[index::count])
