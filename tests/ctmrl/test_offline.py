"""The meta-test on contexts of the tasks' own data."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from ctmrl.config import RunConfig
from ctmrl.errors import UsageError
from ctmrl.meta_test import Group, MetaTest
from ctmrl.networks import Actor, ContextEncoder, mean_encoding
from ctmrl.offline import offline_contexts, open_data
from ctmrl.presets import preset
from datagen.dataset import open_dataset
from meta_envs import ENVIRONMENTS, MetaEnv, task_set
from tests.ctmrl.commands import Commands, contents
from tests.ctmrl.conftest import FinishedRun

Groups = dict[str, np.ndarray[Any, Any]]
GROUPS: Groups = {"unseen": np.array([2, 7]), "seen": np.array([0, 4, 8])}


@pytest.fixture
def config(wind_path: Path) -> RunConfig:
    made = preset("point_robot_wind", "ctmrl", "smoke", data=wind_path)
    return dataclasses.replace(
        made, meta_test=dataclasses.replace(made.meta_test, repetitions=3, scored_episodes=1)
    )


def given(config: RunConfig, groups: Groups = GROUPS, seed: int = 1) -> dict[str, torch.Tensor]:
    """Contexts of the data that the config names."""
    return offline_contexts(config, groups, seed, open_data(config).hash)


def test_each_context_is_of_its_own_task(config: RunConfig, wind_path: Path) -> None:
    found = given(config)
    dataset = open_dataset(wind_path)
    for name, rows in GROUPS.items():
        contexts = found[name].numpy()
        assert contexts.shape == (3 * len(rows), config.training.context_size, 2 + 2 + 1 + 2)
        for task, context in zip(np.tile(rows, 3), contexts, strict=True):
            data = dataset.read(int(task))
            before = [data.observations, data.actions, data.rewards[:, None]]
            own = np.concatenate([*before, data.next_observations], axis=1)
            rows_of = [int(np.flatnonzero((own == row).all(axis=1))[0]) for row in context]
            episodes = {int(data.columns["episode"][row]) for row in rows_of}
            assert len(episodes) <= config.training.context_episodes
    assert len(np.unique(found["seen"].numpy()[:, 0], axis=0)) == 9, "each repetition has its own"


def test_draws_depend_on_the_seed_and_not_on_other_groups(config: RunConfig) -> None:
    found, other = (given(config, seed=seed) for seed in (1, 2))
    alone = given(config, {"seen": GROUPS["seen"]})
    assert torch.equal(found["seen"], alone["seen"])
    assert not torch.equal(found["seen"], other["seen"])


def test_the_policy_is_scored_on_the_given_context(config: RunConfig) -> None:
    ones = torch.ones(7)
    encoder = ContextEncoder((0.1 * ones, 0.5 * ones), 2, (11,), 5)
    actor = Actor((torch.zeros(2), torch.ones(2)), 5, (13,), 2)
    tasks, contexts = task_set("point_robot_wind"), given(config)
    groups = {name: Group(rows, "offline", contexts[name]) for name, rows in GROUPS.items()}
    results = MetaTest(encoder, actor, tasks, config.meta_test, 0).run(groups)
    for name, rows in GROUPS.items():
        with torch.no_grad():
            z = mean_encoding(encoder(contexts[name]))
        result = results[name]
        assert result.curve.shape == (1, len(rows))
        np.testing.assert_allclose(result.contexts.reshape(z.shape), z, rtol=1e-5, atol=1e-6)
        for place, task in enumerate(np.tile(rows, 3)):
            env = MetaEnv("point_robot_wind", int(task))
            obs, total = env.reset(seed=place)[0], 0.0
            for _ in range(ENVIRONMENTS["point_robot_wind"].horizon):
                action = actor.act(torch.from_numpy(obs)[None], z[place : place + 1])[0].numpy()
                obs, reward, *_ = env.step(action)
                total += float(reward)
            assert result.returns.flatten()[place] == pytest.approx(total, rel=1e-4)


@pytest.fixture
def run(wind_path: Path, commands: Commands, tmp_path: Path) -> Path:
    """A run that learned from the dataset."""
    path = tmp_path / "run"
    train = ("ctmrl.train", "--preset", "smoke", "--steps", "20", "--validate")
    words = (*train, "--data", str(wind_path), "--out", str(path))
    assert commands.run(*words) == 0, commands.output()
    return path


def test_the_command(run: Path, wind_path: Path, commands: Commands, tmp_path: Path) -> None:
    # What is in the folder of another evaluation does not stay beside this one.
    assert commands.run("ctmrl.evaluate", str(run), "--out", str(tmp_path / "a")) == 0
    assert "adaptation.png" in contents(tmp_path / "a")
    words = ("ctmrl.evaluate", str(run), "--protocols", "offline", "--data", str(wind_path))
    assert commands.run(*words, "--out", str(tmp_path / "a")) == 0, commands.output()
    assert "ctmrl-validation, offline, seed 0" in commands.output()
    assert commands.run(*words, "--out", str(tmp_path / "b")) == 0
    assert contents(tmp_path / "a") == contents(tmp_path / "b")
    assert sorted(contents(tmp_path / "a")) == ["contexts.png", "evaluation.json", "settings.json"]
    record = json.loads((tmp_path / "a" / "evaluation.json").read_text())
    assert record["method"] == "ctmrl-validation, offline"
    assert record["protocol"]["name"] == "offline"
    assert record["protocol"]["random_episodes"] == record["protocol"]["policy_episodes"] == 0
    assert all(len(group["curve"]) == 1 for group in record["groups"].values())


def test_all_protocols_in_one_pass(
    run: Path, wind_path: Path, commands: Commands, tmp_path: Path
) -> None:
    words = ("ctmrl.evaluate", str(run), "--data", str(wind_path), "--protocols")
    together, names = tmp_path / "together", ("offline", "np_online", "online", "codes")
    assert commands.run(*words, *names, "--out", str(together)) == 0, commands.output()
    for title in (
        "ctmrl-validation, offline, seed 0",
        "ctmrl-validation, seed 0",
        "ctmrl-validation, online, seed 0",
    ):
        assert title in commands.output()
    returns = set()
    for name in names:
        own = words if name == "offline" else (*words[:2], "--protocols")
        assert commands.run(*own, name, "--out", str(tmp_path / name)) == 0, commands.output()
        found = contents(together / name)
        assert found == contents(tmp_path / name), name
        record = json.loads(found["evaluation.json"])
        assert record["protocol"]["name"] == name
        returns.add(record["groups"]["unseen"]["return"])
    assert len(returns) == 4
    # np_online is what training ends with.
    trained = contents(run)["evaluation.json"]
    assert contents(together / "np_online")["evaluation.json"] == trained
    explored = json.loads((together / "online" / "evaluation.json").read_text())["protocol"]
    assert (explored["random_episodes"], explored["policy_episodes"]) == (0, 4)
    files = ["adaptation.png", "contexts.png", "evaluation.json", "settings.json"]
    assert sorted(contents(together / "online")) == files
    # A report keeps them apart.
    assert commands.run("ctmrl.report", str(together)) == 0, commands.output()
    assert "ctmrl-validation, offline" in commands.output()


@pytest.mark.parametrize("method", ["oracle_task", "no_context", "focal"])
def test_online_of_every_kind_of_encoder(
    method: str, wind_path: Path, commands: Commands, tmp_path: Path
) -> None:
    run, scored = tmp_path / "run", tmp_path / "scored"
    train = ("ctmrl.train", "--method", method, "--preset", "smoke", "--steps", "20", "--validate")
    assert commands.run(*train, "--data", str(wind_path), "--out", str(run)) == 0
    words = ("ctmrl.evaluate", str(run), "--protocols", "online", "--out", str(scored))
    assert commands.run(*words) == 0, commands.output()
    record = json.loads((scored / "evaluation.json").read_text())
    for group in record["groups"].values():
        # Whoever learns nothing from exploration acts alike before and after it.
        alike = group["curve"][0] == group["curve"][-1]
        assert alike == (method != "focal")


def test_tasks_without_data_are_named(config: RunConfig, good_path: Path) -> None:
    config = dataclasses.replace(config, data=good_path)
    with pytest.raises(UsageError, match=r"data of the unseen tasks, and .* has none of 2, 7: py"):
        given(config)


def test_other_data_than_the_run_learned_from_are_refused(
    finished_run: FinishedRun, good_path: Path, commands: Commands
) -> None:
    protocol = ("--protocols", "offline", "--data", str(good_path))
    words = ("ctmrl.evaluate", str(finished_run.path), *protocol)
    assert commands.run(*words) == 2
    assert commands.output() == (
        f"error: {good_path} does not hold the data that the run learned from: "
        "give --data with the folder that does\n"
    )


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            ("--protocols", "offline", "--fresh", "3"),
            "--protocols offline is for tasks with data, and --fresh tasks have none",
        ),
        (("--data", "somewhere"), "--data is for --protocols offline: no other reads a dataset"),
        (("--protocols", "offline", "--data", "nowhere"), "nowhere"),
        (("--protocols", "online", "online"), "one or more, each once, got online online"),
        (("--protocols",), "one or more, each once, got none"),
        (("--protocols", "of"), "invalid choice 'of' for argument '--protocols'"),
    ],
)
def test_options_that_do_not_fit(
    words: tuple[str, ...], message: str, finished_run: FinishedRun, commands: Commands
) -> None:
    assert commands.run("ctmrl.evaluate", str(finished_run.path), *words) == 2
    assert message in commands.output()
    assert "Traceback" not in commands.output()
