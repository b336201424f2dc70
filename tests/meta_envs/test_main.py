import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from meta_envs import ENVIRONMENTS
from meta_envs.__main__ import main


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "meta_envs", *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ["show", "point_robot_wnd"],
            "no environment 'point_robot_wnd'; did you mean 'point_robot_wind'? "
            f"(known: {', '.join(ENVIRONMENTS)})",
        ),
        (["show", "point_robot", "--task", "100"], "point_robot has tasks 0 to 99, got task=100"),
        (["show", "point_robot", "--task", "-1"], "point_robot has tasks 0 to 99, got task=-1"),
        (
            ["show", "point_robot", "--out", "picture.jpg"],
            "--out picture.jpg: the name must end in .png, which says what to write",
        ),
        (
            ["show", "point_robot", "--out", "absent/picture.png"],
            "--out absent/picture.png: there is no folder absent; make it first",
        ),
        (
            ["show", "point_robot", "--out", "folder.png"],
            "--out folder.png: this is a folder; name a file in it",
        ),
    ],
)
def test_a_mistake_is_one_sentence_and_exit_code_2(
    arguments: list[str],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "folder.png").mkdir()
    assert main(arguments) == 2
    captured = capsys.readouterr()
    assert captured.err == message + "\n"
    assert captured.out == ""
    assert [path.name for path in tmp_path.iterdir()] == ["folder.png"]


def test_a_picture_that_cannot_be_written_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def full(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    file = tmp_path / "picture.png"
    assert main(["show", "point_robot_wind", "--out", str(file)]) == 2
    assert capsys.readouterr().err == f"--out {file}: cannot be written: No space left on device\n"
    assert list(tmp_path.iterdir()) == []


def test_ctrl_c_is_a_sentence_and_exit_code_130(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(*arguments: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("meta_envs.commands.show.reference_returns", interrupted)
    assert main(["show", "point_robot"]) == 130
    assert capsys.readouterr().err == "Interrupted; nothing is left half written.\n"


def test_ctrl_c_before_the_command_is_known(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(*arguments: Any, **kwargs: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("tyro.cli", interrupted)
    assert main(["list"]) == 130
    assert capsys.readouterr().err == "Interrupted; nothing is left half written.\n"


def test_the_module_runs_as_a_command() -> None:
    done = run("show", "point_robt")
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr.startswith("no environment 'point_robt'; did you mean 'point_robot'?")
    assert "Traceback" not in done.stderr


def test_help_explains_every_option_and_loads_nothing_heavy() -> None:
    words = {
        "": ("list", "show", "render", "check", "gallery"),
        "show": ("ENV", "--task", "--out", "short name", "exact optimum"),
        "render": ("ENV", "--task", "--out", "--seed", ".gif", "random actions"),
        "check": ("ENV", "module:Class"),
        "gallery": ("--out",),
    }
    code = (
        "import sys, meta_envs.__main__ as cli\n"
        f"for command in {list(words)}:\n"
        "    try:\n        cli.main([*command.split(), '--help'])\n"
        "    except SystemExit as end:\n        assert end.code == 0\n"
        "    print('END OF HELP')\n"
        "heavy = {'torch', 'mujoco', 'matplotlib', 'PIL', 'stable_baselines3', 'h5py'}\n"
        "assert not heavy & set(sys.modules), heavy & set(sys.modules)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    helps = done.stdout.split("END OF HELP")
    for printed, expected in zip(helps, words.values(), strict=False):
        for word in expected:
            assert word in printed
