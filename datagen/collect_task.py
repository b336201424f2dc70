"""The work on one task, from its policies to its file; run in a worker process."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from datagen.dataset import TaskData, task_file, write_task
from datagen.groups import rows_text
from datagen.job import Job, Stream, origin, policy_file
from datagen.rollout import episode_returns, join, rollout
from meta_envs import TaskSet, reference_returns, task_set

if TYPE_CHECKING:
    from datagen.behavior import Policy


def references(job: Job) -> dict[str, float]:
    """Returns of the reference controllers on this task, by the controller's name."""
    tasks = task_set(job.env)
    row = tasks.params[job.task : job.task + 1].copy()
    alone = TaskSet(tasks.env, tasks.param_names, row, np.array([0]), tasks.sampler)
    found = reference_returns(alone, job.budget.reference_episodes, job.number(Stream.REFERENCE))
    return {name: float(values[0]) for name, values in found.items()}


def _policies(job: Job, report: Callable[[int], None]) -> list[Policy]:
    """A task's policies: trained here, or before in a fleet."""
    if job.budget.fleet:
        from datagen.fleet.training import trained_policies

        return trained_policies(job)
    from datagen.behavior import train_policies

    return train_policies(job.env, job.task, job.budget, job.number(Stream.TRAINING), report)


def _export(job: Job, folder: Path) -> None:
    from datagen.fleet.export import export_policy, sac_of
    from datagen.fleet.training import trained_networks

    path = policy_file(folder, job.task)
    export_policy(path, sac_of(job.env, job.task, job.budget, trained_networks(job)))


def collect_task(job: Job, report: Callable[[int], None] = lambda step: None) -> dict[str, Any]:
    """Train a task's behaviour policy, roll its checkpoints out and write the task's file.

    A fleet's policies must have been trained before, by `datagen.fleet.training.train_fleet`. The
    file depends on the job alone: not on the process or on what ran before, nor on other tasks, but
    for the last digits of a fleet's weights, which depend on the job's group.

    Args:
        job: what to do.
        report: told the number of training steps every now and then.

    Returns:
        The `returns` of the file's meta.

    Raises:
        DatasetError: the file of the task's group is damaged, of another training, not finished or
            not there.
        OSError: the file could not be written; nothing is left of it.
    """
    policies = _policies(job, report)
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
        "split": tasks.split_of(job.task),
        "returns": returns,
    }
    if job.budget.fleet:
        meta["group"] = rows_text(job.group)
    if job.policies is not None:
        # Before the task's file: once that is there, a task is done.
        _export(job, job.policies)
    write_task(job.folder / task_file(job.task), TaskData(job.task, join(parts), meta))
    return returns
