"""The plain learner that speed is compared with does the same step as ours."""

from __future__ import annotations

import dataclasses
from typing import Any

import pytest
import torch
from plain_learner import Batch, Network, PlainLearner
from torch import Tensor, nn

from ctmrl.data import OfflineData, Transitions
from ctmrl.meta_train import Learner
from ctmrl.methods.ctmrl import CTMRL
from ctmrl.networks import Critic
from ctmrl.presets import preset
from ctmrl.synthetic import synthetic_dataset


def linears(network: nn.Module) -> list[nn.Linear]:
    return [module for module in network.modules() if isinstance(module, nn.Linear)]


def fill(plain: Network, layers: list[tuple[Tensor, Tensor]]) -> None:
    for linear, (weight, bias) in zip(linears(plain), layers, strict=True):
        linear.weight.data.copy_(weight)
        linear.bias.data.copy_(bias)


def of_mlp(network: nn.Module) -> list[tuple[Tensor, Tensor]]:
    return [(layer.weight.data, layer.bias.data) for layer in linears(network)]


def of_critic(critic: Critic, head: int) -> list[tuple[Tensor, Tensor]]:
    return [
        (weight.data[head].T, bias.data[head, 0])
        for weight, bias in zip(critic.weights, critic.biases, strict=True)
    ]


def together(batches: list[Batch], tasks: int) -> Transitions:
    """The rows of all batches, task by task."""
    columns = [
        torch.stack([x.view(tasks, -1, *x.shape[1:]) for x in one], 1)
        for one in zip(*batches, strict=True)
    ]
    flat = [one.flatten(0, 2) for one in columns]
    return Transitions._make([*flat, torch.zeros(len(flat[0]))])


@pytest.mark.parametrize("dual_steps", [1, 3])
@pytest.mark.parametrize("codebook", [False, True], ids=["before", "codebook"])
def test_its_losses_stay_equal_to_ours(
    codebook: bool, dual_steps: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = preset("point_robot_wind", "ctmrl", "smoke", seed=3)
    config = dataclasses.replace(
        config,
        training=dataclasses.replace(config.training, steps=10_000, decay=False),
        # With a target of 0 and a large weight the divergence matters for the actor at once.
        actor_critic=dataclasses.replace(
            config.actor_critic,
            behavior_regularization=True,
            hidden=(16, 16),
            dual_lr=1e-2,
            dual_steps=dual_steps,
            divergence_target=0.5,
        ),
    )
    dataset = synthetic_dataset("point_robot_wind", episodes=4)
    ours = Learner(config, OfflineData(dataset, dataset.train_tasks))
    tasks = [dataset.read(int(task)) for task in dataset.train_tasks]
    plain = PlainLearner(config, tasks, ours.data.statistics(config.context.next_obs_in_context))
    method, networks = ours.method, plain.networks
    assert isinstance(method, CTMRL)
    fill(networks["encoder"], of_mlp(method.encoder))
    fill(networks["reward"], of_mlp(method.predictors.reward_net))
    fill(networks["state"], of_mlp(method.predictors.state_net))
    fill(networks["actor"], of_mlp(ours.actor_critic.actor))
    fill(networks["critic_1"], of_critic(ours.actor_critic.critic, 0))
    fill(networks["critic_2"], of_critic(ours.actor_critic.critic, 1))
    fill(networks["value"], of_critic(ours.actor_critic.value, 0))
    fill(networks["dual"], of_critic(ours.actor_critic.dual_critic, 0))
    plain.target_value.load_state_dict(networks["value"].state_dict())
    plain.codes.data.copy_(method.codebook.codes.data)
    plain.with_codebook = codebook
    method.codebook.placed.fill_(codebook)
    for _ in range(5):
        chosen = plain.rng.permutation(len(tasks))[: config.training.meta_batch]
        contexts = plain.sample_contexts(chosen)
        batches = [plain.sample_batch(chosen) for _ in range(dual_steps)]
        monkeypatch.setattr(ours, "_draw", lambda *_, found=contexts: found)
        given = together(batches, len(chosen))
        monkeypatch.setattr(ours.data, "transitions", lambda *_, found=given: found)
        # Ours draws tasks first; then both draw the same numbers in the same order.
        monkeypatch.setattr(torch, "randperm", lambda n, generator: torch.arange(n))
        plain.generator.set_state(ours.generator.get_state())
        wanted, found = ours.update(), plain.step(contexts, batches[0], batches[1:])
        for name, value in found.items():
            prefix = "loss/" if f"loss/{name}" in wanted else "loss/encoder/"
            torch.testing.assert_close(
                value.detach(), wanted[prefix + name], rtol=1e-4, atol=1e-5, msg=name
            )
        assert (found["contrast"] > 0) == codebook


def test_its_own_steps_draw_as_many_batches_as_the_preset_has_steps_of_the_dual_critic(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    config = preset("half_cheetah_vel", "ctmrl", "paper")
    config = dataclasses.replace(
        config,
        training=dataclasses.replace(config.training, batch_size=5, context_episodes=1),
        actor_critic=dataclasses.replace(config.actor_critic, hidden=(16, 16)),
    )
    dataset = synthetic_dataset("half_cheetah_vel", episodes=2)
    data = OfflineData(dataset, dataset.train_tasks)
    tasks = [dataset.read(int(task)) for task in dataset.train_tasks]
    plain = PlainLearner(config, tasks, data.statistics(config.context.next_obs_in_context))
    drawn: list[Batch] = []
    sample = plain.sample_batch

    def spied(*chosen: Any) -> Batch:
        drawn.append(sample(*chosen))
        return drawn[-1]

    monkeypatch.setattr(plain, "sample_batch", spied)
    plain.update()
    assert len(drawn) == 3
    steps = {int(one["step"]) for one in plain.optimizers["dual"].state.values()}
    assert steps == {3}
