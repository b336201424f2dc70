"""Defects of the field's published code, and where a test keeps each of them out of here.

Defects of the code that was released with the source paper:

| R | defect | test |
|---|---|---|
| 1 | stops after an iteration; would collect codes before there are any | `test_r1_...` |
| 2 | an unmatched code decays to 0: its cosine is NaN and draws every task | `test_r2_...` |
| 3 | metrics stand under wrong names, test tasks' as training tasks' | `test_r3_...` |
| 4 | needs an account, a window system and a file a trajectory | `test_r4_...` |
| 5 | encodes all training tasks twice more in every step | `test_r5_...` |

Defects that the field's code bases share or hand on:

| F | defect | test |
|---|---|---|
| 1 | environments reseed the generator everyone shares | `test_f1_...`, tests/meta_envs |
| 2 | the time limit is stored as a real end | `test_f2_...` |
| 3 | contact costs that vanish | tests/meta_envs/test_ant.py, test_humanoid.py |
| 4 | inertia drawn apart from mass, friction of the floor | tests/meta_envs/test_rand_params.py |
| 5 | a frame skip that is asked for and not used | tests/meta_envs/test_simulation.py |
| 6 | a goal radius of the wrong sign | tests/meta_envs/test_point_robot.py |
| 7 | batches without repetition leave FOCAL no positive pairs | `test_f7_...` |
| 8 | the multiplier winds up; a penalty on the value, not the gradient | `test_f8_...` |
| 9 | initial weights scaled by the number of outputs | `test_f9_...` |
| 10 | training tasks are scored on a draw with repetition | `test_f10_...` |
| 11 | behaviour checkpoints that exist are left out | tests/datagen/test_budgets.py |
| 12 | R1 to R4 | there |
| 13 | the order of a folder's listing is the order of the tasks | `test_f13_...` |
| 14 | observations are scaled after a step but not after a reset | `test_f14_...` |
| 15 | episodes that end early shift the evaluation's counters | `test_f15_...` |
| 16 | models that newer MuJoCo releases refuse | tests/meta_envs/test_simulation.py |
| 17 | seeds that do not reach the reset | `test_f17_...` |
| 18 | all tasks have one goal: only r and s' tell the wind | `test_f18_...` |
"""

from __future__ import annotations

import ast
import dataclasses
import random
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
import torch
from torch import Tensor

import ctmrl as package
from ctmrl.actor_critic import ActorCriticConfig
from ctmrl.brac import Multiplier, Penalty, gradient_penalty, value_penalty
from ctmrl.codebook import Codebook
from ctmrl.data import OfflineData
from ctmrl.evaluate import evaluate_agent
from ctmrl.meta_test import MetaTestConfig, meta_test
from ctmrl.meta_train import Learner
from ctmrl.networks import Actor, ContextEncoder, Critic
from ctmrl.runs import read_json
from datagen.dataset import open_dataset, task_file, write_index, write_task
from meta_envs import task_set
from tests.ctmrl.conftest import FinishedRun
from tests.ctmrl.examples import CODES, Z, ctmrl, generator, normal, open_hand_made, smoke
from tests.datagen.examples import index_of, task_data

WIND = "point_robot_wind"
ONCE = MetaTestConfig(random_episodes=1, policy_episodes=1, repetitions=1)


def networks(obs: tuple[Tensor, Tensor] | None = None) -> tuple[ContextEncoder, Actor]:
    """An untrained encoder and actor for the point robots."""
    statistics = obs or (torch.zeros(2), torch.ones(2))
    context = torch.zeros(7), torch.ones(7)
    return ContextEncoder(context, 2, (11,), Z), Actor(statistics, Z, (13,), 2)


