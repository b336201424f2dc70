"""One episode of a legacy folder made rows of a dataset, and held against its task."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datagen.columns import COLUMNS, SPARSE_COLUMN
from datagen.files import DatasetError
from datagen.legacy_files import Episode, LegacyTask, read_episode
from meta_envs import Definition, resolve, task_set
from meta_envs.point_robot import PointRobot
from meta_envs.registry import definition

Columns = dict[str, NDArray[Any]]
TOLERANCE = 1e-4
"""Largest difference between a number in a file and the same computed anew from float32 ones."""


@dataclass(frozen=True)
class Source:
    """What all episodes of a legacy folder have in common.

    Attributes:
        env: short name of the environment.
        width: numbers of an observation in the files.
        surplus: how many of them, at the end, are zeros the environment does not have.
        rewards: `as stepped`, or `dense` where the environment's own are sparse.
    """

    env: str
    width: int
    surplus: int
    rewards: str

    @property
    def definition(self) -> Definition:
        """The environment's functions."""
        return definition(self.env)

    @property
    def verifiable(self) -> bool:
        """Whether a step of the environment can be computed from its observation."""
        return isinstance(self.definition, PointRobot)


def probe(env: str, task: LegacyTask) -> Source:
    """What the first episode of a folder says of all.

    Raises:
        DatasetError: it is damaged or does not fit the environment.
    """
    path = task.stochastic[0].path
    episode = read_episode(path)
    wanted = int(definition(env).observation_space.shape[0])
    width = episode.observations.shape[1]
    try:
        if width < wanted:
            raise ValueError(f"has observations of {width} numbers, {env} of {wanted}")
        source = Source(env, width, width - wanted, "as stepped")
        if not source.definition.sparse:
            return source
        if not source.verifiable:
            raise ValueError(f"lacks the dense rewards that datasets of {env} have")
        computed = _computed(_rows(episode, source), task.task, source.definition)
        dense = float(np.abs(computed[SPARSE_COLUMN] - episode.rewards).max()) <= TOLERANCE
        return Source(env, width, width - wanted, "dense" if dense else "as stepped")
    except ValueError as error:
        raise DatasetError(path, str(error), "choose another --env") from error


def to_columns(episode: Episode, task: int, checkpoint: int, source: Source) -> Columns:
    """The rows of one episode, numbered 0.

    It ends in a terminal where it is shorter than the environment's time limit and tasks of the
    environment can end by themselves, and in a timeout otherwise.

    Args:
        episode: as read.
        task: row of the environment's task set.
        checkpoint: what the column `checkpoint` says.
        source: what it shares with the others.

    Raises:
        ValueError: it does not fit the environment, its task or the other episodes.
    """
    rows = _rows(episode, source)
    length, limit = len(episode), resolve(source.env).horizon
    if length > limit:
        raise ValueError(f"has {length} steps, an episode of {source.env} at most {limit}")
    if source.verifiable:
        rows = _verified(rows, task, source)
    last = np.arange(length) == length - 1
    terminal = length < limit and _can_end(source.definition)
    columns = {
        **rows,
        "terminals": last & terminal,
        "timeouts": last & (not terminal),
        "episode": np.zeros(length),
        "checkpoint": np.full(length, checkpoint),
    }
    return {name: columns[name].astype(COLUMNS[name]) for name in COLUMNS if name in columns}


def _rows(episode: Episode, source: Source) -> Columns:
    """Observations, actions and rewards, checked for sizes, range and order."""
    width, wanted = source.width, source.width - source.surplus
    if episode.observations.shape[1] != width:
        raise ValueError(
            f"has observations of {episode.observations.shape[1]} numbers, other files of {width}"
        )
    both = np.stack([episode.observations, episode.next_observations])
    if both[:, :, wanted:].any():
        raise ValueError(
            f"has observations of {width} numbers, {source.env} of {wanted}, and not all of the "
            "others are zero"
        )
    observations, next_observations = both[:, :, :wanted].astype(np.float32)
    actions = episode.actions.astype(np.float32)
    size = int(source.definition.action_space.shape[0])
    if actions.shape[1] != size:
        raise ValueError(f"has actions of {actions.shape[1]} numbers, {source.env} of {size}")
    outside = np.flatnonzero((np.abs(actions) > 1).any(axis=1))
    if len(outside):
        raise ValueError(f"has an action outside [-1, 1] in step {outside[0]}")
    torn = np.flatnonzero((next_observations[:-1] != observations[1:]).any(axis=1))
    if len(torn):
        raise ValueError(f"does not go on after step {torn[0]} where that step led to")
    return {
        "observations": observations,
        "actions": actions,
        "rewards": episode.rewards,
        "next_observations": next_observations,
    }


def _computed(rows: Mapping[str, NDArray[Any]], task: int, env: Definition) -> Columns:
    """Next states and rewards of the same actions, by the environment's own functions."""
    states, actions, next_states = (
        rows[name].astype(np.float64) for name in ("observations", "actions", "next_observations")
    )
    params = np.repeat(task_set(env.name).params[task : task + 1], len(states), axis=0)
    reward, terms = env.reward(states, actions, next_states, params)
    found = {"next_observations": env.advance(states, actions, params), "rewards": reward}
    return {**found, SPARSE_COLUMN: terms["dense_reward"]} if env.sparse else found


def _verified(rows: Columns, task: int, source: Source) -> Columns:
    """The rows, with both kinds of reward, if they are what the task's environment would do."""
    computed = _computed(rows, task, source.definition)
    dense = source.rewards == "dense"
    given = {SPARSE_COLUMN if dense else "rewards": rows["rewards"]}
    for name, values in {**given, "next_observations": rows["next_observations"]}.items():
        difference = np.abs(values - computed[name]).reshape(len(values), -1).max(axis=1)
        wrong = np.flatnonzero(difference > TOLERANCE)
        if len(wrong):
            what = "next observation" if name == "next_observations" else "reward"
            raise ValueError(
                f"is not of task {task} of {source.env}: the {what} of step {wrong[0]} differs by "
                f"{difference[wrong[0]]:.3g} from what that task gives"
            )
    both = {name: computed[name] for name in ("rewards", SPARSE_COLUMN) if name in computed}
    return {**rows, **both, **given}


def _can_end(env: Definition) -> bool:
    """Whether tasks of an environment can end by themselves, before the time limit."""
    # No task that can end at all goes on from states like these.
    (start,) = env.initial_state([np.random.default_rng(0)])
    impossible = np.array([[np.nan], [np.inf], [-np.inf]])
    return bool(env.terminated(np.repeat(impossible, len(start), axis=1)).any())
