"""The work on one task, from nothing to its file; run in a worker process."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from datagen.budgets import Budget
from datagen.dataset import FORMAT_VERSION, TaskData, task_file, write_task
from datagen.rollout import episode_returns, join, rollout
from meta_envs import TaskSet, reference_returns, resolve, task_set

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
    """

    env: str
    task: int
    budget: Budget
    seed: int
    folder: Path

    def stream(self, purpose: Stream, checkpoint: int = 0) -> np.random.SeedSequence:
        """Seeds that no other task, purpose or checkpoint shares."""
        return np.random.SeedSequence([self.seed, self.task, purpose, checkpoint])

    def number(self, purpose: Stream) -> int:
        """One seed below 2**32."""
        return int(self.stream(purpose).generate_state(1)[0])


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


def references(job: Job) -> dict[str, float]:
    """Returns of the reference controllers on this task, by the controller's name."""
    tasks = task_set(job.env)
    row = tasks.params[job.task : job.task + 1].copy()
    alone = TaskSet(tasks.env, tasks.param_names, row, np.array([0]), tasks.sampler)
    found = reference_returns(alone, job.budget.reference_episodes, job.number(Stream.REFERENCE))
    return {name: float(values[0]) for name, values in found.items()}


def collect_task(job: Job, report: Callable[[int], None] = lambda step: None) -> dict[str, Any]:
    """Train a task's behaviour policy, roll its checkpoints out and write the task's file.

    The file depends on the job alone: not on other tasks, on the process or on what ran before.

    Args:
        job: what to do.
        report: told the number of training steps every now and then.

    Returns:
        The `returns` of the file's meta.

    Raises:
        OSError: the file could not be written; nothing is left of it.
    """
    from datagen.behavior import train_policies

    policies = train_policies(job.env, job.task, job.budget, job.number(Stream.TRAINING), report)
    parts, behavior, deterministic = [], {}, {}
    for policy in policies:
        mark = policy.checkpoint
        generator = np.random.default_rng(job.stream(Stream.ROLLOUT, mark))
        part = rollout(job.env, job.task, policy, mark, job.budget.episodes, generator)
        once = rollout(job.env, job.task, policy, mark, 1, None)
        parts.append(part)
        behavior[str(mark)] = float(episode_returns(part).mean())
        deterministic[str(mark)] = float(episode_returns(once)[0])
    anchors = references(job)
    returns = {
        "random": anchors["random"],
        # Where no exact optimum is known, the best the task's own policy ever did stands for it.
        "expert": anchors.get("oracle", max(deterministic.values())),
        "behavior": behavior,
        "deterministic": deterministic,
    }
    tasks = task_set(job.env)
    meta = {
        **origin(job.env, job.budget, job.seed),
        "task": job.task,
        "params": tasks.params[job.task].tolist(),
        "split": "test" if job.task in tasks.test_tasks else "train",
        "returns": returns,
    }
    write_task(job.folder / task_file(job.task), TaskData(job.task, join(parts), meta))
    return returns
