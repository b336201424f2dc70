"""The learner: its optimisers, gradients, determinism and state, and that it learns."""

from __future__ import annotations

import dataclasses
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from ctmrl.config import MetaTrainConfig, RunConfig
from ctmrl.data import OfflineData
from ctmrl.errors import UsageError
from ctmrl.meta_test import MetaTestConfig, meta_test
from ctmrl.meta_train import LARGEST_Q, LAST_RATE, Learner, meta_train
from ctmrl.methods import METHODS
from ctmrl.methods.base import Reference
from ctmrl.presets import preset
from datagen.dataset import open_dataset
from meta_envs import reference_returns, task_set

STEPS = 12
"""Steps of a run here: with the schedule below K-means runs before steps 4 and 8."""


def config_of(
    method: str = "ctmrl", brac: bool = False, precision: str = "float32", **training: Any
) -> RunConfig:
    config = preset("point_robot_wind", method, "smoke", precision=precision)
    if hasattr(config.context, "refresh"):
        schedule: dict[str, Any] = {"warm_up": 1 / 3, "refresh": 1 / 3}
        config = dataclasses.replace(
            config, context=dataclasses.replace(config.context, **schedule)
        )
    return dataclasses.replace(
        config,
        training=dataclasses.replace(config.training, **({"steps": STEPS} | training)),
        actor_critic=dataclasses.replace(config.actor_critic, behavior_regularization=brac),
    )


CONFIGS = [("ctmrl", False), *((method, True) for method in METHODS)]


@pytest.fixture(params=[*CONFIGS, ("ctmrl", True, "bfloat16")], ids=str)
def config(request: pytest.FixtureRequest) -> RunConfig:
    return config_of(*request.param)


def frozen(state: dict[str, Tensor]) -> dict[str, Tensor]:
    """A state that does not change as training goes on."""
    return {key: value.detach().clone() for key, value in state.items()}


def assert_same(found: dict[str, Tensor], wanted: dict[str, Tensor]) -> None:
    assert found.keys() == wanted.keys()
    for key, value in found.items():
        assert value.numpy().tobytes() == wanted[key].numpy().tobytes(), key


def train(learner: Learner, steps: int) -> list[dict[str, float]]:
    """Metrics of some steps."""
    rows = []
    for _ in range(steps):
        rows.append({key: float(value) for key, value in learner.update().items()})
    return rows


def modules(learner: Learner) -> nn.ModuleDict:
    return nn.ModuleDict({"method": learner.method, "actor_critic": learner.actor_critic})


def test_every_trained_parameter_is_in_exactly_one_optimiser(
    config: RunConfig, wind_data: OfflineData
) -> None:
    learner = Learner(config, wind_data)
    owned = Counter(
        id(parameter)
        for optimizer in learner.optimizers.values()
        for group in optimizer.param_groups
        for parameter in group["params"]
    )
    names = {id(parameter): name for name, parameter in modules(learner).named_parameters()}
    assert set(owned.values()) == {1}
    assert owned.keys() <= names.keys()
    for name, parameter in modules(learner).named_parameters():
        assert (id(parameter) in owned) is parameter.requires_grad, name
        assert parameter.requires_grad is not name.startswith("actor_critic.target_value."), name


def test_a_step_changes_every_trained_parameter(config: RunConfig, wind_data: OfflineData) -> None:
    learner = Learner(config, wind_data)
    before = frozen(dict(modules(learner).named_parameters()))
    train(learner, STEPS)
    for name, parameter in modules(learner).named_parameters():
        assert not parameter.equal(before[name]), name
        assert parameter.isfinite().all()


