"""The training tasks' table: which rows batches and contexts are drawn from."""

from __future__ import annotations

import itertools
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from ctmrl.data import OfflineData
from ctmrl.errors import UsageError
from ctmrl.table import Room
from datagen.dataset import DatasetError, Quality, open_dataset, task_file
from meta_envs import task_set
from tests.ctmrl.examples import ACT, OBS, generator, open_hand_made
from tests.datagen.examples import graded_data, write_tasks

LENGTHS = {7: (3, 11, 2, 5, 13), 2: (17,) * 7, 5: (1, 2, 3, 1, 2, 3)}
"""Episodes of three tasks, in the order of the table: the learner's tasks 0, 1 and 2."""
TASK_OF = list(LENGTHS)


@pytest.fixture(scope="module")
def data() -> OfflineData:
    return open_hand_made(LENGTHS)


def wanted_reward(obs: Tensor) -> Tensor:
    """The reward of rows (task, episode, step)."""
    return 1000 * obs[..., 0] + 10 * obs[..., 1] + obs[..., 2] / 10


def test_the_table_counts_tasks_and_episodes(data: OfflineData) -> None:
    assert len(data) == 3
    assert data.tasks.tolist() == [7, 2, 5]
    assert data.episodes == 5
    assert (data.obs_dim, data.act_dim) == (OBS, ACT)
    assert data.table.dtype == torch.float32
    assert len(data.table) == 34 + 7 * 17 + 12


def test_each_task_has_its_own_parameters(data: OfflineData) -> None:
    assert data.params.tolist() == [[7, -7], [2, -2], [5, -5]]
    assert data.params.dtype == torch.float32


def test_a_batch_is_of_the_right_tasks_in_order(data: OfflineData) -> None:
    tasks, n = torch.tensor([2, 0]), 13
    found = data.transitions(tasks, n, generator())
    shapes = [(26, OBS), (26, ACT), (26,), (26, OBS), (26,), (26,)]
    assert [tuple(part.shape) for part in found] == shapes
    assert found.obs[:, 0].tolist() == [5.0] * n + [7.0] * n
    # The actor-critic learns from the dense reward, which is minus the other one here.
    torch.testing.assert_close(found.reward, -wanted_reward(found.obs))
    reward = -found.reward
    torch.testing.assert_close(found.action, torch.stack([reward.sin(), reward.cos()], dim=1))
    moved = found.obs + torch.tensor([0.0, 0.0, 1.0])
    assert found.next_obs.equal(moved)


def test_batches_are_uniform_over_a_tasks_rows_with_replacement(data: OfflineData) -> None:
    found = data.transitions(torch.tensor([0]), 34_000, generator())
    rows, counts = np.unique(found.obs.numpy(), axis=0, return_counts=True)
    assert len(rows) == 34
    # Binomial: mean 1000, deviation 31.
    assert np.abs(counts - 1000).max() < 140


@pytest.mark.parametrize("timeouts_as_terminals", [False, True])
def test_terminals_are_real_ends_unless_asked_otherwise(timeouts_as_terminals: bool) -> None:
    table = open_hand_made(LENGTHS, timeouts_as_terminals)
    found = table.transitions(torch.tensor([0, 1, 2]), 5_003, generator())
    task, episode, step = found.obs.long().unbind(dim=1)
    for k in range(len(task)):
        length = LENGTHS[int(task[k])][int(episode[k])]
        last = bool(step[k] == length - 1)
        odd = bool(episode[k] % 2 == 1)
        assert bool(found.terminal[k]) == (last and (odd or timeouts_as_terminals))


def test_contexts_have_the_rows_of_their_episodes_and_tasks(data: OfflineData) -> None:
    tasks, sets, episodes, n = torch.tensor([1, 2, 0]), 2, 2, 1_009
    found = data.contexts(tasks, sets, episodes, n, generator())
    assert found.shape == (sets, 3, n, 2 * OBS + ACT + 1)
    obs, action, reward, next_obs = torch.split(found, [OBS, ACT, 1, OBS], dim=-1)
    # Contexts see the environment's own reward, not the dense one.
    torch.testing.assert_close(reward[..., 0], wanted_reward(obs))
    torch.testing.assert_close(action, torch.cat([reward.sin(), reward.cos()], dim=-1))
    assert next_obs.equal(obs + torch.tensor([0.0, 0.0, 1.0]))
    for k, i in itertools.product(range(sets), range(3)):
        task = TASK_OF[int(tasks[i])]
        assert (obs[k, i, :, 0] == task).all()
        chosen = sorted({int(e) for e in obs[k, i, :, 1]})
        assert len(chosen) == episodes
        rows = {(int(e), int(t)) for _, e, t in obs[k, i].tolist()}
        assert rows == {(e, t) for e in chosen for t in range(LENGTHS[task][e])}


