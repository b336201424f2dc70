"""Pictures of datasets: drawn for the plane and for anything else, the same each time."""

from __future__ import annotations

from pathlib import Path

import matplotlib
import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

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


@pytest.mark.parametrize("suffix", ["png", "pdf", "svg"])
def test_the_same_dataset_gives_the_same_picture(folder: Path, tmp_path: Path, suffix: str) -> None:
    paths = [tmp_path / f"{n}.{suffix}" for n in range(2)]
    with matplotlib.rc_context({"svg.hashsalt": "test"}):
        for path in paths:
            draw(open_dataset(folder), path)
    assert paths[0].read_bytes() == paths[1].read_bytes()
    if suffix == "png":
        pixels = np.asarray(Image.open(paths[0]).convert("RGB"))
        assert len(np.unique(pixels.reshape(-1, 3), axis=0)) > 100


def test_episodes_are_paths_that_begin_at_the_origin(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    left, *grid = figure_of(folder, tmp_path / "a.png", monkeypatch).get_axes()
    lines = {line.get_label(): np.asarray(line.get_ydata()) for line in left.get_lines()}
    train = [task_data(task).meta["returns"] for task in (0, 1, 3, 4, 5, 6)]
    wanted = [np.mean([one["behavior"][mark] for one in train]) for mark in ("200", "1000")]
    np.testing.assert_allclose(lines["6 train tasks, mean and 10-90 %"], wanted)
    titles = [axes.get_title() for axes in grid if axes.get_title()]
    assert len(titles) == pictures.SHOWN_TASKS
    assert titles[0].startswith("task 0 (train): -0.02, 0.03")
    assert titles[-1].startswith("task 7 (test)")
    (paths,) = grid[0].collections
    data = task_data(0)
    assert len(paths.get_paths()) == 4
    wanted_path = np.concatenate([data.observations[:25], data.next_observations[24:25]])
    np.testing.assert_allclose(paths.get_paths()[0].vertices, wanted_path)
    totals = data.rewards.reshape(4, 25).sum(axis=1)
    np.testing.assert_allclose(paths.get_array(), totals, rtol=1e-5)


def test_elsewhere_a_histogram_counts_every_episode(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pictures, "_in_the_plane", lambda env: False)
    axes = figure_of(folder, tmp_path / "a.png", monkeypatch).get_axes()[1]
    assert axes.get_title() == "32 episodes of 8 tasks"
    heights = sum(patch.get_height() for patch in axes.patches)  # type: ignore[attr-defined]
    assert heights == 32
