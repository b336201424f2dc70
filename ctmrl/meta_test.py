"""The two-phase meta-test: explore at random, then with the policy, then score fresh episodes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ctmrl.networks import Actor, Encoder
from meta_envs import MetaVectorEnv, TaskSet

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class MetaTestConfig:
    """How much an agent may explore a task before it is scored."""

    random_episodes: int = 10
    """Phase one: episodes of uniformly random actions."""
    policy_episodes: int = 10
    """Phase two: episodes of the stochastic policy, each on the context of all before it."""
    scored_episodes: int = 1
    """Fresh episodes of the deterministic policy on the final context, their mean is the return."""
    repetitions: int = 4
    """Independent repetitions of the whole adaptation of each task."""


class MetaTestResult(NamedTuple):
    """What a meta-test of n tasks gave; E exploration episodes, R repetitions.

    Attributes:
        returns: final return of each repetition and task, [R, n].
        curve: return of one deterministic episode after 0..E exploration episodes, mean over
            repetitions, [E + 1, n].
        contexts: final context of each repetition and task, [R, n, Z].
    """

    returns: Floats
    curve: Floats
    contexts: NDArray[np.float32]


class _Adaptation:
    """Many tasks side by side in one vector environment, each with a context that grows."""

    def __init__(self, env: MetaVectorEnv, encoder: Encoder, actor: Actor, seed: int) -> None:
        self.env, self.encoder, self.actor = env, encoder, actor
        self.dense = encoder.sees_dense_reward and env.definition.sparse
        self.shape = env.action_space.shape or ()
        self.params = torch.tensor(env.params, dtype=torch.float32)
        self.noise = np.random.default_rng(seed)
        self.generator = torch.Generator().manual_seed(seed)
        self.total = torch.zeros(env.num_envs, encoder.z_dim, dtype=torch.float64)
        self.count = torch.zeros(env.num_envs, 1, dtype=torch.float64)
        env.reset(seed=seed)

    @property
    def z(self) -> Tensor:
        """What the policy is given: contexts so far, [num_envs, Z]; 0 before any transition."""
        mean = (self.total / self.count.clamp_min(1.0)).float()
        return self.encoder.told(mean, self.params)

    def random(self, obs: Tensor) -> NDArray[np.float32]:
        """Uniform actions."""
        return self.noise.uniform(-1.0, 1.0, self.shape).astype(np.float32)

    def stochastic(self, z: Tensor) -> Callable[[Tensor], NDArray[np.float32]]:
        """The policy's samples on fixed contexts."""
        return lambda obs: self.actor.sample(obs, z, self.generator).action.numpy()

    def deterministic(self, z: Tensor) -> Callable[[Tensor], NDArray[np.float32]]:
        """The policy's means on fixed contexts."""
        return lambda obs: self.actor.act(obs, z).numpy()

    def episode(self, act: Callable[[Tensor], NDArray[np.float32]], explore: bool) -> Floats:
        """Returns [num_envs] of one episode each; `explore` adds its transitions to the context."""
        obs, _ = self.env.reset()
        running = np.ones(self.env.num_envs, dtype=np.bool_)
        returns = np.zeros(self.env.num_envs)
        while running.any():
            action = act(torch.from_numpy(obs))
            next_obs, reward, terminated, truncated, info = self.env.step(action)
            returns += np.where(running, reward, 0.0)
            if explore:
                seen = info["dense_reward"] if self.dense else reward
                rows = (obs, action, seen[:, None].astype(np.float32), next_obs)
                encoded = self.encoder.encode(torch.from_numpy(np.concatenate(rows, axis=1)))
                keep = torch.from_numpy(running)[:, None]
                self.total += torch.where(keep, encoded.double(), 0.0)
                self.count += keep
            running &= ~(terminated | truncated)
            obs = next_obs
        return returns


@torch.no_grad()
def meta_test(
    encoder: Encoder,
    actor: Actor,
    tasks: TaskSet,
    rows: NDArray[np.int64],
    config: MetaTestConfig,
    seed: int,
) -> MetaTestResult:
    """Adapt to each task and score it, all tasks and repetitions side by side.

    Args:
        encoder: makes contexts from transitions.
        actor: acts on contexts.
        tasks: the task set.
        rows: n tasks of it.
        config: the protocol.
        seed: of random actions, policy noise and the environments.
    """
    repetitions = config.repetitions
    env = MetaVectorEnv(tasks.env, tasks=np.tile(rows, repetitions), task_set=tasks)
    adaptation = _Adaptation(env, encoder, actor, seed)

    def score() -> Floats:
        return adaptation.episode(adaptation.deterministic(adaptation.z), explore=False)

    curve = []
    for episode in range(config.random_episodes + config.policy_episodes):
        curve.append(score())
        if episode < config.random_episodes:
            adaptation.episode(adaptation.random, explore=True)
        else:
            adaptation.episode(adaptation.stochastic(adaptation.z), explore=True)
    scored = np.mean([score() for _ in range(config.scored_episodes)], axis=0)
    curve.append(scored)
    shape = (repetitions, len(rows))
    return MetaTestResult(
        scored.reshape(shape),
        np.stack(curve).reshape(-1, *shape).mean(axis=1),
        adaptation.z.numpy().reshape(*shape, -1),
    )
