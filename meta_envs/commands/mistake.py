"""A user's mistake: one sentence on stderr and exit code 2, never a traceback."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from meta_envs.headless import RenderingUnavailableError


class MistakeError(Exception):
    """What a user got wrong or lacks, in one sentence."""


@contextmanager
def mistakes() -> Iterator[None]:
    """Turn what the package says about wrong names and missing libraries into a mistake."""
    try:
        yield
    except (ValueError, RenderingUnavailableError) as error:
        raise MistakeError(str(error)) from None
    except ImportError as error:
        if _interrupted(error):
            raise KeyboardInterrupt from None
        if not (error.name or "").startswith("mujoco"):
            raise
        raise MistakeError(str(error)) from None


def _interrupted(error: BaseException | None) -> bool:
    """Whether Ctrl-C came while a compiled module was being loaded, which reports it as a fault."""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__
    return error is not None
