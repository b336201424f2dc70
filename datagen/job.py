"""A task to collect: its random streams, and where its data say that they come from."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from enum import IntEnum
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from datagen.budgets import Budget
from datagen.dataset import FORMAT_VERSION, task_file
from datagen.files import digest
from meta_envs import resolve, task_set

PACKAGES = ("numpy", "torch", "gymnasium", "stable-baselines3", "h5py", "mujoco")
"""Packages whose versions the bytes of a dataset may depend on."""


class Stream(IntEnum):
    """What a task's random streams are for; one number each, so that none is used twice."""

    TRAINING = 1
    ROLLOUT = 2
    REFERENCE = 3


@dataclass(frozen=True)
class Job:
    """One task to collect.

    Attributes:
        env: short name of the environment.
        task: row of its task set.
        budget: how much.
        seed: of the dataset.
        folder: where the task's file goes; it exists.
        group: tasks its policy is trained beside, itself among them, where the budget is a fleet's.
        policies: folder for its last policy as a file of Stable-Baselines3's, or None.
    """

    env: str
    task: int
    budget: Budget
    seed: int
    folder: Path
    group: tuple[int, ...] = ()
    policies: Path | None = None

    @property
    def tasks(self) -> tuple[int, ...]:
        """The task, as all the tasks a job is about."""
        return (self.task,)

    def stream(self, purpose: Stream, checkpoint: int = 0) -> np.random.SeedSequence:
        """Seeds that no other task, purpose or checkpoint shares."""
        return np.random.SeedSequence([self.seed, self.task, purpose, checkpoint])

    def number(self, purpose: Stream) -> int:
        """One seed below 2**32."""
        return int(self.stream(purpose).generate_state(1)[0])


STATE_FILES = ".fleet_*.safetensors"
"""What the names of `group_file` are like, for `Path.glob`."""


def group_file(folder: Path, group: tuple[int, ...]) -> Path:
    """The file of a group's training, no part of the dataset; it goes when its tasks are done."""
    name = digest(",".join(map(str, group)))[:8]
    return folder / f".fleet_{group[0]:03d}-{group[-1]:03d}_{name}.safetensors"


def policy_file(folder: Path, task: int) -> Path:
    """The file of a task's last policy in the folder for them, such as `task_003.zip`."""
    return folder / f"{task_file(task).removesuffix('.h5')}.zip"


def versions() -> dict[str, str]:
    """Versions of Python and of the packages the data depend on, without build tags."""
    found = {name.replace("-", "_"): metadata.version(name) for name in PACKAGES}
    python = ".".join(map(str, sys.version_info[:3]))
    return {"python": python, **{name: v.partition("+")[0] for name, v in found.items()}}


def origin(env: str, budget: Budget, seed: int) -> dict[str, Any]:
    """What all files of one dataset share: the part of `meta` that names no task.

    Args:
        env: any of the environment's names.
        budget: how much is collected of each task.
        seed: of the dataset.
    """
    row, tasks = resolve(env), task_set(env)
    return {
        "format_version": FORMAT_VERSION,
        "env": row.name,
        "env_id": row.id,
        "param_names": list(tasks.param_names),
        "task_hash": tasks.hash,
        "budget": budget.name,
        "seed": seed,
        "config": budget.config(),
        "versions": versions(),
    }