def test_the_actor_critic_never_trains_the_encoder_nor_the_method_the_actor_critic(
    config: RunConfig, wind_data: OfflineData, monkeypatch: pytest.MonkeyPatch
) -> None:
    learner = Learner(config, wind_data)
    train(learner, STEPS // 2)
    method, actor_critic = learner.method, learner.actor_critic
    losses: dict[str, Tensor] = {}
    context_loss, policy_loss = method.context_loss, actor_critic.loss

    def keep(name: str, result: tuple[Tensor, dict[str, Tensor]]) -> Any:
        losses[name] = result[0]
        return result

    monkeypatch.setattr(method, "context_loss", lambda *a: keep("method", context_loss(*a)))
    monkeypatch.setattr(actor_critic, "loss", lambda *a: keep("actor_critic", policy_loss(*a)))
    # The losses as the learner hands them its tensors, before it steps on them.
    monkeypatch.setattr(learner.optimizers["main"], "step", lambda: None)
    monkeypatch.setattr(Tensor, "backward", lambda self: None)
    if actor_critic.dual_optimizer:
        monkeypatch.setattr(actor_critic.dual_optimizer, "step", lambda: None)
    learner.update()
    named = dict(modules(learner).named_parameters())
    trained = {name: p for name, p in named.items() if p.requires_grad}
    if isinstance(method, Reference):
        assert not losses.pop("method").requires_grad
    for owner, loss in losses.items():
        gradients = torch.autograd.grad(loss, list(trained.values()), allow_unused=True)
        reached = {
            name
            for name, gradient in zip(trained, gradients, strict=True)
            if gradient is not None and gradient.any()
        }
        assert reached
        assert {name.partition(".")[0] for name in reached} == {owner}
        assert not any("dual_critic" in name for name in reached)


def test_the_same_seed_gives_the_same_bytes_and_another_seed_others(
    config: RunConfig, wind_data: OfflineData
) -> None:
    first, again, other = (
        Learner(dataclasses.replace(config, seed=seed), wind_data) for seed in (3, 3, 4)
    )
    rows = [train(learner, STEPS) for learner in (first, again, other)]
    assert rows[0] == rows[1]
    assert rows[0] != rows[2]
    assert_same(first.state(), again.state())
    different = other.state()
    for name, value in first.state().items():
        if name.endswith("weight"):
            assert not value.equal(different[name]), name


def test_the_shared_generator_has_no_part_in_it(wind_data: OfflineData) -> None:
    first = Learner(config_of(), wind_data)
    torch.manual_seed(99)
    before = torch.random.get_rng_state()
    second = Learner(config_of(), wind_data)
    assert train(first, 3) == train(second, 3)
    assert torch.random.get_rng_state().equal(before)


@pytest.mark.parametrize("at", [1, 5])
def test_a_state_goes_on_bit_for_bit(at: int, config: RunConfig, wind_data: OfflineData) -> None:
    whole = Learner(config, wind_data)
    train(whole, at)
    saved = frozen(whole.state())
    wanted = train(whole, STEPS - at)
    resumed = Learner(dataclasses.replace(config, seed=77), wind_data)
    resumed.load(saved)
    assert resumed.step == at
    assert_same(resumed.state(), saved)
    assert train(resumed, STEPS - at) == wanted
    assert_same(resumed.state(), whole.state())


def test_a_state_is_tensors_and_a_foreign_one_is_refused(wind_data: OfflineData) -> None:
    learner = Learner(config_of(), wind_data)
    train(learner, 2)
    state = frozen(learner.state())
    assert all(isinstance(value, Tensor) for value in state.values())
    assert {"step", "generator", "method/codebook.codes", "method/collected"} <= state.keys()
    for key in ("step", "method/encoder.net.0.weight"):
        rest = {name: value for name, value in state.items() if name != key}
        with pytest.raises((KeyError, RuntimeError)):
            learner.load(rest)
    wrong = {**state, "actor_critic/actor.net.0.weight": torch.zeros(3, 5)}
    with pytest.raises(RuntimeError, match="size mismatch"):
        learner.load(wrong)


def rates(learner: Learner) -> dict[str, float]:
    """The learning rate of each trained parameter, by name."""
    by_parameter = {
        id(parameter): group["lr"]
        for optimizer in learner.optimizers.values()
        for group in optimizer.param_groups
        for parameter in group["params"]
    }
    named = modules(learner).named_parameters()
    return {name: by_parameter[id(p)] for name, p in named if p.requires_grad}


def with_rates(config: RunConfig) -> RunConfig:
    """Three rates that differ."""
    return dataclasses.replace(
        config,
        context=dataclasses.replace(config.context, encoder_lr=2e-3),
        actor_critic=dataclasses.replace(config.actor_critic, learning_rate=3e-3, dual_lr=5e-3),
    )


def test_each_network_has_its_rate_and_rates_fall_linearly(wind_data: OfflineData) -> None:
    learner = Learner(with_rates(config_of(brac=True)), wind_data)
    start = rates(learner)
    for name, rate in start.items():
        wanted = 2e-3 if name.startswith("method.") else 3e-3
        assert rate == (5e-3 if "dual_critic" in name else wanted), name
    for step in range(STEPS):
        learner.update()
        share = 1.0 - 0.99 * step / STEPS
        for name, rate in rates(learner).items():
            assert rate == pytest.approx(start[name] * share, rel=1e-9)
    assert LAST_RATE == 0.01


def test_without_decay_rates_stay(wind_data: OfflineData) -> None:
    learner = Learner(with_rates(config_of(brac=True, decay=False)), wind_data)
    start = rates(learner)
    train(learner, 5)
    assert rates(learner) == start


def test_a_step_draws_different_tasks_and_their_contexts_belong_to_their_rows(
    wind_data: OfflineData, monkeypatch: pytest.MonkeyPatch
) -> None:
    learner = Learner(config_of(), wind_data)
    seen: list[tuple[Tensor, Tensor, Tensor]] = []
    draw, transitions, loss = wind_data.contexts, wind_data.transitions, learner.actor_critic.loss
    tasks: list[Tensor] = []

    def spied_contexts(asked: Tensor, *rest: Any) -> Tensor:
        tasks.append(asked)
        return draw(asked, *rest)

    def spied_transitions(asked: Tensor, *rest: Any) -> Any:
        tasks.append(asked)
        return transitions(asked, *rest)

    def spied_loss(batch: Any, z: Tensor, *rest: Any) -> Any:
        seen.append((tasks[-1], batch.obs, z))
        return loss(batch, z, *rest)

    monkeypatch.setattr(learner.data, "contexts", spied_contexts)
    monkeypatch.setattr(learner.data, "transitions", spied_transitions)
    monkeypatch.setattr(learner.actor_critic, "loss", spied_loss)
    learner.update()
    ((asked, obs, z),) = seen
    # meta_batch 5 of 7 tasks, 7 rows each: rows come task by task, each with its task's context.
    assert tasks[-2].equal(tasks[-1])
    assert len(set(asked.tolist())) == 5
    assert obs.shape[0] == z.shape[0] == 35
    blocks = z.view(5, 7, -1)
    assert (blocks == blocks[:, :1]).all()
    assert len({tuple(row) for row in blocks[:, 0].tolist()}) == 5
    assert not z.requires_grad


def test_a_meta_batch_is_at_most_all_tasks(wind_data: OfflineData) -> None:
    learner = Learner(config_of(meta_batch=101), wind_data)
    assert all(np.isfinite(value) for value in train(learner, 1)[0].values())


def test_fresh_contexts_of_all_tasks(wind_data: OfflineData) -> None:
    learner = Learner(config_of(), wind_data)
    first, second = learner.all_contexts(), learner.all_contexts()
    assert first.shape == (7, 4)
    assert not first.requires_grad
    assert (first != second).any(dim=1).all()


def test_the_spread_of_contexts(wind_data: OfflineData, monkeypatch: pytest.MonkeyPatch) -> None:
    learner = Learner(config_of(), wind_data)
    seen: list[np.ndarray[Any, Any]] = []
    loss = learner.method.context_loss

    def spied(contexts: Tensor, encodings: Tensor, generator: torch.Generator) -> Any:
        seen.append(encodings.detach().double().mean(dim=2).numpy())
        return loss(contexts, encodings, generator)

    monkeypatch.setattr(learner.method, "context_loss", spied)
    metrics = learner.update()
    ((anchors, positives),) = seen
    assert metrics["contexts/between"] == pytest.approx(anchors.std(axis=0, ddof=1).mean())
    # Two contexts of one task: their variance is half of the squared difference.
    within = np.sqrt(((anchors - positives) ** 2 / 2).mean(axis=0)).mean()
    assert metrics["contexts/within"] == pytest.approx(within)
    assert "contexts/within" not in Learner(config_of("focal"), wind_data).update()


def test_settings_that_do_not_fit_the_data_are_said_at_once(wind_data: OfflineData) -> None:
    with pytest.raises(UsageError, match=r"contexts need 2 x 4 .*the dataset has 6"):
        Learner(config_of(context_episodes=4), wind_data)
    changes: dict[str, Any] = {"codes": 7}
    config = config_of()
    config = dataclasses.replace(config, context=dataclasses.replace(config.context, **changes))
    with pytest.raises(UsageError, match=r"--codes .* 7 training tasks"):
        Learner(config, wind_data)


@pytest.mark.parametrize(("log_every", "save_every"), [(2, 4), (5, 5), (100, 100)])
def test_the_loop_logs_means_and_saves_after_its_logs(
    log_every: int, save_every: int, wind_data: OfflineData
) -> None:
    plain = train(Learner(config_of(), wind_data), STEPS)
    learner = Learner(config_of(), wind_data)
    events: list[tuple[str, int]] = []
    done = 0
    for row in meta_train(
        learner, log_every, lambda: events.append(("save", learner.step)), save_every
    ):
        step = int(row.pop("step"))
        events.append(("log", step))
        dead = row.pop("codes/dead")
        for key, value in row.items():
            over = np.max if key == LARGEST_Q else np.mean
            wanted = over([one[key] for one in plain[done:step]])
            assert value == pytest.approx(wanted, rel=1e-4, abs=1e-6), key
        shares = [key for key in row if key.startswith("codes/share/")]
        assert dead == sum(not any(one[key] for one in plain[done:step]) for key in shares)
        done = step
    logs = [*range(log_every, STEPS, log_every), STEPS]
    saves = [*range(save_every, STEPS, save_every), STEPS]
    assert [step for kind, step in events if kind == "log"] == logs
    assert [step for kind, step in events if kind == "save"] == saves
    for step in saves:
        assert events.index(("save", step)) == events.index(("log", step)) + 1
    assert list(meta_train(learner, log_every, lambda: None, save_every)) == []


def test_it_learns(good_path: Path) -> None:
    """The context tells the wind, the losses fall, and unseen tasks are done far better."""
    dataset = open_dataset(good_path)
    data = OfflineData(dataset, dataset.train_tasks)
    config = preset("point_robot_wind", "ctmrl", "smoke")
    weights = ("code_contrast_weight", "cross_prediction_weight", "contrast_weight")
    context: dict[str, Any] = {
        **dict.fromkeys(weights, 1.0),
        **dict.fromkeys(("encoder_hidden", "predictor_hidden"), (32, 32)),
        "warm_up": 0.3,
        "z_dim": 5,
    }
    config = dataclasses.replace(
        config,
        training=MetaTrainConfig(
            steps=400, meta_batch=8, batch_size=32, context_episodes=1, context_size=16
        ),
        context=dataclasses.replace(config.context, **context),
        actor_critic=dataclasses.replace(
            config.actor_critic,
            hidden=(32, 32),
            gamma=0.9,
            reward_scale=100.0,
            learning_rate=4e-3,
            target_rate=0.03,
        ),
    )
    learner, tasks = Learner(config, data), task_set("point_robot_wind")
    protocol = MetaTestConfig(random_episodes=3, policy_episodes=3, repetitions=1)

    def test(rows: Any) -> Any:
        actor = learner.actor_critic.actor
        return meta_test(learner.method.encoder, actor, tasks, rows, protocol, 0)

    untrained = test(tasks.test_tasks).returns.mean()
    rows = list(meta_train(learner, 50, lambda: None, 50))
    unseen, seen = test(tasks.test_tasks), test(data.tasks)
    random = reference_returns(tasks, episodes=50)["random"][tasks.test_tasks].mean()
    assert unseen.returns.mean() > max(untrained, random) + 10
    for key in ("loss/encoder/spe_prediction", "loss/encoder/code_contrast", "loss/critic"):
        values = [row[key] for row in rows if row[key] > 0]
        assert values[-1] < 0.6 * values[0], key
    # The winds of tasks it never saw, read off their contexts by the seen tasks' linear map.
    given = np.c_[seen.contexts[0], np.ones(len(data))]
    linear = np.linalg.lstsq(given, tasks.params[data.tasks], rcond=None)[0]
    error = np.c_[unseen.contexts[0], np.ones(10)] @ linear - tasks.params[tasks.test_tasks]
    spread = tasks.params[tasks.test_tasks] - tasks.params[tasks.test_tasks].mean(axis=0)
    assert 1 - (error**2).sum() / (spread**2).sum() > 0.6


def test_every_method_trains_without_a_word_of_its_own_in_the_loop(wind_data: OfflineData) -> None:
    for method in METHODS:
        rows = train(Learner(config_of(method), wind_data), 3)
        shared = {"loss/critic", "loss/value", "loss/actor", "contexts/between"}
        assert shared <= rows[0].keys()
        assert rows[0].keys() == rows[2].keys()
