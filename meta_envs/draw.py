"""Pictures of the point robots: drawn by Pillow in memory, so no display is needed."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from meta_envs.definition import Floats

if TYPE_CHECKING:
    from PIL.ImageDraw import ImageDraw
    from PIL.ImageFont import FreeTypeFont, ImageFont

SIZE = 400
"""Width and height of a picture in pixels."""
PLOT_HEIGHT = 340
"""Height of the part that shows the plane; the caption is below it."""
MARGIN = 14
"""Pixels between the plot's edge and the middle of anything drawn in it."""
SHARPNESS = 3
"""Pictures are drawn this many times larger and scaled down, which smooths every edge."""

Color = tuple[int, int, int] | tuple[int, int, int, int]
Pixel = tuple[float, float]

WHITE: Color = (255, 255, 255)
BAND: Color = (246, 247, 249)
AXIS: Color = (221, 224, 230)
FAINT_TEXT: Color = (150, 156, 167)
TEXT: Color = (38, 43, 51)
GOAL: Color = (26, 140, 73)
GOAL_DISC: Color = (26, 140, 73, 38)
ROBOT: Color = (24, 90, 189)
PATH: Color = (112, 160, 226)
START: Color = (110, 118, 130)
WIND: Color = (217, 119, 6)
WIND_FIELD: Color = (217, 119, 6, 80)

FIELD_COLUMNS, FIELD_ROWS = 8, 7
"""Number of arrows in the wind's field."""
FIELD_SCALE = 520.0
"""Pixels of an arrow in the field for a wind of 1 a step."""
LEGEND_SCALE = 620.0
"""Pixels of the caption's arrow for a wind of 1 a step."""


@dataclass(frozen=True)
class View:
    """Which part of the plane a picture shows.

    Attributes:
        x: the plane's x at the middle of the plot.
        y: the plane's y at the middle of the plot.
        zoom: pixels of the picture for a distance of 1.
    """

    x: float
    y: float
    zoom: float

    def pixel(self, point: Floats) -> Pixel:
        """Where a point [2] of the plane is in the picture, (right, down)."""
        right = SIZE / 2 + (float(point[0]) - self.x) * self.zoom
        return right, PLOT_HEIGHT / 2 - (float(point[1]) - self.y) * self.zoom

    def span(self) -> tuple[float, float, float, float]:
        """Edges of what is shown: lowest x, highest x, lowest y, highest y."""
        width, height = SIZE / 2 / self.zoom, PLOT_HEIGHT / 2 / self.zoom
        return self.x - width, self.x + width, self.y - height, self.y + height


def view_of(path: Floats, goal: Floats, radius: float, has_wind: bool) -> View:
    """The usual view, zoomed out in steps of a quarter until path and goal are all inside it."""
    home = View(0.5, 0.0, 190.0) if has_wind else View(0.0, 0.42, 150.0)
    points = np.concatenate([path, [goal + radius, goal - radius]])
    reach = home.zoom * np.abs(points - [home.x, home.y]).max(axis=0)
    need = max(reach[0] / (SIZE / 2 - MARGIN), reach[1] / (PLOT_HEIGHT / 2 - MARGIN), 1.0)
    steps = math.ceil(math.log(need, 1.25) - 1e-9)
    return View(home.x, home.y, home.zoom / 1.25**steps)


@cache
def _font(size: float) -> FreeTypeFont | ImageFont:
    from PIL import ImageFont

    return ImageFont.load_default(size)


