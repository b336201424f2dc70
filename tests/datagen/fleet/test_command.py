"""Fleets through `python -m datagen.collect`: what it makes, also where it is killed."""

from __future__ import annotations

import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
import torch
from stable_baselines3 import SAC

from datagen import check
from datagen.accelerator import best_precision
from datagen.budgets import FleetSettings
from datagen.card import remake_commands
from datagen.collect import CollectConfig, main, plan_of
from datagen.dataset import open_dataset
from datagen.fleet.state import save_state
from datagen.job import group_file
from datagen.plan import Plan
from meta_envs import MetaVectorEnv

Capture = pytest.CaptureFixture[str]
HOPPERS = ("--env", "hopper_params", "--budget", "smoke", "--tasks", "0-2", "--workers", "1")
ROBOTS = ("--env", "point_robot_wind", "--budget", "smoke", "--tasks", "0-1", "--workers", "1")
PAIRS = (*HOPPERS, "--fleet-size", "2")
SB3 = (*HOPPERS, "--engine", "sb3")


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.fixture(scope="module")
def hoppers(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a collection, not to be written to."""
    folder = tmp_path_factory.mktemp("hoppers") / "data"
    assert main([*HOPPERS, "--out", str(folder)]) == 0
    return folder


def test_it_makes_an_intact_dataset(hoppers: Path, capsys: Capture) -> None:
    assert check.main([str(hoppers)]) == 0
    said = capsys.readouterr()
    assert "3 tasks" in said.out
    assert said.err == "", "a warning would name a file that does not belong there"
    names = {"README.md", "dataset.json", *(f"task_{task:03d}.h5" for task in range(3))}
    assert set(contents(hoppers)) == names


def test_the_data_are_those_of_the_budget(hoppers: Path) -> None:
    dataset = open_dataset(hoppers)
    assert dataset.index["config"]["fleet"] == {
        "size": 25,
        "precision": best_precision(),
        "device": "cpu",
    }
    for task in range(3):
        data = dataset.read(task)
        assert data.meta["group"] == dataset.entry(task)["group"] == "0-2"
        ends = np.flatnonzero(np.diff(data.episode, append=-1))
        assert data.checkpoint[ends].tolist() == [300] * 2 + [400] * 2
        assert (data.columns["terminals"] | data.columns["timeouts"])[ends].all()
        assert data.observations.shape[1] == 11
    rows = [dataset.read(task).actions[:5] for task in range(3)]
    assert not np.array_equal(rows[0], rows[1])
    card = (hoppers / "README.md").read_text()
    assert "\n".join(["```", *remake_commands(dataset.index), "```"]) in card
    assert f"--budget smoke --precision {best_precision()} --tasks 0-2 --seed 0" in card


def test_a_second_run_does_nothing(hoppers: Path, tmp_path: Path, capsys: Capture) -> None:
    folder = shutil.copytree(hoppers, tmp_path / "data")
    before = {path.name: path.stat().st_mtime_ns for path in folder.glob("*.h5")}
    assert main([*HOPPERS, "--out", str(folder)]) == 0
    assert capsys.readouterr().out.startswith("3 of 3 tasks are already finished.\n")
    assert {path.name: path.stat().st_mtime_ns for path in folder.glob("*.h5")} == before
    assert contents(folder) == contents(hoppers)


def test_policies_are_kept_where_asked(hoppers: Path, tmp_path: Path, capsys: Capture) -> None:
    out, kept = tmp_path / "data", tmp_path / "policies"
    assert main([*HOPPERS, "--out", str(out), "--policies", str(kept)]) == 0
    assert contents(out) == contents(hoppers)
    assert sorted(contents(kept)) == [f"task_{task:03d}.zip" for task in range(3)]
    capsys.readouterr()
    assert main([*HOPPERS, "--out", str(out), "--policies", str(kept)]) == 0
    assert "not kept" not in capsys.readouterr().out, "they are there"
    data = open_dataset(out).read(1)
    loaded = SAC.load(kept / "task_001.zip", device="cpu")
    envs = MetaVectorEnv("hopper_params", tasks=[1])
    obs, _ = envs.reset(seed=[0])
    total, over = 0.0, False
    while not over:
        action, _ = loaded.predict(obs, deterministic=True)
        obs, reward, terminated, truncated, _ = envs.step(action)
        total, over = total + float(reward[0]), bool(terminated[0] or truncated[0])
    # The return of its mean action, as the file has it.
    assert total == pytest.approx(data.meta["returns"]["deterministic"]["400"], rel=1e-3)


def test_policies_of_finished_tasks_are_said_not_to_be_kept(
    hoppers: Path, tmp_path: Path, capsys: Capture
) -> None:
    folder, kept = shutil.copytree(hoppers, tmp_path / "data"), tmp_path / "kept"
    assert main([*HOPPERS, "--out", str(folder), "--policies", str(kept)]) == 0
    sentence = (
        f"The policies of finished tasks are not kept: {kept} will have none of 0-2, collect to "
        "another --out to have them."
    )
    assert capsys.readouterr().out.splitlines()[1] == sentence
    assert not kept.exists()


@pytest.mark.parametrize("engine", ["fleet", pytest.param("sb3", marks=pytest.mark.slow)])
def test_either_engine_collects_point_robots(engine: str, tmp_path: Path, capsys: Capture) -> None:
    options = ["--precision", "float32"] if engine == "fleet" else ["--tasks", "0"]
    assert main([*ROBOTS, "--engine", engine, *options, "--out", str(tmp_path)]) == 0
    dataset = open_dataset(tmp_path)
    assert dataset.tasks.tolist() == ([0, 1] if engine == "fleet" else [0])
    fleet = {"size": 25, "precision": "float32", "device": "cpu"} if engine == "fleet" else None
    assert dataset.index["config"].get("fleet") == fleet
    assert len(dataset.read(0)) == 2 * 4 * 25
    assert check.main([str(tmp_path)]) == 0
    assert not list(tmp_path.glob(".fleet*"))
    # What the one engine has made, the other does not go on with.
    other = ["--engine", "sb3" if engine == "fleet" else "fleet"]
    capsys.readouterr()
    assert main([*ROBOTS, *other, "--out", str(tmp_path)]) == 2
    assert "was collected with config.fleet" in capsys.readouterr().err


def test_the_default_engines() -> None:
    def asked(env: str, engine: Literal["fleet", "sb3"] | None = None) -> Plan:
        return plan_of(CollectConfig(env, "smoke", engine=engine))

    for env in ("point_robot_wind", "hopper_params"):
        assert asked(env, "fleet") == asked(env)
        assert asked(env).budget.fleet == FleetSettings(25, best_precision())
        assert asked(env, "sb3").budget.fleet is None


@pytest.mark.parametrize("device", ["cuda", "cuda:1"])
def test_a_gpu_has_all_tasks_at_once(device: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("datagen.accelerator.check_precision", lambda *about: "float32")
    many = CollectConfig("half-cheetah-vel", "smoke", device=device, workers=3)
    assert plan_of(many).groups == (tuple(range(100)),)
    # The budget of a few tasks is that of all, so that the others can be added.
    few = plan_of(replace(many, tasks="3,5,60"))
    assert few.groups == ((3, 5, 60),)
    assert few.budget == plan_of(many).budget
    assert len(plan_of(replace(many, fleet_size=25)).groups) == 4
    assert len(plan_of(replace(many, device="cpu")).groups) == 4
    points = CollectConfig("point_robot", "smoke", engine="fleet", device=device)
    assert len(plan_of(points).groups) == 1


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ((*SB3, "--precision", "bfloat16"), "--precision is for fleets, not for --engine sb3"),
        ((*SB3, "--fleet-size", "3"), "--fleet-size is for fleets, not for --engine sb3"),
        ((*SB3, "--device", "cuda"), "--device is for fleets, not for --engine sb3"),
        ((*SB3, "--policies", "kept"), "--policies is for fleets, not for --engine sb3"),
        ((*HOPPERS, "--fleet-size", "0"), "--fleet-size must be at least 1, got 0"),
        ((*HOPPERS, "--device", "nonsense"), "--device nonsense cannot be used here: "),
        ((*HOPPERS, "--device", "cuda:99"), "--device cuda:99 cannot be used here: "),
        pytest.param(
            (*HOPPERS, "--device", "cuda"),
            "--device cuda cannot be used here: ",
            marks=pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU"),
        ),
    ],
)
def test_mistakes_are_one_sentence(
    arguments: tuple[str, ...], sentence: str, tmp_path: Path, capsys: Capture
) -> None:
    assert main([*arguments, "--out", str(tmp_path / "new")]) == 2
    said = capsys.readouterr()
    assert said.err.startswith(sentence)
    assert said.err.count("\n") == 1
    assert said.out == ""
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize("count", [1, 2, 3])
def test_shards_are_the_groups_of_the_whole(count: int) -> None:
    def asked(shard: str | None) -> Plan:
        tasks, size = "0-9,20", 4
        return plan_of(
            CollectConfig("ant_goal", "smoke", tasks=tasks, fleet_size=size, shard=shard)
        )

    shards = [asked(f"{index}/{count}") for index in range(count)]
    assert sorted(group for shard in shards for group in shard.groups) == list(asked(None).groups)


@pytest.mark.slow
def test_all_shards_together_have_the_same_bytes(tmp_path: Path) -> None:
    whole, shards = tmp_path / "whole", tmp_path / "shards"
    assert main([*PAIRS, "--out", str(whole)]) == 0
    for shard in ("1/2", "0/2"):
        assert main([*PAIRS, "--shard", shard, "--out", str(shards)]) == 0
    assert contents(shards) == contents(whole)


def test_an_interrupted_collection_of_other_tasks_leaves_nothing(
    hoppers: Path, tmp_path: Path
) -> None:
    folder = shutil.copytree(hoppers, tmp_path / "data")
    finished, other = group_file(folder, (0, 2)), group_file(folder, (2, 3))
    for path, group in ((finished, [0, 2]), (other, [2, 3])):
        save_state(path, {}, {"origin": {"group": group}})
    assert main([*HOPPERS, "--out", str(folder)]) == 0
    assert not finished.exists()
    assert other.exists(), "task 3 has no file: it may be another shard's"


def test_another_device_is_another_collection(
    hoppers: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    folder = shutil.copytree(hoppers, tmp_path / "data")
    monkeypatch.setattr("datagen.accelerator.check_precision", lambda *_: best_precision())
    assert main([*HOPPERS, "--device", "cuda:1", "--out", str(folder)]) == 2
    said = capsys.readouterr().err
    assert "was collected with config.fleet.device 'cpu', not 'cuda'; give the same options" in said


def test_a_damaged_training_is_one_sentence(tmp_path: Path, capsys: Capture) -> None:
    path = group_file(tmp_path, (0, 1))
    path.write_bytes(b"x" * 1000)
    assert main([*ROBOTS, "--out", str(tmp_path)]) == 2
    said = capsys.readouterr().err
    assert said.startswith(f"{path}: is damaged (")
    assert said.endswith("; delete it to train its tasks again\n")
    assert said.count("\n") == 1
    assert path.read_bytes() == b"x" * 1000


PROGRAM = (
    "import sys\nfrom datagen.collect import main\nif __name__ == '__main__': sys.exit(main())"
)


@contextmanager
def collecting(folder: Path) -> Iterator[subprocess.Popen[str]]:
    """A collection at work, in a process group of its own."""
    # Two groups, on two workers.
    words = [sys.executable, "-c", PROGRAM, *HOPPERS[:-1], "2", "--fleet-size", "2"]
    process = subprocess.Popen(
        [*words, "--out", str(folder)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def finish(folder: Path) -> dict[str, bytes]:
    with collecting(folder) as process:
        _, said = process.communicate(timeout=300)
    assert (process.returncode, said) == (0, "")
    return contents(folder)


def workers_of(pid: int) -> list[int]:
    """Process ids of a collection's workers."""
    columns = ["-o", "pid=", "-o", "ppid=", "-o", "args="]
    listing = subprocess.run(["ps", "-Aww", *columns], capture_output=True, text=True, check=True)
    rows = [line.split(maxsplit=2) for line in listing.stdout.splitlines()]
    return [int(row[0]) for row in rows if int(row[1]) == pid and "spawn_main" in row[2]]


def gone(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return True
    return False


@pytest.mark.slow
def test_killed_at_random_moments_it_ends_in_the_same_bytes(tmp_path: Path) -> None:
    generator = random.Random(0)
    begin = time.monotonic()
    original = finish(tmp_path / "original")
    whole = time.monotonic() - begin
    assert sorted(original) == ["README.md", "dataset.json", *(f"task_00{i}.h5" for i in range(3))]
    folder = tmp_path / "data"
    kills, trainings = 0, 0
    while kills < 10:
        shutil.rmtree(folder, ignore_errors=True)
        for _ in range(3):
            with collecting(folder) as process:
                time.sleep(generator.uniform(0.2 * whole, whole))
                workers = workers_of(process.pid)
                victim = generator.choice([process.pid, *workers])
                if process.poll() is not None or gone(victim):
                    break
                os.kill(victim, signal.SIGKILL)
                kills += 1
                process.wait(timeout=60)
                end = time.monotonic() + 60
                while not all(map(gone, workers)):
                    assert time.monotonic() < end, "a worker outlived its parent"
                    time.sleep(0.01)
            trainings += len(list(folder.glob(".fleet*"))) if folder.exists() else 0
        assert finish(folder) == original
    assert trainings > 0, "no kill has left a training to go on from"


@pytest.mark.slow
def test_a_file_that_was_lost_is_made_again(hoppers: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(hoppers, tmp_path / "data")
    (folder / "task_001.h5").unlink()
    assert main([*HOPPERS, "--out", str(folder)]) == 0
    assert contents(folder) == contents(hoppers)


def test_what_cannot_be_removed_in_the_end_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def refuse(folder: Path) -> None:
        raise PermissionError("not allowed")

    monkeypatch.setattr("datagen.collect.remove_states", refuse)
    few = ["--env", "point_robot_wind", "--budget", "smoke", "--tasks", "0-1", "--workers", "1"]
    assert main([*few, "--out", str(tmp_path)]) == 1
    assert "the dataset is complete, but" in capsys.readouterr().err
    assert check.main([str(tmp_path)]) == 0
