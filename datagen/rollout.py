"""From a policy to the columns of a dataset: all episodes of a checkpoint side by side."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from datagen.columns import COLUMNS
from meta_envs import MetaVectorEnv

Floats32 = NDArray[np.float32]
Distribution = Callable[[Floats32], tuple[Floats32, Floats32]]
"""Observations [n, O] -> mean and log standard deviation [n, A] of a normal before the tanh."""
Columns = dict[str, NDArray[Any]]


def rollout(
    env: str,
    task: int,
    policy: Distribution,
    checkpoint: int,
    episodes: int,
    generator: np.random.Generator | None,
) -> Columns:
    """Episodes of a tanh-normal policy on one task.

    Args:
        env: any of the environment's names.
        task: row of its task set.
        policy: acts as tanh(mean + std * noise).
        checkpoint: what the column `checkpoint` says of every row.
        episodes: how many, numbered from 0.
        generator: of the reset seeds and the noise; None for the policy's mean action and
            reset seeds from 0 on.

    Returns:
        The columns of `datagen.dataset`, episode after episode, N rows. Rewards are float32;
        `next_observations` of an episode's last row is the state it ended in.
    """
    # In this mode a finished sub-environment first returns the state it ended in. It then plays
    # on, unrecorded, until the longest episode is over.
    many = MetaVectorEnv(
        env, tasks=[task] * episodes, autoreset_mode=AutoresetMode.NEXT_STEP, threads=1
    )
    seeds = range(episodes) if generator is None else generator.integers(2**31, size=episodes)
    obs, _ = many.reset(seed=[int(seed) for seed in seeds])
    running = np.ones(episodes, dtype=np.bool_)
    number = np.arange(episodes)
    steps: list[list[NDArray[Any]]] = []
    while running.any():
        mean, log_std = policy(obs)
        if generator is None:
            action = np.tanh(mean)
        else:
            noise = generator.standard_normal(mean.shape, dtype=np.float32)
            action = np.tanh(mean + np.exp(log_std) * noise)
        next_obs, reward, terminated, truncated, info = many.step(action)
        marks = np.full(episodes, checkpoint)
        # Reaching a real end in the last step of all is no timeout.
        timeouts = truncated & ~terminated
        row = [obs, action, reward, next_obs, terminated, timeouts, number, marks]
        if many.definition.sparse:
            row.append(info["dense_reward"])
        steps.append([running.copy(), *row])
        running &= ~(terminated | truncated)
        obs = next_obs
    return _flatten(steps)


def _flatten(steps: list[list[NDArray[Any]]]) -> Columns:
    """Columns of the rows that were recorded, episode by episode."""
    # [T, E, ...] of each column, then episodes first; the mask flattens to rows.
    stacked = [np.swapaxes(np.stack(part), 0, 1) for part in zip(*steps, strict=True)]
    recorded, values = stacked[0], stacked[1:]
    return {
        name: value[recorded].astype(COLUMNS[name])
        for name, value in zip(COLUMNS, values, strict=False)
    }


def join(parts: list[Columns]) -> Columns:
    """One set of columns after another, episodes numbered through."""
    columns = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    counts = [int(part["episode"][-1]) + 1 for part in parts]
    shifts = np.cumsum([0, *counts[:-1]], dtype=np.int64)
    sizes = [len(part["episode"]) for part in parts]
    columns["episode"] += np.repeat(shifts, sizes).astype(np.int32)
    return columns


def episode_returns(columns: Columns) -> NDArray[np.float64]:
    """Undiscounted return of each episode, from the stored rewards, [episodes]."""
    totals = np.bincount(columns["episode"], weights=columns["rewards"])
    return totals.astype(np.float64)
