"""Steps of the dual critic: one on each of a gradient step's batches, and nothing else of it."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.nn import functional

from ctmrl.actor_critic import ActorCritic
from ctmrl.data import OfflineData, Transitions, split_batches
from ctmrl.meta_train import Learner
from ctmrl.table import Room
from datagen.dataset import open_dataset
from tests.ctmrl.examples import ACT, batch, generator, smoke, with_dual_steps
from tests.ctmrl.test_actor_critic import (
    ROWS,
    actor_critic,
    after_a_backward_pass,
    contexts,
    gradients,
)
from tests.ctmrl.test_meta_train import assert_same, config_of, frozen, train

TASKS, PER_TASK = 5, 7
"""Of a step of the smoke preset."""


def batches(count: int) -> list[Transitions]:
    """Batches in double precision that differ."""
    made = [batch(ROWS, seed=seed) for seed in range(count)]
    return [Transitions(*(part.double() for part in one)) for one in made]


def update(ac: ActorCritic, given: Sequence[Transitions]) -> dict[str, Tensor]:
    """A backward pass of the loss on these batches; its metrics."""
    loss, metrics = ac.loss(given[0], contexts(), generator(1), given[1:])
    loss.backward()  # type: ignore[no-untyped-call]
    return metrics


def by_hand(old: ActorCritic, given: Sequence[Transitions], rate: float) -> list[float]:
    """Steps of the dual critic as its formulas have them, by a plain Adam; their losses."""
    dual, z, draw = old.dual_critic, contexts(), generator(1)
    optimizer = torch.optim.Adam(dual.parameters(), lr=rate, fused=False)
    noise = [torch.randn(ROWS, ACT, generator=draw)]
    if len(given) > 1:
        noise += torch.randn((len(given) - 1) * ROWS, ACT, generator=draw).chunk(len(given) - 1)
    losses = []
    for rows, e in zip(given, noise, strict=True):
        with torch.no_grad():
            mean, log_std = old.actor(rows.obs, z)
            action = torch.tanh(mean + log_std.exp() * e)
        between = action + torch.rand(ROWS, 1, generator=draw) * (rows.action - action)
        bound = (dual(rows.obs, between, z)[0] ** 2 + 1e-8).sqrt()
        at_policy = functional.softplus(dual(rows.obs, action, z)[0])
        at_data = functional.softplus(dual(rows.obs, rows.action, z)[0])
        divergence = ((at_policy + 1e-8).log() - at_data + 1).mean()
        loss = 5 * ((bound - 1).clamp_min(0) ** 2).mean() - divergence
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    return losses


@pytest.mark.parametrize("count", [1, 2, 3])
def test_the_dual_critic_takes_a_step_on_each_batch(count: int) -> None:
    ac = actor_critic(behavior_regularization=True, dual_lr=3e-3)
    with torch.no_grad():
        # Steep enough for the penalty to bite.
        for parameter in ac.dual_critic.parameters():
            parameter.mul_(3.0)
    old, given = copy.deepcopy(ac), batches(count)
    begin = copy.deepcopy(ac.dual_critic)
    metrics = update(ac, given)
    losses = by_hand(old, given, 3e-3)
    for found, wanted, before in zip(
        *(one.parameters() for one in (ac.dual_critic, old.dual_critic, begin)), strict=True
    ):
        torch.testing.assert_close(found, wanted, rtol=1e-9, atol=1e-12)
        assert (found - before).abs().max() > 0.5 * count * 3e-3
    assert metrics["loss/dual_critic"].item() == pytest.approx(sum(losses) / count, rel=1e-9)
    assert len(set(losses)) == count


def test_the_divergence_is_of_the_current_batch_behind_all_steps() -> None:
    ac, (rows, *further) = actor_critic(behavior_regularization=True, dual_lr=0.1), batches(3)
    old, z = copy.deepcopy(ac), contexts()
    metrics = update(ac, [rows, *further])
    action = old.actor.sample(rows.obs, z, generator(1)).action
    # `ac.dual_critic` has taken its steps.
    at_policy = functional.softplus(ac.dual_critic(rows.obs, action, z)[0])
    at_data = functional.softplus(ac.dual_critic(rows.obs, rows.action, z)[0])
    divergence = (torch.log(at_policy + 1e-8) - at_data + 1).mean()
    assert metrics["divergence/mean"].item() == pytest.approx(divergence.item(), rel=1e-9)
    one = after_a_backward_pass(copy.deepcopy(old), rows, z)
    assert metrics["divergence/mean"].item() != pytest.approx(one["divergence/mean"].item())


def test_further_batches_train_nothing_but_the_dual_critic() -> None:
    # Without a weight of the divergence it is only for the dual critic to see them.
    settings = {"behavior_regularization": True, "divergence_initial": 0.0}
    alone = actor_critic(**settings)
    further = copy.deepcopy(alone)
    assert further.dual_optimizer
    further.dual_optimizer = torch.optim.Adam(further.dual_critic.parameters(), lr=1e-4)
    given = batches(3)
    update(alone, given[:1])
    update(further, given)
    for name in ("actor", "critic", "value"):
        pairs = zip(*(gradients(getattr(ac, name)) for ac in (alone, further)), strict=True)
        for one, other in pairs:
            assert one.equal(other), name
            assert one.any(), name
    twins = zip(alone.dual_critic.parameters(), further.dual_critic.parameters(), strict=True)
    assert not any(one.equal(other) for one, other in twins)


@pytest.mark.parametrize("penalty", ["value", "gradient"])
def test_the_steps_reach_no_other_network_and_no_context(penalty: Any) -> None:
    ac = actor_critic(behavior_regularization=True, dual_penalty=penalty)
    z = contexts().requires_grad_()
    given = batches(3)
    action = torch.zeros(ROWS, ACT).double()
    loss = ac._train_dual(given, z.detach(), action, generator())
    assert not loss.requires_grad
    reached = {name for name, p in ac.named_parameters() if p.grad is not None}
    assert {name.partition(".")[0] for name in reached} == {"dual_critic"}
    assert z.grad is None


def test_the_encoder_learns_the_same_with_any_number_of_them(wind_data: OfflineData) -> None:
    found = []
    for steps in (1, 3):
        learner = Learner(with_dual_steps(config_of("focal", decay=False), steps), wind_data)
        learner.update()
        found.append([parameter.detach() for parameter in learner.method.encoder.parameters()])
    assert all(one.equal(other) for one, other in zip(*found, strict=True))


@pytest.mark.parametrize("count", [1, 2, 3])
def test_rows_are_split_task_by_task(count: int) -> None:
    n = 2 * 4 * count
    rows = batch(n)._replace(rank=torch.arange(n).float())
    found = split_batches(rows, 2, count)
    wanted = [[t * 4 * count + k * 4 + i for t in (0, 1) for i in range(4)] for k in range(count)]
    assert [one.rank.tolist() for one in found] == wanted
    for one, numbers in zip(found, wanted, strict=True):
        assert all(part.equal(whole[numbers]) for part, whole in zip(one, rows, strict=True))
    if count == 1:
        pairs = zip(found[0], rows, strict=True)
        assert all(one.data_ptr() == whole.data_ptr() for one, whole in pairs)


@pytest.mark.parametrize("steps", [1, 2, 3])
def test_batches_are_others_of_the_same_tasks_with_the_same_contexts(
    steps: int, wind_data: OfflineData, monkeypatch: pytest.MonkeyPatch
) -> None:
    learner = Learner(with_dual_steps(smoke(), steps), wind_data)
    seen: list[tuple[Transitions, Tensor]] = []
    asked: list[Tensor] = []
    dual, draw = learner.actor_critic._update_dual, wind_data.transitions

    def spied_dual(rows: Transitions, z: Tensor, *rest: Any) -> Tensor:
        seen.append((rows, z))
        return dual(rows, z, *rest)

    def spied_draw(tasks: Tensor, *rest: Any) -> Transitions:
        asked.append(tasks)
        return draw(tasks, *rest)

    monkeypatch.setattr(learner.actor_critic, "_update_dual", spied_dual)
    monkeypatch.setattr(wind_data, "transitions", spied_draw)
    learner.update()
    (tasks,) = asked
    assert len(seen) == steps
    start = wind_data._task_start.tolist()
    # The noisy actions of these data are all different.
    place = {
        tuple(row): k for k, row in enumerate(wind_data.unpack(wind_data.table).action.tolist())
    }
    assert len(place) == len(wind_data.table)
    drawn = set()
    for rows, z in seen:
        assert z is seen[0][1]
        numbers = [place[tuple(row)] for row in rows.action.tolist()]
        assert wind_data.unpack(wind_data.table[numbers]).obs.equal(rows.obs)
        owners = [max(t for t in range(7) if start[t] <= number) for number in numbers]
        assert owners == tasks.repeat_interleave(PER_TASK).tolist()
        drawn.add(tuple(numbers))
    assert len(drawn) == steps


@pytest.mark.parametrize(("brac", "steps"), [(False, 1), (False, 3), (True, 1), (True, 3)])
def test_what_a_step_draws(brac: bool, steps: int, wind_data: OfflineData) -> None:
    config = with_dual_steps(smoke(method="focal"), steps, brac)
    learner = Learner(config, wind_data)
    draw, rows = generator(config.seed), TASKS * PER_TASK
    learner.update()
    tasks = torch.randperm(7, generator=draw)[:TASKS]
    sets = learner.method.context_sets
    wind_data.contexts(tasks, sets, 1, config.training.context_size, draw)
    count = steps if brac else 1
    torch.rand(TASKS, count * PER_TASK, generator=draw)
    torch.randn(rows, 2, generator=draw)
    if count > 1:
        torch.randn((count - 1) * rows, 2, generator=draw)
    for _ in range(count * brac):
        torch.rand(rows, 1, generator=draw)
    assert learner.generator.get_state().equal(draw.get_state())


def test_without_a_dual_critic_they_change_nothing(wind_data: OfflineData) -> None:
    one, three = (Learner(with_dual_steps(smoke(), n, False), wind_data) for n in (1, 3))
    assert train(one, 5) == train(three, 5)
    assert_same(one.state(), three.state())


@pytest.mark.parametrize("in_file", [False, True])
def test_a_run_goes_on_bit_for_bit(in_file: bool, wind_path: Path, tmp_path: Path) -> None:
    dataset = open_dataset(wind_path)
    room = Room(0, tmp_path) if in_file else None
    data = OfflineData(dataset, dataset.train_tasks, room=room)
    config = with_dual_steps(config_of(), 3)
    whole, resumed = (Learner(config, data) for _ in range(2))
    train(whole, 5)
    resumed.load(frozen(whole.state()))
    assert train(resumed, 7) == train(whole, 7)
    assert_same(resumed.state(), whole.state())
    # The dual critic's optimiser counts its own steps.
    assert whole.state()["optimizer/dual_critic/0/step"] == 36
    assert whole.state()["optimizer/main/0/step"] == 12


def test_all_batches_are_looked_at(wind_data: OfflineData) -> None:
    learner, seen = Learner(with_dual_steps(smoke(), 3), wind_data), dict[str, Tensor]()
    learner.update(seen.update)
    for name in Transitions._fields:
        assert len(seen[f"data/{name}"]) == 3 * TASKS * PER_TASK
