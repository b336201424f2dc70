"""The profile: its parts add up, its FLOPs are right, and training is left as it was."""

from __future__ import annotations

import dataclasses
import io
import json
import time
from pathlib import Path

import pytest
import torch
from rich.console import Console
from torch import nn

from ctmrl import profile as module
from ctmrl import synthetic
from ctmrl.console import run_command
from ctmrl.data import OfflineData
from ctmrl.meta_train import Learner
from ctmrl.methods.ctmrl import CTMRL
from ctmrl.networks import Critic
from ctmrl.presets import preset
from ctmrl.profile import (
    REST,
    WARM_UP,
    Part,
    ProfileConfig,
    Stopwatch,
    count_flops,
    measure,
    parts_of,
    peak_flops,
    profile,
    table_of,
    watched,
    whole_rate,
)
from datagen.accelerator import WARM_UP as RECORDED_AFTER
from tests.ctmrl.commands import Commands
from tests.ctmrl.examples import smoke, with_dual_steps
from tests.datagen.tape import pretend_cuda


@pytest.fixture
def learner(wind_data: OfflineData) -> Learner:
    return Learner(smoke(steps=1_000), wind_data)


def show(table: object) -> str:
    console = Console(width=80, record=True, file=io.StringIO())
    console.print(table)
    return console.export_text()


def test_a_parts_time_and_count_are_without_those_of_the_parts_inside() -> None:
    counted = [0]
    stopwatch = Stopwatch(lambda: counted[0])
    with stopwatch.part("outer"):
        counted[0] += 1
        with stopwatch.part("inner"):
            time.sleep(0.05)
            counted[0] += 20
        counted[0] += 300
    counted[0] += 4000
    stopwatch.edge()
    assert stopwatch.flops == {REST: 4000, "outer": 301, "inner": 20}
    assert stopwatch.seconds["inner"] >= 0.05
    assert stopwatch.seconds["outer"] < 0.05


def test_watching_changes_no_result_and_leaves_no_trace(
    learner: Learner, wind_data: OfflineData
) -> None:
    other = Learner(smoke(steps=1_000), wind_data)
    before = [dict(vars(owner)) for owner, _, _ in parts_of(learner)]
    with watched(learner, Stopwatch()):
        seen = [learner.update() for _ in range(3)]
    assert [dict(vars(owner)).keys() for owner, _, _ in parts_of(learner)] == [
        one.keys() for one in before
    ]
    for found in seen:
        wanted = other.update()
        assert {k: float(v) for k, v in found.items()} == {k: float(v) for k, v in wanted.items()}


def test_every_part_is_seen(wind_data: OfflineData) -> None:
    config = smoke(steps=1_000)
    regularized = dataclasses.replace(config.actor_critic, behavior_regularization=True)
    learner = Learner(dataclasses.replace(config, actor_critic=regularized), wind_data)
    assert isinstance(learner.method, CTMRL)
    learner.method.codebook.placed.fill_(True)
    parts = measure(learner, 4)
    assert parts.keys() == {REST, *(name for _, _, name in parts_of(learner))}
    assert all(part.seconds > 0 for part in parts.values())
    seconds = [part.seconds for part in parts.values()]
    assert seconds == sorted(seconds, reverse=True)


def weights(network: nn.Module) -> int:
    """Of the matrices alone, biases not."""
    if isinstance(network, Critic):
        return sum(weight.numel() for weight in network.weights)
    return sum(p.numel() for p in network.parameters() if p.ndim == 2)


def test_the_flops_are_those_of_the_layers(learner: Learner) -> None:
    flops, training = count_flops(learner), learner.config
    rows = training.meta_batch * training.batch_size
    actor_critic, method = learner.actor_critic, learner.method
    assert flops["actor, forward"] == 2 * rows * weights(actor_critic.actor)
    assert flops["value, forward"] == 2 * rows * weights(actor_critic.value)
    # At the data's actions, and at the policy's.
    assert flops["critic, forward"] == 2 * 2 * rows * weights(actor_critic.critic)
    contexts = 2 * training.meta_batch * training.context_size
    assert flops["encoder, forward"] == 2 * contexts * weights(method.encoder)
    assert flops["sampling"] == flops["optimisers"] == 0


def test_the_flops_of_the_dual_critics_steps(wind_data: OfflineData) -> None:
    learner = Learner(with_dual_steps(smoke(steps=1_000), 3), wind_data)
    flops, training, actor_critic = count_flops(learner), learner.config, learner.actor_critic
    rows = training.meta_batch * training.batch_size
    # At the policy's actions, the data's and those between in each step, and twice after them.
    passes = 3 * 3 + 2
    dual = 2 * passes * rows * weights(actor_critic.dual_critic)
    assert flops["dual critic, forward"] == dual
    assert flops["actor, forward"] == 3 * 2 * rows * weights(actor_critic.actor)