def test_no_episode_is_in_two_of_a_tasks_sets(data: OfflineData) -> None:
    draw, seen = generator(), set()
    for _ in range(60):
        found = data.contexts(torch.arange(3), 2, 2, 211, draw)
        for i in range(3):
            first, second = ({*found[k, i, :, 1].long().tolist()} for k in range(2))
            assert len(first) == len(second) == 2
            assert not first & second
            seen |= {(i, episode) for episode in first | second}
    # And every episode has its turn.
    assert seen == {(i, e) for i, t in enumerate(TASK_OF) for e in range(len(LENGTHS[t]))}


def test_all_episodes_of_the_smallest_task_can_be_used(data: OfflineData) -> None:
    found = data.contexts(torch.tensor([0]), 5, 1, 101, generator())
    assert sorted(found[:, 0, 0, 1].tolist()) == [0.0, 1.0, 2.0, 3.0, 4.0]


def test_contexts_are_uniform_over_the_rows_of_their_episodes(data: OfflineData) -> None:
    # Episodes of 3, 11, 2, 5 and 13 steps: a step counts, not an episode.
    found = data.contexts(torch.tensor([0]), 1, 5, 34_000, generator())
    _, counts = np.unique(found[0, 0, :, :OBS].numpy(), axis=0, return_counts=True)
    assert len(counts) == 34
    assert np.abs(counts - 1000).max() < 140


def test_episodes_are_chosen_uniformly(data: OfflineData) -> None:
    draw, counts = generator(), torch.zeros(5)
    for _ in range(500):
        found = data.contexts(torch.tensor([0]), 1, 1, 2, draw)
        counts[int(found[0, 0, 0, 1])] += 1
    assert (counts - 100).abs().max() < 45


def test_the_mean_value_is_that_of_a_walk_that_ends_as_often_as_the_data(data: OfflineData) -> None:
    rows = data.unpack(data.table)
    reward, end = rows.reward.double().mean().item(), rows.terminal.double().mean().item()
    assert 0 < end < 1
    alive = (1 - end) ** np.arange(2_000)
    wanted = reward * (0.97 ** np.arange(2_000) * alive).sum()
    assert data.mean_value(0.97) == pytest.approx(wanted, rel=1e-4)


def test_a_rows_rank_is_the_share_of_its_tasks_rows_in_episodes_of_lower_returns() -> None:
    table = open_hand_made({7: (3, 11, 2, 5, 13), 2: (4, 4, 4)})
    rows = table.unpack(table.table)
    task, episode, _ = rows.obs.unbind(dim=1)
    for k in range(len(task)):
        own = task == task[k]
        of_episode = {int(e): rows.reward[own & (episode == e)].sum() for e in episode[own]}
        lower = [e for e, found in of_episode.items() if found < of_episode[int(episode[k])]]
        count = sum(int((own & (episode == e)).sum()) for e in lower)
        assert rows.rank[k].item() == pytest.approx(count / int(own.sum()))
    assert sorted({*rows.rank[task == 2].tolist()}) == pytest.approx([0, 1 / 3, 2 / 3])


def test_episodes_of_one_return_have_one_rank(data: OfflineData) -> None:
    # The first task's episodes have 3, 11, 2, 5 and 13 rows.
    reward = torch.zeros(len(data.table))
    reward[:3], reward[3:14] = 2.0, 0.5
    wanted = [31 / 34, 20 / 34, 0.0, 0.0, 0.0]
    assert data._ranks(reward)[:5].tolist() == pytest.approx(wanted)


def test_draws_depend_on_the_generator_alone(data: OfflineData) -> None:
    tasks = torch.tensor([1, 0])
    first, again, other = (data.contexts(tasks, 2, 2, 7, generator(seed)) for seed in (3, 3, 4))
    assert first.equal(again)
    assert not first.equal(other)
    one, same = (data.transitions(tasks, 7, generator(3)).obs for _ in range(2))
    assert one.equal(same)