class _Pen:
    """Draws in the picture's own pixels on the enlarged one."""

    def __init__(self, draw: ImageDraw) -> None:
        self._draw = draw

    def line(self, points: list[Pixel], color: Color, width: float) -> None:
        enlarged = [(right * SHARPNESS, down * SHARPNESS) for right, down in points]
        self._draw.line(enlarged, color, round(width * SHARPNESS), joint="curve")

    def disc(self, at: Pixel, radius: float, fill: Color | None, edge: Color | None = None) -> None:
        box = [
            (at[0] - radius) * SHARPNESS,
            (at[1] - radius) * SHARPNESS,
            (at[0] + radius) * SHARPNESS,
            (at[1] + radius) * SHARPNESS,
        ]
        self._draw.ellipse(box, fill, edge, round(1.5 * SHARPNESS))

    def arrow(self, middle: Pixel, along: Pixel, color: Color, width: float) -> None:
        """An arrow whose middle is there and that spans `along`; a dot if that is nothing."""
        span = math.hypot(*along)
        if not span:
            self.disc(middle, width, color)
            return
        ahead = (along[0] / span, along[1] / span)
        aside = (-ahead[1], ahead[0])
        # A short arrow is drawn longer than it is, for else its direction could not be seen.
        length, head = max(span, 6.0 * width), 4.5 * width

        def place(forward: float, sideways: float) -> Pixel:
            return (
                middle[0] + forward * ahead[0] + sideways * aside[0],
                middle[1] + forward * ahead[1] + sideways * aside[1],
            )

        # One outline, because strokes that overlap would be darker where the colour is see-through.
        half, neck = width / 2, length / 2 - head
        outline = [
            place(-length / 2, half),
            place(neck, half),
            place(neck, head * 0.45),
            place(length / 2, 0.0),
            place(neck, -head * 0.45),
            place(neck, -half),
            place(-length / 2, -half),
        ]
        self._draw.polygon([(x * SHARPNESS, y * SHARPNESS) for x, y in outline], color)

    def text(self, at: Pixel, text: str, color: Color, size: float, anchor: str) -> None:
        enlarged = (at[0] * SHARPNESS, at[1] * SHARPNESS)
        self._draw.text(enlarged, text, color, _font(size * SHARPNESS), anchor)


def draw_point_robot(
    path: Floats, goal: Floats, radius: float, wind: Floats | None
) -> NDArray[np.uint8]:
    """Picture of an episode so far: goal, path, robot, wind and a caption.

    Args:
        path: positions from the episode's start on, [t, 2], t at least 1.
        goal: position of the goal, [2].
        radius: within this distance of the goal a step is a success.
        wind: distance it moves the robot a step, [2], or None where there is none.

    Returns:
        uint8 [400, 400, 3]. The view zooms out until the whole path is inside it.
    """
    from PIL import Image, ImageDraw

    image = Image.new("RGB", (SIZE * SHARPNESS, SIZE * SHARPNESS), WHITE)
    pen = _Pen(ImageDraw.Draw(image, "RGBA"))
    view = view_of(path, goal, radius, wind is not None)
    _draw_plane(pen, view, half_circle=wind is None)
    if wind is not None:
        _draw_wind_field(pen, wind)
    at_goal = view.pixel(goal)
    pen.disc(at_goal, radius * view.zoom, GOAL_DISC, GOAL)
    _mark_goal(pen, at_goal)
    _draw_path(pen, [view.pixel(point) for point in path])
    # The band hides what the plane's drawing left below its edge.
    ImageDraw.Draw(image).rectangle(
        (0, PLOT_HEIGHT * SHARPNESS, SIZE * SHARPNESS, SIZE * SHARPNESS), BAND
    )
    distance = math.dist(path[-1].tolist(), goal.tolist())
    _draw_caption(pen, len(path) - 1, distance, radius, wind)
    return np.array(image.reduce(SHARPNESS))


