"""What each quality means, and which rows a slice has."""

from __future__ import annotations

import itertools
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from datagen.dataset import DatasetError, open_dataset, read_task, task_file, write_task
from datagen.slices import (
    QUALITIES,
    Quality,
    Slice,
    chosen_checkpoints,
    chosen_episodes,
    shares,
    slice_meta,
    take,
)
from meta_envs import task_set
from tests.datagen.examples import graded_data, task_data, write_dataset

CURVE = {100: -29.0, 200: -24.0, 300: -20.0, 400: -16.0, 500: -12.0, 600: -11.9, 700: -13.0,
         800: -10.0, 1000: -12.5, 1200: -10.1}  # fmt: skip
"""Returns of ten checkpoints; with random at -30 the best one, 800, is 20 above it."""


def returns(curve: dict[int, float] = CURVE, random: float = -30.0) -> dict[str, Any]:
    return {"random": random, "behavior": {str(mark): value for mark, value in curve.items()}}


def test_shares_are_0_at_random_and_1_at_the_best_checkpoint() -> None:
    found = shares(returns())
    assert list(found) == sorted(CURVE)
    assert found == pytest.approx(
        {100: 0.05, 200: 0.3, 300: 0.5, 400: 0.7, 500: 0.9, 600: 0.905, 700: 0.85, 800: 1.0,
         1000: 0.875, 1200: 0.995}
    )  # fmt: skip
    assert shares(returns({5: -31.0, 7: -30.0})) == {}


@pytest.mark.parametrize(
    ("quality", "wanted"),
    [
        ("mixed", tuple(CURVE)),
        # Ten thirds, rounded up.
        ("early", (100, 200, 300, 400)),
        ("medium", (200, 300, 400)),
        # 700 and 1000 are not good enough, and 500 to 1200 are no more than a third.
        ("expert", (500, 600, 800, 1200)),
    ],
)
def test_the_checkpoints_of_each_quality(quality: Quality, wanted: tuple[int, ...]) -> None:
    assert chosen_checkpoints(returns(), quality) == wanted
    # In whatever order JSON's sorted keys list them: "1000" before "200".
    backwards = returns({mark: CURVE[mark] for mark in sorted(CURVE, key=str)})
    assert chosen_checkpoints(backwards, quality) == wanted


def test_expert_is_the_last_third_of_the_good_checkpoints_even_where_the_end_is_bad() -> None:
    flat = dict.fromkeys(range(100, 1500, 100), -6.0)
    assert chosen_checkpoints(returns(flat), "expert") == (1000, 1100, 1200, 1300, 1400)
    collapsed = flat | {1100: -20.0, 1400: -29.0}
    assert chosen_checkpoints(returns(collapsed), "expert") == (800, 900, 1000, 1200, 1300)
    assert chosen_checkpoints(returns(collapsed), "early") == (100, 200, 300, 400, 500)
    assert chosen_checkpoints(returns(collapsed), "medium") == (1100,)


def test_the_bounds_of_a_quality_belong_to_it() -> None:
    # Of 100 above random: exact in binary or not, a fifth of it is 20.
    curve = {1: 19.9, 2: 20.0, 3: 80.0, 4: 80.1, 5: 89.9, 6: 90.0, 7: 100.0, 8: 50.0, 9: 0.0}
    assert chosen_checkpoints(returns(curve, 0.0), "medium") == (2, 3, 8)
    assert chosen_checkpoints(returns(curve, 0.0), "expert") == (6, 7)


