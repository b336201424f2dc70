"""`python -m ctmrl.train` as its users run it: what it makes, what it refuses, what it survives."""

from __future__ import annotations

import contextlib
import csv
import dataclasses
import io
import json
import os
import random
import re
import shutil
import signal
import time
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from rich.console import Console

from ctmrl.config import RunConfig
from ctmrl.errors import Diverged, UsageError
from ctmrl.evaluate import EvaluateConfig
from ctmrl.evaluate import main as evaluate
from ctmrl.meta_train import Learner
from ctmrl.methods import METHODS
from ctmrl.presets import config_from_settings, preset
from ctmrl.runs import load_checkpoint, read_json
from ctmrl.train import best_behavior, default_folder, parse, split_tasks, train
from datagen.dataset import open_dataset, task_file
from datagen.files import machine
from meta_envs import task_set
from tests.ctmrl.commands import FILES, Commands, contents, rows, wait_until
from tests.ctmrl.conftest import FinishedRun
from tests.ctmrl.examples import smoke


def run(config: RunConfig, **changes: Any) -> tuple[dict[str, Any], str]:
    """Train in this process; the evaluation's record, and what was shown."""
    console = Console(file=io.StringIO(), width=200)
    record = train(dataclasses.replace(config, **changes), console)
    assert isinstance(console.file, io.StringIO)
    return record, console.file.getvalue()


def short(steps: int = 3, **changes: Any) -> RunConfig:
    config = smoke(steps, **changes)
    protocol = dataclasses.replace(config.meta_test, random_episodes=1, policy_episodes=1)
    return dataclasses.replace(config, meta_test=protocol)


