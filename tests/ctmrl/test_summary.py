from __future__ import annotations

import json
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ctmrl.errors import UsageError
from ctmrl.summary import collate, find_records, interquartile_mean, interval, to_csv


def record(seed: int, value: float, tasks: tuple[int, ...] = (2, 7)) -> dict[str, Any]:
    group = {
        "tasks": list(tasks),
        "return": value,
        "score": 100 + value,
        "references": {"random": -30.0, "oracle": -5.0},
    }
    return {"env": "point_robot", "method": "focal", "seed": seed, "groups": {"unseen": group}}


def write(folder: Path, content: dict[str, Any]) -> Path:
    folder.mkdir(parents=True)
    (folder / "evaluation.json").write_text(json.dumps(content))
    return folder


def test_seeds_are_collated_in_their_order(tmp_path: Path) -> None:
    for seed, value in ((10, -7.0), (2, -5.0), (0, -6.0)):
        write(tmp_path / f"seed-{seed}", record(seed, value))
    (result,) = collate(find_records([tmp_path]))
    assert result.seeds == (0, 2, 10)
    assert result.returns.tolist() == [-6.0, -5.0, -7.0]
    assert result.scores.tolist() == [94.0, 95.0, 93.0]
    assert result.references["oracle"] == -5.0
    assert to_csv([result]).splitlines()[2] == "point_robot,focal,unseen,2,-5.0000,95.00"


def test_a_folder_named_twice_counts_once(tmp_path: Path) -> None:
    one = write(tmp_path / "seed-0", record(0, -6.0))
    assert len(find_records([tmp_path, one])) == 1


def test_two_runs_of_one_seed_are_refused(tmp_path: Path) -> None:
    write(tmp_path / "a", record(3, -6.0))
    write(tmp_path / "b", record(3, -5.0))
    with pytest.raises(UsageError, match="both have seed 3"):
        collate(find_records([tmp_path]))


def test_runs_on_different_tasks_are_refused(tmp_path: Path) -> None:
    write(tmp_path / "a", record(0, -6.0))
    write(tmp_path / "b", record(1, -5.0, tasks=(2, 8)))
    with pytest.raises(UsageError, match="different unseen tasks"):
        collate(find_records([tmp_path]))


@pytest.mark.parametrize("content", ["", "[]", '{"env": 1}'])
def test_a_foreign_evaluation_is_named(tmp_path: Path, content: str) -> None:
    (tmp_path / "evaluation.json").write_text(content)
    with pytest.raises(UsageError, match="is not an evaluation of a run"):
        find_records([tmp_path])


def test_no_run_is_said(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no finished run"):
        find_records([tmp_path])


def test_the_interval_is_that_of_all_resamples() -> None:
    values = np.array([-5.1, -5.9, -5.4])
    # With three seeds there are only 27 resamples: the exact percentiles can be counted.
    means = np.sort([np.mean(sample) for sample in product(values, repeat=3)])
    low, high = interval(values)
    assert low == pytest.approx(means[0], abs=0.02)
    assert high == pytest.approx(means[-1], abs=0.02)
    assert interval(values) == (low, high)


def test_one_seed_has_no_interval() -> None:
    assert np.isnan(interval(np.array([-5.0]))).all()


def test_the_interquartile_mean_leaves_the_outer_quarters_out() -> None:
    assert interquartile_mean(np.array([0.0, 1.0, 2.0, 100.0])) == 1.5
