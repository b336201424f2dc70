import copy
import subprocess
import sys
import threading
from typing import Any

import mujoco
import numpy as np
import pytest

from meta_envs import headless, render_mujoco
from meta_envs.headless import close
from meta_envs.render_mujoco import SIZE, Marker, render
from meta_envs.simulation import load_model
from tests.meta_envs.opengl import needs_opengl

pytestmark = needs_opengl

CHEETAH, ANT = "half_cheetah.xml", "ant.xml"
MODELS = {name: load_model(name, 0.01) for name in (CHEETAH, ANT)}


def draw(name: str, *markers: Marker, **moved: float) -> Any:
    """Picture of a robot at rest, moved along x or y, as integers."""
    model = MODELS[name]
    qpos = model.qpos0.copy()
    for axis, distance in moved.items():
        qpos["xy".index(axis)] += distance
    return render(model, qpos, markers).astype(int)


def green(picture: Any) -> Any:
    """Where a picture shows the goal, bool [height, width]."""
    return (picture[..., 1] > 1.6 * picture[..., 0]) & (picture[..., 1] > 1.3 * picture[..., 2])


def orange(picture: Any) -> Any:
    """Where a picture shows an arrow, bool [height, width]."""
    return (picture[..., 0] > 1.7 * picture[..., 1]) & (picture[..., 1] > 3 * picture[..., 2])


def middle(mask: Any) -> tuple[float, float]:
    """Mean position of what is marked, (right, down)."""
    down, right = np.nonzero(mask)
    return float(right.mean()), float(down.mean())


def span(mask: Any) -> tuple[int, int]:
    """First and last column of what is marked."""
    right = np.nonzero(mask.any(axis=0))[0]
    return int(right.min()), int(right.max())


def test_a_picture_is_a_fresh_array_of_the_documented_kind() -> None:
    model = MODELS[ANT]
    before = copy.copy(model)
    qpos = model.qpos0.copy()
    picture, again = render(model, qpos), render(model, qpos)
    assert not green(picture.astype(int)).any()
    assert not orange(picture.astype(int)).any()
    assert picture.dtype == np.uint8
    assert picture.shape == (SIZE, SIZE, 3)
    assert picture.flags.owndata
    np.testing.assert_array_equal(picture, again)
    np.testing.assert_array_equal(qpos, model.qpos0)
    assert model.vis.quality.shadowsize == before.vis.quality.shadowsize
    assert model.vis.quality.offsamples == before.vis.quality.offsamples
    assert model.vis.global_.offwidth == before.vis.global_.offwidth
    assert model.vis.global_.offheight == before.vis.global_.offheight


def test_the_robot_is_in_the_middle_wherever_it_is() -> None:
    for moved in (0.0, 7.3):
        picture = draw(CHEETAH, x=moved)
        brown = (picture[..., 0] > picture[..., 2] + 40) & (picture[..., 0] > 80)
        right, down = middle(brown)
        assert abs(right - SIZE / 2) < 20
        assert abs(down - SIZE / 2) < 60
    # The floor goes by.
    assert (draw(CHEETAH) != draw(CHEETAH, x=0.5)).any(axis=2).mean() > 0.1


@pytest.mark.parametrize("goal", [(2.0, 0.0), (-1.4, 1.4), (0.0, -2.0)])
def test_a_goal_is_where_it_is(goal: tuple[float, float]) -> None:
    picture = draw(ANT, Marker("goal", (*goal, 0.0)))
    assert green(picture).sum() > 150
    right, down = middle(green(picture))
    # A pinhole camera at 45 degrees above the middle between robot and goal, looking along y.
    reach, height = robot_size(MODELS[ANT])
    look = np.array([goal[0] / 2, goal[1] / 2, height / 2])
    radius = np.linalg.norm([*goal, height]) / 2 + reach
    distance = radius / (0.9 * np.sin(np.radians(22.5)))
    camera = look + distance * np.array([0.0, -np.sqrt(0.5), np.sqrt(0.5)])
    offset = np.array([*goal, 0.3]) - camera
    depth = offset @ [0.0, np.sqrt(0.5), -np.sqrt(0.5)]
    scale = SIZE / 2 / np.tan(np.radians(22.5)) / depth
    assert right == pytest.approx(SIZE / 2 + scale * offset[0], abs=3)
    assert down == pytest.approx(SIZE / 2 - scale * (offset @ [0.0, 0.5**0.5, 0.5**0.5]), abs=14)


