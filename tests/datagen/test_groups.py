"""Groups of tasks: as text, as planned, and as a dataset says them."""

from __future__ import annotations

from typing import Any

import pytest

from datagen.groups import planned_groups, rows_text, trained_groups


@pytest.mark.parametrize(
    ("tasks", "text"), [([0, 1, 2, 5], "0-2,5"), ([4], "4"), ([], ""), ([1, 3, 4], "1,3-4")]
)
def test_rows_text(tasks: list[int], text: str) -> None:
    assert rows_text(tasks) == text


def index(*records: dict[str, Any]) -> dict[str, Any]:
    return {"config": {"fleet": {"size": 2}}, "tasks": list(records)}


def test_groups_are_planned_from_all_tasks() -> None:
    tasks = index(*({"task": task} for task in (1, 2, 5, 7, 9)))
    assert planned_groups(tasks) == {1: "1", 2: "2,5", 5: "2,5", 7: "7,9", 9: "7,9"}
    assert trained_groups(tasks) == planned_groups(tasks)


def test_a_record_knows_its_own_group() -> None:
    tasks = index({"task": 1, "group": "1,4"}, {"task": 2})
    assert trained_groups(tasks) == {1: "1,4", 2: "1-2"}
    assert planned_groups(tasks) == {1: "1-2", 2: "1-2"}


def test_there_are_no_groups_without_a_fleet() -> None:
    alone = {"config": {}, "tasks": [{"task": 1}]}
    assert planned_groups(alone) == trained_groups(alone) == {}
