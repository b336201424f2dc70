"""Whether this machine can draw MuJoCo's pictures."""

import pytest

from meta_envs import headless


def reason() -> str:
    """Why it cannot; empty where it can."""
    try:
        headless.backend()
    except headless.RenderingUnavailableError as error:
        return str(error)
    return ""


needs_opengl = pytest.mark.skipif(bool(reason()), reason=reason())
