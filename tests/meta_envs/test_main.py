import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from meta_envs import ENVIRONMENTS, reference_returns, task_set
from meta_envs.__main__ import main
from meta_envs.draw import ROBOT


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "meta_envs", *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def cells(line: str) -> list[str]:
    return [cell.strip() for cell in re.split("[│┃]", line)[1:-1]]


def row_of(text: str, first: str) -> list[str]:
    """Cells of the table row that starts so."""
    rows = [cells(line) for line in text.splitlines() if cells(line)[:1] == [first]]
    assert len(rows) == 1
    return rows[0]


def test_list_has_every_environment(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["list"]) == 0
    printed = capsys.readouterr().out
    for row in ENVIRONMENTS.values():
        assert row.id in printed
        assert row.varies in printed
    wind = next(line for line in printed.splitlines() if " point_robot_wind " in line)
    assert wind.split()[:6] == ["point_robot_wind", "2", "2", "25", "40", "10"]


@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_show_prints_the_tasks_and_the_references(
    name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["show", ENVIRONMENTS[name].id, "--task", "7"]) == 0
    printed = capsys.readouterr().out
    tasks = task_set(name)
    assert row_of(printed, "hash")[1] == tasks.hash
    n_train, n_test = len(tasks.train_tasks), len(tasks.test_tasks)
    assert row_of(printed, "tasks")[1] == f"{len(tasks)}: {n_train} train, {n_test} test"
    assert row_of(printed, "test tasks")[1] == str(tasks.test_tasks.tolist())[1:-1]
    assert "task 7 (test)" in printed
    for column, param in enumerate(tasks.param_names):
        values = tasks.params[:, column]
        expected = [values.min(), values.mean(), values.max(), values[7]]
        found = [float(cell) for cell in row_of(printed, param)[1:]]
        np.testing.assert_allclose(found, expected, atol=5.1e-5)
    returns = reference_returns(tasks)
    groups = (tasks.train_tasks, tasks.test_tasks, np.array([7]))
    for controller, values in returns.items():
        found = [float(cell) for cell in row_of(printed, controller)[1:]]
        np.testing.assert_allclose(found[::2], [values[rows].mean() for rows in groups], atol=0.006)
        low, best = ([returns[key][rows].mean() for rows in groups] for key in ("random", "oracle"))
        means = np.array([values[rows].mean() for rows in groups])
        scores = 100 * (means - low) / (np.array(best) - low)
        np.testing.assert_allclose(found[1::2], scores, atol=0.06)


def test_a_train_task_is_called_so(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["show", "point_robot_wind", "--task", "3"]) == 0
    assert "task 3 (train)" in capsys.readouterr().out
    assert main(["show", "point_robot_wind"]) == 0
    assert "(train)" not in capsys.readouterr().out


def test_out_writes_the_optimums_episode(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    files = [tmp_path / "a.png", tmp_path / "b.png", tmp_path / "c.png"]
    for file, task in zip(files, ("0", "30", None), strict=True):
        chosen = [] if task is None else ["--task", task]
        assert main(["show", "point_robot_wind", *chosen, "--out", str(file)]) == 0
        assert f"Wrote {file}" in capsys.readouterr().out
    assert sorted(tmp_path.iterdir()) == files
    assert files[0].read_bytes() == files[2].read_bytes() != files[1].read_bytes()
    assert files[1].stat().st_size < 30_000
    picture = np.array(Image.open(files[0]))
    assert picture.shape == (400, 400, 3)
    # The optimum's robot ends on the goal, (1, 0).
    down, right = np.nonzero((np.abs(picture[:340].astype(int) - ROBOT[:3]) <= 12).all(axis=2))
    assert np.hypot(down - 170, right - 295).min() < 2


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ["show", "point_robot_wnd"],
            "no environment 'point_robot_wnd'; did you mean 'point_robot_wind'? "
            "(known: point_robot, point_robot_wind, sparse_point_robot)",
        ),
        (["show", "point_robot", "--task", "100"], "point_robot has tasks 0 to 99, got task=100"),
        (["show", "point_robot", "--task", "-1"], "point_robot has tasks 0 to 99, got task=-1"),
        (
            ["show", "point_robot", "--out", "picture.jpg"],
            "--out picture.jpg: the picture is a PNG, so its name must end in .png",
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

    monkeypatch.setattr("meta_envs.__main__.reference_returns", interrupted)
    assert main(["show", "point_robot"]) == 130
    assert capsys.readouterr().err == "Interrupted; nothing is left half written.\n"


def test_the_module_runs_as_a_command() -> None:
    done = run("show", "point_robt")
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr.startswith("no environment 'point_robt'; did you mean 'point_robot'?")
    assert "Traceback" not in done.stderr


def test_help_explains_every_option_and_loads_nothing_heavy() -> None:
    code = (
        "import sys, meta_envs.__main__ as cli\n"
        "try:\n    cli.main(['show', '--help'])\n"
        "except SystemExit as end:\n    assert end.code == 0\n"
        "heavy = {'torch', 'mujoco', 'matplotlib', 'PIL', 'stable_baselines3', 'h5py'}\n"
        "assert not heavy & set(sys.modules), heavy & set(sys.modules)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    for word in ("ENV", "--task", "--out", "short name", "exact optimum"):
        assert word in done.stdout
