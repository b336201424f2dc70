"""How long a collection would take, from a second or two of it, and what its trainings store."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence
from contextlib import suppress
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from datagen.budgets import Budget
from datagen.job import Job
from datagen.plan import Plan
from datagen.rollout import rollout
from meta_envs.registry import definition

MEASURED_SECONDS = 1.5
"""Seconds of learning a measurement takes, at least."""
START_SECONDS = 5.0
"""Seconds until a new worker has loaded torch."""


class _EnoughError(Exception):
    """The measurement has lasted long enough."""


class _Stopwatch:
    """Times the steps of a training from the moment its updates begin."""

    def __init__(self, first: int) -> None:
        self.first = first
        self.marks: list[tuple[int, float]] = []

    def report(self, step: int) -> None:
        if step <= self.first:
            return
        self.marks.append((step, time.perf_counter()))
        if self.marks[-1][1] - self.marks[0][1] > MEASURED_SECONDS:
            raise _EnoughError

    def seconds_a_step(self) -> float:
        (a, begin), (b, end) = self.marks[0], self.marks[-1]
        return (end - begin) / (b - a)


def seconds_a_learning_step(env: str, budget: Budget) -> float:
    """Measured seconds of one environment step and one update, on this machine and one thread."""
    from datagen.behavior import REPORT_EVERY, train_policies

    random_steps = 2 * REPORT_EVERY
    # The first updates are slow: memory is allocated and code is loaded.
    watch = _Stopwatch(random_steps + 2 * REPORT_EVERY)
    endless = dataclasses.replace(
        budget, steps=10**5, random_steps=random_steps, checkpoints=(10**5,)
    )
    with suppress(_EnoughError):
        train_policies(env, 0, endless, 0, watch.report)
    return watch.seconds_a_step()


def seconds_a_fleet_step(plan: Plan) -> float:
    """Measured seconds of one environment step and one update of all tasks of a group."""
    from datagen.fleet.training import FleetJob, Reports, learner

    random_steps = 2 * plan.budget.sac.update_every
    watch = _Stopwatch(2 * random_steps)
    endless = dataclasses.replace(
        plan.budget, steps=10**5, random_steps=random_steps, checkpoints=(10**5,)
    )
    group = plan.groups[0]
    jobs = tuple(Job(plan.env, task, endless, 0, plan.folder, group) for task in group)
    model = learner(FleetJob(jobs, plan.device))
    with suppress(_EnoughError):
        model.learn(10**5 * len(group), Reports(watch.report, plan.budget.sac.update_every))
    return watch.seconds_a_step()


def seconds_a_rollout(env: str, episodes: int) -> float:
    """Measured seconds of one checkpoint's episodes."""

    def still(obs: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        return zeros, zeros

    zeros = np.zeros((episodes, *definition(env).action_space.shape), np.float32)
    begin = time.perf_counter()
    rollout(env, 0, still, 0, episodes, np.random.default_rng(0))
    return time.perf_counter() - begin


def seconds_of(plan: Plan, missing: Sequence[int]) -> float:
    """About how long the tasks of a plan that are missing take, its workers side by side."""
    budget = plan.budget
    if budget.fleet:
        update = seconds_a_fleet_step(plan)
        jobs = sum(not set(missing).isdisjoint(group) for group in plan.groups)
    else:
        update, jobs = seconds_a_learning_step(plan.env, budget), len(missing)
    learning = budget.updates * update * -(-jobs // plan.workers)
    rollouts = len(budget.checkpoints) * seconds_a_rollout(plan.env, budget.episodes)
    return START_SECONDS + learning + rollouts * -(-len(missing) // plan.workers)


def state_bytes(plan: Plan, missing: Sequence[int]) -> int:
    """Most bytes of the files that a plan's trainings go on from, as long as tasks are missing.

    Of the groups that are trained at once, the file before stays until the file of a checkpoint is
    whole, and each holds the replay memory so far. A group's last file has none.
    """
    sizes = [len(group) for group in plan.groups if not set(missing).isdisjoint(group)]
    if plan.budget.fleet is None:
        return 0
    env, budget = definition(plan.env), plan.budget
    obs, acts = env.observation_space.shape[0], env.action_space.shape[0]
    actor = _parameters((obs, *budget.sac.hidden, 2 * acts))
    critic = _parameters((obs + acts, *budget.sac.hidden, 1))
    # Rows of `FleetMemory`.
    memory = (2 * obs + acts + 2) * sum(budget.checkpoints[-3:-1])
    # Adam's two averages beside each, two target critics, and the actor at every checkpoint.
    networks = (3 + len(budget.checkpoints)) * actor + 8 * critic
    training = sum(sorted(sizes)[-plan.workers :])
    return 4 * (training * (memory + 2 * networks) + (sum(sizes) - training) * networks)


def _parameters(sizes: Sequence[int]) -> int:
    """Weights and biases of a network with layers of so many units."""
    return sum((a + 1) * b for a, b in pairwise(sizes))
