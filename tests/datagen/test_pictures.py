"""Pictures of datasets: drawn for the plane and for anything else, the same each time."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure

from datagen import pictures
from datagen.dataset import open_dataset
from datagen.pictures import draw
from tests.datagen.examples import task_data, write_dataset


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_dataset(tmp_path_factory.mktemp("pictures"), tasks=range(8))


def figure_of(folder: Path, path: Path, monkeypatch: pytest.MonkeyPatch) -> Figure:
    """The figure that `draw` makes."""
    made: list[Figure] = []

    def keep(*arguments: object, **keywords: object) -> Figure:
        made.append(Figure(*arguments, **keywords))  # type: ignore[arg-type]  # passed through
        return made[-1]

    monkeypatch.setattr(pictures, "Figure", keep)
    draw(open_dataset(folder), path)
    return made[0]


def test_episodes_are_paths_that_begin_at_the_origin(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    picture = tmp_path / "a.png"
    left, *grid = figure_of(folder, picture, monkeypatch).get_axes()
    lines = {line.get_label(): np.asarray(line.get_ydata()) for line in left.get_lines()}
    train = [task_data(task).meta["returns"] for task in (0, 1, 3, 4, 5, 6)]
    wanted = [np.mean([one["behavior"][mark] for one in train]) for mark in ("200", "1000")]
    np.testing.assert_allclose(lines["6 train tasks, mean and 10-90 %"], wanted)
    titles = [axes.get_title().partition(":")[0] for axes in grid if axes.get_title()]
    assert titles == [
        "task 0 (train)", "task 2 (test)", "task 3 (train)", "task 4 (train)", "task 6 (train)",
        "task 7 (test)",
    ]  # fmt: skip
    paths: Any = grid[0].collections[0]
    data = task_data(0)
    assert len(paths.get_paths()) == 4
    first = np.concatenate([data.observations[:25], data.next_observations[24:25]])
    np.testing.assert_allclose(paths.get_paths()[0].vertices, first)
    totals = data.rewards.reshape(4, 25).sum(axis=1)
    np.testing.assert_allclose(paths.get_array(), totals, rtol=1e-5)
    again = tmp_path / "b.png"
    draw(open_dataset(folder), again)
    assert picture.read_bytes() == again.read_bytes()


def test_elsewhere_a_histogram_counts_every_episode(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pictures, "_in_the_plane", lambda env: False)
    picture = tmp_path / "a.pdf"
    axes = figure_of(folder, picture, monkeypatch).get_axes()[1]
    assert picture.read_bytes().startswith(b"%PDF")
    assert axes.get_title() == "32 episodes of 8 tasks"
    heights = sum(patch.get_height() for patch in axes.patches)  # type: ignore[attr-defined]
    assert heights == 32