@pytest.mark.parametrize(("sets", "episodes"), [(2, 3), (1, 6), (6, 1)])
def test_too_few_episodes_are_one_sentence(data: OfflineData, sets: int, episodes: int) -> None:
    with pytest.raises(UsageError, match=f"{sets} x {episodes} .*the dataset has 5: collect more"):
        data.contexts(torch.tensor([1]), sets, episodes, 7, generator())
    with pytest.raises(UsageError):
        data.check_episodes(sets, episodes)


@pytest.mark.parametrize("next_obs", [True, False])
def test_statistics_against_numpy(wind_path: Path, next_obs: bool) -> None:
    dataset = open_dataset(wind_path)
    columns = [dataset.read(int(task)).columns for task in dataset.train_tasks]
    obs, action, reward, after = (
        np.concatenate([part[name] for part in columns]).astype(np.float64)
        for name in ("observations", "actions", "rewards", "next_observations")
    )
    change = after - obs
    seen = [obs, action, reward[:, None]] + [change] * next_obs
    params = task_set("point_robot_wind").params[dataset.train_tasks]
    wanted = obs, np.hstack(seen), np.hstack([reward[:, None], change]), params
    found = OfflineData(dataset, dataset.train_tasks).statistics(next_obs)
    for (mean, std), values in zip(found, wanted, strict=True):
        np.testing.assert_allclose(mean, values.mean(axis=0), atol=1e-5)
        np.testing.assert_allclose(std, values.std(axis=0, ddof=1), rtol=1e-4)


def test_statistics_are_exactly_those_of_the_whole_columns(wind_data: OfflineData) -> None:
    """Published runs rest on every bit of them."""
    obs, change = wind_data.table[:, :2], wind_data.table[:, 5:7] - wind_data.table[:, :2]
    before = wind_data.table[:, :5]
    for next_obs in (True, False):
        seen = torch.cat([before, change], dim=1) if next_obs else before
        wanted = obs, seen, torch.cat([before[:, -1:], change], dim=1), wind_data.params
        found = wind_data.statistics(next_obs)
        for (mean, std), values in zip(found, wanted, strict=True):
            assert mean.equal(values.mean(dim=0))
            assert std.equal(values.std(dim=0))


@pytest.mark.parametrize("quality", ["mixed", "early"])
def test_a_table_in_a_file_is_the_same(quality: Quality, wind_path: Path, tmp_path: Path) -> None:
    part = open_dataset(wind_path).select(quality)
    memory, file = (
        OfflineData(part, part.train_tasks, room=Room(gigabytes, tmp_path)) for gigabytes in (1, 0)
    )
    assert (memory.in_file, file.in_file) == (False, True)
    assert file.table.equal(memory.table)
    for next_obs in (True, False):
        pairs = zip(file.statistics(next_obs), memory.statistics(next_obs), strict=True)
        assert all(a.equal(b) for one, other in pairs for a, b in zip(one, other, strict=True))


def test_rows_drawn_are_those_of_the_batch(data: OfflineData) -> None:
    tasks = torch.tensor([2, 0])
    rows = data.batch_rows(tasks, 5, generator())
    assert data.table[rows, :OBS].equal(data.transitions(tasks, 5, generator()).obs)
    rows = data.context_rows(tasks, 2, 2, 5, generator())
    found = data.contexts(tasks, 2, 2, 5, generator())
    assert data.table[rows, : found.shape[-1]].equal(found.flatten(0, 2))


def test_contexts_see_sparse_rewards_and_batches_dense_ones(sparse_path: Path) -> None:
    dataset = open_dataset(sparse_path)
    data = OfflineData(dataset, dataset.train_tasks)
    tasks = torch.arange(len(data))
    for i, task in enumerate(dataset.train_tasks):
        goal = dataset.params[dataset.tasks == task][0]
        dense = data.transitions(tasks[i : i + 1], 300, generator())
        distance = np.linalg.norm(dense.next_obs.numpy() - goal, axis=1)
        np.testing.assert_allclose(dense.reward, -distance, atol=1e-5)
        context = data.contexts(tasks[i : i + 1], 1, 4, 300, generator())[0, 0]
        distance = np.linalg.norm(context[:, -2:].numpy() - goal, axis=1)
        np.testing.assert_allclose(context[:, 4], np.maximum(1 - distance / 0.2, 0), atol=1e-5)


