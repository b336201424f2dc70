"""The replay memory of a fleet: one array [step, task, ...], one row a transition."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.buffers import BaseBuffer
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.common.vec_env import VecNormalize
from torch import Tensor


class FleetMemory(BaseBuffer):
    """Transitions of all tasks, sampled task by task with generators of their own.

    A row holds observation, action, next observation, reward, and whether the task itself ended
    the episode; a time limit is no end. Unlike Stable-Baselines3's buffer this one must be long
    enough for everything: it never overwrites.
    """

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        device: torch.device | str = "cpu",
        n_envs: int = 1,
        generators: Sequence[np.random.Generator] = (),
        **ignored: object,
    ) -> None:
        """Set aside the memory; the system gives it page by page as it fills.

        Args:
            buffer_size: transitions of all tasks together.
            observation_space: of one task, a Box.
            action_space: of one task, a Box.
            device: of the samples.
            n_envs: number of tasks.
            generators: one a task, of the samples.
            ignored: what other buffers know.
        """
        super().__init__(
            -(-buffer_size // n_envs), observation_space, action_space, device, n_envs=n_envs
        )
        self._generators = generators
        size, acts = int(self.obs_shape[0]), self.action_dim
        self._ends = np.cumsum([size, acts, size, 1])
        self.rows = np.zeros((self.buffer_size, n_envs, 2 * size + acts + 2), dtype=np.float32)

    def add(
        self,
        obs: NDArray[np.float32],
        next_obs: NDArray[np.float32],
        action: NDArray[np.float32],
        reward: NDArray[Any],
        done: NDArray[np.bool_],
        infos: list[dict[str, Any]],
    ) -> None:
        """One step of every task, arrays [task, ...].

        Raises:
            ValueError: the memory is full.
        """
        if self.pos == self.buffer_size:
            raise ValueError(f"the replay memory is full: it holds {self.buffer_size} steps a task")
        row = self.rows[self.pos]
        parts = np.split(row, self._ends, axis=1)
        parts[0][...], parts[1][...], parts[2][...] = obs, action, next_obs
        parts[3][:, 0] = reward
        limits = [info.get("TimeLimit.truncated", False) for info in infos]
        parts[4][:, 0] = done & ~np.array(limits, dtype=np.bool_)
        self.pos += 1

    def sample(self, batch_size: int, env: VecNormalize | None = None) -> ReplayBufferSamples:
        """Transitions drawn with replacement, tensors [task, batch, ...]."""
        rows = np.empty((self.n_envs, batch_size, self.rows.shape[2]), dtype=np.float32)
        self.draw(rows)
        return self.split(torch.from_numpy(rows).to(self.device))

    def draw(self, into: NDArray[np.float32]) -> None:
        """Write rows drawn with replacement to an array [task, batch, row]."""
        steps = np.stack([one.integers(self.pos, size=into.shape[1]) for one in self._generators])
        flat = steps * self.n_envs + np.arange(self.n_envs)[:, None]
        # No step is out of bounds; to check that, NumPy would fill another array first.
        self.rows.reshape(-1, into.shape[2]).take(flat, axis=0, out=into, mode="clip")

    def split(self, rows: Tensor) -> ReplayBufferSamples:
        """The parts of rows [task, batch, row], views of the same memory."""
        obs, action, next_obs, reward, done = rows.tensor_split(self._ends.tolist(), dim=2)
        return ReplayBufferSamples(obs, action, next_obs, done, reward)

    def _get_samples(
        self, batch_inds: NDArray[np.int64], env: VecNormalize | None = None
    ) -> ReplayBufferSamples:
        raise NotImplementedError("a fleet's tasks have steps of their own, which sample() draws")
