"""Stored runs are meta-tested again: the same numbers, and fresh tasks."""

from __future__ import annotations

import dataclasses
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from ctmrl.agent import Agent, load_agent
from ctmrl.console import run_command
from ctmrl.evaluate import EvaluateConfig, evaluate_agent, main
from ctmrl.meta_test import meta_test
from ctmrl.methods.base import Dimensions
from ctmrl.presets import config_from_settings
from ctmrl.runs import load_checkpoint, read_json, to_json
from meta_envs import reference_returns, task_set
from tests.ctmrl.commands import Commands, contents
from tests.ctmrl.conftest import FinishedRun


def evaluate(run: Path, **options: Any) -> None:
    main(EvaluateConfig(run, **options))


@pytest.fixture(scope="module")
def agent(finished_run: FinishedRun) -> Agent:
    stored = read_json(finished_run.path / "config.json")
    config = config_from_settings(stored, finished_run.path)
    state = load_checkpoint(finished_run.path / "checkpoint.pt")
    return load_agent(config, Dimensions(**stored["dimensions"]), state)


@pytest.fixture
def copy(finished_run: FinishedRun, tmp_path: Path) -> Path:
    """A run that a test may change."""
    return shutil.copytree(finished_run.path, tmp_path / "copy")


def test_a_stored_run_repeats_its_training_commands_evaluation(
    finished_run: FinishedRun, commands: Commands, tmp_path: Path
) -> None:
    before = contents(finished_run.path)
    words = ("ctmrl.evaluate", str(finished_run.path), "--out", str(tmp_path / "again"))
    assert commands.run(*words) == 0, commands.output()
    found = contents(tmp_path / "again")
    config = json.loads(before["config.json"])
    wanted = {name: config[name] for name in ("dataset", "settings")}
    assert json.loads(found.pop("settings.json")) == wanted
    assert sorted(found) == ["adaptation.png", "contexts.png", "evaluation.json"]
    assert found == {name: before[name] for name in found}
    assert contents(finished_run.path) == before
    table = commands.output()
    assert "oracle (exact optimum)" in table
    # The same table as at the end of the training.
    assert table.strip() in finished_run.output


def test_what_a_record_holds(finished_run: FinishedRun, agent: Agent) -> None:
    record = read_json(finished_run.path / "evaluation.json")
    config = config_from_settings(read_json(finished_run.path / "config.json"), Path())
    tasks = task_set("point_robot_wind")
    references = reference_returns(tasks)
    assert record["protocol"] == {"name": "np_online"} | dataclasses.asdict(config.meta_test)
    assert (record["env"], record["method"], record["seed"]) == ("point_robot_wind", "ctmrl", 0)
    assert record["evaluation_seed"] == 0
    assert record["param_names"] == ["wind_x", "wind_y"]
    rows = {"unseen": tasks.test_tasks, "seen": np.array([0, 1, 3, 4, 5, 6, 8])}
    assert set(record["groups"]) == set(rows)
    for name, group in record["groups"].items():
        result = meta_test(
            agent.method.encoder, agent.actor, tasks, rows[name], config.meta_test, 0
        )
        assert group["tasks"] == rows[name].tolist()
        assert group["params"] == tasks.params[rows[name]].tolist()
        np.testing.assert_allclose(group["task_returns"], result.returns.mean(axis=0))
        np.testing.assert_allclose(group["repetition_returns"], result.returns.mean(axis=1))
        np.testing.assert_allclose(group["curve"], result.curve)
        contexts = torch.from_numpy(result.contexts.mean(axis=0))
        np.testing.assert_allclose(group["contexts"], contexts, rtol=1e-6)
        codes = agent.method.code_of(contexts)
        assert codes is not None
        assert group["codes"] == codes.tolist()
        assert group["return"] == pytest.approx(np.mean(group["task_returns"]))
        # The references are of exactly the tasks they stand beside.
        anchors = group["references"]
        for key, values in references.items():
            assert anchors[key] == pytest.approx(values[rows[name]].mean())
        share = (group["return"] - anchors["random"]) / (anchors["oracle"] - anchors["random"])
        assert group["score"] == pytest.approx(100 * share)


def test_the_best_behaviour_is_shown_only_where_it_is_known_of_every_task(
    finished_run: FinishedRun, wind_path: Path
) -> None:
    record = read_json(finished_run.path / "evaluation.json")
    index = json.loads((wind_path / "dataset.json").read_bytes())
    best = {one["task"]: max(one["returns"]["deterministic"].values()) for one in index["tasks"]}
    seen = record["groups"]["seen"]
    wanted = np.mean([best[task] for task in seen["tasks"]])
    assert seen["references"]["best_behavior"] == pytest.approx(wanted)
    assert "best_behavior" not in record["groups"]["unseen"]["references"]


