"""Train the behaviour policies of a group of tasks side by side, with a state to go on from."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.sac.policies import Actor
from torch import Tensor

from datagen.behavior import REPORT_EVERY, Policy
from datagen.files import DatasetError
from datagen.finished import difference
from datagen.fleet.algorithm import FleetSAC
from datagen.fleet.state import (
    learner_counts,
    learner_tensors,
    load_state,
    network_tensors,
    restore,
    save_state,
)
from datagen.fleet.vec_env import FleetVecEnv
from datagen.job import Job, Stream, group_file, origin
from meta_envs.registry import definition


@dataclass(frozen=True)
class FleetJob:
    """The training of a group of tasks.

    Attributes:
        jobs: the tasks', all of one environment, budget, seed and folder.
        device: torch's.
    """

    jobs: tuple[Job, ...]
    device: str = "cpu"

    @property
    def tasks(self) -> tuple[int, ...]:
        """Rows of the task set."""
        return self.jobs[0].group

    @property
    def path(self) -> Path:
        """Where the state is, and in the end the policies."""
        return group_file(self.jobs[0].folder, self.jobs[0].group)

    @property
    def origin(self) -> dict[str, Any]:
        """What must be the same to go on from a state."""
        first = self.jobs[0]
        return {
            **origin(first.env, first.budget, first.seed),
            "group": list(first.group),
        }


class Reports(BaseCallback):
    """Tells how far every task is, in steps of each."""

    def __init__(self, report: Callable[[int], None], every: int = REPORT_EVERY) -> None:
        """Set up.

        Args:
            report: told the number of steps.
            every: so many steps.
        """
        super().__init__()
        self.report, self.every = report, every

    def _on_step(self) -> bool:
        steps = self.num_timesteps // self.model.n_envs
        if steps % self.every == 0:
            self.report(steps)
        return True


def learner(work: FleetJob) -> FleetSAC:
    """A fleet at its start. Sets the number of torch's threads to one."""
    torch.set_num_threads(1)
    first = work.jobs[0]
    budget, fleet = first.budget, first.budget.fleet
    if fleet is None or fleet.precision == "auto":
        raise ValueError(f"the budget {budget.name} does not say how a fleet learns")
    model = FleetSAC(
        FleetVecEnv(first.env, first.group),
        budget.sac,
        [job.stream(Stream.TRAINING) for job in work.jobs],
        budget.checkpoints[-1],
        budget.random_steps,
        fleet.precision,
        work.device,
    )
    model.set_logger(Logger(folder=None, output_formats=[]))
    return model


def check_group(work: FleetJob) -> None:
    """Raise a DatasetError if a group has a file that its training cannot go on from."""
    if work.path.exists():
        _read(work.path, work.origin)


def train_fleet(work: FleetJob, report: Callable[[int], None] = lambda step: None) -> None:
    """Train every task of a group up to the last checkpoint and leave the policies in its file.

    All episodes are begun anew at a checkpoint, so that a state needs nothing of the environment's.
    Killed and called again, this goes on from the last checkpoint and ends in the same bytes. Sets
    the number of torch's threads to one.

    Args:
        work: the group.
        report: told the number of steps of each task every now and then.

    Raises:
        DatasetError: the group's file is damaged or of another training.
        OSError: it cannot be written.
    """
    budget = work.jobs[0].budget
    policies, counts, model = _begin(work)
    done = counts["checkpoint"]
    for mark in [mark for mark in budget.checkpoints if mark > done]:
        _train_to(model, work, mark, report)
        for index, weight in enumerate(model.policy.actor.parameters()):
            policies[f"actor.{mark}.{index}"] = weight.detach().cpu().clone()
        last = mark == budget.checkpoints[-1]
        counts = {"checkpoint": mark, **({} if last else learner_counts(model))}
        rest = network_tensors(model) if last else learner_tensors(model)
        save_state(work.path, {**policies, **rest}, {"origin": work.origin, **counts})


def _begin(work: FleetJob) -> tuple[dict[str, Tensor], dict[str, Any], FleetSAC]:
    """Policies so far, counts and the learner: of the group's file, or at the start."""
    model = learner(work)
    if not work.path.exists():
        return {}, {"checkpoint": 0}, model
    tensors, counts = _read(work.path, work.origin)
    policies = {name: value for name, value in tensors.items() if name.startswith("actor.")}
    if "generators" in counts:
        try:
            restore(model, tensors, counts)
        except ValueError as error:
            raise _foreign(work.path, str(error)) from error
    return policies, counts, model


