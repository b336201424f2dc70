"""Runs on a MuJoCo robot: noise at the reset, its physics' version, native threads."""

from __future__ import annotations

import json
import signal
from pathlib import Path

import mujoco
import pytest

from ctmrl.runs import RunError, RunFolder, read_json
from tests.ctmrl.commands import Commands, contents, rows, wait_until
from tests.datagen.examples import write_dataset


@pytest.fixture(scope="module")
def cheetah_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Random behaviour on HalfCheetahDir, four episodes a task."""
    folder = tmp_path_factory.mktemp("datasets") / "cheetah"
    return write_dataset(folder, (0, 1), "half_cheetah_dir")


def test_a_killed_run_on_a_robot_ends_in_the_same_bytes(
    commands: Commands, cheetah_path: Path, tmp_path: Path
) -> None:
    options = ("--env", "half_cheetah_dir", "--preset", "smoke", "--steps", "12", "--codes", "1")
    few = ("--random-episodes", "1", "--policy-episodes", "1")
    data = ("--context-episodes", "1", "--data", str(cheetah_path), "--beside", "always")
    words = ("ctmrl.train", *options, *data, "--repetitions", "1", *few, "--out")
    whole, path = tmp_path / "whole", tmp_path / "run"
    assert commands.run(*words, str(whole)) == 0, commands.output()
    commands.start(*words, str(path))
    wait_until(lambda: rows(path / "metrics.csv") > 3)
    commands.send(signal.SIGKILL)
    assert commands.wait() == -signal.SIGKILL
    assert commands.run(*words, str(path)) == 0, commands.output()
    assert commands.output().startswith("Going on at step ")
    assert contents(path) == contents(whole)
    # Another MuJoCo would go on with other physics.
    settings = read_json(path / "config.json")
    assert settings["versions"]["mujoco"] == mujoco.__version__
    other = {**settings, "versions": {**settings["versions"], "mujoco": "3.0.0"}}
    with pytest.raises(RunError, match=r"holds a run with versions\.mujoco = .*, this one has 3"):
        RunFolder(path, other, restart=False)
    # Runs from before it was named go on.
    del settings["versions"]["mujoco"]
    (path / "config.json").write_text(json.dumps(settings))
    RunFolder(path, other, restart=False).close()
