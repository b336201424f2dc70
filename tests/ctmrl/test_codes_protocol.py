"""The meta-test's protocol `codes`: acting on codes in place of random actions."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from ctmrl.meta_test import Group, MetaTest, MetaTestConfig, MetaTestResult
from ctmrl.networks import Actor, ContextEncoder
from meta_envs import TaskSet, task_set
from tests.ctmrl.commands import Commands, contents
from tests.ctmrl.test_meta_test import CONFIG, ROWS, SEED, Adaptation, Z

CODES = torch.linspace(-1.0, 1.0, 3 * Z).reshape(3, Z)[:, torch.arange(Z) * 3 % Z]


class OnCodes(Adaptation):
    """Single environments that are told what they are given."""

    told: Tensor

    def contexts(self) -> Tensor:
        return self.encoder.scaled(self.told)

    def encoded(self, transitions: list[Tensor]) -> Tensor:
        found: Tensor = self.encoder(torch.stack(transitions)).mean(dim=0)
        return found


@torch.no_grad()
def by_single_environments(
    encoder: ContextEncoder, actor: Actor, tasks: TaskSet, config: MetaTestConfig
) -> tuple[MetaTestResult, NDArray[np.int64]]:
    """The result, and which episode was each environment's best."""
    rows = [int(task) for _ in range(config.repetitions) for task in ROWS]
    run, n = OnCodes(encoder, actor, tasks, rows), len(rows)
    best, place = [-np.inf] * n, np.zeros(n, dtype=np.int64)
    chosen, contexts = torch.zeros(n, Z), torch.zeros(n, Z)
    curve = []
    for number in range(config.random_episodes + config.policy_episodes):
        run.told = chosen
        curve.append(run.episode("score"))
        on_code = number < config.random_episodes
        run.told = CODES[number % 3].repeat(n, 1) if on_code else contexts.clone()
        run.transitions = [[] for _ in rows]
        chosen = chosen.clone()
        for k, found in enumerate(run.episode("policy")):
            if found > best[k]:
                best[k], place[k], chosen[k] = found, number, run.told[k]
                contexts[k] = run.encoded(run.transitions[k])
    run.told = chosen
    final = np.array(run.episode("score"))
    shape = (config.repetitions, len(ROWS))
    result = MetaTestResult(
        final.reshape(shape),
        np.array([*curve, final]).reshape(-1, *shape).mean(axis=1),
        chosen.reshape(*shape, Z).numpy(),
    )
    return result, place


def networks(standardize: bool) -> tuple[ContextEncoder, Actor]:
    """Small ones; every context matters to the actor."""
    ones = torch.ones(7)
    with torch.random.fork_rng():
        torch.manual_seed(3)
        encoder = ContextEncoder(
            (0.1 * ones, 0.5 * ones), 2, (11,), Z, standardize_contexts=standardize
        )
        actor = Actor((torch.zeros(2), torch.ones(2)), Z, (13,), 2)
        encoder.show(0.3 * torch.randn(50, Z) + 0.1)
    with torch.no_grad():
        next(actor.parameters()).mul_(3.0)
        # Over the edge where the noisy robot's episodes end.
        list(actor.parameters())[-1][0] += 0.3
    return encoder, actor


