import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from meta_envs.draw import (
    BAND,
    GOAL,
    PLOT_HEIGHT,
    ROBOT,
    SIZE,
    START,
    WHITE,
    WIND,
    draw_point_robot,
    view_of,
)

Picture = NDArray[np.uint8]
RIGHT = np.array([1.0, 0.0])
PATH = np.array([[0.0, 0.0], [0.1, 0.05], [0.2, 0.0], [0.3, 0.1]])


def draw(path: Any = PATH, goal: Any = RIGHT, radius: float = 0.2, wind: Any = None) -> Picture:
    wind = None if wind is None else np.asarray(wind, dtype=float)
    return draw_point_robot(np.asarray(path, dtype=float), np.asarray(goal), radius, wind)


def near(picture: Picture, color: tuple[int, ...], tolerance: int = 12) -> NDArray[np.bool_]:
    """Where a picture has a colour, bool [height, width]."""
    gap = np.abs(picture.astype(int) - np.array(color[:3])).max(axis=2)
    return np.asarray(gap <= tolerance)


def middle(mask: NDArray[np.bool_]) -> tuple[float, float]:
    """Mean position of what is marked, (right, down) in pixels."""
    down, right = np.nonzero(mask)
    return float(right.mean()), float(down.mean())


def pixel(point: Any, path: Any = PATH, goal: Any = RIGHT, wind: bool = False) -> tuple[int, int]:
    """Row and column of a point of the plane."""
    view = view_of(np.asarray(path, dtype=float), np.asarray(goal), 0.2, wind)
    right, down = view.pixel(np.asarray(point))
    return round(down), round(right)


def test_a_picture_is_an_array_of_the_documented_kind() -> None:
    path, goal = PATH.copy(), RIGHT.copy()
    picture = draw_point_robot(path, goal, 0.2, None)
    assert picture.shape == (400, 400, 3)
    assert picture.dtype == np.uint8
    assert picture.flags.writeable
    np.testing.assert_array_equal(picture, draw_point_robot(path, goal, 0.2, None))
    np.testing.assert_array_equal(path, PATH)
    assert (picture[2, 2] == WHITE).all()
    assert (picture[-3, 3] == BAND).all()


@pytest.mark.parametrize("wind", [None, (0.03, -0.02)])
def test_the_robot_is_where_the_path_ends(wind: Any) -> None:
    for length in (1, 2, 4):
        picture = draw(PATH[:length], wind=wind)
        row, column = pixel(PATH[length - 1], PATH[:length], wind=wind is not None)
        assert near(picture, ROBOT)[row - 2 : row + 3, column - 2 : column + 3].all()


@pytest.mark.parametrize("goal", [(1.0, 0.0), (0.0, 1.0), (-0.6, 0.8), (-1.0, 0.0)])
def test_the_goal_and_its_disc_are_where_it_is(goal: Any) -> None:
    start = np.zeros((1, 2))
    green = near(draw(start, goal), GOAL, 40)[:PLOT_HEIGHT]
    row, column = pixel(goal, start, goal)
    assert green[row, column]
    right, down = middle(green)
    assert abs(right - column) < 1.5
    assert abs(down - row) < 1.5
    view = view_of(start, np.asarray(goal), 0.2, False)
    rows, columns = np.nonzero(green)
    edge = np.hypot(rows - row, columns - column).max()
    assert edge == pytest.approx(0.2 * view.zoom, abs=2.5)


def test_a_larger_radius_has_a_larger_disc() -> None:
    sizes = [(~near(draw(radius=radius), WHITE)).sum() for radius in (0.05, 0.1, 0.2)]
    assert sizes[0] < sizes[1] < sizes[2]


def test_the_path_has_a_dot_at_each_step_and_a_line_between() -> None:
    picture = draw(wind=(0.0, 0.0))
    blue = near(picture, ROBOT, 40)
    for point in PATH[1:-1]:
        row, column = pixel(point, wind=True)
        assert blue[row, column]
    halfway = pixel((PATH[1] + PATH[2]) / 2, wind=True)
    assert not near(picture, WHITE, 60)[halfway]
    assert near(picture, WHITE)[halfway[0] + 12, halfway[1]]


def test_the_start_is_marked_once_the_robot_has_left_it() -> None:
    row, column = pixel((0.0, 0.0))
    around = (slice(row - 6, row + 7), slice(column - 6, column + 7))
    assert near(draw(PATH), START, 30)[around].sum() >= 8
    assert not near(draw(PATH[:1]), START, 30)[around].any()


