"""The fleet's learner: Stable-Baselines3's update for each task, and the tasks apart."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import BaseCallback, CheckpointCallback
from stable_baselines3.common.logger import KVWriter, Logger
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from torch import Tensor, nn

from datagen.behavior import training_environment
from datagen.fleet.algorithm import FleetSAC
from datagen.fleet.networks import BatchedMLP
from datagen.fleet.training import actor
from datagen.fleet.vec_env import FleetVecEnv
from tests.datagen.fleet.fleets import NEVER, SETTINGS, fleet, parameters

ENV = "hopper_params"


def linear(net: nn.Module) -> list[nn.Linear]:
    return [layer for layer in net.modules() if isinstance(layer, nn.Linear)]


def as_batched(net: nn.Module) -> list[NDArray[np.float32]]:
    """Weights [in, out] and biases [1, out] of Stable-Baselines3's layers, in our order."""
    layers = linear(net)
    weights = [layer.weight.detach().T.numpy() for layer in layers]
    return [*weights, *(layer.bias.detach()[None].numpy() for layer in layers)]


def copy_critic(into: nn.Module, net: BatchedMLP, task: int) -> None:
    for layer, weight, bias in zip(linear(into), net.weights, net.biases, strict=True):
        layer.weight.data, layer.bias.data = weight[task].detach().T.clone(), bias[task, 0].clone()


def reference(model: FleetSAC, task: int, row: int) -> SAC:
    """Stable-Baselines3's SAC with the weights a fleet's task has now."""
    settings = SETTINGS
    sac = SAC(
        "MlpPolicy",
        training_environment(ENV, task),
        learning_rate=settings.learning_rate,
        buffer_size=1,
        batch_size=settings.batch_size,
        tau=settings.tau,
        gamma=settings.gamma,
        ent_coef=f"auto_{settings.initial_temperature}",
        policy_kwargs={"net_arch": list(settings.hidden)},
        seed=0,
        device="cpu",
    )
    sac.set_logger(Logger(folder=None, output_formats=[]))
    weights = [value[row].detach() for value in model.policy.actor.parameters()]
    made = actor(model.observation_space, model.action_space, weights)  # type: ignore[arg-type] # both are Boxes
    sac.actor.load_state_dict(made.state_dict())
    for critics, ours in (
        (sac.critic, model.policy.critics),
        (sac.critic_target, model.policy.targets),
    ):
        for one, net in zip(critics.q_networks, ours, strict=True):
            copy_critic(one, net, row)
    assert sac.log_ent_coef is not None
    sac.log_ent_coef.data[:] = model.log_temperature[row, 0].detach()
    return sac


def of_reference(sac: SAC) -> dict[str, list[NDArray[np.float32]]]:
    assert sac.log_ent_coef is not None
    layers, heads = linear(sac.actor.latent_pi), []
    for head in (sac.actor.mu, sac.actor.log_std):
        assert isinstance(head, nn.Linear)
        heads.append(as_batched(head))
    return {
        "actor": [
            *(layer.weight.detach().T.numpy() for layer in layers),
            np.concatenate([one[0] for one in heads], axis=1),
            *(layer.bias.detach()[None].numpy() for layer in layers),
            np.concatenate([one[1] for one in heads], axis=1),
        ],
        **{f"critic_{i}": as_batched(q) for i, q in enumerate(sac.critic.q_networks)},
        **{f"target_{i}": as_batched(q) for i, q in enumerate(sac.critic_target.q_networks)},
        "temperature": [sac.log_ent_coef.detach().numpy()],
    }


def of_fleet(model: FleetSAC, row: int) -> dict[str, list[NDArray[np.float32]]]:
    def task(net: BatchedMLP) -> list[NDArray[np.float32]]:
        return [value[row].detach().numpy().copy() for value in net.parameters()]

    return {
        "actor": task(model.policy.actor),
        **{f"critic_{i}": task(net) for i, net in enumerate(model.policy.critics)},
        **{f"target_{i}": task(net) for i, net in enumerate(model.policy.targets)},
        "temperature": [model.log_temperature[row, 0].detach().numpy().copy()],
    }


class Recorder:
    """Calls a function that writes to an array, and keeps what it wrote."""

    def __init__(self, function: Callable[[NDArray[np.float32]], None]) -> None:
        self.function, self.written = function, list[Tensor]()

    def __call__(self, into: NDArray[np.float32]) -> None:
        self.function(into)
        self.written.append(torch.from_numpy(into.copy()))


