"""Reference returns of tasks, and the normalised score they define."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from meta_envs.definition import Controller, Definition, Floats
from meta_envs.env import MetaVectorEnv
from meta_envs.registry import definition
from meta_envs.tasks import TaskSet

RANDOM_EPISODES = Definition.random_episodes
"""Episodes a task behind the random policy's return, where the environment does not differ."""


def _episode_returns(env: MetaVectorEnv, controller: Controller) -> Floats:
    """Return of one episode in every sub-environment, [num_envs]."""
    env.reset(seed=0)
    total = np.zeros(env.num_envs)
    running = np.ones(env.num_envs, dtype=np.bool_)
    while running.any():
        _, reward, terminated, truncated, _ = env.step(controller(env.state, env.params))
        total += np.where(running, reward, 0.0)
        running &= ~(terminated | truncated)
    return total


def reference_returns(
    tasks: TaskSet, episodes: int | None = None, seed: int = 0, threads: int | None = None
) -> dict[str, Floats]:
    """Undiscounted returns of the reference controllers on exactly these tasks.

    Args:
        tasks: any task set, the environment's own, a part of it or fresh tasks.
        episodes: episodes a task of the random policy; the environment's own number by default.
        seed: of the random policy's private generator.
        threads: that step the environments; as many as there are by default. No number depends on
            them.

    Returns:
        `random` (uniform actions, mean of `episodes`) and one entry for each controller of the
        environment, such as `oracle` (the exact optimum, where one is known) or `still` (no
        action, one episode); each float64 [n_tasks].
    """
    rows = np.arange(len(tasks))
    generator = np.random.default_rng(seed)

    def uniform(state: Floats, params: Floats) -> Floats:
        return generator.uniform(-1.0, 1.0, shape)

    if episodes is None:
        episodes = definition(tasks.env).random_episodes
    repeated = np.repeat(rows, episodes)
    many = MetaVectorEnv(tasks.env, tasks=repeated, task_set=tasks, threads=threads)
    shape = (many.num_envs, *many.definition.action_space.shape)
    found = {"random": _episode_returns(many, uniform).reshape(len(tasks), episodes).mean(axis=1)}
    for name, controller in many.definition.controllers.items():
        one = MetaVectorEnv(tasks.env, tasks=rows, task_set=tasks, threads=threads)
        found[name] = _episode_returns(one, controller)
    return found


def normalized_score(
    episode_return: ArrayLike, random: ArrayLike, expert: ArrayLike
) -> NDArray[np.float64]:
    """100 (R - random) / (expert - random): 0 is the random policy, 100 the expert.

    Args:
        episode_return: returns R, any shape.
        random: return of the random policy on the same tasks.
        expert: return of the expert on the same tasks.

    Returns:
        float64, of the shape the three broadcast to; NaN where the expert is no better than the
        random policy, since there is no scale then.
    """
    low, high = np.asarray(random, np.float64), np.asarray(expert, np.float64)
    scale = np.where(high > low, high - low, np.nan)
    return np.asarray(100.0 * (np.asarray(episode_return, np.float64) - low) / scale)
