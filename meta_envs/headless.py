"""OpenGL without a display: EGL, or OSMesa where that is missing.

The choice is made when the first context is opened, whether or not MuJoCo was imported before; the
environment variable MUJOCO_GL overrides it, with the values MuJoCo knows.
"""

from __future__ import annotations

import atexit
import ctypes
import ctypes.util
import importlib
import os
import platform
import threading
import warnings
from collections import OrderedDict
from collections.abc import Hashable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from typing import Any, Protocol

REMEDIES = {
    "egl": "install EGL (Debian, Ubuntu: apt install libegl1 libgl1-mesa-dri; Fedora: mesa-libEGL)",
    "osmesa": "install OSMesa (Debian, Ubuntu: apt install libosmesa6; "
    "Fedora: mesa-compat-libOSMesa)",
    "glfw": "it needs a display",
    "cgl": "it needs a macOS session that may use OpenGL",
}
"""What a user can do who lacks a library or what it needs."""
AUTOMATIC = ("", "enable", "enabled", "on", "true", "1")
OFF = ("disable", "disabled", "off", "false", "0")
SYNONYMS = {"glx": "glfw", "wgl": "glfw"}
EGL_PLATFORM_DEVICE_EXT = 0x313F
MOST_DEVICES = 16


class RenderingUnavailableError(RuntimeError):
    """No picture can be made here; the message says what to install or to set."""


@cache
def backend() -> str:
    """The OpenGL library pictures are drawn with: "egl", "osmesa", "glfw" or "cgl".

    Raises:
        RenderingUnavailableError: there is none, or MUJOCO_GL asks for none or an unknown one.
    """
    wanted = os.environ.get("MUJOCO_GL", "").lower().strip()
    if wanted in OFF:
        raise RenderingUnavailableError(f"MUJOCO_GL={wanted} switches pictures off; unset it")
    if wanted not in AUTOMATIC:
        named = SYNONYMS.get(wanted, wanted)
        if named not in REMEDIES:
            raise RenderingUnavailableError(
                f"MUJOCO_GL={wanted} is not known (known: {', '.join(REMEDIES)}); unset it"
            )
        return named
    if platform.system() != "Linux":
        return "cgl" if platform.system() == "Darwin" else "glfw"
    # PyOpenGL is bound to one of the two when it is first imported, and keeps it.
    bound = os.environ.get("PYOPENGL_PLATFORM", "").lower()
    if bound in ("", "egl") and egl_works():
        return "egl"
    if bound in ("", "osmesa") and ctypes.util.find_library("OSMesa"):
        return "osmesa"
    raise RenderingUnavailableError(
        "pictures of MuJoCo need OpenGL that works without a display, and none was found: "
        f"{REMEDIES['egl']}, or {REMEDIES['osmesa']}"
    )


def unavailable(name: str, error: Exception) -> RenderingUnavailableError:
    """What to tell a user for whom a library failed.

    Args:
        name: the library, one that `backend` returns.
        error: what it raised.
    """
    other = ", or unset MUJOCO_GL" if os.environ.get("MUJOCO_GL") else ""
    return RenderingUnavailableError(
        f"pictures of MuJoCo cannot be drawn with {name} ({error}): {REMEDIES[name]}{other}"
    )


def egl_works() -> bool:
    """Whether EGL is installed and one of its devices can be used.

    Asked by its C interface, because MuJoCo's module for it, once it has failed, bars OSMesa too.
    """
    library = ctypes.util.find_library("EGL")
    if library is None:
        return False
    egl = ctypes.CDLL(library)
    egl.eglGetProcAddress.restype = ctypes.c_void_p
    addresses = [
        egl.eglGetProcAddress(name) for name in (b"eglQueryDevicesEXT", b"eglGetPlatformDisplayEXT")
    ]
    if not all(addresses):
        return False
    query_type = ctypes.CFUNCTYPE(
        ctypes.c_uint, ctypes.c_int, ctypes.POINTER(ctypes.c_void_p), ctypes.POINTER(ctypes.c_int)
    )
    display_type = ctypes.CFUNCTYPE(
        ctypes.c_void_p, ctypes.c_uint, ctypes.c_void_p, ctypes.c_void_p
    )
    query, display_of = query_type(addresses[0]), display_type(addresses[1])
    devices, count = (ctypes.c_void_p * MOST_DEVICES)(), ctypes.c_int()
    if not query(MOST_DEVICES, devices, ctypes.byref(count)):
        return False
    for device in devices[: count.value]:
        display = ctypes.c_void_p(display_of(EGL_PLATFORM_DEVICE_EXT, device, None))
        # It stays as it is, for the process has but one and somebody may be drawing on it.
        if display and egl.eglInitialize(display, None, None):
            return True
    return False


