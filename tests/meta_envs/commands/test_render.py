from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from meta_envs import ENVIRONMENTS, MetaEnv
from meta_envs.__main__ import main
from meta_envs.commands import render
from meta_envs.headless import RenderingUnavailableError
from meta_envs.point_robot import PointRobot
from tests.meta_envs.opengl import needs_opengl


def frames(file: Path) -> list[Any]:
    """Pictures of an animation, each [height, width, 3]."""
    with Image.open(file) as image:
        found = []
        for number in range(getattr(image, "n_frames", 1)):
            image.seek(number)
            found.append(np.array(image.convert("RGB")).astype(int))
        return found


def pause(file: Path) -> int:
    """Milliseconds from an animation's first picture to the second."""
    with Image.open(file) as image:
        return int(image.info["duration"])


def test_an_animation_shows_the_whole_episode(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "robot.gif"
    assert main(["render", "point_robot", "--task", "30", "--out", str(file)]) == 0
    assert capsys.readouterr().out == f"Wrote {file}: the optimum's episode on task 30.\n"
    assert list(tmp_path.iterdir()) == [file]
    shown = frames(file)
    assert len(shown) == ENVIRONMENTS["point_robot"].horizon + 1
    env = MetaEnv("point_robot", task=30, render_mode="rgb_array")
    position, _ = env.reset()
    # An animation has few colours, so they are near the picture's rather than equal.
    assert np.abs(shown[0] - env.render()).mean() < 1.0
    for _ in range(20):
        position, *_ = env.step(10.0 * (env.task_set.params[30] - position))
    assert np.abs(shown[-1] - env.render()).mean() < 1.0
    assert pause(file) == 100


@needs_opengl
def test_an_animation_is_no_faster_than_browsers_show_it(tmp_path: Path) -> None:
    file = tmp_path / "hopper.gif"
    assert main(["render", "hopper_mass", "--out", str(file)]) == 0
    # Every third of its steps of 8 ms, in hundredths of a second.
    assert pause(file) == 20


def test_a_picture_is_the_last_of_the_episode(tmp_path: Path) -> None:
    gif, png = tmp_path / "robot.gif", tmp_path / "robot.png"
    for file in (gif, png):
        assert main(["render", "PointRobotWind-v0", "--task", "3", "--out", str(file)]) == 0
    (picture,) = frames(png)
    different = [(np.abs(one - picture).max(axis=2) > 90).sum() for one in frames(gif)]
    assert different[-1] < 20 < 400 < different[0]


@needs_opengl
def test_an_episode_of_random_actions_where_the_optimum_is_not_known(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(render, "MOST_PICTURES", 4)
    files = [tmp_path / f"ant{number}.gif" for number in range(3)]
    for file, seed in zip(files, ("5", "5", "6"), strict=True):
        assert main(["render", "ant-goal", "--out", str(file), "--seed", seed]) == 0
        expected = f"Wrote {file}: an episode of random actions (seed {seed}) on task 0.\n"
        assert capsys.readouterr().out == expected
    shown = frames(files[0])
    assert len(shown) == 5
    assert pause(files[0]) == 50 * 50
    assert files[0].read_bytes() == files[1].read_bytes() != files[2].read_bytes()
    for picture in shown:  # the goal is in sight in each
        green = (picture[..., 1] > 1.5 * picture[..., 0]) & (picture[..., 1] > 60)
        assert green.sum() > 100


@needs_opengl
def test_the_gallery_has_every_environment(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    few = {name: ENVIRONMENTS[name] for name in ("point_robot", "point_robot_wind", "ant_dir")}
    monkeypatch.setattr(render, "ENVIRONMENTS", few)
    monkeypatch.setattr(render, "COLUMNS", 2)
    file = tmp_path / "gallery.png"
    assert main(["gallery", "--out", str(file)]) == 0
    assert capsys.readouterr().out == f"Wrote {file}: 3 environments.\n"
    assert list(tmp_path.iterdir()) == [file]
    (whole,) = frames(file)
    tile, caption = render.TILE, render.CAPTION
    assert whole.shape == (2 * (tile + caption), 2 * tile, 3)
    for down in range(2):
        for across in range(2):
            part = whole[down * (tile + caption) :, across * tile :][: tile + caption, :tile]
            there = (down, across) != (1, 1)
            assert (part[:tile].min() < 200) == there
            assert (part[tile:].min() < 100) == there


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["render", "ant_gaol", "--out", "a.gif"], "no environment 'ant_gaol'; did you mean 'ant_"),
        (["render", "ant_goal", "--task", "40", "--out", "a.gif"], "ant_goal has tasks 0 to 39"),
        (["render", "ant_goal", "--seed", "-1", "--out", "a.gif"], "--seed must be at least 0"),
        (
            ["render", "ant_goal", "--out", "a.mp4"],
            "--out a.mp4: the name must end in .gif or .png, which says what to write",
        ),
        (["gallery", "--out", "a.gif"], "--out a.gif: the name must end in .png, which says"),
    ],
)
def test_a_mistake_is_one_sentence(
    arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(arguments) == 2
    captured = capsys.readouterr()
    assert captured.err.startswith(message)
    assert captured.err.count("\n") == 1
    assert captured.out == ""


def test_without_opengl_a_sentence_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def unavailable(*given: Any) -> None:
        raise RenderingUnavailableError("install something")

    monkeypatch.setattr(PointRobot, "render", unavailable)
    for arguments in (["render", "point_robot"], ["gallery"], ["show", "point_robot"]):
        assert main([*arguments, "--out", str(tmp_path / "a.png")]) == 2
        assert capsys.readouterr().err == "install something\n"
    assert list(tmp_path.iterdir()) == []