@pytest.mark.parametrize("steps", [5, 40])
def test_r1_training_passes_every_stage_and_collects_contexts(
    steps: int, wind_data: OfflineData, monkeypatch: pytest.MonkeyPatch
) -> None:
    learner = Learner(smoke(steps), wind_data)
    drawn: list[Tensor] = []
    draw = learner.all_contexts

    def spied() -> Tensor:
        drawn.append(draw())
        return drawn[-1]

    monkeypatch.setattr(learner, "all_contexts", spied)
    method: Any = learner.method
    while learner.step < steps:
        before = len(drawn)
        learner.update()
        for number, contexts in enumerate(reversed(drawn[before:])):
            # What was drawn last is in the collection, before there are codes and after.
            slots = [slot for slot in method.collected if slot.equal(contexts)]
            assert len(slots) == 1, number
            assert contexts.abs().max() < 1
    assert method.codebook.placed
    assert drawn


def test_r2_a_dead_code_neither_decays_nor_draws_the_tasks() -> None:
    book = Codebook(CODES, Z, generator())
    contexts = normal(17, Z).float()
    contexts[:, 0] = -3.0
    with torch.no_grad():
        book.codes[2] = torch.tensor([1.0] + [0.0] * (Z - 1))
    dead = book.codes[2].clone()
    for _ in range(1000):
        matched = book.match(contexts)
        book.update(contexts, matched, 0.1)
        assert (matched != 2).all()
    assert book.codes[2].equal(dead)
    assert book.codes.isfinite().all()
    assert len(set(matched.tolist())) > 1
    # Even a code of length 0 draws nobody from a code that points the same way.
    with torch.no_grad():
        book.codes[2] = 0.0
    assert (book.match(contexts) != 2).all()


def test_r3_returns_stand_under_the_names_of_their_tasks(
    finished_run: FinishedRun, wind_data: OfflineData
) -> None:
    record = read_json(finished_run.path / "evaluation.json")["groups"]
    assert record["seen"]["tasks"] == wind_data.tasks.tolist()
    assert record["unseen"]["tasks"] == task_set(WIND).test_tasks.tolist()
    assert record["seen"]["return"] != record["unseen"]["return"]
    learner, tasks = Learner(smoke(), wind_data), task_set(WIND)
    encoder, actor = learner.method.encoder, learner.actor_critic.actor
    groups = {"unseen": tasks.test_tasks, "seen": wind_data.tasks}
    config = dataclasses.replace(smoke(), meta_test=ONCE)
    found = evaluate_agent(learner.agent, config, tasks, groups, {}, 0)["np_online"]["groups"]
    for name, rows in groups.items():
        wanted = meta_test(encoder, actor, tasks, rows, ONCE, 0).returns.mean()
        assert found[name]["return"] == pytest.approx(wanted)


