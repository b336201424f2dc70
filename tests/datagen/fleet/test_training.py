"""The training of a group: killed and called again, damaged, foreign, and what it leaves."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.logger import Logger

from datagen.budgets import Budget, FleetSettings
from datagen.files import DatasetError
from datagen.fleet import training
from datagen.fleet.algorithm import FleetSAC
from datagen.fleet.state import load_state, save_state
from datagen.fleet.training import (
    FleetJob,
    Reports,
    actor,
    learner,
    train_fleet,
    trained_networks,
    trained_policies,
)
from datagen.job import Job, group_file
from tests.datagen.fleet.fleets import TINY, parameters, work

TASKS = (2, 4)
OBS = np.random.default_rng(0).uniform(-1, 1, (30, 2)).astype(np.float32)


class KilledError(Exception):
    """Stands for the end of a process."""


def killed_at(step: int) -> Callable[[int], None]:
    def report(now: int) -> None:
        if now >= step:
            raise KilledError

    return report


def often(monkeypatch: pytest.MonkeyPatch) -> None:
    """Reports after every step, so that a training can be stopped at any of them."""

    class Often(Reports):
        def __init__(self, report: Callable[[int], None]) -> None:
            super().__init__(report, 1)

    monkeypatch.setattr(training, "Reports", Often)


def distributions(model: FleetSAC) -> list[NDArray[np.float32]]:
    """Mean and log standard deviation [task, n, A] of the fleet's own policies."""
    obs = torch.from_numpy(OBS).expand(model.n_envs, -1, -1).contiguous()
    with torch.no_grad():
        return [part.numpy() for part in model.policy.distribution(obs)]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The file of a training that nothing disturbed; not to be written to."""
    group = work(tmp_path_factory.mktemp("whole"))
    train_fleet(group)
    return group.path


@pytest.fixture(scope="module")
def half(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The file of a training that was stopped after its first checkpoint."""
    group = work(tmp_path_factory.mktemp("half"))
    with pytest.MonkeyPatch.context() as patch:
        often(patch)
        with pytest.raises(KilledError):
            train_fleet(group, killed_at(45))
    return group.path


def put(file: Path, folder: Path) -> FleetJob:
    """A group with a copy of a file."""
    group = work(folder)
    shutil.copy(file, group.path)
    return group


def test_it_leaves_one_hidden_file(whole: Path) -> None:
    assert list(whole.parent.iterdir()) == [whole]
    assert whole == group_file(whole.parent, TASKS)
    assert whole.name.startswith(".fleet_002-004_")
    assert torch.get_num_threads() == 1
    tensors, about = load_state(whole)
    assert set(about) == {"checkpoint", "origin"}
    assert about["checkpoint"] == 60
    assert about["origin"]["group"] == list(TASKS)
    # Two layers have two weights and two biases. Of the learner only the networks are left.
    policies = {f"actor.{mark}.{i}" for mark in (40, 60) for i in range(4)}
    state = {f"policy.{name}" for name in learner(work(whole.parent)).policy.state_dict()}
    assert set(tensors) == policies | state | {"log_temperature"}


def test_groups_have_files_of_their_own(tmp_path: Path) -> None:
    groups = [(0, 1, 5), (0, 2, 5), (0, 5), (0,), (5,)]
    assert len({group_file(tmp_path, group) for group in groups}) == len(groups)


def test_a_state_in_the_middle_has_everything(half: Path) -> None:
    tensors, about = load_state(half)
    assert about["checkpoint"] == 40
    assert about["timesteps"] == 40 * 2
    assert about["updates"] == 10
    assert tensors["memory"].shape == (40, 2, 2 + 2 + 2 + 1 + 1)
    assert list(half.parent.iterdir()) == [half]