def test_contexts_see_dense_rewards_on_request(sparse_path: Path) -> None:
    dataset = open_dataset(sparse_path)
    data = OfflineData(dataset, dataset.train_tasks, dense_context=True)
    context = data.contexts(torch.tensor([0]), 1, 4, 300, generator())[0, 0]
    goal = dataset.params[dataset.tasks == dataset.train_tasks[0]][0]
    distance = np.linalg.norm(context[:, -2:].numpy() - goal, axis=1)
    np.testing.assert_allclose(context[:, 4], -distance, atol=1e-5)


def test_the_test_tasks_files_are_never_read(wind_path: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(wind_path, tmp_path / "wind")
    dataset = open_dataset(folder)
    assert dataset.test_tasks.tolist() == [2, 7]
    (folder / task_file(2)).unlink()
    (folder / task_file(7)).write_bytes(b"not a dataset")
    data = OfflineData(dataset, dataset.train_tasks)
    assert data.tasks.tolist() == [0, 1, 3, 4, 5, 6, 8]
    with pytest.raises(DatasetError):
        OfflineData(dataset, dataset.tasks)


@pytest.fixture
def graded_path(tmp_path: Path) -> Path:
    """Three tasks with returns of 0.05, 0.5, 0.9 and 1.0 of the way to the best checkpoint."""
    curve = {100: -29.0, 200: -20.0, 300: -12.0, 400: -10.0}
    tasks = [graded_data(task, curve, episodes=4) for task in (0, 1, 3)]
    return write_tasks(tmp_path / "graded", tasks)


def test_a_slice_is_all_that_is_learned_from(graded_path: Path) -> None:
    dataset = open_dataset(graded_path)
    data = OfflineData(dataset.select("expert", 3), dataset.train_tasks)
    whole = OfflineData(dataset, dataset.train_tasks)
    # Checkpoints 300 and 400 are episodes 8 to 15, whose lengths go 25, 24, 23, 22, 21, 25, ...
    kept, lengths = (8, 9, 10, 12, 13, 14), [25 - number % 5 for number in range(16)]
    starts = np.cumsum([0, *lengths])
    rows = np.concatenate([np.arange(starts[k], starts[k + 1]) for k in kept])
    assert data.episodes == 6
    assert len(whole.table) == 3 * sum(lengths)
    for i in range(3):
        found, all_rows = (one.table[i * (len(one.table) // 3) :] for one in (data, whole))
        # But for the rank, which is among the slice's own episodes.
        assert found[: len(rows), :-1].equal(all_rows[torch.from_numpy(rows), :-1])
    assert len(data.table) == 3 * len(rows)
    # Each episode is one of its own: six contexts, six different episodes.
    contexts = data.contexts(torch.arange(3), 6, 1, 400, generator())
    for i in range(3):
        drawn = [{tuple(row) for row in contexts[k, i].tolist()} for k in range(6)]
        assert sorted(map(len, drawn)) == sorted(lengths[k] for k in kept)
        assert len(set.union(*drawn)) == len(rows)


def test_the_slice_that_is_all_is_the_same_as_none(graded_path: Path) -> None:
    dataset = open_dataset(graded_path)
    one, other = (
        OfflineData(part, dataset.train_tasks) for part in (dataset, dataset.select("mixed"))
    )
    assert one.table.equal(other.table)


def test_too_few_episodes_of_a_slice_are_one_sentence(graded_path: Path) -> None:
    dataset = open_dataset(graded_path)
    data = OfflineData(dataset.select("medium", 3), dataset.train_tasks)
    said = "2 x 2 different episodes a task, the slice has 3: ask for more or lower --context"
    with pytest.raises(UsageError, match=said):
        data.check_episodes(2, 2)


def test_a_damaged_training_file_is_an_error(wind_path: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(wind_path, tmp_path / "wind")
    dataset = open_dataset(folder)
    path = folder / task_file(4)
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(DatasetError, match="task_004"):
        OfflineData(dataset, dataset.train_tasks)