def robot_size(model: mujoco.MjModel) -> tuple[float, float]:
    """Half of the longest side of the box around a robot at rest, and the box's middle height."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for geom in range(model.ngeom):
        if model.geom_bodyid[geom]:
            low = np.minimum(low, data.geom_xpos[geom] - model.geom_rbound[geom])
            high = np.maximum(high, data.geom_xpos[geom] + model.geom_rbound[geom])
    return float((high - low).max() / 2), float((high[2] + low[2]) / 2)


def test_robot_and_goal_are_in_sight_while_it_walks_and_the_view_stands_still() -> None:
    goal = Marker("goal", (2.0, 0.0, 0.0))
    pictures = [draw(ANT, goal, x=x) for x in (0.0, 0.5, 1.0)]
    places = [middle(green(picture)) for picture in pictures[:2]]
    assert places[0] == pytest.approx(places[1], abs=3)
    for picture in pictures:
        assert green(picture)[10:-10, 10:-10].sum() > 100


def test_a_velocitys_arrow_is_as_long_as_it_is_fast() -> None:
    def length(speed: float) -> int:
        first, last = span(orange(draw(CHEETAH, Marker("velocity", vector=(speed, 0.0, 0.0)))))
        # Above the robot, as far to its left as to its right.
        assert (first + last) / 2 == pytest.approx(SIZE / 2, abs=4)
        return last - first

    lengths = [length(speed) for speed in (1.0, 2.0, -3.0)]
    assert lengths[1] == pytest.approx(2 * lengths[0], abs=4)
    assert lengths[2] == pytest.approx(3 * lengths[0], abs=6)
    # 0.8 m for 2 m/s, and a direction's is half the robot.
    reach, _ = robot_size(MODELS[CHEETAH])
    first, last = span(orange(draw(CHEETAH, Marker("direction", vector=(1.0, 0.0, 0.0)))))
    assert lengths[1] / (last - first) == pytest.approx(0.8 / reach, rel=0.05)


@pytest.mark.parametrize(("kind", "sign"), [("velocity", 1.0), ("direction", -1.0)])
def test_an_arrow_points_where_it_should(kind: Any, sign: float) -> None:
    mask = orange(draw(CHEETAH, Marker(kind, vector=(2.0 * sign, 0.0, 0.0))))
    heights = mask.sum(axis=0)[slice(*span(mask))][:: int(sign)]
    tail, tip = heights[2:10].mean(), heights[-8:-1].mean()
    widest = int(heights.argmax())
    assert tip < tail < heights.max()
    assert widest > len(heights) / 2


def test_a_direction_of_a_robot_that_walks_anywhere() -> None:
    places = {}
    for name, vector in {"right": (1, 0, 0), "left": (-3, 0, 0), "away": (0, 1, 0)}.items():
        mask = orange(draw(ANT, Marker("direction", vector=vector)))
        assert mask.sum() > 100
        places[name] = span(mask)
    assert places["right"] == pytest.approx(places["left"], abs=3)
    width = np.diff(places["away"])[0]
    assert width < np.diff(places["right"])[0] / 3


def test_an_arrow_with_a_position_starts_there() -> None:
    first, _ = span(orange(draw(CHEETAH, Marker("velocity", (0.0, 0.0, 1.0), (1.0, 0.0, 0.0)))))
    assert first == pytest.approx(SIZE / 2, abs=3)


def test_the_speed_is_written_beside_the_arrow() -> None:
    pictures = [draw(CHEETAH, Marker("velocity", vector=(v, 0.0, 0.0))) for v in (1.0, 1.004, 1.02)]
    same, other = ((picture != pictures[0]).any(axis=2)[:60].sum() for picture in pictures[1:])
    assert same < other


def test_pictures_do_not_depend_on_those_before() -> None:
    goal = Marker("goal", (1.0, 1.0, 0.0))
    alone = {}
    for name in (CHEETAH, ANT):
        close()
        alone[name] = draw(name, goal)
    for name in (CHEETAH, ANT, ANT, CHEETAH):
        np.testing.assert_array_equal(draw(name, goal), alone[name])


def canvases() -> int:
    """How many kinds of model are loaded."""
    with headless.current(SIZE, SIZE) as kept:
        return len(kept)


def test_models_that_look_alike_share_a_canvas_and_few_are_kept(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(render_mujoco, "KEPT_CANVASES", 2)
    close()
    heavier = copy.copy(MODELS[ANT])
    heavier.body_mass[:] *= 2
    render(MODELS[ANT], MODELS[ANT].qpos0)
    render(heavier, heavier.qpos0)
    assert canvases() == 1
    ball = '<body name="{}"><freejoint/><geom size="1"/></body>'
    for number in range(2):
        world = f"<mujoco><worldbody>{ball.format(number)}</worldbody></mujoco>"
        model = mujoco.MjModel.from_xml_string(world)
        render(model, model.qpos0)
    assert canvases() == 2
    close()
    assert canvases() == 0
    close()
    render(MODELS[ANT], MODELS[ANT].qpos0)
    assert canvases() == 1


def test_pictures_from_several_threads() -> None:
    expected, found = {name: draw(name) for name in (CHEETAH, ANT)}, []

    def work(name: str) -> None:
        found.append((name, draw(name)))

    threads = [threading.Thread(target=work, args=(name,)) for name in (*expected, *expected)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(found) == 4
    for name, picture in found:
        np.testing.assert_array_equal(picture, expected[name])


def test_a_process_ends_quietly_with_its_canvases_open() -> None:
    code = (
        "from meta_envs.render_mujoco import render\n"
        "from meta_envs.simulation import load_model\n"
        f"for name in {[CHEETAH, ANT]}:\n"
        "    model = load_model(name, 0.01)\n"
        "    render(model, model.qpos0)\n"
    )
    command = [sys.executable, "-W", "error", "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


@pytest.mark.parametrize("qpos", [np.zeros(3), np.full(9, np.nan), np.zeros((1, 9))])
def test_a_wrong_configuration_is_refused(qpos: Any) -> None:
    with pytest.raises(ValueError, match="qpos must be 9 finite numbers, got"):
        render(MODELS[CHEETAH], qpos)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"kind": "gaol"}, "a marker's kind is one of goal, velocity, direction, got 'gaol'"),
        ({"kind": "goal"}, "a goal's marker needs a position"),
        ({"kind": "direction"}, "a direction's marker needs a vector that is not zero"),
    ],
)
def test_a_wrong_marker_is_refused(given: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Marker(**given)