@pytest.mark.parametrize("standardize", [False, True])
@pytest.mark.parametrize("env", ["point_robot_wind", "noisy_robot"])
@pytest.mark.parametrize(
    "change",
    [
        {},
        {"random_episodes": 5, "policy_episodes": 0},
        {"random_episodes": 0},
        {"random_episodes": 0, "policy_episodes": 0},
    ],
    ids=str,
)
def test_the_protocol(
    env: str, change: dict[str, int], standardize: bool, request: pytest.FixtureRequest
) -> None:
    if env == "noisy_robot":
        request.getfixturevalue("noisy_robot")
    config = dataclasses.replace(CONFIG, **change)
    encoder, actor = networks(standardize)
    tasks = task_set(env)
    found = MetaTest(encoder, actor, tasks, config, SEED).run(
        {"some": Group(ROWS, "codes", codes=CODES)}
    )["some"]
    wanted, place = by_single_environments(encoder, actor, tasks, config)
    episodes = config.random_episodes + config.policy_episodes
    assert found.curve.shape == (episodes + 1, 3)
    np.testing.assert_allclose(found.returns, wanted.returns, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(found.curve, wanted.curve, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(found.contexts, wanted.contexts, rtol=1e-4, atol=1e-5)
    if not episodes:
        assert not found.contexts.any()
        return
    # Not always the same episode was the best.
    assert len(set(place.tolist())) > 1
    if config.policy_episodes == 0:
        on_codes = (torch.from_numpy(found.contexts)[:, :, None] == CODES).all(dim=-1)
        assert on_codes.any(dim=-1).all()


def goal_seeker(hand: float) -> Actor:
    """It goes where its context of size 2 says, fast, with little noise."""
    actor = Actor((torch.zeros(2), torch.ones(2)), 2, (), 2)
    with torch.no_grad():
        (weight, bias) = actor.parameters()
        weight.zero_()
        weight[:2, :2] = -hand * torch.eye(2)
        weight[:2, 2:] = hand * torch.eye(2)
        bias.copy_(torch.tensor([0.0, 0.0, -5.0, -5.0]))
    return actor


def test_sparse_rewards_that_random_actions_never_see_are_found() -> None:
    tasks = task_set("sparse_point_robot")
    angles = torch.linspace(0.0, torch.pi, 9)
    codes = torch.stack([angles.cos(), angles.sin()], dim=1)
    ones = torch.ones(7)
    encoder = ContextEncoder((0.1 * ones, 0.5 * ones), 2, (11,), 2)
    rows = np.arange(20)
    config = MetaTestConfig(random_episodes=9, policy_episodes=2, repetitions=1)
    test = MetaTest(encoder, goal_seeker(10.0), tasks, config, SEED)
    found = test.run({"codes": Group(rows, "codes", codes=codes), "random": Group(rows)})
    # The nearest code is within 0.2 of every goal, and the untrained encoder's contexts of none.
    goals = torch.from_numpy(tasks.params[rows]).float()
    nearest = codes[torch.cdist(goals, codes).argmin(dim=1)]
    np.testing.assert_array_equal(found["codes"].contexts[0], nearest.numpy())
    assert (found["codes"].returns > 0).all()
    assert found["random"].returns.sum() < 0.1 * found["codes"].returns.sum()


def test_of_equal_episodes_the_earliest_is_chosen() -> None:
    # Away from the goals, so that all returns are 0.
    tasks, away = task_set("sparse_point_robot"), -torch.eye(2)
    encoder = ContextEncoder((torch.zeros(7), torch.ones(7)), 2, (11,), 2)
    codes = torch.stack([away[1], away[1] + 0.1])
    config = MetaTestConfig(random_episodes=2, policy_episodes=0, repetitions=1)
    test = MetaTest(encoder, goal_seeker(10.0), tasks, config, SEED)
    found = test.run({"some": Group(ROWS, "codes", codes=codes)})["some"]
    assert not found.returns.any()
    np.testing.assert_array_equal(found.contexts[0], codes[:1].expand(3, 2).numpy())


@pytest.mark.parametrize("group", [Group(ROWS, "codes"), Group(ROWS, "online", codes=CODES)])
def test_a_group_with_codes_that_do_not_fit_its_protocol(group: Group) -> None:
    test = MetaTest(*networks(False), task_set("point_robot_wind"), CONFIG, SEED)
    with pytest.raises(ValueError, match="group 'some': 'codes' needs codes, no others take any"):
        test.run({"some": group})


def refusal(run: Path) -> str:
    return (
        f"--protocols codes acts on a codebook, and {run} has none in use: it is for runs of "
        "ctmrl and ctmrl_released that are past their warm-up"
    )


def test_a_codebook_that_is_not_in_use(wind_path: Path, commands: Commands, tmp_path: Path) -> None:
    run = tmp_path / "run"
    train = ("ctmrl.train", "--preset", "smoke", "--steps", "20", "--warm-up", "1", "--validate")
    assert commands.run(*train, "--data", str(wind_path), "--out", str(run)) == 0
    assert commands.run("ctmrl.evaluate", str(run), "--protocols", "codes") == 2
    assert refusal(run) in " ".join(commands.output().split())


@pytest.mark.parametrize("method", ["ctmrl", "ctmrl_released", "focal", "no_context"])
def test_the_command(method: str, wind_path: Path, commands: Commands, tmp_path: Path) -> None:
    run, scored = tmp_path / "run", tmp_path / "scored"
    train = ("ctmrl.train", "--method", method, "--preset", "smoke", "--steps", "20", "--validate")
    assert commands.run(*train, "--data", str(wind_path), "--out", str(run)) == 0
    words = ("ctmrl.evaluate", str(run), "--protocols", "codes", "--out", str(scored))
    code = commands.run(*words)
    if method in ("focal", "no_context"):
        assert code == 2
        assert refusal(run) in " ".join(commands.output().split())
        assert not scored.exists()
        return
    assert code == 0, commands.output()
    assert f"{method}-validation, codes, seed 0" in commands.output()
    record = json.loads((scored / "evaluation.json").read_text())
    wanted = {"name": "codes", "random_episodes": 0, "code_episodes": 2, "policy_episodes": 2}
    assert record["protocol"].items() >= wanted.items()
    assert {len(group["curve"]) for group in record["groups"].values()} == {5}
    files = ["adaptation.png", "contexts.png", "evaluation.json", "settings.json"]
    assert sorted(contents(scored)) == files