def _draw_plane(pen: _Pen, view: View, half_circle: bool) -> None:
    left, right, bottom, top = view.span()
    across, down = view.pixel(np.zeros(2))
    pen.line([(0.0, down), (SIZE, down)], AXIS, 1.0)
    pen.line([(across, 0.0), (across, PLOT_HEIGHT)], AXIS, 1.0)
    step = _tick_step(60.0 / view.zoom)
    for tick in np.arange(math.ceil(left / step), math.floor(right / step) + 1) * step:
        at = view.pixel(np.array([tick, 0.0]))[0]
        if tick and 12 < at < SIZE - 12:
            pen.line([(at, down - 3), (at, down + 3)], AXIS, 1.0)
            pen.text((at, down + 6), f"{tick:g}", FAINT_TEXT, 10, "ma")
    for tick in np.arange(math.ceil(bottom / step), math.floor(top / step) + 1) * step:
        at = view.pixel(np.array([0.0, tick]))[1]
        if tick and 10 < at < PLOT_HEIGHT - 10:
            pen.line([(across - 3, at), (across + 3, at)], AXIS, 1.0)
            pen.text((across - 7, at), f"{tick:g}", FAINT_TEXT, 10, "rm")
    if half_circle:
        angles = np.linspace(0.0, np.pi, 91)
        points = np.stack([np.cos(angles), np.sin(angles)], axis=1)
        pen.line([view.pixel(point) for point in points], AXIS, 1.5)


def _tick_step(least: float) -> float:
    """The smallest of ..., 0.5, 1, 2, 5, 10, ... that is at least so large."""
    power = 10.0 ** math.floor(math.log10(least))
    return power * next(digit for digit in (1, 2, 5, 10) if digit * power >= least)


def _draw_wind_field(pen: _Pen, wind: Floats) -> None:
    along = (float(wind[0]) * FIELD_SCALE, -float(wind[1]) * FIELD_SCALE)
    for row in range(FIELD_ROWS):
        for column in range(FIELD_COLUMNS):
            right = (column + 0.5) * SIZE / FIELD_COLUMNS
            down = (row + 0.5) * PLOT_HEIGHT / FIELD_ROWS
            pen.arrow((right, down), along, WIND_FIELD, 1.5)


def _mark_goal(pen: _Pen, at: Pixel) -> None:
    pen.disc(at, 5.0, WHITE, GOAL)
    pen.disc(at, 2.2, GOAL)


def _draw_path(pen: _Pen, pixels: list[Pixel]) -> None:
    pen.disc(pixels[0], 4.5, WHITE, START)
    if len(pixels) > 1:
        pen.line(pixels, PATH, 2.0)
    for at in pixels[1:]:
        pen.disc(at, 2.4, ROBOT)
    pen.disc(pixels[-1], 7.5, WHITE)
    pen.disc(pixels[-1], 6.0, ROBOT)


def _draw_caption(
    pen: _Pen, steps: int, distance: float, radius: float, wind: Floats | None
) -> None:
    upper, lower = PLOT_HEIGHT + 20, PLOT_HEIGHT + 42
    pen.line([(0.0, PLOT_HEIGHT), (SIZE, PLOT_HEIGHT)], AXIS, 1.0)
    pen.text((14, upper), f"step {steps}", TEXT, 13, "lm")
    color = GOAL if distance <= radius else TEXT
    pen.text((78, upper), f"distance to goal {distance:.3f}", color, 13, "lm")
    pen.disc((20, lower), 5.0, ROBOT)
    pen.text((30, lower), "robot", FAINT_TEXT, 11, "lm")
    pen.disc((78, lower), 4.5, WHITE, START)
    pen.text((88, lower), "start", FAINT_TEXT, 11, "lm")
    _mark_goal(pen, (132, lower))
    pen.text((142, lower), f"goal, reached within {radius:g}", FAINT_TEXT, 11, "lm")
    if wind is not None:
        across, up = float(wind[0]), float(wind[1])
        pen.text((290, upper), "wind a step", FAINT_TEXT, 11, "lm")
        pen.text((290, lower), f"{math.hypot(across, up):.3f}", WIND, 13, "lm")
        middle = (374.0, (PLOT_HEIGHT + SIZE) / 2)
        pen.arrow(middle, (across * LEGEND_SCALE, -up * LEGEND_SCALE), WIND, 3.0)
