"""`render` and `gallery`: an episode as a picture or an animation; all environments in one."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from numpy.typing import NDArray
from rich.console import Console

from meta_envs.commands import episode, files
from meta_envs.commands.mistake import mistakes
from meta_envs.registry import ENVIRONMENTS, Row, definition, resolve, task_set

MOST_PICTURES = 100
"""Pictures of an animation, about; an episode of more steps is shown in larger ones."""
MOST_A_SECOND = 50
"""Pictures a second of an animation; browsers show one that is faster at a tenth of its speed."""
TILE, CAPTION, COLUMNS = 232, 26, 5
"""Size of one environment's picture in the gallery, height of its name, and pictures a row."""
GALLERY_STEPS = 20
"""Steps after which the gallery shows a robot whose optimum is not known."""


@dataclass(frozen=True)
class Render:
    """Write an episode as a picture or an animation."""

    env: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="ENV")]
    """Environment: its short name, its id or the field's hyphenated name."""
    out: Annotated[Path, tyro.conf.arg(metavar="FILE")]
    """File to write: .gif for the whole episode, .png for its last picture."""
    task: Annotated[int, tyro.conf.arg(metavar="TASK")] = 0
    """The task."""
    seed: Annotated[int, tyro.conf.arg(metavar="SEED")] = 0
    """Seed of the episode's start, and of the random actions where the optimum is not known."""

    def run(self, console: Console) -> int:
        """Run the episode and write the file."""
        with mistakes():
            row = resolve(self.env)
            task_set(row.name).check_task(self.task)
            files.check_out(self.out, (".gif", ".png"))
            if self.seed < 0:
                raise ValueError(f"--seed must be at least 0, got {self.seed}")
        animated = self.out.suffix.lower() == ".gif"
        fps = definition(row.name).render_fps
        fewest = max(row.horizon / MOST_PICTURES, fps / MOST_A_SECOND)
        every = math.ceil(fewest) if animated else None
        found = []
        with mistakes(), console.status("Running the episode ...") as status:
            for picture in episode.pictures(row, self.task, self.seed, every):
                found.append(picture)
                status.update(f"Made {len(found)} pictures ...")
        if every is not None:
            files.write_file(self.out, files.encode_gif(found, round(1000 * every / fps)))
        else:
            files.write_file(self.out, files.encode_png(found[-1]))
        written = f"Wrote {self.out}: {episode.who_acts(row, self.seed)} on task {self.task}."
        console.print(written, soft_wrap=True, markup=False, highlight=False)
        return 0


@dataclass(frozen=True)
class Gallery:
    """Write one picture of all environments."""

    out: Annotated[Path, tyro.conf.arg(metavar="FILE")]
    """Picture (.png) to write."""

    def run(self, console: Console) -> int:
        """Make each environment's picture and put them side by side."""
        files.check_out(self.out, (".png",))
        tiles = []
        with mistakes(), console.status("Making pictures ...") as status:
            for row in ENVIRONMENTS.values():
                status.update(f"Making the picture of {row.name} ...")
                tiles.append((row, _tile(row)))
        files.write_file(self.out, files.encode_png(_side_by_side(tiles)))
        written = f"Wrote {self.out}: {len(tiles)} environments."
        console.print(written, soft_wrap=True, markup=False, highlight=False)
        return 0


def _tile(row: Row) -> NDArray[np.uint8]:
    """Picture of an environment on one of its test tasks."""
    known = "oracle" in definition(row.name).controllers
    test_tasks = task_set(row.name).test_tasks
    task = int(test_tasks[len(test_tasks) // 3])
    (picture,) = episode.pictures(row, task, steps=None if known else GALLERY_STEPS)
    return picture


def _side_by_side(tiles: list[tuple[Row, NDArray[np.uint8]]]) -> NDArray[np.uint8]:
    """All pictures in a grid, each with its id below, [height, width, 3]."""
    from PIL import Image, ImageDraw, ImageFont

    lines = math.ceil(len(tiles) / COLUMNS)
    whole = Image.new("RGB", (COLUMNS * TILE, lines * (TILE + CAPTION)), "white")
    pen, font = ImageDraw.Draw(whole), ImageFont.load_default(14)
    for number, (row, picture) in enumerate(tiles):
        across, down = number % COLUMNS * TILE, number // COLUMNS * (TILE + CAPTION)
        side = TILE - 6
        small = Image.fromarray(picture).resize((side, side), Image.Resampling.LANCZOS)
        whole.paste(small, (across + 3, down + 3))
        middle = (across + TILE / 2, down + TILE + CAPTION / 2 - 3)
        pen.text(middle, row.id, "black", font, "mm")
    return np.array(whole)
