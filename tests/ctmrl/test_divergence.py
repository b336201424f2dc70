"""Runs that go wrong: what is said, from which step, and what is left of them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from ctmrl.actor_critic import ActorCritic
from ctmrl.data import OfflineData
from ctmrl.errors import Diverged
from ctmrl.meta_train import Learner, meta_train
from ctmrl.runs import load_checkpoint, read_json
from tests.ctmrl.commands import Commands, contents, rows
from tests.ctmrl.examples import smoke

Losses = tuple[Tensor, dict[str, Tensor]]


def corrupted(
    learner: Learner, monkeypatch: pytest.MonkeyPatch, step: int, change: Callable[[Losses], Losses]
) -> None:
    """Let `change` have what the actor-critic's loss gives in one step, the first is 1."""
    whole = ActorCritic.loss

    def loss(self: ActorCritic, *rest: object) -> Losses:
        found = whole(self, *rest)  # type: ignore[arg-type]
        return change(found) if learner.step == step - 1 else found

    monkeypatch.setattr(ActorCritic, "loss", loss)


def metric(name: str, value: float) -> Callable[[Losses], Losses]:
    return lambda found: (found[0], {**found[1], name: torch.tensor(value)})


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (metric("loss/value", np.nan), "loss/value is nan at step 5"),
        (metric("policy/q_largest", np.inf), "policy/q_largest is inf at step 5"),
        (lambda found: (found[0] * np.nan, found[1]), "loss is nan at step 5"),
        (
            lambda found: (found[0] + (0 * found[0]).sqrt(), found[1]),
            "the gradient of actor_critic.actor.net.0.weight is nan at step 5",
        ),
    ],
)
def test_the_first_quantity_that_goes_wrong_is_named_with_its_step(
    change: Callable[[Losses], Losses],
    said: str,
    wind_data: OfflineData,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    learner = Learner(smoke(12), wind_data)
    corrupted(learner, monkeypatch, 5, change)
    saved, logged = [], []
    training = meta_train(learner, 4, lambda: saved.append(learner.step), 4)
    logged.append(next(training)["step"])
    with pytest.raises(Diverged) as caught:
        next(training)
    assert str(caught.value) == said
    assert logged == saved == [4]


def test_a_q_that_no_reward_explains(
    wind_data: OfflineData, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = smoke(4).actor_critic
    reward = float(wind_data.unpack(wind_data.table).reward.abs().max())
    limit = 100 * (reward + 2 / config.reward_scale) / (1 - config.gamma)
    learner = Learner(smoke(4), wind_data)
    with monkeypatch.context() as patch:
        corrupted(learner, patch, 3, metric("policy/q_largest", 0.99 * limit))
        row = next(meta_train(learner, 4, lambda: None, 4))
    # A maximum, not a mean: it was that of one step of four.
    assert row["policy/q_largest"] == pytest.approx(0.99 * limit)
    learner = Learner(smoke(4), wind_data)
    corrupted(learner, monkeypatch, 3, metric("policy/q_largest", 1.01 * limit))
    with pytest.raises(Diverged) as caught:
        next(meta_train(learner, 4, lambda: None, 4))
    said = f"policy/q_largest is {1.01 * limit:.3g} at step 3, beyond its limit {limit:.3g}"
    assert str(caught.value) == said


def test_what_breaks_down_behind_it_is_not_blamed(
    wind_data: OfflineData, monkeypatch: pytest.MonkeyPatch
) -> None:
    """K-means refuses contexts that are not finite, a step after the weights were lost."""
    config = smoke(12)
    learner = Learner(config, wind_data)
    whole = learner.method.context_loss

    def lost(*rest: object) -> Losses:
        loss, metrics = whole(*rest)  # type: ignore[arg-type]
        return (loss * np.nan if learner.step == 1 else loss), metrics

    def refuse(step: int, all_contexts: Callable[[], Tensor]) -> None:
        if not all_contexts().isfinite().all():
            raise ValueError("Input contains NaN.")

    monkeypatch.setattr(learner.method, "context_loss", lost)
    monkeypatch.setattr(learner.method, "before_step", refuse)
    with pytest.raises(Diverged, match=r"^loss is nan at step 2$"):
        next(meta_train(learner, 4, lambda: None, 4))


def test_a_fault_of_another_kind_stays_what_it_is(
    wind_data: OfflineData, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(found: Losses) -> Losses:
        raise ZeroDivisionError

    learner = Learner(smoke(12), wind_data)
    corrupted(learner, monkeypatch, 3, fail)
    # Nothing is taken again to find out what the error says.
    monkeypatch.setattr(learner, "retrace", None)
    with pytest.raises(ZeroDivisionError):
        next(meta_train(learner, 4, lambda: None, 4))


def test_a_state_that_goes_wrong_without_a_metric(
    wind_data: OfflineData, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What the steps taken again do not show is named as it was found."""
    learner = Learner(smoke(12), wind_data)
    whole = learner.actor_critic.follow_value
    once = iter([True])

    def follow() -> None:
        whole()
        if next(once, False):
            learner.actor_critic.target_value.biases[-1].fill_(torch.inf)

    monkeypatch.setattr(learner.actor_critic, "follow_value", follow)
    with pytest.raises(Diverged, match=r"^actor_critic/target_value\.biases\.1 is inf at step 1$"):
        next(meta_train(learner, 1, lambda: None, 1))


def test_the_command_keeps_the_last_sound_checkpoint_and_stops_alike(
    commands: Commands, wind_path: Path, tmp_path: Path
) -> None:
    """A weight of the codebook's loss that is no number of sense, once the codebook is in use."""
    path = tmp_path / "run"
    words: tuple[str, ...] = (
        "ctmrl.train",
        "--preset",
        "smoke",
        "--steps",
        "60",
        "--data",
        str(wind_path),
    )
    words += ("--steps", "60", "--code-contrast-weight", "3e38", "--out", str(path))
    assert commands.run(*words) == 1
    said = commands.output().splitlines()[-1]
    assert said == (
        "error: training diverged: the gradient of method.codebook.codes is inf at step 7; "
        f"{path / 'checkpoint.pt'} is of step 6, before it; the same command goes on from there "
        "and stops alike: lower --learning-rate or --encoder-lr, with --restart or another --out"
    )
    left = contents(path)
    state = load_checkpoint(path / "checkpoint.pt")
    assert int(state["step"]) == 6
    assert all(value.isfinite().all() for value in state.values())
    assert left["metrics.csv"].count(b"\n") == 7
    assert commands.run(*words) == 1
    assert commands.output().splitlines()[-1] == said
    assert contents(path) == left
    assert commands.run("ctmrl.evaluate", str(path)) == 2
    assert commands.run("ctmrl.evaluate", str(path), "--unfinished") == 0
    assert commands.output().startswith("The checkpoint of step 6 of 60.\n")
    several = ("--unfinished", "--protocols", "online", "np_online", "--out", "scored")
    assert commands.run("ctmrl.evaluate", str(path), *several) == 0
    for name in ("online", "np_online"):
        record = read_json(commands.folder / "scored" / name / "evaluation.json")
        assert record["step"] == 6
        # So that no report takes it for a finished one.
        assert record["method"].endswith(", step 6 of 60")


def test_without_a_checkpoint(commands: Commands, wind_path: Path, tmp_path: Path) -> None:
    words = ("ctmrl.train", "--preset", "smoke", "--data", str(wind_path), "--out", "run")
    assert commands.run(*words, "--learning-rate", "1e6") == 1
    said = commands.output()
    assert said.startswith("error: training diverged: policy/q_largest is ")
    assert " at step 2, beyond its limit " in said
    assert "; run has no checkpoint yet; the same command starts again and stops alike: " in said
    assert rows(commands.folder / "run" / "metrics.csv") == 2