def test_fresh_tasks(
    finished_run: FinishedRun, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    evaluate(finished_run.path, fresh=3, seed=7, repetitions=2, out=tmp_path / "out")
    assert "fresh tasks (3)" in capsys.readouterr().out
    record = read_json(tmp_path / "out" / "evaluation.json")
    fresh = task_set("point_robot_wind").sample(seed=7, n_tasks=3)
    assert list(record["groups"]) == ["fresh"]
    group = record["groups"]["fresh"]
    assert group["params"] == fresh.params.tolist()
    assert (record["seed"], record["evaluation_seed"]) == (0, 7)
    assert len(group["repetition_returns"]) == record["protocol"]["repetitions"] == 2
    references = reference_returns(fresh)
    for key in ("random", "oracle", "wind_blind"):
        assert group["references"][key] == pytest.approx(references[key].mean())
    assert "best_behavior" not in group["references"]
    assert (tmp_path / "out" / "adaptation.png").exists()


def test_fresh_tasks_by_several_protocols(finished_run: FinishedRun, tmp_path: Path) -> None:
    out = tmp_path / "out"
    evaluate(finished_run.path, fresh=2, protocols=("online", "np_online"), out=out)
    for name in ("online", "np_online"):
        assert list(read_json(out / name / "evaluation.json")["groups"]) == ["fresh"]


def test_another_seed_explores_otherwise(finished_run: FinishedRun, agent: Agent) -> None:
    config = config_from_settings(read_json(finished_run.path / "config.json"), Path())
    tasks = task_set("point_robot_wind").sample(seed=0, n_tasks=2)
    groups = {"fresh": np.arange(2)}
    records = [
        evaluate_agent(agent, config, tasks, groups, {}, seed)["np_online"] for seed in (0, 0, 1)
    ]
    assert records[0] == records[1]
    assert records[0]["groups"]["fresh"]["contexts"] != records[2]["groups"]["fresh"]["contexts"]


def test_behaviour_no_better_than_random_is_no_scale(
    agent: Agent, finished_run: FinishedRun, monkeypatch: pytest.MonkeyPatch
) -> None:
    # A robot whose optimum is not known, and a policy of too few steps to be worth anything.
    random = {"random": np.full(50, 20.0)}
    monkeypatch.setattr("meta_envs.reference_returns", lambda tasks, threads: random)
    config = config_from_settings(read_json(finished_run.path / "config.json"), Path())
    groups = {"unseen": np.array([2, 7]), "seen": np.array([0, 1])}
    best = {2: 19.0, 7: 21.0, 0: 20.0, 1: 30.0}
    record = evaluate_agent(agent, config, task_set("point_robot_wind"), groups, best, 0)[
        "np_online"
    ]
    assert record["groups"]["unseen"]["score"] is None
    assert record["groups"]["seen"]["score"] < 0
    assert json.loads(to_json(record)) == record


def mistake(capsys: pytest.CaptureFixture[str], run: Path, **options: Any) -> str:
    """The one sentence that a command ends with."""
    assert run_command(lambda: evaluate(run, **options)) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.count("\n") == 1
    assert captured.err.startswith("error: ")
    return captured.err.removeprefix("error: ").strip()


def test_a_group_alone_has_the_record_it_has_beside_others(
    finished_run: FinishedRun, agent: Agent
) -> None:
    record = read_json(finished_run.path / "evaluation.json")
    config = config_from_settings(read_json(finished_run.path / "config.json"), Path())
    tasks = task_set("point_robot_wind")
    for name, group in record["groups"].items():
        rows = {name: np.array(group["tasks"])}
        alone = evaluate_agent(agent, config, tasks, rows, {}, 0)["np_online"]["groups"][name]
        # The best behaviour is the dataset's, which is not given here.
        alone["references"]["best_behavior"] = group["references"].get("best_behavior")
        assert json.loads(json.dumps(alone)) == group | {"references": alone["references"]}


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"fresh": -1}, "--fresh must be at least 0, got -1"),
        ({"repetitions": 0}, "--repetitions must be at least 1, got 0"),
        ({"seed": -3}, "--seed must be from 0 to 9.22337e+18, got -3"),
    ],
)
def test_wrong_options(
    options: dict[str, int],
    said: str,
    finished_run: FinishedRun,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert mistake(capsys, finished_run.path, **options) == said


def test_a_folder_that_is_no_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert mistake(capsys, tmp_path / "nowhere") == (
        f"{tmp_path / 'nowhere'} is not a run's folder: it has no config.json; "
        "python -m ctmrl.train makes one"
    )


def test_a_run_that_is_not_finished(copy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    state = load_checkpoint(copy / "checkpoint.pt")
    torch.save({**state, "step": torch.tensor(12)}, copy / "checkpoint.pt")
    assert mistake(capsys, copy) == (
        f"{copy} stopped at step 12 of 40: give its training command again to finish it, "
        "or --unfinished to score it as it is"
    )
    (copy / "checkpoint.pt").unlink()
    assert mistake(capsys, copy) == f"{copy} has no checkpoint.pt yet: train it first"


def test_a_checkpoint_that_is_not_of_the_run(
    copy: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    state = load_checkpoint(copy / "checkpoint.pt")
    few = {key: value for key, value in state.items() if key.startswith("method/")}
    key = "actor_critic/actor.net.0.weight"
    for wrong in ({}, few, {**state, key: state[key][:, :3]}, {**state, "method/x": state[key]}):
        torch.save(wrong, copy / "checkpoint.pt")
        said = mistake(capsys, copy)
        assert said.startswith(f"{copy / 'checkpoint.pt'} does not fit its run (")
        assert said.endswith("): train again with --restart")
    (copy / "checkpoint.pt").write_bytes(b"PK\x03\x04")
    assert mistake(capsys, copy).startswith(f"{copy / 'checkpoint.pt'} is damaged (")


@pytest.mark.parametrize("key", ["settings", "groups", "best_behavior", "dimensions"])
def test_a_config_of_another_version(
    key: str, copy: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    stored = read_json(copy / "config.json")
    for wrong in (None, 3, [1], {"steps": "many"}):
        if key in ("groups", "best_behavior") and isinstance(wrong, dict):
            continue
        (copy / "config.json").write_text(json.dumps({**stored, key: wrong}))
        said = mistake(capsys, copy)
        assert said.startswith(f"{copy / 'config.json'} does not fit ")
        assert said.endswith("train again with --restart")
    del stored[key]
    (copy / "config.json").write_text(json.dumps(stored))
    assert mistake(capsys, copy).startswith(f"{copy / 'config.json'} does not fit ")


@pytest.mark.parametrize(
    ("key", "wrong", "why"),
    [
        ("best_behavior", {"x": 1}, "invalid literal for int() with base 10: 'x'"),
        ("best_behavior", {"1": "x"}, "could not convert string to float: 'x'"),
        ("groups", {"unseen": [2], "seen": [999]}, "groups.seen is not of tasks from 0 to 49"),
        ("groups", {"unseen": [-1]}, "groups.unseen is not of tasks from 0 to 49"),
        ("groups", {"unseen": [0.5]}, "groups.unseen is not of tasks from 0 to 49"),
        ("groups", {"foo": [1]}, "groups.foo is neither of unseen nor of seen tasks"),
        ("groups", {"unseen": []}, "groups.unseen is not of tasks from 0 to 49"),
        ("dimensions", {"obs": 2, "act": 2, "tasks": 7, "steps": "x"}, "invalid literal for int()"),
        ("groups", {}, "groups has none"),
        ("groups", {"unseen": [True]}, "groups.unseen is not of tasks from 0 to "),
    ],
)
def test_a_damaged_config(
    key: str, wrong: Any, why: str, copy: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    stored = read_json(copy / "config.json")
    (copy / "config.json").write_text(json.dumps({**stored, key: wrong}))
    said = mistake(capsys, copy)
    assert said.startswith(f"{copy / 'config.json'} does not fit its run ({why}")
    assert said.endswith("): train again with --restart")


@pytest.mark.parametrize(
    ("part", "name", "wrong"),
    [
        ("training", "steps", "many"),
        ("meta_test", "repetitions", 1.5),
        ("context", "z_dim", None),
        ("actor_critic", "hidden", 64),
    ],
)
def test_a_setting_of_a_wrong_type(
    part: str, name: str, wrong: Any, copy: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    stored = read_json(copy / "config.json")
    stored["settings"][part][name] = wrong
    (copy / "config.json").write_text(json.dumps(stored))
    said = mistake(capsys, copy)
    assert said.startswith(f"{copy / 'config.json'} does not fit ")
    assert f"({name} is {wrong!r})" in said


def test_an_output_folder_that_is_a_file(
    finished_run: FinishedRun,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # It is told before anything is computed.
    monkeypatch.setattr("ctmrl.evaluate.evaluate_agent", None)
    (tmp_path / "out").write_text("")
    for out, why in (
        (tmp_path / "out", "File exists"),
        (tmp_path / "out" / "x", "Not a directory"),
    ):
        said = mistake(capsys, finished_run.path, fresh=1, out=out)
        assert said == f"--out {out} cannot be written to ({why}): choose another folder"


def test_the_runs_own_folder_as_output(copy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = contents(copy)
    out = copy / ".." / copy.name
    said = f"--out {out} is the run itself: choose another folder"
    assert mistake(capsys, copy, out=out, fresh=1) == said
    other = copy.with_name("other")
    shutil.copytree(copy, other)
    said = f"--out {other} is another run: choose another folder"
    assert mistake(capsys, copy, out=other, fresh=1) == said
    below = copy.with_name("scored") / "online"
    shutil.copytree(copy, below)
    said = f"--out {below} is another run: choose another folder"
    found = mistake(capsys, copy, out=below.parent, fresh=1, protocols=("np_online", "online"))
    assert found == said
    assert contents(below) == contents(other) == before
    assert contents(copy) == before
