import ctypes.util
import importlib
import os
import platform
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

import pytest

from meta_envs import headless
from meta_envs.headless import RenderingUnavailableError
from tests.meta_envs.opengl import needs_opengl


@pytest.fixture(autouse=True)
def chosen_anew(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Every test chooses on a Linux where nothing is set, and leaves no choice behind."""
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.delenv("PYOPENGL_PLATFORM", raising=False)
    monkeypatch.setattr(platform, "system", lambda: "Linux")
    headless.backend.cache_clear()
    yield
    headless.backend.cache_clear()


def install(monkeypatch: pytest.MonkeyPatch, egl: bool, osmesa: bool) -> None:
    library = "libOSMesa.so.8" if osmesa else None
    monkeypatch.setattr(headless, "egl_works", lambda: egl)
    monkeypatch.setattr(ctypes.util, "find_library", lambda name: library)


@pytest.mark.parametrize(
    ("egl", "osmesa", "bound", "expected"),
    [
        (True, True, "", "egl"),
        (True, False, "", "egl"),
        (False, True, "", "osmesa"),
        (True, True, "osmesa", "osmesa"),
        (True, True, "egl", "egl"),
    ],
)
def test_egl_comes_before_osmesa(
    egl: bool, osmesa: bool, bound: str, expected: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    install(monkeypatch, egl, osmesa)
    monkeypatch.setenv("PYOPENGL_PLATFORM", bound)
    assert headless.backend() == expected


@pytest.mark.parametrize(
    ("egl", "osmesa", "bound"),
    [(False, False, ""), (True, False, "osmesa"), (False, True, "egl"), (True, True, "glx")],
)
def test_where_there_is_neither_the_packages_are_named(
    egl: bool, osmesa: bool, bound: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    install(monkeypatch, egl, osmesa)
    monkeypatch.setenv("PYOPENGL_PLATFORM", bound)
    with pytest.raises(RenderingUnavailableError, match=r"apt install libegl1 .* libosmesa6"):
        headless.backend()


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        ("osmesa", "osmesa"),
        ("EGL", "egl"),
        ("glfw", "glfw"),
        ("glx", "glfw"),
        ("on", "egl"),
        ("", "egl"),
    ],
)
def test_the_environment_variable_decides(
    value: str, expected: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    install(monkeypatch, egl=True, osmesa=False)
    monkeypatch.setenv("MUJOCO_GL", value)
    assert headless.backend() == expected


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ("off", "MUJOCO_GL=off switches pictures off; unset it"),
        ("vulkan", "MUJOCO_GL=vulkan is not known .known: egl, osmesa, glfw, cgl.; unset it"),
    ],
)
def test_a_value_without_opengl_is_refused(
    value: str, message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MUJOCO_GL", value)
    with pytest.raises(RenderingUnavailableError, match=message):
        headless.backend()


@pytest.mark.parametrize(("system", "expected"), [("Darwin", "cgl"), ("Windows", "glfw")])
def test_other_systems_have_their_own(
    system: str, expected: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(platform, "system", lambda: system)
    assert headless.backend() == expected


def test_without_the_library_egl_does_not_work(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ctypes.util, "find_library", lambda name: None)
    assert not headless.egl_works()
    # A library without EGL's functions for devices is no better.
    monkeypatch.setattr(ctypes, "CDLL", NoEgl)
    monkeypatch.setattr(ctypes.util, "find_library", lambda name: "libEGL.so.1")
    assert not headless.egl_works()


class NoEgl:
    def __init__(self, library: str) -> None:
        self.eglGetProcAddress: Any = NoFunction()


class NoFunction:
    restype: Any = None

    def __call__(self, name: bytes) -> None:
        return None


@pytest.mark.parametrize(
    ("name", "remedy"),
    [
        ("egl", "install EGL .*libegl1.*, or unset MUJOCO_GL"),
        ("osmesa", "install OSMesa .*libosmesa6.*, or unset MUJOCO_GL"),
        ("glfw", "it needs a display, or unset MUJOCO_GL"),
    ],
)
def test_what_cannot_be_opened_names_the_package(
    name: str, remedy: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(module: str) -> None:
        raise AttributeError(f"no {module}")

    headless.close()
    monkeypatch.setenv("MUJOCO_GL", name)
    monkeypatch.setattr(importlib, "import_module", broken)
    with (
        pytest.raises(
            RenderingUnavailableError, match=rf"with {name} .no (mujoco\.)?{name}.: {remedy}"
        ),
        headless.current(8, 8),
    ):
        pass


def python(code: str) -> subprocess.CompletedProcess[str]:
    """Run it in a process of its own, with warnings as errors."""
    command = [sys.executable, "-W", "error", "-c", code]
    return subprocess.run(command, capture_output=True, text=True, check=False)


@needs_opengl
def test_asking_whether_egl_works_disturbs_nobody_who_draws() -> None:
    with headless.current(8, 8):
        gl: Any = importlib.import_module("OpenGL.GL")
        version = gl.glGetString(gl.GL_VERSION)
        assert headless.egl_works() == (headless.backend() == "egl")
        assert gl.glGetString(gl.GL_VERSION) == version
    with headless.current(8, 8):
        assert gl.glGetString(gl.GL_VERSION) == version
    headless.close()
    with headless.current(8, 8):
        assert gl.glGetString(gl.GL_VERSION) == version


@pytest.mark.skipif(
    platform.system() != "Linux" or ctypes.util.find_library("OSMesa") is not None,
    reason="needs a Linux without OSMesa",
)
@pytest.mark.parametrize(
    ("value", "message"),
    [
        ("osmesa", "pictures of MuJoCo cannot be drawn with osmesa ("),
        ("vulkan", "MUJOCO_GL=vulkan is not known"),
        ("glfw", "pictures of MuJoCo cannot be drawn with glfw ("),
    ],
)
def test_a_library_asked_for_and_missing_is_one_sentence(value: str, message: str) -> None:
    """For real, because MuJoCo itself loads what the variable names."""
    arguments = ["render", "half_cheetah_dir", "--out", "absent.png"]
    variables = {name: one for name, one in os.environ.items() if "DISPLAY" not in name}
    done = subprocess.run(
        [sys.executable, "-m", "meta_envs", *arguments],
        capture_output=True,
        text=True,
        check=False,
        env={**variables, "MUJOCO_GL": value},
    )
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith(message)
    assert done.stderr.count("\n") == 1
    assert "unset" in done.stderr


BEFORE_MUJOCO = """
import meta_envs
from meta_envs import headless
import mujoco
for _ in range(2):
    with headless.current(8, 8):
        from OpenGL import GL
        assert GL.glGetString(GL.GL_VERSION)
    headless.close()
"""


@needs_opengl
def test_it_does_not_matter_that_mujoco_is_imported_afterwards() -> None:
    done = python(BEFORE_MUJOCO)
    assert (done.returncode, done.stderr) == (0, "")


FORKS = """
import os
from meta_envs import headless

def draw():
    with headless.current(8, 8):
        pass

def child_status(work):
    child = os.fork()
    if not child:
        try:
            work()
        except headless.RenderingUnavailableError as error:
            os._exit(7 if "spawn" in str(error) else 8)
        os._exit(0)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])

assert child_status(draw) == 0
draw()
assert child_status(draw) == 7
draw()
"""


@needs_opengl
@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system has no fork")
def test_a_process_forked_after_drawing_is_told_rather_than_left_hanging() -> None:
    done = python(FORKS)
    assert (done.returncode, done.stderr) == (0, "")