def test_on_a_gpu_a_step_is_measured_in_parts_and_as_a_recording(
    learner: Learner, wind_data: OfflineData, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On the stand-in for a GPU's graphs: what is replayed has no parts."""
    said = pretend_cuda(monkeypatch)
    waited: list[torch.device] = []
    monkeypatch.setattr(torch.cuda, "synchronize", waited.append)
    recorded = Learner(smoke(steps=1_000), wind_data)
    recorded.record()
    recorded.device = torch.device("cuda:1")
    parts, wanted = measure(recorded, 3), count_flops(learner)
    assert {name: part.flops for name, part in parts.items()} == wanted
    assert "replay" not in said
    # At every edge of a part, or its time would be that of what came before it.
    assert len(waited) >= 3 * 2 * len(parts)
    assert {*waited} == {recorded.device}
    del waited[:]
    before = recorded.step
    assert whole_rate(recorded, 7) > 0
    assert recorded.step - before == 7 + 2 * WARM_UP
    assert said.count("replay") == 7 + 2 * WARM_UP - RECORDED_AFTER
    assert len(waited) == 2


def test_the_table_fits_a_terminal_and_adds_up() -> None:
    parts = {"backward": Part(3e-3, 6_000_000_000), "target value, forward": Part(1e-3, 0)}
    text = show(table_of(parts, peak=4e12))
    lines = text.splitlines()
    assert max(map(len, lines)) <= 80
    rows = [[cell.strip() for cell in line.split("│")[1:-1]] for line in lines if "│" in line]
    assert rows == [
        ["backward", "3.00", "75.0%", "6.000", "2000.0", "50%"],
        ["target value, forward", "1.00", "25.0%", "", "", ""],
        ["whole step", "4.00", "100.0%", "6.000", "1500.0", "38%"],
    ]


def test_the_peak_is_a_rate(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "PEAK_SIZE", 256)
    assert 1e8 < peak_flops() < 1e14


def test_the_command_prints_the_table_and_writes_a_trace(
    commands: Commands, wind_path: Path, tmp_path: Path
) -> None:
    trace = tmp_path / "trace.json"
    words = ("--preset", "smoke", "--steps", "3", "--data", str(wind_path), "--trace", str(trace))
    assert commands.run("ctmrl.profile", *words) == 0, commands.output()
    output = commands.output()
    assert "whole step" in output
    assert "point_robot_wind, ctmrl, smoke: " in output
    assert "GFLOP/s in float32, 1 thread." in output
    assert "There is no" not in output
    events = json.loads(trace.read_text())["traceEvents"]
    names = {event["name"] for event in events}
    assert {"backward", "sampling", "critic, forward"} <= names


def test_without_a_dataset_it_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(module, "PEAK_SIZE", 64)
    console = Console(width=80, record=True, file=io.StringIO())
    options = ProfileConfig(env="point-robot", method="focal", preset="smoke", steps=2)
    profile(dataclasses.replace(options, precision="bfloat16"), console)
    text = console.export_text()
    assert "There is no datasets/point_robot, so these are random numbers" in text
    assert "python -m datagen.collect --env point_robot" in text
    assert "point_robot, focal, smoke: " in text
    assert "GFLOP/s in bfloat16, 1 thread." in text


@pytest.mark.parametrize("env", ["half_cheetah_vel", "point_robot"])
def test_random_numbers_are_enough_for_the_contexts(
    env: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def short(env: str, episodes: int) -> synthetic.SyntheticDataset:
        return dataclasses.replace(real(env, episodes), horizon=2)

    real = synthetic.synthetic_dataset
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(synthetic, "synthetic_dataset", short)
    config = preset(env, "ctmrl", "paper")
    data = module.open_or_make(config, Console(file=io.StringIO()))
    data.check_episodes(CTMRL.context_sets, config.training.context_episodes)


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (ProfileConfig(steps=0), "--steps must be at least 1, got 0"),
        (ProfileConfig(threads=0), "--threads must be from 1 to 1024, got 0"),
        (ProfileConfig(env="windy"), "no environment 'windy'"),
        (ProfileConfig(method="ctrml"), "did you mean 'ctmrl'?"),
        (ProfileConfig(preset="big"), "no preset 'big'"),
        (ProfileConfig(device="tpu"), "--device tpu cannot be used here: learning is on cpu or"),
        (ProfileConfig(trace=Path("nowhere/trace.json")), "there is no folder nowhere"),
        (ProfileConfig(trace=Path()), "--trace . is a folder: give the name of a file"),
        (ProfileConfig(data=Path("nowhere")), "nowhere"),
    ],
)
def test_a_mistake_gets_a_sentence(
    options: ProfileConfig, sentence: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_command(lambda: profile(options, Console())) == 2
    error = capsys.readouterr().err
    assert sentence in error
    assert error.count("\n") == 1
