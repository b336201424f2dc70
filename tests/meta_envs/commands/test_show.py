import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from meta_envs import ENVIRONMENTS, reference_returns, task_set
from meta_envs.__main__ import main
from meta_envs.draw import ROBOT
from meta_envs.mujoco_robot import MujocoRobot

POINT_ROBOTS = ("point_robot", "point_robot_wind", "sparse_point_robot")


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
    for expected in ("point_robot_wind 2 2 25 40 10", "half_cheetah_dir 20 6 200 2 2"):
        name = expected.split()[0]
        line = next(line for line in printed.splitlines() if f" {name} " in line)
        assert line.split()[:6] == expected.split()


@pytest.mark.parametrize("name", POINT_ROBOTS)
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


def test_without_an_oracle_there_are_returns_but_no_scores(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["show", "half_cheetah_dir", "--task", "1"]) == 0
    printed = capsys.readouterr().out
    assert "no score: the optimum is not known" in " ".join(printed.split())
    assert "score │" not in printed
    assert "task 1 (train and test)" in printed
    returns = reference_returns(task_set("half_cheetah_dir"))
    assert "oracle" not in returns
    for controller, values in returns.items():
        found = [float(cell) for cell in row_of(printed, controller)[1:]]
        expected = [values.mean(), values.mean(), values[1]]
        np.testing.assert_allclose(found, expected, atol=0.006)


def test_show_has_every_split(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("meta_envs.commands.show._references", lambda row, task: "")
    for name in ENVIRONMENTS:
        assert main(["show", name]) == 0
        printed = capsys.readouterr().out
        for split, rows in task_set(name).splits.items():
            if split != "interpolate":
                sizes = f"{len(rows.train_tasks)} train, {len(rows.test_tasks)} test"
                assert row_of(printed, f"split '{split}'")[1] == sizes


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
        assert (
            f"Wrote {file}: the optimum's episode on task {task or 0}." in capsys.readouterr().out
        )
    assert sorted(tmp_path.iterdir()) == files
    assert files[0].read_bytes() == files[2].read_bytes() != files[1].read_bytes()
    assert files[1].stat().st_size < 30_000
    picture = np.array(Image.open(files[0]))
    assert picture.shape == (400, 400, 3)
    # The optimum's robot ends on the goal, (1, 0).
    down, right = np.nonzero((np.abs(picture[:340].astype(int) - ROBOT[:3]) <= 12).all(axis=2))
    assert np.hypot(down - 170, right - 295).min() < 2


def test_without_mujoco_a_sentence_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def absent(*given: object) -> None:
        raise ImportError("this environment needs MuJoCo", name="mujoco")

    monkeypatch.setattr(MujocoRobot, "simulation", absent)
    assert main(["show", "half_cheetah_dir"]) == 2
    assert capsys.readouterr().err == "this environment needs MuJoCo\n"
