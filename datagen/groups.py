"""Groups of tasks as `--tasks` takes them, and those that a dataset's tasks were trained in."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from datagen.budgets import groups_of


def rows_text(tasks: Sequence[int]) -> str:
    """Task numbers as `--tasks` takes them: [0, 1, 2, 5] is `0-2,5`."""
    spans: list[list[int]] = []
    for task in tasks:
        if spans and task == spans[-1][1] + 1:
            spans[-1][1] = task
        else:
            spans.append([task, task])
    return ",".join(str(a) if a == b else f"{a}-{b}" for a, b in spans)


def planned_groups(index: Mapping[str, Any]) -> dict[int, str]:
    """The group that one command for all of an index's tasks trains each in; none if no fleet does.

    Args:
        index: content of `dataset.json`.
    """
    if "fleet" not in index["config"]:
        return {}
    tasks = [int(record["task"]) for record in index["tasks"]]
    groups = groups_of(tasks, int(index["config"]["fleet"]["size"]))
    return {task: rows_text(group) for group in groups for task in group}


def trained_groups(index: Mapping[str, Any]) -> dict[int, str]:
    """The group that each of an index's tasks was trained in; none if no fleet trained them.

    It is in the task's record; where older files do not have it, it is the planned one.

    Args:
        index: content of `dataset.json`.
    """
    planned = planned_groups(index)
    said = {int(record["task"]): record.get("group") for record in index["tasks"]}
    return {task: str(said[task] or group) for task, group in planned.items()}