def metrics(path: Path) -> list[dict[str, str]]:
    with (path / "metrics.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def test_what_a_run_makes(finished_run: FinishedRun, wind_path: Path) -> None:
    path = finished_run.path
    assert tuple(sorted(contents(path))) == FILES
    stored = read_json(path / "config.json")
    dataset = open_dataset(wind_path)
    assert stored["dataset"] == dataset.hash
    assert stored["groups"]["seen"] == dataset.train_tasks.tolist()
    assert stored["groups"]["unseen"] == task_set("point_robot_wind").test_tasks.tolist()
    assert stored["dimensions"] == {"obs": 2, "act": 2, "tasks": 7, "steps": 40}
    assert stored["settings"]["training"]["steps"] == 40
    assert stored["versions"]["torch"].startswith(torch.__version__.partition("+")[0])
    # Where a run lies, and from where its data were read, is not part of it.
    assert not {"data", "out", "restart", "loggers"} & stored["settings"].keys()
    state = torch.load(path / "checkpoint.pt", weights_only=True)
    assert int(state["step"]) == 40
    assert all(value.isfinite().all() for value in state.values())
    for name in ("adaptation.png", "contexts.png"):
        with Image.open(path / name) as image:
            image.verify()


def test_what_a_run_logs(finished_run: FinishedRun) -> None:
    found = metrics(finished_run.path)
    assert [int(row["step"]) for row in found] == list(range(1, 41))
    names = {"loss/critic", "loss/actor", "loss/encoder/contrast", "codes/perplexity"}
    assert names <= found[0].keys()
    measured = [int(row["step"]) for row in found if row["return/training_tasks"]]
    assert measured == [10, 20, 30, 40]
    record = read_json(finished_run.path / "evaluation.json")
    # One repetition, the run's seed: the last return on training tasks is that of the evaluation.
    last = float(found[-1]["return/training_tasks"])
    assert last == pytest.approx(record["groups"]["seen"]["return"], rel=1e-9)


def test_what_a_run_shows(finished_run: FinishedRun) -> None:
    record = read_json(finished_run.path / "evaluation.json")
    lines = finished_run.output.splitlines()
    progress = [line for line in lines if line.startswith("step ")]
    assert [line.partition(":")[0] for line in progress] == [
        f"step {step}/40" for step in (10, 20, 30, 40)
    ]
    assert all("codes in use" in line and "return on training tasks" in line for line in progress)
    assert "unseen tasks (10)" in finished_run.output
    for group in record["groups"].values():
        (row,) = [line for line in lines if re.match(r"\W+ctmrl\b", line)]
        assert f"{group['return']:.2f}" in row
        assert f"{group['score']:.1f}" in row
    assert lines[-1] == f"Pictures, metrics and checkpoint: {finished_run.path}"


def test_a_finished_run_is_not_trained_again(finished_run: FinishedRun, commands: Commands) -> None:
    before = {path: path.stat().st_mtime_ns for path in finished_run.path.iterdir()}
    assert commands.run(*finished_run.words, "--out", str(finished_run.path)) == 0
    assert {path: path.stat().st_mtime_ns for path in finished_run.path.iterdir()} == before
    output = commands.output()
    first, _, table = output.partition("\n")
    assert first.endswith("is finished; --restart trains it anew, --seed n another.")
    assert table.strip() in finished_run.output


def test_other_settings_do_not_touch_a_run(finished_run: FinishedRun, commands: Commands) -> None:
    before = contents(finished_run.path)
    words = (*finished_run.words, "--out", str(finished_run.path), "--seed", "1")
    assert commands.run(*words) == 2
    assert commands.output() == (
        f"error: {finished_run.path} holds a run with settings.seed = 0, this one has 1: "
        "choose another --out, or --restart to throw it away\n"
    )
    assert contents(finished_run.path) == before


def test_a_restart_trains_anew(finished_run: FinishedRun, wind_path: Path, tmp_path: Path) -> None:
    path = shutil.copytree(finished_run.path, tmp_path / "copy")
    run(short(), data=wind_path, out=path, restart=True)
    assert tuple(sorted(contents(path))) == FILES
    assert len(metrics(path)) == 3
    assert int(load_checkpoint(path / "checkpoint.pt")["step"]) == 3


def test_an_interrupted_and_twice_killed_run_ends_in_the_same_bytes(
    finished_run: FinishedRun, commands: Commands, tmp_path: Path
) -> None:
    path = tmp_path / "run"
    words = (*finished_run.words, "--out", str(path))
    commands.start(*words)
    wait_until(lambda: rows(path / "metrics.csv") > 5)
    commands.send(signal.SIGINT)
    assert commands.wait() == 130
    assert commands.output().splitlines()[-1] == (
        "Stopped. The same command goes on from the last checkpoint."
    )
    assert "Traceback" not in commands.output()
    reached = int(load_checkpoint(path / "checkpoint.pt")["step"])
    assert 0 < reached < 40
    commands.start(*words)
    wait_until(lambda: rows(path / "metrics.csv") > 15)
    commands.send(signal.SIGKILL)
    assert commands.wait() == -signal.SIGKILL
    assert commands.output().splitlines()[0] == f"Going on at step {reached} of 40."
    assert int(load_checkpoint(path / "checkpoint.pt")["step"]) < 40
    # A pipe that nobody reads holds the command up between the first and the second picture.
    commands.start(*words)
    pipe = path / f".contexts.png.{machine()}.{commands.child}.partial"
    os.mkfifo(pipe)
    wait_until((path / "adaptation.png").exists)
    commands.send(signal.SIGKILL)
    assert commands.wait() == -signal.SIGKILL
    assert not (path / "evaluation.json").exists()
    assert pipe.exists()
    assert commands.run(*words) == 0, commands.output()
    assert commands.output().splitlines()[0] == "Going on at step 40 of 40."
    assert contents(path) == contents(finished_run.path)


def test_a_killed_run_with_its_data_in_a_file_ends_in_the_same_bytes(
    finished_run: FinishedRun, commands: Commands, tmp_path: Path
) -> None:
    path = tmp_path / "run"
    words = (*finished_run.words, "--memory", "0", "--out", str(path))
    commands.start(*words)
    wait_until(lambda: rows(path / "metrics.csv") > 5)
    commands.send(signal.SIGKILL)
    assert commands.wait() == -signal.SIGKILL
    said = "The training data are read from a file; more --memory avoids it."
    assert commands.output().splitlines()[0] == said
    # The file went with the process.
    left = {name for name in contents(path) if not name.endswith(".partial")}
    assert left <= {*FILES}
    assert [one.name for one in tmp_path.iterdir()] == ["run"]
    assert commands.run(*words) == 0, commands.output()
    assert contents(path) == contents(finished_run.path)


@pytest.mark.slow
@pytest.mark.parametrize("gigabytes", ["1", "0"])
def test_runs_killed_at_20_random_moments_end_in_the_same_bytes(
    gigabytes: str, finished_run: FinishedRun, commands: Commands, tmp_path: Path
) -> None:
    wanted = contents(finished_run.path)
    common = (*finished_run.words, "--memory", gigabytes)
    begun = time.monotonic()
    assert commands.run(*common, "--out", str(tmp_path / "whole")) == 0
    length = time.monotonic() - begun
    draw, killed, had_checkpoint = random.Random(0), 0, 0
    for number in range(20):
        path = tmp_path / str(number)
        words = (*common, "--out", str(path))
        commands.start(*words)
        time.sleep(length * (number + draw.random()) / 20)
        # The last ones may have ended by themselves, if the machine has become quicker.
        with contextlib.suppress(ProcessLookupError):
            commands.send(signal.SIGKILL)
        killed += commands.wait() == -signal.SIGKILL
        had_checkpoint += (path / "checkpoint.pt").exists()
        assert commands.run(*words) == 0, commands.output()
        assert contents(path) == wanted, number
    # That the moments were spread over the whole run:
    assert killed >= 12
    assert 4 <= had_checkpoint <= 19


def test_where_runs_go() -> None:
    config = preset("point_robot", "focal", "smoke", seed=3)
    assert default_folder(config) == Path("runs/point_robot/focal/seed-3")
    validating = dataclasses.replace(config, validate=True)
    assert default_folder(validating) == Path("runs/point_robot/focal-validation/seed-3")
    expert = dataclasses.replace(config, quality="expert")
    assert default_folder(expert) == Path("runs/point_robot/focal-expert/seed-3")
    few = dataclasses.replace(validating, quality="early", data_episodes=10)
    wanted = Path("runs/point_robot/focal-early-10-episodes-validation/seed-3")
    assert default_folder(few) == wanted


def test_the_split(wind_path: Path) -> None:
    dataset = open_dataset(wind_path)
    plain, validating = split_tasks(dataset, False), split_tasks(dataset, True)
    assert plain.train.tolist() == [0, 1, 3, 4, 5, 6, 8]
    assert plain.unseen.tolist() == [2, 7, 12, 17, 22, 27, 32, 37, 42, 47]
    assert validating.train.tolist() == [0, 1, 4, 5, 6, 8]
    assert validating.unseen.tolist() == [3]


def test_the_best_behaviour_of_each_task(wind_path: Path) -> None:
    found = best_behavior(open_dataset(wind_path))
    index = json.loads((wind_path / "dataset.json").read_bytes())
    assert found == {
        one["task"]: max(one["returns"]["deterministic"].values()) for one in index["tasks"]
    }
    assert len(found) == 9


def test_validation_reads_and_uses_no_meta_test_task_and_no_held_out_one(
    wind_path: Path, tmp_path: Path
) -> None:
    folder = shutil.copytree(wind_path, tmp_path / "wind")
    for task in (2, 7):
        (folder / task_file(task)).unlink()
    (folder / task_file(3)).write_bytes(b"damaged")
    record, _ = run(short(), data=folder, out=tmp_path / "run", validate=True)
    unseen, seen = record["groups"]["unseen"], record["groups"]["seen"]
    assert unseen["tasks"] == [3]
    assert seen["tasks"] == [0, 1, 4, 5, 6, 8]
    assert not {*unseen["tasks"], *seen["tasks"]} & {*task_set("point_robot_wind").test_tasks}
    stored = read_json(tmp_path / "run" / "config.json")
    assert stored["dimensions"]["tasks"] == 6
    assert stored["groups"] == {"unseen": [3], "seen": [0, 1, 4, 5, 6, 8]}
    with pytest.raises(ValueError, match="task_003"):
        run(short(), data=folder, out=tmp_path / "other")


def test_a_run_on_a_slice_is_another_run(
    finished_run: FinishedRun, wind_path: Path, tmp_path: Path
) -> None:
    before = contents(finished_run.path)
    stored = read_json(finished_run.path / "config.json")
    # As a run's file was before there were slices.
    assert not {"quality", "data_episodes"} & stored["settings"].keys()
    for changes, said in (
        ({"quality": "early"}, "settings.quality = mixed, this one has early"),
        ({"data_episodes": 2}, "settings.data_episodes = None, this one has 2"),
    ):
        with pytest.raises(UsageError, match=f" holds a run with {said}: choose another --out"):
            run(smoke(40), data=wind_path, out=finished_run.path, **changes)
    assert contents(finished_run.path) == before
    record, _ = run(short(), data=wind_path, out=tmp_path / "run", quality="early")
    found = read_json(tmp_path / "run" / "config.json")
    assert found["settings"]["quality"] == "early"
    # A report pools runs of one method, and so must not take this for the whole data's.
    assert record["method"] == "ctmrl-early"
    assert "data_episodes" not in found["settings"]
    assert found["dataset"] == stored["dataset"]
    restored = config_from_settings(found, tmp_path / "run" / "config.json")
    assert (restored.quality, restored.data_episodes) == ("early", None)
    # The same again is the same run; all data are not.
    again, shown = run(short(), data=wind_path, out=tmp_path / "run", quality="early")
    assert again == record
    assert "is finished" in shown
    with pytest.raises(UsageError, match=r"settings\.quality = early, this one has mixed"):
        run(short(), data=wind_path, out=tmp_path / "run")
    mixed, _ = run(short(), data=wind_path, out=tmp_path / "mixed")
    assert mixed["groups"]["seen"]["references"] == record["groups"]["seen"]["references"]
    one, other = (load_checkpoint(tmp_path / name / "checkpoint.pt") for name in ("run", "mixed"))
    key = "actor_critic/actor.net.0.weight"
    assert not one[key].equal(other[key])


@dataclasses.dataclass(frozen=True)
class SparseRun:
    """A run of FOCAL on the sparse robot, with TensorBoard events."""

    path: Path
    record: dict[str, Any]
    shown: str


@pytest.fixture(scope="module")
def sparse_run(sparse_path: Path, tmp_path_factory: pytest.TempPathFactory) -> SparseRun:
    path = tmp_path_factory.mktemp("sparse") / "run"
    config = preset("sparse_point_robot", "focal", "smoke", data=sparse_path, out=path)
    training = dataclasses.replace(config.training, steps=3)
    names = ("tensorboard",) if find_spec("tensorboard") else ()
    record, shown = run(config, training=training, meta_test=short().meta_test, loggers=names)
    return SparseRun(path, record, shown)


def test_a_method_without_codes_and_a_sparse_reward(sparse_run: SparseRun) -> None:
    # The return of a policy that has not found the goal is exactly 0.
    assert "return on training tasks 0.00; " in sparse_run.shown
    assert "codes" not in sparse_run.shown
    assert sparse_run.record["groups"]["seen"]["return"] == 0.0
    assert sparse_run.record["groups"]["seen"]["codes"] is None
    assert metrics(sparse_run.path)[-1]["return/training_tasks"] == "0.0"


@pytest.mark.parametrize("method", METHODS)
def test_every_method_trains_goes_on_and_is_evaluated_again(
    method: str, wind_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    command = ["--preset", "smoke", "--steps", "6", "--method", method, "--data", str(wind_path)]
    config = parse([*command, "--policy-episodes", "1", "--random-episodes", "1"])
    whole, _ = run(config, out=tmp_path / "whole")
    assert whole["method"] == method
    update = Learner.update

    def interrupted(learner: Learner) -> dict[str, torch.Tensor]:
        if learner.step == 4:
            raise KeyboardInterrupt
        return update(learner)

    monkeypatch.setattr(Learner, "update", interrupted)
    with pytest.raises(KeyboardInterrupt):
        run(config, out=tmp_path / "parts")
    monkeypatch.setattr(Learner, "update", update)
    run(config, out=tmp_path / "parts")
    assert contents(tmp_path / "parts") == contents(tmp_path / "whole")
    evaluate(EvaluateConfig(tmp_path / "whole", out=tmp_path / "again"))
    assert read_json(tmp_path / "again" / "evaluation.json") == whole


def test_tensorboard_events(sparse_run: SparseRun) -> None:
    accumulator = pytest.importorskip(
        "tensorboard.backend.event_processing.event_accumulator"
    ).EventAccumulator
    events = accumulator(str(sparse_run.path / "tensorboard"))
    events.Reload()
    losses = events.Scalars("loss/critic")
    values = [float(row["loss/critic"]) for row in metrics(sparse_run.path)]
    assert [event.step for event in losses] == [1, 2, 3]
    assert [event.value for event in losses] == pytest.approx(values)
    assert [event.step for event in events.Scalars("return/training_tasks")] == [3]


def test_a_run_that_diverges_is_one_sentence_and_leaves_no_nan(
    wind_path: Path, tmp_path: Path
) -> None:
    config = short(steps=20)
    broken = dataclasses.replace(config.actor_critic, learning_rate=1e30)
    with pytest.raises(Diverged, match=r"^training diverged: [\w/]+ is (nan|inf) at step \d+; "):
        run(config, actor_critic=broken, data=wind_path, out=tmp_path / "run")
    for row in metrics(tmp_path / "run") if (tmp_path / "run" / "metrics.csv").exists() else []:
        assert all(np.isfinite(float(value)) for value in row.values() if value)
    assert not (tmp_path / "run" / "evaluation.json").exists()


def test_a_checkpoint_of_another_run_is_one_sentence(
    finished_run: FinishedRun, wind_path: Path, tmp_path: Path
) -> None:
    path = shutil.copytree(finished_run.path, tmp_path / "copy")
    (path / "evaluation.json").unlink()
    state = load_checkpoint(path / "checkpoint.pt")
    key = "actor_critic/actor.net.0.weight"
    for wrong in ({}, {**state, key: state[key][:, :3]}):
        torch.save(wrong, path / "checkpoint.pt")
        with pytest.raises(
            UsageError, match=r"does not fit its run .*: train again with --restart"
        ):
            run(smoke(40), data=wind_path, out=path)