def test_wind_is_a_field_of_arrows_and_one_in_the_caption() -> None:
    still, windy = draw(wind=(0.0, 0.0)), draw(wind=(0.05, 0.0))
    legend = near(windy, WIND, 30)[PLOT_HEIGHT:]
    assert legend.sum() > 2 * near(still, WIND, 30)[PLOT_HEIGHT:].sum() > 0
    changed = (still != windy).any(axis=2)
    for rows in np.array_split(changed[:PLOT_HEIGHT], 7, axis=0):
        for cell in np.array_split(rows, 8, axis=1):
            assert cell.any()
    assert not near(draw(), WIND, 60).any()


@pytest.mark.parametrize("angle", range(0, 360, 45))
def test_the_arrow_points_where_the_wind_blows(angle: int) -> None:
    direction = np.array([math.cos(math.radians(angle)), math.sin(math.radians(angle))])
    for strength in (0.002, 0.07):
        picture = draw(PATH[:1], wind=strength * direction)
        arrow = near(picture, WIND, 100)[PLOT_HEIGHT + 2 :, 345:]
        down, right = np.nonzero(arrow)
        offset = np.stack([right - 29.0, 28.0 - down], axis=1)  # from the arrow's middle
        along = offset @ direction
        across = offset @ [-direction[1], direction[0]]
        # Ahead of the barbs it narrows slowly to the tip, behind them it is at once the shaft.
        barbs = along[np.abs(across) > 0.85 * np.abs(across).max()].mean()
        ahead = np.abs(across[(along > barbs + 1) & (along < barbs + 5)]).max()
        assert ahead > 1.4 * np.abs(across[along < barbs - 2.5]).max()
        assert abs(across.mean()) < 1.0
        assert np.ptp(along) == pytest.approx(max(620 * strength, 18.0), abs=3.0)


def test_the_half_circle_is_there_where_goals_lie_on_it() -> None:
    start = np.zeros((1, 2))
    still, windy = draw(start), draw(start, wind=(0.0, 0.0))
    for angle in (30, 60, 120, 150):
        point = [math.cos(math.radians(angle)), math.sin(math.radians(angle))]
        assert not near(still, WHITE, 12)[pixel(point, start)]
    point = [math.cos(math.radians(48)), math.sin(math.radians(48))]
    assert near(windy, WHITE)[pixel(point, start, wind=True)]


@pytest.mark.parametrize("wind", [None, (0.05, 0.05)])
@pytest.mark.parametrize(
    "end", [(3.0, 0.0), (-3.75, 0.1), (0.2, 3.75), (-2.0, -2.0), (90.0, -70.0)]
)
def test_the_view_zooms_out_until_all_is_visible(end: Any, wind: Any) -> None:
    path = np.linspace([0.0, 0.0], end, 20)
    picture = draw(path, wind=wind)
    row, column = pixel(end, path, wind=wind is not None)
    assert 8 <= row < PLOT_HEIGHT - 8
    assert 8 <= column < SIZE - 8
    assert near(picture, ROBOT)[row - 2 : row + 3, column - 2 : column + 3].all()
    assert near(picture, GOAL, 40)[:PLOT_HEIGHT].any()


def test_the_view_stays_while_the_robot_is_inside_it() -> None:
    assert view_of(PATH[:1], RIGHT, 0.2, False) == view_of(PATH, RIGHT, 0.2, False)
    far, farther = (np.array([[0.0, 0.0], [x, 0.0]]) for x in (1.6, 1.61))
    assert view_of(far, RIGHT, 0.2, False) == view_of(farther, RIGHT, 0.2, False)
    assert view_of(far, RIGHT, 0.2, False) != view_of(PATH, RIGHT, 0.2, False)


def test_the_caption_counts_steps_and_tells_the_distance() -> None:
    caption = slice(PLOT_HEIGHT, SIZE)
    here, there = [0.5, 0.0], [0.5, 0.2]
    base = draw([here, here])
    assert (base[caption, :75] != draw([here, here, here])[caption, :75]).any()
    assert (base[caption, 75:] == draw([here, here, here])[caption, 75:]).all()
    assert (base[caption, 75:] != draw([here, there])[caption, 75:]).any()
    assert (base[caption, :75] == draw([here, there])[caption, :75]).all()
    # Within the radius the distance is written in the goal's colour.
    line = slice(PLOT_HEIGHT + 10, PLOT_HEIGHT + 30)
    assert not near(base, GOAL, 40)[line].any()
    assert near(draw([[0.9, 0.0]]), GOAL, 40)[line].sum() > 20