# Before and at the first checkpoint, after it, and in the last step.
@pytest.mark.parametrize("moments", [(1,), (39,), (40,), (41,), (60,), (35, 42, 59)])
def test_killed_and_called_again_it_ends_in_the_same_bytes(
    moments: tuple[int, ...], whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    group = work(tmp_path)
    often(monkeypatch)
    for moment in moments:
        with pytest.raises(KilledError):
            train_fleet(group, killed_at(moment))
        held = [path.name for path in tmp_path.iterdir()]
        assert held == ([group.path.name] if moment > 40 else [])
    told: list[int] = []
    train_fleet(group, told.append)
    assert told == list(range(41 if max(moments) > 40 else 1, 61))
    assert group.path.read_bytes() == whole.read_bytes()


def test_killed_hoppers_in_bfloat16_too(tmp_path: Path) -> None:
    # Unlike the robot in the wind, hoppers begin their episodes at random.
    low = replace(TINY, fleet=FleetSettings(2, "bfloat16"))
    files = []
    for name in ("one", "other"):
        (tmp_path / name).mkdir()
        group = work(tmp_path / name, rows=low, env="hopper_params")
        if name == "other":
            with pytest.raises(KilledError):
                train_fleet(group, killed_at(50))
        train_fleet(group)
        files.append(group.path.read_bytes())
    assert files[0] == files[1]


def test_a_finished_file_is_not_trained_again(whole: Path, tmp_path: Path) -> None:
    group, told = put(whole, tmp_path), list[int]()
    before = group.path.stat().st_mtime_ns
    train_fleet(group, told.append)
    assert told == []
    assert group.path.stat().st_mtime_ns == before


def test_the_seed_and_the_group_decide(whole: Path, tmp_path: Path) -> None:
    other = work(tmp_path, seed=1)
    train_fleet(other)
    one, two = (load_state(path)[0] for path in (whole, other.path))
    assert not any(torch.equal(value, two[name]) for name, value in one.items())


@pytest.mark.parametrize("which", ["whole", "half"])
def test_a_damaged_file_is_named(
    which: str, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    group = put(request.getfixturevalue(which), tmp_path)
    content = group.path.read_bytes()
    # All over the header and the values behind it.
    places = range(0, len(content), len(content) // 25)
    damages = [
        content[:place] + bytes([content[place] ^ 0x10]) + content[place + 1 :] for place in places
    ]
    for damaged in (*damages, b"", content[:50], content[:-1], content + b"\0"):
        group.path.write_bytes(damaged)
        for use in (train_fleet, lambda group: trained_policies(group.jobs[0])):
            with pytest.raises(DatasetError) as caught:
                use(group)
            sentence = str(caught.value)
            assert sentence.startswith(f"{group.path}: is damaged (")
            assert sentence.endswith("; delete it to train its tasks again")
            assert "\n" not in sentence
        assert list(tmp_path.iterdir()) == [group.path]
        assert group.path.read_bytes() == damaged


@pytest.mark.parametrize(
    ("seed", "rows", "difference"),
    [
        (1, TINY, "seed 0, not 1"),
        (0, replace(TINY, episodes=9), "config.episodes 4, not 9"),
        (
            0,
            replace(TINY, sac=replace(TINY.sac, gamma=0.5)),
            "config.sac.gamma 0.97, not 0.5",
        ),
        (
            0,
            replace(TINY, fleet=FleetSettings(2, "bfloat16")),
            "config.fleet.precision 'float32', not 'bfloat16'",
        ),
        (0, replace(TINY, fleet=FleetSettings(9, "float32")), "config.fleet.size 2, not 9"),
        (
            0,
            replace(TINY, fleet=FleetSettings(2, "float32", "cuda")),
            "config.fleet.device 'cpu', not 'cuda'",
        ),
        (
            0,
            replace(TINY, checkpoints=(40, 50)),
            "config.checkpoints [40, 60], not [40, 50]",
        ),
    ],
)
@pytest.mark.parametrize("which", ["whole", "half"])
def test_the_file_of_another_collection(
    which: str,
    seed: int,
    rows: Budget,
    difference: str,
    tmp_path: Path,
    request: pytest.FixtureRequest,
) -> None:
    put(request.getfixturevalue(which), tmp_path)
    group = work(tmp_path, seed=seed, rows=rows)
    sentence = (
        f"{group.path}: is of a collection with {difference}; give the same options as then, or "
        "delete it to train its tasks again"
    )
    for use in (train_fleet, lambda group: trained_policies(group.jobs[0])):
        with pytest.raises(DatasetError) as caught:
            use(group)
        assert str(caught.value) == sentence


def test_the_file_of_another_group(whole: Path, tmp_path: Path) -> None:
    group = work(tmp_path, tasks=(2, 5))
    shutil.copy(whole, group.path)
    with pytest.raises(DatasetError, match=r"of a collection with group \[2, 4\], not \[2, 5\]; "):
        train_fleet(group)


def test_the_file_of_other_versions(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    group = put(whole, tmp_path)
    monkeypatch.setattr("datagen.job.versions", lambda: {"torch": "99.0"})
    with pytest.raises(
        DatasetError, match=r"with versions\.\w+ '[\d.]+', not nothing of that name"
    ):
        train_fleet(group)


@pytest.mark.parametrize("about", [{}, {"origin": 3}])
def test_a_file_that_does_not_say_what_it_is_of(about: dict[str, int], tmp_path: Path) -> None:
    group = work(tmp_path)
    save_state(group.path, {}, about)
    with pytest.raises(DatasetError, match="with budget nothing of that name, not 'smoke'; "):
        train_fleet(group)


def test_policies_are_the_fleets_at_that_checkpoint(whole: Path) -> None:
    group = work(whole.parent)
    model, found = learner(group), []
    for mark in TINY.checkpoints:
        training._train_to(model, group, mark, lambda step: None)
        found.append(distributions(model))
    assert not np.allclose(found[0][0], found[1][0])
    for row, job in enumerate(group.jobs):
        policies = trained_policies(job)
        assert [policy.checkpoint for policy in policies] == [40, 60]
        for policy, (mean, log_std) in zip(policies, found, strict=True):
            ours = policy(OBS)
            np.testing.assert_allclose(ours[0], mean[row], rtol=1e-5, atol=1e-6)
            np.testing.assert_allclose(ours[1], log_std[row], rtol=1e-5, atol=1e-6)
            assert ours[0].dtype == ours[1].dtype == np.float32
            assert not policy.actor.training


def test_networks_are_those_after_the_last_step(whole: Path) -> None:
    group = work(whole.parent)
    model = learner(group)
    for mark in TINY.checkpoints:
        training._train_to(model, group, mark, lambda step: None)
    for row, job in enumerate(group.jobs):
        found = trained_networks(job)
        for name, value in parameters(model, row).items():
            np.testing.assert_array_equal(found[name].numpy(), value, err_msg=name)


def test_policies_that_are_not_there_yet(half: Path, tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="is missing; run the same command again"):
        trained_policies(work(tmp_path).jobs[0])
    with pytest.raises(DatasetError, match="is not finished; run the same command again"):
        trained_policies(put(half, tmp_path).jobs[0])


def test_a_learner_is_as_the_budget_says(tmp_path: Path) -> None:
    model = learner(work(tmp_path))
    assert model.n_envs == 2
    assert model.replay_buffer.buffer_size == 60
    assert model.learning_starts == 2 * 30
    assert model.policy.actor.dtype == torch.float32
    assert [tuple(value.shape) for value in model.policy.actor.weights] == [(2, 2, 5), (2, 5, 4)]
    for fleet in (None, FleetSettings(2, "auto")):
        with pytest.raises(ValueError, match="the budget smoke does not say how a fleet learns"):
            learner(work(tmp_path, rows=replace(TINY, fleet=fleet)))


def test_a_task_of_a_group_is_the_task_alone(tmp_path: Path) -> None:
    models = [learner(work(tmp_path, tasks=tasks)) for tasks in ((2, 4), (4,))]
    for model, tasks in zip(models, ((2, 4), (4,)), strict=True):
        training._train_to(model, work(tmp_path, tasks=tasks), 40, lambda step: None)
    both, alone = (distributions(model) for model in models)
    np.testing.assert_allclose(both[0][1], alone[0][0], atol=1e-5)


def test_reports_are_in_steps_of_a_task(tmp_path: Path) -> None:
    model, told = learner(work(tmp_path)), list[int]()
    model.set_logger(Logger(folder=None, output_formats=[]))
    model.learn(20 * 2, Reports(told.append, every=7))
    assert told == [7, 14]


def test_an_actor_of_any_depth() -> None:
    obs, action = (spaces.Box(-1, 1, (size,), np.float32) for size in (3, 2))
    generator = np.random.default_rng(0)
    for hidden in ((), (4,), (6, 5, 4)):
        sizes = (3, *hidden, 4)
        matrices = [generator.standard_normal(shape) for shape in pairwise(sizes)]
        biases = [generator.standard_normal((1, size)) for size in sizes[1:]]
        rows = generator.standard_normal((8, 3))
        value = rows
        for number, (matrix, bias) in enumerate(zip(matrices, biases, strict=True)):
            value = value @ matrix + bias
            if number < len(hidden):
                value = np.maximum(value, 0)
        weights = [torch.from_numpy(part).float() for part in (*matrices, *biases)]
        made = actor(obs, action, weights)
        with torch.no_grad():
            mean, log_std, _ = made.get_action_dist_params(torch.from_numpy(rows).float())
        np.testing.assert_allclose(mean.numpy(), value[:, :2], atol=1e-4)
        np.testing.assert_allclose(log_std.numpy(), np.clip(value[:, 2:], -20, 2), atol=1e-4)


def test_a_fleets_job_speaks_of_all_its_tasks(tmp_path: Path) -> None:
    group = work(tmp_path)
    assert group.tasks == TASKS
    fleet = {"size": 2, "precision": "float32", "device": "cpu"}
    assert group.origin["config"]["fleet"] == fleet
    assert group.jobs[1] == Job("point_robot_wind", 4, TINY, 0, tmp_path, TASKS)
