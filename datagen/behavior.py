"""A task's behaviour policy: soft actor-critic of Stable-Baselines3, kept at checkpoints."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, SupportsFloat

import gymnasium
import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.sac.policies import Actor

from datagen.budgets import Budget
from meta_envs import resolve
from meta_envs.registry import definition

REPORT_EVERY = 50
"""Environment steps between two reports of progress."""


@dataclass(frozen=True, eq=False)
class Policy:
    """A behaviour policy as it was after a number of training steps.

    Attributes:
        checkpoint: the steps.
        actor: its network; not trained any more.
    """

    checkpoint: int
    actor: Actor

    def __call__(
        self, observations: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Mean and log standard deviation [n, A] of the action before its tanh, for [n, O]."""
        with torch.no_grad():
            mean, log_std, _ = self.actor.get_action_dist_params(torch.as_tensor(observations))
        return mean.numpy(), log_std.numpy()


class DenseReward(gymnasium.Wrapper[Any, Any, Any, Any]):
    """A sparse environment that pays its dense reward, which is what behaviour policies learn."""

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """One step; the reward is `info["dense_reward"]`."""
        obs, _, terminated, truncated, info = self.env.step(action)
        return obs, info["dense_reward"], terminated, truncated, info


class _KeepCheckpoints(BaseCallback):
    """Copies the actor at every checkpoint and ends the training at the last."""

    def __init__(self, checkpoints: tuple[int, ...], report: Callable[[int], None]) -> None:
        super().__init__()
        self.checkpoints, self.report = checkpoints, report
        self.policies: list[Policy] = []

    def _on_step(self) -> bool:
        if self.num_timesteps % REPORT_EVERY == 0:
            self.report(self.num_timesteps)
        if self.num_timesteps in self.checkpoints:
            assert isinstance(self.model, SAC)
            actor = copy.deepcopy(self.model.actor)
            actor.set_training_mode(False)
            self.policies.append(Policy(self.num_timesteps, actor))
        return self.num_timesteps < self.checkpoints[-1]


def training_environment(env: str, task: int) -> gymnasium.Env[Any, Any]:
    """The environment a behaviour policy learns in, with its time limit and the dense reward."""
    row = resolve(env)
    made = gymnasium.make(row.id, task=task, disable_env_checker=True)
    return DenseReward(made) if definition(row.name).sparse else made


def new_sac(env: str, task: int, budget: Budget, seed: int | None = None) -> SAC:
    """Stable-Baselines3's SAC of one task as a budget has it, before its first step."""
    settings = budget.sac
    return SAC(
        "MlpPolicy",
        training_environment(env, task),
        learning_rate=settings.learning_rate,
        buffer_size=budget.steps,
        learning_starts=budget.random_steps,
        batch_size=settings.batch_size,
        tau=settings.tau,
        gamma=settings.gamma,
        train_freq=settings.update_every,
        gradient_steps=settings.update_every,
        ent_coef=f"auto_{settings.initial_temperature}",
        policy_kwargs={
            "net_arch": list(settings.hidden),
            "optimizer_kwargs": {"fused": True},
        },
        seed=seed,
        device="cpu",
    )


def train_policies(
    env: str,
    task: int,
    budget: Budget,
    seed: int,
    report: Callable[[int], None] = lambda step: None,
) -> list[Policy]:
    """Train one task's behaviour policy up to the last checkpoint.

    Sets the number of torch's threads to one, and seeds the global random states, because
    Stable-Baselines3 draws from them: call it in a process of its own.

    Args:
        env: any of the environment's names.
        task: row of its task set.
        budget: how long and how.
        seed: below 2**32; it decides everything.
        report: told the number of steps every now and then.

    Returns:
        The policy at each of the budget's checkpoints.
    """
    torch.set_num_threads(1)
    keep = _KeepCheckpoints(budget.checkpoints, report)
    model = new_sac(env, task, budget, seed)
    # Without a logger of its own, each model would leave a folder among the temporary files.
    model.set_logger(Logger(folder=None, output_formats=[]))
    model.learn(budget.steps, callback=keep, log_interval=budget.steps)
    return keep.policies
