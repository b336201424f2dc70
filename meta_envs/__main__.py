"""Command line: which environments there are, what one of them is, and whether it is sound.

python -m meta_envs list
python -m meta_envs show point_robot_wind --task 3 --out picture.png
python -m meta_envs render ant_goal --task 0 --out ant.gif
python -m meta_envs check my_package.my_robot:MyRobot
python -m meta_envs gallery --out gallery.png
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

import tyro
from rich.console import Console

from meta_envs.commands.check import Check
from meta_envs.commands.mistake import MistakeError
from meta_envs.commands.render import Gallery, Render
from meta_envs.commands.show import List, Show

PLAIN_WIDTH = 120
"""Columns of the tables where the output is not a terminal."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code.

    It is 1 for an environment that fails a check, 2 for a user's mistake, 130 for Ctrl-C.
    """
    # Without emoji, for a Definition's `module:Class:` is none.
    console = Console(emoji=False)
    if not console.is_terminal:
        console = Console(width=PLAIN_WIDTH, emoji=False)
    errors = Console(stderr=True, emoji=False)
    try:
        command = tyro.cli(
            List | Show | Render | Check | Gallery, prog="python -m meta_envs", args=argv
        )
        return command.run(console)
    except MistakeError as mistake:
        errors.print(str(mistake), soft_wrap=True, markup=False, highlight=False)
        return 2
    except KeyboardInterrupt:
        errors.print("Interrupted; nothing is left half written.")
        return 130


if __name__ == "__main__":
    sys.exit(main())
