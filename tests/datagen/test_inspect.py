"""`python -m datagen.inspect`: the table's numbers, and a user's mistakes."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from datagen.inspect import main, params_text
from meta_envs import normalized_score
from tests.datagen.examples import graded_data, task_data, write_dataset, write_tasks

Capture = pytest.CaptureFixture[str]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_dataset(tmp_path_factory.mktemp("inspect") / "point_robot_wind")


def test_the_table_has_every_task_and_the_means(folder: Path, capsys: Capture) -> None:
    assert main([str(folder)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("PointRobotWind-v0: 4 tasks, budget smoke, seed 0")
    rows = {line.split()[0]: line.split() for line in lines if line.split()[1:2] == ["train"]}
    returns = task_data(3).meta["returns"]
    first, last = returns["behavior"]["200"], returns["behavior"]["1000"]
    score = normalized_score(max(first, last), returns["random"], returns["expert"])
    values = [returns["random"], first, last, max(first, last), -5.0]
    assert rows["3"][4:] == ["100", "4", *(f"{value:.2f}" for value in values), f"{score:.1f}"]
    of_all = [line.split() for line in lines if line.split()[:1] == ["all"]]
    assert [row[1:6] for row in of_all] == [
        ["train", "3", "tasks", "300", "12"],
        ["test", "1", "tasks", "100", "4"],
    ]
    train = [task_data(task).meta["returns"]["random"] for task in (0, 1, 3)]
    assert of_all[0][6] == f"{sum(train) / 3:.2f}"


def test_the_slices_are_counted(tmp_path: Path, capsys: Capture) -> None:
    # Above random at -30: 1, 10, 18, 19, 20 of 20, and no medium checkpoint for task 1.
    curves = {
        0: {100: -29.0, 200: -20.0, 300: -12.0, 400: -11.0, 500: -10.0},
        1: {100: -29.0, 200: -10.0, 300: -12.0, 400: -11.0, 500: -10.0},
    }
    tasks = [graded_data(task, curve, episodes=5) for task, curve in curves.items()]
    folder = write_tasks(tmp_path / "point_robot_wind", tasks)
    assert main([str(folder)]) == 0
    lines = capsys.readouterr().out.splitlines()
    rows = {line.split()[0]: line.split()[1:] for line in lines if " of 2 " in line}
    # Five episodes of a checkpoint have 25 + 24 + 23 + 22 + 21 steps.
    random, expert = -30.0, -5.0
    means = {
        "mixed": (sum(curves[0].values()) + sum(curves[1].values())) / 10,
        "medium": -20.0,
        "expert": (-10.5 - 10.5) / 2,
        "early": (-24.5 - 19.5) / 2,
    }
    score = {name: 100 * (mean - random) / (expert - random) for name, mean in means.items()}
    ends = {name: [f"{means[name]:.2f}", f"{score[name]:.1f}"] for name in means}
    assert rows == {
        "mixed": ["2", "of", "2", "1,150", "50", "5", "5", *ends["mixed"]],
        "medium": ["1", "of", "2", "115", "5", "1", "5", *ends["medium"]],
        "expert": ["2", "of", "2", "460", "20", "2", "5", *ends["expert"]],
        "early": ["2", "of", "2", "460", "20", "2", "5", *ends["early"]],
    }


def test_a_slice_no_task_has_is_shown_as_empty(folder: Path, capsys: Capture) -> None:
    assert main([str(folder)]) == 0
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert ["medium", "0", "of", "4", "0", "0", "-", "-", "-", "-"] in lines


def test_many_parameters_are_cut_short() -> None:
    assert params_text([1.0, -0.25]) == "1.000, -0.250"
    assert params_text([1.0, 2.0, 3.0, 4.0]) == "1.000, 2.000, 3.000, ..."


def test_a_picture_is_written(folder: Path, tmp_path: Path, capsys: Capture) -> None:
    picture = tmp_path / "picture.png"
    assert main([str(folder), "--plot", str(picture)]) == 0
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert f"Wrote {picture}." in capsys.readouterr().out


def test_mistakes_are_one_sentence(folder: Path, tmp_path: Path, capsys: Capture) -> None:
    broken = shutil.copytree(folder, tmp_path / "broken")
    (broken / "task_001.h5").unlink()
    mistakes = {
        (str(tmp_path / "none"),): "no dataset is there",
        (str(broken),): "task_001.h5: is missing; ",
        (str(folder), "--plot", "picture.bmp"): "must end in .png or .pdf",
        (str(folder), "--plot", str(tmp_path / "no" / "a.png")): "there is no folder",
    }
    for arguments, sentence in mistakes.items():
        assert main(arguments) == 2
        said = capsys.readouterr()
        assert sentence in said.err
        assert said.err.count("\n") == 1
        assert said.out == ""
