"""`python -m datagen.inspect`: the table's numbers, and a user's mistakes."""

from __future__ import annotations

from pathlib import Path

import pytest

from datagen.inspect import main, params_text
from meta_envs import normalized_score
from tests.datagen.examples import task_data, write_dataset

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


def test_many_parameters_are_cut_short() -> None:
    assert params_text([1.0, -0.25]) == "1.000, -0.250"
    assert params_text([1.0, 2.0, 3.0, 4.0]) == "1.000, 2.000, 3.000, ..."


def test_a_picture_is_written(folder: Path, tmp_path: Path, capsys: Capture) -> None:
    picture = tmp_path / "picture.png"
    assert main([str(folder), "--plot", str(picture)]) == 0
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert f"Wrote {picture}." in capsys.readouterr().out


def test_mistakes_are_one_sentence(folder: Path, tmp_path: Path, capsys: Capture) -> None:
    mistakes = {
        (str(tmp_path / "none"),): "no dataset is there",
        (str(folder), "--plot", "picture.bmp"): "must end in .png or .pdf",
        (str(folder), "--plot", str(tmp_path / "no" / "a.png")): "there is no folder",
    }
    for arguments, sentence in mistakes.items():
        assert main(arguments) == 2
        said = capsys.readouterr()
        assert sentence in said.err
        assert said.err.count("\n") == 1
        assert said.out == ""