@pytest.mark.parametrize("updates", [1, 4])
def test_an_update_is_stable_baselines3s(updates: int, monkeypatch: pytest.MonkeyPatch) -> None:
    tasks = (2, 9)
    model = fleet(tasks, ENV)
    # 40 random steps, so that hoppers have fallen, and then ten updates.
    model.learn(50 * len(tasks), log_interval=NEVER)
    assert model._n_updates == 10
    sacs = [reference(model, task, row) for row, task in enumerate(tasks)]
    for sac in sacs:
        # Adam's averages start at nothing in both.
        for optimizer in (sac.actor.optimizer, sac.critic.optimizer, sac.ent_coef_optimizer):
            assert optimizer is not None
            assert not optimizer.state
    for optimizer in model.optimizers.values():
        optimizer.state.clear()
    before = [of_fleet(model, row) for row in range(2)]
    draws = Recorder(model.replay_buffer.draw)
    noises = Recorder(model.policy.draw_noise)
    monkeypatch.setattr(model.replay_buffer, "draw", draws)
    monkeypatch.setattr(model.policy, "draw_noise", noises)
    model.train(updates, SETTINGS.batch_size)
    assert len(draws.written) == updates
    assert len(noises.written) == 2 * updates
    batches = [model.replay_buffer.split(rows) for rows in draws.written]
    assert any(0 < batch.dones.mean() < 1 for batch in batches)
    for row, sac in enumerate(sacs):
        rows = iter([ReplayBufferSamples(*(part[row] for part in one[:5])) for one in batches])
        drawn = iter([noise[row] for noise in noises.written])
        monkeypatch.setattr(
            "torch.distributions.normal._standard_normal",
            lambda *about, drawn=drawn, **more: next(drawn),
        )
        monkeypatch.setattr(
            sac.replay_buffer, "sample", lambda *about, rows=rows, **more: next(rows)
        )
        sac.train(updates, SETTINGS.batch_size)
        assert next(drawn, None) is None
        ours, theirs = of_fleet(model, row), of_reference(sac)
        assert ours.keys() == theirs.keys()
        for name, values in theirs.items():
            moved = 0.0
            for wanted, got, old in zip(values, ours[name], before[row][name], strict=True):
                # A step of Adam is about the learning rate, 1e-3; this is a thousandth of it.
                np.testing.assert_allclose(got, wanted, rtol=1e-5, atol=1e-6, err_msg=name)
                moved = max(moved, float(np.abs(wanted - old).max()))
            assert moved > (1e-3 * SETTINGS.tau / 2 if "target" in name else 5e-4), name
    _same_losses(model, sacs)


def _same_losses(model: FleetSAC, sacs: list[SAC]) -> None:
    """What the logger is told is the mean over tasks of what Stable-Baselines3 tells it."""
    said = model.logger.name_to_value
    for name in ("actor_loss", "critic_loss", "ent_coef_loss"):
        mean = np.mean([sac.logger.name_to_value[f"train/{name}"] for sac in sacs])
        assert said[f"train/{name}"] == pytest.approx(mean, rel=1e-4, abs=1e-6)


def test_no_task_learns_from_anothers_data() -> None:
    one, other = fleet((0, 1), ENV), fleet((0, 1), ENV)
    for model in (one, other):
        model.learn(40 * 2, log_interval=NEVER)
    other.replay_buffer.rows[: other.replay_buffer.pos, 1] *= 1.5
    for model in (one, other):
        model.train(5, SETTINGS.batch_size)
    for name, value in parameters(one, 0).items():
        np.testing.assert_array_equal(parameters(other, 0)[name], value, err_msg=name)
    assert any(
        not np.array_equal(parameters(other, 1)[name], value)
        for name, value in parameters(one, 1).items()
    )