def _train_to(model: FleetSAC, work: FleetJob, mark: int, report: Callable[[int], None]) -> None:
    env = model.get_env()
    assert isinstance(env, FleetVecEnv)
    seeds = [job.stream(Stream.TRAINING, mark).generate_state(1)[0] for job in work.jobs]
    env.seed_tasks([int(seed) for seed in seeds])
    # Without a last observation Stable-Baselines3 resets the environment.
    model._last_obs = None
    steps = mark * model.n_envs - model.num_timesteps
    model.learn(steps, Reports(report), log_interval=10**9, reset_num_timesteps=False)


def _read(path: Path, wanted: dict[str, Any]) -> tuple[dict[str, Tensor], dict[str, Any]]:
    try:
        tensors, about = load_state(path)
    except ValueError as error:
        if isinstance(error, DatasetError):
            raise
        raise DatasetError(path, str(error), "delete it to train its tasks again") from error
    there = about.get("origin")
    found = difference(there if isinstance(there, Mapping) else {}, wanted)
    if found:
        raise _foreign(path, f"is of a collection with {found}")
    return tensors, about


def _foreign(path: Path, fault: str) -> DatasetError:
    return DatasetError(
        path, fault, "give the same options as then, or delete it to train its tasks again"
    )


def trained_policies(job: Job) -> list[Policy]:
    """A task's policies from its group's file, as Stable-Baselines3's actors.

    Raises:
        DatasetError: the file is damaged, not finished or not there.
    """
    tensors, env = _trained(job), definition(job.env)
    found = []
    for mark in job.budget.checkpoints:
        prefix = f"actor.{mark}."
        count = sum(name.startswith(prefix) for name in tensors)
        weights = [tensors[f"{prefix}{index}"] for index in range(count)]
        found.append(Policy(mark, actor(env.observation_space, env.action_space, weights)))
    return found


def trained_networks(job: Job) -> dict[str, Tensor]:
    """A task's networks after its last step, as `datagen.fleet.export.sac_of` takes them.

    Raises:
        DatasetError: the file is damaged, not finished or not there.
    """
    return {name.removeprefix("policy."): value for name, value in _trained(job).items()}


def _trained(job: Job) -> dict[str, Tensor]:
    """What a finished group's file has of one task."""
    path = group_file(job.folder, job.group)
    if not path.exists():
        raise DatasetError(path, "is missing", "run the same command again")
    wanted = {**origin(job.env, job.budget, job.seed), "group": list(job.group)}
    tensors, counts = _read(path, wanted)
    if counts["checkpoint"] != job.budget.checkpoints[-1]:
        raise DatasetError(path, "is not finished", "run the same command again")
    row = job.group.index(job.task)
    return {name: value[row] for name, value in tensors.items()}


def actor(
    observation_space: gymnasium.spaces.Box,
    action_space: gymnasium.spaces.Box,
    weights: list[Tensor],
) -> Actor:
    """Stable-Baselines3's actor of one task.

    Args:
        observation_space: of the task.
        action_space: of the task.
        weights: first every layer's weight [in, out], then every layer's bias [1, out].
    """
    layers = len(weights) // 2
    matrices, biases = weights[:layers], weights[layers:]
    made = Actor(
        observation_space,
        action_space,
        net_arch=[matrix.shape[1] for matrix in matrices[:-1]],
        features_extractor=FlattenExtractor(observation_space),
        features_dim=int(np.prod(observation_space.shape)),
    )
    state = {}
    for layer, (matrix, bias) in enumerate(zip(matrices[:-1], biases[:-1], strict=True)):
        # Between its linear layers are the ReLUs.
        state[f"latent_pi.{2 * layer}.weight"] = matrix.T
        state[f"latent_pi.{2 * layer}.bias"] = bias[0]
    size = action_space.shape[0]
    for name, part in (("mu", slice(0, size)), ("log_std", slice(size, 2 * size))):
        state[f"{name}.weight"] = matrices[-1][:, part].T
        state[f"{name}.bias"] = biases[-1][0, part]
    made.load_state_dict(state)
    made.set_training_mode(False)
    return made
