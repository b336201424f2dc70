"""The table of environments: one row each, and how a user's spelling finds it."""

from __future__ import annotations

import difflib
import importlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING

import gymnasium

from meta_envs import checks

if TYPE_CHECKING:
    from meta_envs.definition import Definition
    from meta_envs.tasks import TaskSet

OwnTasks = Mapping[str, float] | Sequence[Mapping[str, float]]
"""Parameters of a task by their names, or of several tasks."""


@dataclass(frozen=True)
class Row:
    """One environment.

    Attributes:
        name: short name, for command lines and folders.
        id: Gymnasium id.
        alias: the field's hyphenated name.
        definition: `module:Class` of its Definition, imported only when it is needed.
        horizon: steps an episode.
        varies: what differs from task to task, a few words.
    """

    name: str
    id: str
    alias: str
    definition: str
    horizon: int
    varies: str


ENVIRONMENTS: dict[str, Row] = {
    row.name: row
    for row in (
        Row(
            "point_robot",
            "PointRobot-v0",
            "point-robot",
            "meta_envs.point_robot:PointRobot",
            20,
            "goal on the unit half circle",
        ),
        Row(
            "point_robot_wind",
            "PointRobotWind-v0",
            "point-robot-wind",
            "meta_envs.point_robot:PointRobotWind",
            25,
            "wind; the goal is always (1, 0)",
        ),
        Row(
            "sparse_point_robot",
            "SparsePointRobot-v0",
            "sparse-point-robot",
            "meta_envs.point_robot:SparsePointRobot",
            20,
            "goal on the unit half circle; reward only near it",
        ),
        Row(
            "half_cheetah_vel",
            "HalfCheetahVel-v0",
            "half-cheetah-vel",
            "meta_envs.half_cheetah:HalfCheetahVel",
            200,
            "target velocity, 1 to 3 m/s",
        ),
        Row(
            "hopper_params",
            "HopperRandParams-v0",
            "hopper-rand-params",
            "meta_envs.rand_params:HopperRandParams",
            200,
            "masses, inertias, damping, friction",
        ),
        Row(
            "walker_params",
            "WalkerRandParams-v0",
            "walker-rand-params",
            "meta_envs.rand_params:WalkerRandParams",
            200,
            "masses, inertias, damping, friction",
        ),
        Row(
            "ant_goal",
            "AntGoal-v0",
            "ant-goal",
            "meta_envs.ant:AntGoal",
            200,
            "goal on a circle of radius 2 m",
        ),
        Row(
            "half_cheetah_dir",
            "HalfCheetahDir-v0",
            "half-cheetah-dir",
            "meta_envs.half_cheetah:HalfCheetahDir",
            200,
            "direction: backwards or forwards",
        ),
        Row(
            "ant_dir",
            "AntDir-v0",
            "ant-dir",
            "meta_envs.ant:AntDir",
            200,
            "direction, all around",
        ),
        Row(
            "humanoid_dir",
            "HumanoidDir-v0",
            "humanoid-dir",
            "meta_envs.humanoid:HumanoidDir",
            200,
            "direction, all around",
        ),
        Row(
            "hopper_mass",
            "HopperMass-v0",
            "hopper-mass",
            "meta_envs.scaled_params:HopperMass",
            200,
            "one multiplier of masses and inertias",
        ),
        Row(
            "hopper_friction",
            "HopperFriction-v0",
            "hopper-friction",
            "meta_envs.scaled_params:HopperFriction",
            200,
            "one multiplier of all friction",
        ),
        Row(
            "walker_mass",
            "WalkerMass-v0",
            "walker-mass",
            "meta_envs.scaled_params:WalkerMass",
            200,
            "one multiplier of masses and inertias",
        ),
        Row(
            "walker_friction",
            "WalkerFriction-v0",
            "walker-friction",
            "meta_envs.scaled_params:WalkerFriction",
            200,
            "one multiplier of all friction",
        ),
    )
}


def register(row: Row) -> None:
    """Make an environment known to Gymnasium and by its short name, your own too.

    Args:
        row: what to call it and where its Definition is.

    Raises:
        ValueError: another environment has its name or its id.
    """
    if ENVIRONMENTS.get(row.name, row) is not row or row.id in gymnasium.registry:
        raise ValueError(f"there is an environment '{row.name}' or {row.id} already")
    gymnasium.register(
        id=row.id,
        entry_point="meta_envs.env:MetaEnv",
        vector_entry_point="meta_envs.env:MetaVectorEnv",
        max_episode_steps=row.horizon,
        kwargs={"name": row.name},
    )
    ENVIRONMENTS[row.name] = row


def unregister(row: Row) -> None:
    """Take back `register`, and forget what was made of the Definition."""
    del ENVIRONMENTS[row.name], gymnasium.registry[row.id]
    _definition.cache_clear()
    _task_set.cache_clear()


def resolve(name: str) -> Row:
    """Find an environment by its short name, its id or the field's hyphenated name.

    Raises:
        ValueError: no environment is called so; the message has the nearest and all names.
    """
    wanted = name.strip().lower()
    spellings = {
        spelling.lower(): row
        for row in ENVIRONMENTS.values()
        for spelling in (row.name, row.id, row.id.rpartition("-")[0], row.alias)
    }
    if wanted in spellings:
        return spellings[wanted]
    near = difflib.get_close_matches(wanted, spellings, n=1, cutoff=0.6)
    hint = f"; did you mean '{spellings[near[0]].name}'?" if near else ""
    raise ValueError(f"no environment '{name}'{hint} (known: {', '.join(ENVIRONMENTS)})")


@cache
def _definition(name: str) -> Definition:
    module, _, attribute = ENVIRONMENTS[name].definition.partition(":")
    made: Definition = getattr(importlib.import_module(module), attribute)()
    return made


def definition(name: str) -> Definition:
    """The batched functions of an environment, by any of its names."""
    return _definition(resolve(name).name)


@cache
def _task_set(name: str) -> TaskSet:
    return _definition(name).tasks()


def task_set(name: str) -> TaskSet:
    """The tasks of an environment, by any of its names."""
    return _task_set(resolve(name).name)


def chosen_tasks(name: str, tasks: TaskSet | None, own: OwnTasks | None) -> TaskSet:
    """The tasks that an environment is made with: a set that is given, one's own, or its own.

    Raises:
        ValueError: a set of another environment, wrong parameters, or both.
    """
    if own is not None:
        if tasks is not None:
            raise ValueError("give task_set or task_params, not both")
        return task_set(name).with_params(own)
    return task_set(name) if tasks is None else checks.check_task_set(name, tasks)
