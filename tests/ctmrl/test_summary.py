"""Results over seeds."""

from __future__ import annotations

import csv
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ctmrl.errors import UsageError
from ctmrl.summary import (
    collate,
    find_records,
    interquartile_mean,
    interval,
    titled,
    to_csv,
)
from tests.ctmrl.examples import record


def test_a_note_stands_behind_the_methods_name() -> None:
    assert titled("focal", "") == "focal"
    assert titled("no_context", "reference") == "no_context (reference)"


def of_run(name: str = "", **changes: Any) -> dict[str, Any]:
    made = record(**changes)
    return {**made, "run": name or f"runs/{made['method']}/seed-{made['seed']}"}


def write(folder: Path, content: object) -> Path:
    folder.mkdir(parents=True)
    (folder / "evaluation.json").write_text(json.dumps(content))
    return folder


def test_records_are_found_in_folders_and_below(tmp_path: Path) -> None:
    for seed in (2, 0, 1):
        write(tmp_path / "runs" / f"seed-{seed}", record(seed=seed))
    found = find_records([tmp_path / "runs"])
    assert [one["seed"] for one in found] == [0, 1, 2]
    assert found[2]["run"] == str(tmp_path / "runs" / "seed-2")
    # A run that is named twice counts once.
    twice = [tmp_path / "runs" / "seed-1", tmp_path / "runs"]
    assert len(find_records(twice)) == 3
    assert len(find_records(twice[:1])) == 1


def test_no_record_is_one_sentence(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"no finished run in .*a, .*b: "):
        find_records([tmp_path / "a", tmp_path / "b"])


NOT_RECORDS: list[object] = [
    [],
    3,
    {},
    {"groups": {}, "env": "x", "method": "y"},
    record() | {"seed": "first"},
    record() | {"groups": []},
    *({**record(), "groups": {"unseen": {"return": value}}} for value in (None, 1.0)),
]


@pytest.mark.parametrize("content", NOT_RECORDS)
def test_a_foreign_record_is_one_sentence(content: object, tmp_path: Path) -> None:
    folder = write(tmp_path / "x", content)
    with pytest.raises(UsageError, match=r"evaluation.json is not an evaluation of a run"):
        find_records([folder])
    (folder / "evaluation.json").write_text('{"groups": ')
    with pytest.raises(UsageError, match="is not an evaluation of a run"):
        find_records([folder])


def test_records_are_collated_by_environment_method_and_group() -> None:
    records = [of_run(seed=3), of_run(seed=1), of_run(method="focal", seed=1), of_run(seed=10)]
    results = collate(records)
    assert [(result.method, result.group) for result in results] == [
        ("ctmrl", "seen"),
        ("ctmrl", "unseen"),
        ("focal", "seen"),
        ("focal", "unseen"),
    ]
    unseen = results[1]
    assert unseen.env == "point_robot_wind"
    assert unseen.seeds == (1, 3, 10)
    np.testing.assert_allclose(unseen.returns, [-10.0, -12.0, -19.0])
    np.testing.assert_allclose(unseen.scores, [80.0, 72.0, 44.0])
    assert unseen.references["oracle"] == -5.0


def test_a_missing_score_is_nan() -> None:
    one = of_run()
    one["groups"]["seen"]["score"] = None
    assert math.isnan(collate([one])[0].scores[0])


def test_a_missing_score_is_an_empty_cell_of_the_csv() -> None:
    runs = [of_run()]
    for group in runs[0]["groups"].values():
        group["score"] = None
    rows = list(csv.DictReader(to_csv(collate(runs)).splitlines()))
    assert [row["score"] for row in rows] == ["", ""]


def test_two_runs_of_one_seed_are_one_sentence() -> None:
    with pytest.raises(UsageError, match=r"^a and b both have seed 4 of ctmrl on point_robot_wind"):
        collate([of_run("a", seed=4), of_run("b", seed=4)])


def test_runs_on_different_tasks_are_one_sentence() -> None:
    other = of_run("b", seed=1)
    other["groups"]["unseen"]["tasks"] = [1, 2]
    with pytest.raises(UsageError, match=r"^a and b were scored on different unseen tasks"):
        collate([of_run("a"), other])


def test_fresh_tasks_of_other_seeds_are_different_tasks() -> None:
    one, other = of_run("a"), of_run("b", seed=1)
    other["groups"]["unseen"]["params"][0][0] += 0.01
    with pytest.raises(UsageError, match=r"^a and b were scored on different unseen tasks"):
        collate([one, other])


def write_run(folder: Path, seed: int, settings: dict[str, Any] | None) -> None:
    write(folder / f"seed-{seed}", record(seed=seed))
    if settings is not None:
        config = {"dataset": "abc", "settings": {"seed": seed, **settings}}
        (folder / f"seed-{seed}" / "config.json").write_text(json.dumps(config))


