"""A fleet's tasks as the vector environment Stable-Baselines3 expects."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvStepReturn

from meta_envs import MetaVectorEnv


class FleetVecEnv(VecEnv):
    """One sub-environment a task, paid the dense reward where there is one.

    What `info` says is what Stable-Baselines3 reads: at an episode's end "terminal_observation",
    "TimeLimit.truncated", and "episode" with its return "r", its length "l" and its task.
    """

    def __init__(self, env: str, tasks: Sequence[int], threads: int = 1) -> None:
        """Make the sub-environments.

        Args:
            env: any of the environment's names.
            tasks: rows of its task set.
            threads: native threads.
        """
        self._many = MetaVectorEnv(
            env, tasks=list(tasks), autoreset_mode=AutoresetMode.SAME_STEP, threads=threads
        )
        self.render_mode = None
        super().__init__(
            len(tasks), self._many.single_observation_space, self._many.single_action_space
        )
        self._sparse = self._many.definition.sparse
        self._tasks = list(tasks)
        self._start_seeds: list[int | None] = [None] * len(tasks)
        self._returns = np.zeros(len(tasks))
        self._lengths = np.zeros(len(tasks), dtype=np.int64)
        self._actions: NDArray[np.float32] | None = None

    def seed_tasks(self, seeds: Sequence[int]) -> None:
        """Seeds of the next reset, one a task."""
        self._start_seeds = list(seeds)

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Stable-Baselines3's way: task i gets seed + i."""
        if seed is not None:
            self._start_seeds = [seed + row for row in range(self.num_envs)]
        return self._start_seeds

    def reset(self) -> NDArray[np.float32]:
        """Start an episode of every task.

        Returns:
            Observations [task, O], float32.
        """
        obs, _ = self._many.reset(seed=self._start_seeds)
        self._start_seeds = [None] * self.num_envs
        self._returns[:], self._lengths[:] = 0.0, 0
        return obs

    def step_async(self, actions: NDArray[np.float32]) -> None:
        """Keep the actions for `step_wait`.

        Args:
            actions: [task, A], in [-1, 1].
        """
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        """One step of every task, with the actions of `step_async`.

        Returns:
            Observations [task, O] and rewards [task], float32; whether the episode ended [task];
            and a dict a task, empty inside an episode. Where one ended, the observation is the
            first of the next.
        """
        assert self._actions is not None, "step_async() comes first"
        obs, reward, terminated, truncated, info = self._many.step(self._actions)
        paid = info["dense_reward"] if self._sparse else reward
        self._returns += paid
        self._lengths += 1
        done = terminated | truncated
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for row in np.flatnonzero(done).tolist():
            infos[row] = {
                "terminal_observation": info["final_obs"][row],
                "TimeLimit.truncated": bool(truncated[row] and not terminated[row]),
                "episode": {
                    "r": float(self._returns[row]),
                    "l": int(self._lengths[row]),
                    "task": self._tasks[row],
                },
            }
            self._returns[row], self._lengths[row] = 0.0, 0
        return obs, paid.astype(np.float32), done, infos

    def close(self) -> None:
        """Nothing to close."""

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """An attribute of all sub-environments, which share it."""
        return [getattr(self._many, attr_name)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Refused: sub-environments have nothing to set."""
        raise AttributeError(f"sub-environments of a fleet have no {attr_name} to set")

    def env_method(
        self, method_name: str, *args: Any, indices: VecEnvIndices = None, **kwargs: Any
    ) -> list[Any]:
        """Refused: sub-environments are no objects."""
        raise AttributeError(f"sub-environments of a fleet have no method {method_name}")

    def env_is_wrapped(self, wrapper_class: type[Any], indices: VecEnvIndices = None) -> list[bool]:
        """False for each."""
        return [False for _ in self._get_indices(indices)]