def test_a_task_is_the_same_alone_and_beside_others() -> None:
    three, one = fleet((1, 3, 5), ENV), fleet((3,), ENV)
    for model in (three, one):
        model.learn(90 * model.n_envs, log_interval=NEVER)
        assert model._n_updates == 50
    beside, alone = parameters(three, 1), parameters(one, 0)
    start = parameters(fleet((3,), ENV), 0)
    for name, value in alone.items():
        # Rounding is 1e-7 of a value, and 50 updates and steps may make a hundred times that of
        # it; what 50 updates of 1e-3 have changed is up to 5e-2.
        np.testing.assert_allclose(beside[name], value, rtol=1e-5, atol=1e-5, err_msg=name)
        assert np.abs(value - start[name]).max() > 5e-4, name
    for part in (0, 40, 89):
        np.testing.assert_allclose(
            three.replay_buffer.rows[part, 1], one.replay_buffer.rows[part, 0], rtol=1e-3, atol=1e-4
        )
    assert not np.allclose(parameters(three, 0)["actor.weights.0"], beside["actor.weights.0"])


def actions(model: FleetSAC) -> NDArray[np.float32]:
    """All actions so far, [step, task, A]."""
    obs = model.observation_space.shape
    assert obs is not None
    held = model.replay_buffer
    return held.rows[: held.pos, :, obs[0] : obs[0] + held.action_dim]


def test_random_steps_are_uniform_and_each_tasks_own() -> None:
    env, steps = "point_robot_wind", 1500
    three, one = (fleet(tasks, env, steps, steps) for tasks in ((0, 3, 8), (3,)))
    for model in (three, one):
        model.learn(steps * model.n_envs, log_interval=NEVER)
        assert model._n_updates == 0
    drawn = actions(three)
    np.testing.assert_array_equal(drawn[:, 1], actions(one)[:, 0])
    assert not np.array_equal(drawn[:, 0], drawn[:, 1])
    counts, _ = np.histogram(drawn, bins=10, range=(-1.0, 1.0))
    # A tenth of 9,000 in each, with a standard deviation of 28.
    np.testing.assert_allclose(counts, drawn.size / 10, atol=5 * 28)
    assert abs(np.corrcoef(drawn[:-1, 0, 0], drawn[1:, 0, 0])[0, 1]) < 0.1
    assert abs(np.corrcoef(drawn[:, 0, 0], drawn[:, 1, 0])[0, 1]) < 0.1


def test_later_actions_are_the_policys() -> None:
    model = fleet((0, 1), ENV, random_steps=20)
    model.learn(20 * 2, log_interval=NEVER)
    twin = fleet((0, 1), ENV, random_steps=20)
    twin.learn(20 * 2, log_interval=NEVER)
    obs = model._last_obs
    assert isinstance(obs, np.ndarray)
    wanted = twin.policy(torch.from_numpy(obs.copy())).numpy()
    model.learn(2, log_interval=NEVER, reset_num_timesteps=False)
    np.testing.assert_array_equal(actions(model)[20], wanted)


class Watch(BaseCallback):
    """Notes the steps it is told of, and stops at one of them."""

    def __init__(self, last: int = 10**9) -> None:
        super().__init__()
        self.last, self.seen = last, list[int]()

    def _on_step(self) -> bool:
        self.seen.append(self.num_timesteps)
        return self.num_timesteps < self.last


class Table(KVWriter):
    """Keeps what the logger writes."""

    def __init__(self) -> None:
        self.rows: list[dict[str, Any]] = []

    def write(
        self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0
    ) -> None:
        self.rows.append({**key_values, "step": step})

    def close(self) -> None:
        pass


def test_learn_keeps_stable_baselines3s_conventions() -> None:
    model, watch, table = fleet((0, 1, 2), "point_robot_wind"), Watch(), Table()
    model.set_logger(Logger(folder=None, output_formats=[table]))
    assert model.learn(80 * 3, watch, log_interval=3) is model
    assert watch.seen == [3 * step for step in range(1, 81)]
    assert model.num_timesteps == 240
    # 40 random steps, then bursts of ten updates after every tenth step.
    assert model._n_updates == 40
    # The three robots end their episodes of 25 steps together.
    assert [row["step"] for row in table.rows] == [75, 150, 225]
    assert [row["time/episodes"] for row in table.rows] == [3, 6, 9]
    last = table.rows[-1]
    assert last["rollout/ep_len_mean"] == 25
    assert -60 < last["rollout/ep_rew_mean"] < -5
    assert last["train/n_updates"] == 30
    for name in ("actor_loss", "critic_loss", "ent_coef_loss", "ent_coef"):
        assert np.isfinite(last[f"train/{name}"])
    temperature = model.log_temperature.detach().exp().mean().item()
    assert model.logger.name_to_value["train/ent_coef"] == pytest.approx(temperature)
    model.learn(30, watch, log_interval=NEVER, reset_num_timesteps=False)
    assert model.num_timesteps == 270
    assert model.replay_buffer.pos == 90