class Closable(Protocol):
    """What belongs to an OpenGL context and is given back before it."""

    def close(self) -> None:
        """Give it back; the context is current."""


@dataclass(frozen=True)
class _Context:
    gl: Any
    kept: OrderedDict[Hashable, Closable] = field(default_factory=OrderedDict)


@contextmanager
def current(width: int, height: int) -> Iterator[OrderedDict[Hashable, Closable]]:
    """Have the process's one OpenGL context current on this thread, and on no other.

    It is opened on first use and kept, because a new one costs a second without a GPU.

    Args:
        width: of the largest picture in pixels; read when the context is opened.
        height: the same.

    Yields:
        What the caller keeps in the context from one picture to the next; `close` empties it.

    Raises:
        RenderingUnavailableError: it cannot be opened; the message names what is missing.
    """
    with _LOCK:
        if _forked:
            raise RenderingUnavailableError(
                "this process was forked from one that had made pictures, and OpenGL does not "
                "outlive that: start processes with multiprocessing's method 'spawn'"
            )
        if not _contexts:
            _contexts.append(_open(width, height))
        _contexts[0].gl.make_current()
        try:
            yield _contexts[0].kept
        finally:
            _release()


def close() -> None:
    """Close the context, if there is one, and what is kept in it; the next picture opens one."""
    with _LOCK:
        while _contexts:
            context = _contexts.pop()
            context.gl.make_current()
            while context.kept:
                context.kept.popitem()[1].close()
            _release()
            context.gl.free()


_LOCK = threading.RLock()
_contexts: list[_Context] = []
_forked: list[_Context] = []


def _forget() -> None:
    """In a forked process: keep the parent's context from being used or freed."""
    _forked.extend(_contexts)
    _contexts.clear()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget)


def _open(width: int, height: int) -> _Context:
    name = backend()
    try:
        if name == "glfw":
            _require_display()
        context = importlib.import_module(f"mujoco.{name}").GLContext(width, height)
    # What a missing library or display raises differs from one to the other.
    except Exception as error:
        raise unavailable(name, error) from error
    # At the end, run before MuJoCo's own, which was registered with the context and takes EGL down.
    atexit.unregister(close)
    atexit.register(close)
    return _Context(context)


def _require_display() -> None:
    """Raise what GLFW only warns of: drawing without a display ends in a fatal error."""
    glfw: Any = importlib.import_module("glfw")
    with warnings.catch_warnings():
        warnings.simplefilter("error", glfw.GLFWError)
        glfw.init()


def _release() -> None:
    """Make no context current on this thread, so that another thread may use it."""
    name = backend()
    if name == "egl":
        egl: Any = importlib.import_module("OpenGL.EGL")
        display = importlib.import_module("mujoco.egl").EGL_DISPLAY
        nothing = egl.EGL_NO_SURFACE
        egl.eglMakeCurrent(display, nothing, nothing, egl.EGL_NO_CONTEXT)
    elif name == "osmesa":
        osmesa: Any = importlib.import_module("OpenGL.osmesa")
        osmesa.OSMesaMakeCurrent(None, None, importlib.import_module("OpenGL.GL").GL_FLOAT, 0, 0)
    elif name == "glfw":
        importlib.import_module("glfw").make_context_current(None)