def test_r4_no_account_no_window_and_one_file_a_task(wind_path: Path) -> None:
    imported: set[str] = set()
    for path in Path(package.__file__).parent.rglob("*.py"):
        tree = ast.parse(path.read_text())
        # Loggers that need an account are loaded for those alone who ask for them by name.
        for node in tree.body if path.name == "loggers.py" else ast.walk(tree):
            if isinstance(node, ast.Import):
                imported |= {alias.name.partition(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module:
                imported.add(node.module.partition(".")[0])
    assert {"torch", "numpy", "sys"} <= imported
    assert not imported & {"wandb", "neptune", "comet_ml", "turtle", "tkinter"}
    # Nine tasks, and the index.
    assert len(list(wind_path.iterdir())) == 9 + 1


@pytest.mark.parametrize("method", ["ctmrl", "ctmrl_released"])
def test_r5_a_step_encodes_two_contexts_of_each_task_of_its_batch_and_no_more(
    method: str, wind_data: OfflineData
) -> None:
    learner = Learner(smoke(40, method=method), wind_data)
    encoded: list[tuple[int, ...]] = []
    learner.method.encoder.register_forward_hook(
        lambda module, given, z: encoded.append(tuple(given[0].shape))
    )
    quiet = 0
    for _ in range(40):
        encoded.clear()
        learner.update()
        # The cycle of the published code encodes what its predictors make of the first ones.
        if method == "ctmrl_released" and learner.method.phase:
            assert encoded.pop() == (5, 11, 7)
        # All seven tasks only when the schedule collects.
        assert encoded[-1] == (2, 5, 11, 7)
        assert set(encoded[:-1]) <= {(1, 7, 11, 7)}
        quiet += len(encoded) == 1
    assert quiet > 0


def test_f1_nothing_draws_from_or_seeds_a_shared_generator(wind_data: OfflineData) -> None:
    def shared() -> list[Any]:
        state: Any = np.random.get_state()  # noqa: NPY002 - only looked at
        numpys = [part.tolist() if n == 1 else part for n, part in enumerate(state)]
        return [random.getstate(), numpys, torch.random.get_rng_state().tolist()]

    before = shared()
    learner = Learner(smoke(5), wind_data)
    for _ in range(5):
        learner.update()
    agent = learner.agent
    meta_test(agent.method.encoder, agent.actor, task_set(WIND), np.array([2, 7]), ONCE, 0)
    assert shared() == before


def test_f2_the_time_limit_is_no_end_unless_asked_for(wind_path: Path) -> None:
    dataset = open_dataset(wind_path)
    plain, habit = (OfflineData(dataset, dataset.train_tasks, asked) for asked in (False, True))
    # Point robots never terminate: 7 tasks, 6 episodes each.
    assert plain.unpack(plain.table).terminal.sum() == 0
    assert habit.unpack(habit.table).terminal.sum() == 7 * 6
    assert not ActorCriticConfig().timeouts_as_terminals
    # Real ends stay ends.
    real = open_hand_made({0: (3, 5, 7)})
    assert real.unpack(real.table).terminal.nonzero()[:, 0].tolist() == [7]


def test_f7_positives_come_from_other_episodes_and_not_from_repeated_tasks(
    wind_data: OfflineData, monkeypatch: pytest.MonkeyPatch
) -> None:
    contexts = wind_data.contexts(torch.arange(7), 2, 1, 25, generator())
    anchors, positives = ({tuple(row) for row in part.tolist()} for part in contexts.flatten(1, 2))
    assert not anchors & positives
    assert ctmrl().context_sets == 2
    learner = Learner(smoke(5), wind_data)
    batches: list[Tensor] = []
    draw = wind_data.contexts

    def spied(tasks: Tensor, *rest: Any) -> Tensor:
        batches.append(tasks)
        return draw(tasks, *rest)

    monkeypatch.setattr(wind_data, "contexts", spied)
    for _ in range(5):
        learner.update()
    assert len(batches) >= 5
    for tasks in batches:
        assert len(set(tasks.tolist())) == len(tasks)


def test_f8_winding_up_and_the_penalty_on_the_value_are_switches() -> None:
    assert not ActorCriticConfig().divergence_wind_up
    multiplier = Multiplier(1990.0, 2000.0, 0.05, ActorCriticConfig().divergence_wind_up)
    for _ in range(1000):
        multiplier.update(torch.tensor([0.95]))
    assert multiplier.value == 2000.0
    for _ in range(10):
        multiplier.update(torch.tensor([-0.95]))
    assert multiplier.coefficient() == 1990.0
    assert get_args(Penalty) == ("value", "gradient")
    # A critic of slope 3 everywhere is for the gradient penalty to hold down, though it is small.
    actions = torch.zeros(5, 1, requires_grad=True)
    between = 3.0 * actions[:, 0]
    assert value_penalty(between) == 0.0
    assert gradient_penalty(between, actions) == pytest.approx(20.0)


def test_f9_initial_weights_are_scaled_by_the_number_of_inputs() -> None:
    # 5 inputs and 1009 outputs, and the reverse: by outputs the two bounds would be swapped.
    critic = Critic((torch.zeros(2), torch.ones(2)), 3, (1009, 5), heads=2)
    for weight, inputs in zip(critic.weights, (5, 1009, 5), strict=True):
        assert weight.abs().max() <= inputs**-0.5
        assert weight.abs().max() > 0.7 * inputs**-0.5
    encoder = ContextEncoder((torch.zeros(7), torch.ones(7)), 2, (1009,), 5)
    for parameter, inputs in zip(encoder.net.parameters(), (7, 7, 1009, 1009), strict=True):
        assert 0.7 * inputs**-0.5 < parameter.abs().max() <= inputs**-0.5


def test_f10_seen_tasks_are_all_training_tasks_once(finished_run: FinishedRun) -> None:
    record = read_json(finished_run.path / "evaluation.json")
    assert record["groups"]["seen"]["tasks"] == [0, 1, 3, 4, 5, 6, 8]
    assert len(record["groups"]["seen"]["task_returns"]) == 7


def test_f13_the_order_of_files_has_no_part_in_it(wind_path: Path, tmp_path: Path) -> None:
    tasks = (0, 3, 5, 1)
    for task in tasks:
        write_task(tmp_path / task_file(task), task_data(task, episodes=6))
    write_index(tmp_path, index_of(tmp_path, WIND, tasks, 6, 0))
    dataset = open_dataset(tmp_path)
    assert dataset.train_tasks.tolist() == [0, 1, 3, 5]
    found = OfflineData(dataset, dataset.train_tasks)
    wanted = OfflineData(open_dataset(wind_path), dataset.train_tasks)
    assert found.table.equal(wanted.table)


def test_f14_the_first_observation_is_standardised_like_all_others(wind_data: OfflineData) -> None:
    mean, std = wind_data.statistics(True).obs
    _, actor = networks((mean, std))
    z = normal(1, Z).float()
    for obs in (torch.zeros(1, 2), torch.ones(1, 2)):
        # The networks see raw observations and standardise them themselves, whatever step it is.
        pre = actor.net(torch.cat([(obs - mean) / std, z], dim=1))[:, :2]
        torch.testing.assert_close(actor.act(obs, z), torch.tanh(pre.detach()))
    starts = wind_data.table[::25, :2]
    assert not starts.any()


@pytest.mark.usefixtures("noisy_robot")
def test_f15_phases_count_episodes_and_not_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    encoder, actor = networks()
    with torch.no_grad():
        # To the right as fast as it goes, over the edge where the noisy robot's episodes end.
        list(actor.parameters())[-1].copy_(torch.tensor([3.0, 0.0, -5.0, -5.0]))
    tasks = task_set("noisy_robot")
    counts = []
    encode = encoder.forward

    def counting(context: Tensor) -> Tensor:
        counts.append(len(context))
        return encode(context)

    monkeypatch.setattr(encoder, "forward", counting)
    protocol = MetaTestConfig(random_episodes=2, policy_episodes=3, repetitions=1)
    result = meta_test(encoder, actor, tasks, np.array([1, 4, 7]), protocol, 0)
    # Two random episodes of up to 9 steps, then three that end within 4: five in all.
    assert result.curve.shape == (6, 3)
    assert 5 * 2 <= len(counts) <= 2 * 9 + 3 * 4


@pytest.mark.usefixtures("noisy_robot")
def test_f17_the_seed_reaches_the_reset() -> None:
    encoder, actor = networks()
    tasks, rows = task_set("noisy_robot"), np.array([1, 4, 7])
    nothing = MetaTestConfig(random_episodes=0, policy_episodes=0, repetitions=2)
    first, again, other = (
        meta_test(encoder, actor, tasks, rows, nothing, seed).returns for seed in (0, 0, 1)
    )
    # Nothing but the start of the only episode is random here.
    np.testing.assert_array_equal(first, again)
    assert (first != other).all()
    assert (first[0] != first[1]).all()


def test_f18_contexts_hold_what_tells_the_wind(wind_data: OfflineData) -> None:
    contexts = wind_data.contexts(torch.arange(7), 1, 2, 17, generator())[0]
    obs, action, reward, next_obs = torch.split(contexts, [2, 2, 1, 2], dim=-1)
    wind = torch.from_numpy(task_set(WIND).params[wind_data.tasks]).float()
    torch.testing.assert_close(
        next_obs - obs - 0.1 * action, wind[:, None].expand(7, 17, 2), atol=1e-6, rtol=0
    )
    distance = (next_obs - torch.tensor([1.0, 0.0])).norm(dim=-1, keepdim=True)
    torch.testing.assert_close(reward, -distance, atol=1e-5, rtol=0)