def test_a_callback_stops_it() -> None:
    model, watch = fleet((0, 1, 2), "point_robot_wind"), Watch(last=7 * 3)
    model.learn(80 * 3, watch, log_interval=NEVER)
    assert model.num_timesteps == 21
    assert watch.seen[-1] == 21
    assert model._n_updates == 0


def test_it_is_not_saved_to_a_file_that_nothing_opens(tmp_path: Path) -> None:
    model = fleet((0, 1), "point_robot_wind")
    sentence = "a fleet's state is saved by datagen.fleet.state, its policies by --policies of data"
    with pytest.raises(NotImplementedError, match=sentence):
        model.save(tmp_path / "model")
    often = CheckpointCallback(1, str(tmp_path / "often"))
    with pytest.raises(NotImplementedError, match=sentence):
        model.learn(2, often, log_interval=NEVER)
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]


def test_the_same_seeds_give_the_same_bytes() -> None:
    def made(seed: int) -> list[bytes]:
        torch.manual_seed(seed)
        np.random.seed(seed)  # noqa: NPY002 - the global states must not matter
        model = fleet((1, 3), ENV)
        model.learn(60 * 2, log_interval=NEVER)
        values = [parameters(model, row) for row in range(2)]
        held = [value.tobytes() for one in values for value in one.values()]
        return [*held, model.replay_buffer.rows.tobytes()]

    assert made(0) == made(1)


def test_bfloat16_learns_much_the_same() -> None:
    models = [fleet((1, 3), ENV, precision=name) for name in ("float32", "bfloat16")]
    for model in models:
        model.learn(40 * 2, log_interval=NEVER)
        model.train(20, SETTINGS.batch_size)
    start = parameters(fleet((1, 3), ENV), 0)
    one, other = (parameters(model, 0) for model in models)
    for name, value in one.items():
        moved = np.linalg.norm(value - start[name])
        # The random steps are the same, so the updates are, up to the rounding of gradients: Adam
        # steps by the sign of those that are nothing but rounding.
        assert np.linalg.norm(other[name] - value) < 0.5 * moved, name
        # And the temperature by that of all of its, so that only what it sums up of them differs.
        if name != "log_temperature":
            assert np.linalg.norm(other[name] - value) > 0, name
    sums = [next(iter(model.temperature_optimizer.state.values()))["exp_avg"] for model in models]
    assert not torch.equal(*sums)


def test_after_an_update_every_network_computes_with_its_newest_weights() -> None:
    model = fleet((1, 3), ENV, precision="bfloat16")
    before = [value.clone() for value in model.policy.parameters()]
    model.learn(50 * 2, log_interval=NEVER)
    policy = model.policy
    for one, old in zip(policy.parameters(), before, strict=True):
        assert not torch.equal(one, old)
    for net in (policy.actor, *policy.critics, *policy.targets):
        for (weight, bias), *newest in zip(net.lower, net.weights, net.biases, strict=True):
            assert torch.equal(weight, newest[0].to(weight.dtype))
            assert torch.equal(bias, newest[1].to(bias.dtype))
        assert [weight.dtype for weight, _ in net.lower] == [torch.bfloat16] * 2 + [torch.float32]


def test_a_seed_for_each_task() -> None:
    with pytest.raises(ValueError, match="2 tasks need as many seeds, got 1"):
        FleetSAC(FleetVecEnv(ENV, (0, 1)), SETTINGS, [0], 10, 5)


def test_the_settings_are_the_ones_given() -> None:
    settings = replace(SETTINGS, initial_temperature=0.25)
    model = fleet((0, 1), ENV, settings=settings)
    np.testing.assert_allclose(model.log_temperature.exp().detach().numpy(), 0.25, rtol=1e-6)
    assert (model.gamma, model.tau, model.batch_size) == (0.97, 0.02, 16)
    assert {group["lr"] for group in model.temperature_optimizer.param_groups} == {1e-3}
    first: Tensor = model.policy.actor.weights[0]
    assert first.shape == (2, 11, 16)
    assert model.replay_buffer.buffer_size == 400
