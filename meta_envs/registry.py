"""The table of environments: one row each, and how a user's spelling finds it."""

from __future__ import annotations

import difflib
import importlib
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from meta_envs.definition import Definition
    from meta_envs.tasks import TaskSet


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
    )
}


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
    near = difflib.get_close_matches(wanted, spellings, n=1, cutoff=0.5)
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