def test_no_checkpoint_is_medium_and_expert_and_one_always_is_expert() -> None:
    draw = np.random.default_rng(0)
    for count in (*range(1, 20), 3, 3, 3):
        curve = dict(zip(range(count), np.sort(draw.normal(size=count)).tolist(), strict=True))
        found = {one: {*chosen_checkpoints(returns(curve, -9.0), one)} for one in QUALITIES}
        assert not found["medium"] & found["expert"]
        assert found["expert"]
        assert len(found["expert"]) <= -(-count // 3) == len(found["early"])


def test_a_slice_that_is_none_is_refused() -> None:
    unknown: Any = "good"
    with pytest.raises(ValueError, match=r"no quality 'good' \(known: mixed, medium, expert, "):
        Slice(unknown)
    with pytest.raises(ValueError, match="episodes must be at least 1, got 0"):
        Slice("expert", 0)
    assert Slice().whole
    assert not Slice("early").whole
    assert not Slice(episodes=3).whole


@pytest.mark.parametrize("quality", QUALITIES)
def test_the_rows_are_those_of_the_first_episodes_of_the_checkpoints(quality: Quality) -> None:
    data = graded_data(3, CURVE, episodes=5)
    wanted_marks = chosen_checkpoints(data.meta["returns"], quality)
    for episodes in (None, 1, 2, 5):
        found = take(data, Slice(quality, episodes))
        wanted, seen, last = [], dict.fromkeys(CURVE, 0), -1
        for row in range(len(data)):
            mark = int(data.checkpoint[row])
            if data.episode[row] != last:
                last, seen[mark] = int(data.episode[row]), seen[mark] + 1
            if mark in wanted_marks and (episodes is None or seen[mark] <= episodes):
                wanted.append(row)
        for name, column in data.columns.items():
            if name != "episode":
                assert found.columns[name].dtype == column.dtype
                assert found.columns[name].tolist() == column[wanted].tolist()
        assert found.episode.dtype == np.int32
        ends = np.flatnonzero(found.terminals | found.timeouts)
        assert (np.flatnonzero(np.diff(found.episode)) == ends[:-1]).all()
        assert np.unique(found.episode).tolist() == list(range(len(ends)))
        assert len(ends) == len(wanted_marks) * (episodes or 5)


def test_slices_of_fewer_episodes_are_parts_of_those_of_more() -> None:
    data = graded_data(3, CURVE, episodes=6)
    marks = data.checkpoint[np.flatnonzero(np.diff(data.episode, prepend=-1))]
    for quality, (less, more) in itertools.product(QUALITIES, itertools.pairwise(range(1, 7))):
        part, whole = (
            {*chosen_episodes(marks, data.meta["returns"], Slice(quality, n)).tolist()}
            for n in (less, more)
        )
        assert part < whole


def test_all_of_a_task_is_the_task_itself() -> None:
    data = task_data(3)
    assert take(data, Slice()) is data
    assert slice_meta(data.meta, Slice(), data.checkpoint) == data.meta


def test_a_slice_says_what_it_is_and_keeps_the_promises_of_the_format(tmp_path: Path) -> None:
    found = take(graded_data(3, CURVE), Slice("medium", 2))
    wanted = {"quality": "medium", "episodes": 2, "checkpoints": [200, 300, 400]}
    assert found.meta["slice"] == wanted
    path = tmp_path / task_file(3)
    write_task(path, found)
    assert read_task(path).columns["actions"].tobytes() == found.actions.tobytes()
    assert read_task(path).meta["slice"] == wanted


def test_an_empty_slice_is_one_sentence() -> None:
    marks = np.array([5, 5, 7, 7, 9], dtype=np.int32)
    curve = {5: -29.0, 7: -8.0, 9: -10.0}
    for part, stated, said in (
        (
            Slice("medium"),
            returns(curve),
            "has no medium checkpoint: none is 0.2 to 0.8 of the way from random actions to its "
            "best one, but 0.05, 1.00, 0.91",
        ),
        (
            Slice("expert"),
            returns(curve, -8.0),
            "has no expert checkpoint: none of its 3 did better than random actions",
        ),
        (
            Slice("expert"),
            returns({11: -8.0}),
            "has no episodes of its expert checkpoints, 11",
        ),
        (
            Slice(episodes=2),
            returns(curve),
            "has 1 episodes of checkpoint 9, not the 2 asked for",
        ),
        (
            Slice("early"),
            {"random": 0.0, "behavior": {"final": 1.0}},
            "has returns of a checkpoint that is no number (invalid literal for int() with base "
            "10: 'final')",
        ),
    ):
        with pytest.raises(ValueError, match=f"^{re.escape(said)}$"):
            chosen_episodes(marks, stated, part)


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset of four tasks, not to be written to."""
    return write_dataset(tmp_path_factory.mktemp("slices") / "point_robot_wind")


def test_a_selection_is_a_dataset_of_less(original: Path) -> None:
    dataset = open_dataset(original)
    assert dataset.part == Slice()
    few = dataset.select(tasks=[3, 2])
    assert few.tasks.tolist() == [2, 3]
    assert (few.train_tasks.tolist(), few.test_tasks.tolist()) == ([3], [2])
    assert (few.params == task_set("point_robot_wind").params[[2, 3]]).all()
    assert (few.hash, few.part) == (dataset.hash, Slice())
    assert few.read(3).columns["actions"].tobytes() == task_data(3).actions.tobytes()
    expert = few.select("expert").select(episodes=1)
    assert expert.part == Slice("expert", 1)
    assert expert.tasks.tolist() == [2, 3]
    assert expert.select("mixed").part == Slice(episodes=1)
    # Of two checkpoints with returns around those of random actions, the better one.
    behavior = task_data(3).meta["returns"]["behavior"]
    best = max(behavior, key=behavior.__getitem__)
    found = expert.read(3)
    assert found.meta["slice"] == {"quality": "expert", "episodes": 1, "checkpoints": [int(best)]}
    assert found.checkpoint.tolist() == [int(best)] * 25
    start = 0 if best == "200" else 50
    assert (found.actions == task_data(3).actions[start : start + 25]).all()
    assert dataset.part == Slice()
    assert len(dataset.read(3)) == 100


def test_a_selection_of_nothing_is_one_sentence(original: Path) -> None:
    dataset = open_dataset(original)
    with pytest.raises(DatasetError, match=r"has no task 9, only 0, 1, 2, 3; "):
        dataset.select(tasks=[3, 9])
    with pytest.raises(ValueError, match="select at least one task"):
        dataset.select(tasks=[])
    with pytest.raises(ValueError, match="episodes must be at least 1, got 0"):
        dataset.select(episodes=0)
    few = dataset.select(tasks=[0, 3])
    for ask in (few.read, few.entry, few.verify, few.blocks, few.episodes):
        with pytest.raises(
            DatasetError, match=r"its task 1 is not in this slice, only 0, 3; select it too"
        ):
            ask(1)
    with pytest.raises(DatasetError, match=r"task_003.h5: has no medium checkpoint: .*inspect"):
        few.select("medium").read(3)
