"""Small fleets for tests."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.logger import Logger

from datagen.budgets import Budget, FleetSettings, Precision, SACSettings, budget
from datagen.fleet.algorithm import FleetSAC
from datagen.fleet.training import FleetJob
from datagen.fleet.vec_env import FleetVecEnv
from datagen.job import Job

SETTINGS = SACSettings(
    hidden=(16, 8),
    learning_rate=1e-3,
    batch_size=16,
    gamma=0.97,
    tau=0.02,
    update_every=10,
    initial_temperature=0.3,
)
TINY = replace(
    budget("point_robot_wind", "smoke"),
    sac=replace(SETTINGS, hidden=(5,)),
    steps=60,
    random_steps=30,
    checkpoints=(40, 60),
    fleet=FleetSettings(2, "float32"),
)
"""Seconds would be too long for what is done over and over."""


NEVER = 10**9
"""Episodes between two dumps of a logger that is not looked at."""


def generators(count: int, first: int = 0) -> list[np.random.Generator]:
    return [np.random.default_rng([7, first + row]) for row in range(count)]


def fleet(
    tasks: Sequence[int],
    env: str = "hopper_params",
    steps: int = 400,
    random_steps: int = 40,
    precision: Precision = "float32",
    settings: SACSettings = SETTINGS,
    device: str = "cpu",
) -> FleetSAC:
    """A fleet at its start; a task's seeds depend on its number alone."""
    many = FleetVecEnv(env, tasks)
    many.seed_tasks([100 + task for task in tasks])
    seeds = [np.random.SeedSequence([3, task]) for task in tasks]
    model = FleetSAC(many, settings, seeds, steps, random_steps, precision, device)
    model.set_logger(Logger(folder=None, output_formats=[]))
    return model


def parameters(model: FleetSAC, task: int) -> dict[str, NDArray[np.float32]]:
    """All of one task's parameters, by name; `task` is its place in the fleet."""
    named = {name: value[task] for name, value in model.policy.state_dict().items()}
    named["log_temperature"] = model.log_temperature[task]
    return {name: value.detach().numpy().copy() for name, value in named.items()}


def work(
    folder: Path,
    tasks: tuple[int, ...] = (2, 4),
    seed: int = 0,
    rows: Budget = TINY,
    env: str = "point_robot_wind",
) -> FleetJob:
    """The training of a group of tasks."""
    return FleetJob(tuple(Job(env, task, rows, seed, folder, tasks) for task in tasks))
