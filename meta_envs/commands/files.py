"""Pictures as files: checked before the work, whole or absent after it."""

from __future__ import annotations

import io
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from meta_envs.commands.mistake import MistakeError

COLORS = 128
"""Colours of an animation; few enough that a hundred pictures stay a few megabytes."""
LAST_MILLISECONDS = 1000
"""How long an animation stays on its last picture before it starts again."""


def check_out(path: Path, suffixes: tuple[str, ...]) -> None:
    """Raise a MistakeError unless a file of one of these kinds can be written there."""
    if path.suffix.lower() not in suffixes:
        kinds = " or ".join(suffixes)
        raise MistakeError(f"--out {path}: the name must end in {kinds}, which says what to write")
    if not path.parent.is_dir():
        raise MistakeError(f"--out {path}: there is no folder {path.parent}; make it first")
    if path.is_dir():
        raise MistakeError(f"--out {path}: this is a folder; name a file in it")


def encode_png(picture: NDArray[np.uint8]) -> bytes:
    """A picture [height, width, 3] as a PNG."""
    from PIL import Image

    encoded = io.BytesIO()
    Image.fromarray(picture).save(encoded, "PNG", optimize=True)
    return encoded.getvalue()


def encode_gif(pictures: Sequence[NDArray[np.uint8]], milliseconds: int) -> bytes:
    """Pictures [height, width, 3] as an animation that starts again and again."""
    from PIL import Image

    images = [
        Image.fromarray(picture).quantize(COLORS, dither=Image.Dither.NONE) for picture in pictures
    ]
    times = [milliseconds] * (len(images) - 1) + [LAST_MILLISECONDS]
    encoded = io.BytesIO()
    images[0].save(encoded, "GIF", save_all=True, append_images=images[1:], duration=times, loop=0)
    return encoded.getvalue()


def write_file(path: Path, content: bytes) -> None:
    """Write it under a temporary name and rename it, so that it is whole or absent."""
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        with partial.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        partial.replace(path)
    except OSError as error:
        raise MistakeError(f"--out {path}: cannot be written: {error.strerror}") from None
    finally:
        partial.unlink(missing_ok=True)