def test_runs_of_other_settings_are_one_sentence(tmp_path: Path) -> None:
    for seed, steps in ((0, 60), (1, 60), (2, 70)):
        write_run(tmp_path, seed, {"threads": seed + 1, "training": {"steps": steps}})
    assert collate(find_records([tmp_path / "seed-0", tmp_path / "seed-1"]))
    said = r"/seed-0 and .*/seed-2 differ in steps \(60 and 70\): report them apart$"
    with pytest.raises(UsageError, match=said):
        collate(find_records([tmp_path]))
    # An evaluation in a folder of its own says how many episodes it had.
    one, other = of_run("a"), of_run("b", seed=1)
    other["protocol"]["repetitions"] = 1
    with pytest.raises(UsageError, match=r"^a and b differ in repetitions \(3 and 1\)"):
        collate([one, other])


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"actor_critic": {"behavior_cloning": 1.0}}, r"behavior_cloning \(0\.0 and 1\.0\)"),
        ({"precision": "bfloat16"}, r"precision \(float32 and bfloat16\)"),
    ],
)
def test_a_setting_that_one_run_leaves_out(
    settings: dict[str, Any], said: str, tmp_path: Path
) -> None:
    write_run(tmp_path, 0, {})
    write_run(tmp_path, 1, settings)
    with pytest.raises(UsageError, match=rf"differ in {said}: report them apart$"):
        collate(find_records([tmp_path]))


def test_runs_of_other_devices_are_one_row(tmp_path: Path) -> None:
    write_run(tmp_path, 0, {})
    write_run(tmp_path, 1, {"device": "cuda"})
    assert collate(find_records([tmp_path]))[0].seeds == (0, 1)


def test_a_run_without_settings_hides_no_difference(tmp_path: Path) -> None:
    for seed, settings in enumerate(({"training": {"steps": 60}}, None)):
        write_run(tmp_path, seed, settings)
    assert collate(find_records([tmp_path]))
    write_run(tmp_path, 2, {"training": {"steps": 70}})
    with pytest.raises(UsageError, match=r"/seed-0 and .*/seed-2 differ in steps"):
        collate(find_records([tmp_path]))


def test_evaluations_outside_their_runs_folders_have_its_settings(tmp_path: Path) -> None:
    for seed, steps in ((0, 60), (1, 70)):
        write_run(tmp_path, seed, {"training": {"steps": steps}})
        folder = tmp_path / f"seed-{seed}"
        (folder / "config.json").rename(folder / "settings.json")
    with pytest.raises(UsageError, match=r"differ in steps \(60 and 70\): report them apart$"):
        collate(find_records([tmp_path]))


@pytest.mark.parametrize("text", ["{", "[]", '{"dataset": "abc"}'])
def test_a_config_that_cannot_be_read_is_named(text: str, tmp_path: Path) -> None:
    write_run(tmp_path, 0, {})
    (tmp_path / "seed-0" / "config.json").write_text(text)
    said = r"/seed-0/config.json does not have a run's settings \(.*\): move its folder away$"
    with pytest.raises(UsageError, match=said):
        find_records([tmp_path])


def test_the_interval_is_of_the_mean() -> None:
    values = np.random.default_rng(0).normal(-6.0, 0.5, 29)
    low, high = interval(values)
    error = values.std(ddof=1) / math.sqrt(len(values))
    assert low == pytest.approx(values.mean() - 1.96 * error, abs=0.25 * error)
    assert high == pytest.approx(values.mean() + 1.96 * error, abs=0.25 * error)
    assert interval(values) == (low, high)
    # Percentiles of resampled means, which are not symmetric for values that are not.
    skewed = np.array([1.0, 1.1, 1.2, 1.3, 9.0])
    draws = np.random.default_rng(1).choice(skewed, (20_000, 5)).mean(axis=1)
    assert interval(skewed) == pytest.approx(np.percentile(draws, [2.5, 97.5]), abs=0.1)
    assert interval(np.full(7, -6.0)) == (-6.0, -6.0)
    assert all(math.isnan(bound) for bound in interval(values[:1]))


def test_the_interquartile_mean() -> None:
    assert interquartile_mean(np.array([100.0, 1.0, 2.0, 3.0, -100.0, 4.0, 5.0, 0.0])) == 2.5
    assert interquartile_mean(np.array([7.0])) == 7.0
    assert interquartile_mean(np.array([1.0, 2.0, 6.0])) == 3.0


def test_the_csv() -> None:
    text = to_csv(collate([of_run(seed=1), of_run(seed=0)]))
    rows = list(csv.DictReader(text.splitlines()))
    assert len(rows) == 4
    assert rows[0] == {
        "env": "point_robot_wind",
        "method": "ctmrl",
        "group": "seen",
        "seed": "0",
        "return": "-8.0000",
        "score": "88.00",
    }
    assert "\r" not in text
