"""Pictures of MuJoCo states, with what the task asks for beside the robot."""

from __future__ import annotations

import copy
import zlib
from collections import OrderedDict
from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from meta_envs import headless

SIZE = 400
"""Width and height of a picture in pixels."""
KEPT_CANVASES = 8
"""Kinds of model that stay loaded for the next picture; the one unused the longest goes first."""
SHADOW_SIZE, SAMPLES = 1024, 4
"""Quality of shadows and edges: MuJoCo's own shadows double a picture's time without a GPU."""
MAX_GEOMS = 1000

GOAL = (0.10, 0.55, 0.29)
TARGET = (0.95, 0.47, 0.02)
GOAL_RADIUS, GOAL_HEIGHT, GOAL_POST = 0.2, 0.9, 0.035
"""Radius of a goal's disc, height and half width of its post, metres."""
LENGTH_OF_SPEED = 0.4
"""Length of a velocity's arrow, metres for 1 m/s."""
THICKNESS = 0.04
"""Half width of an arrow's shaft, metres for a robot whose radius is 1."""
ABOVE = 0.25
"""Height of an arrow above the robot, in the robot's radius."""
FILLED = 0.9
"""Share of the picture's height that what must be seen may fill."""

Point = tuple[float, float, float]


@dataclass(frozen=True)
class Marker:
    """What a task asks for, drawn beside the robot.

    Attributes:
        kind: "goal" (a disc with a post), "velocity" (an arrow as long as the speed is large, with
            the speed written on it) or "direction" (an arrow of the robot's size).
        position: where it is, (x, y, z) in metres: a goal's foot, an arrow's tail. A velocity or a
            direction without one is drawn above the robot.
        vector: the velocity, (x, y, z) in m/s, or the direction, of any length but zero; a
            goal has none.

    Raises:
        ValueError: unknown kind, a goal without a position, a direction without a vector.
    """

    kind: Literal["goal", "velocity", "direction"]
    position: Point | None = None
    vector: Point = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        """Check that a goal is somewhere and that a direction points somewhere."""
        known = ("goal", "velocity", "direction")
        if self.kind not in known:
            raise ValueError(f"a marker's kind is one of {', '.join(known)}, got {self.kind!r}")
        if self.kind == "goal" and self.position is None:
            raise ValueError("a goal's marker needs a position")
        if self.kind == "direction" and not any(self.vector):
            raise ValueError("a direction's marker needs a vector that is not zero")


def render(
    model: mujoco.MjModel, qpos: ArrayLike, markers: Sequence[Marker] = ()
) -> NDArray[np.uint8]:
    """Picture of a robot in one configuration, made without a display.

    Args:
        model: compiled model of the task, only read.
        qpos: generalised positions [nq].
        markers: what the task asks for.

    Returns:
        uint8 [400, 400, 3], a fresh array. The camera follows the robot, from the side where it
        moves in a plane; where there are goals, it shows them and the origin too.

    Raises:
        ValueError: qpos of another shape or not finite.
        RenderingUnavailableError: there is no OpenGL that works without a display, or this process
            was forked from one that had made pictures; the message says what to do.
    """
    configuration = np.asarray(qpos, dtype=np.float64)
    if configuration.shape != (model.nq,) or not np.isfinite(configuration).all():
        raise ValueError(f"qpos must be {model.nq} finite numbers, got {qpos!r}")
    data = mujoco.MjData(model)
    stage = _Stage.around(model, data)
    data.qpos[:] = configuration
    _place(model, data)
    with headless.current(SIZE, SIZE) as kept:
        return _draw(_canvas(kept, model), model, data, stage, markers)


def _place(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """Positions of everything that is drawn; no dynamics, for those can fail."""
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_camlight(model, data)


@dataclass(frozen=True)
class _Stage:
    """Size of a robot at rest: what camera and arrows are measured by.

    Attributes:
        reach: radius of the robot around its middle, metres.
        middle: height of that middle, metres.
        top: height of its highest point, metres.
        planar: whether the robot moves in the plane of x and z.
        field_of_view: vertical angle of a picture, degrees.
    """

    reach: float
    middle: float
    top: float
    planar: bool
    field_of_view: float

    @classmethod
    def around(cls, model: mujoco.MjModel, data: mujoco.MjData) -> _Stage:
        """Measure the robot in its model's own configuration."""
        _place(model, data)
        own = np.flatnonzero(model.geom_bodyid > 0)
        places, sizes = data.geom_xpos[own], model.geom_rbound[own, None]
        low, high = (places - sizes).min(axis=0), (places + sizes).max(axis=0)
        planar = bool(model.jnt_type[0] != mujoco.mjtJoint.mjJNT_FREE)
        reach, middle, top = (high - low).max() / 2, (low + high)[2] / 2, high[2]
        angle = float(model.vis.global_.fovy)
        return cls(float(reach), float(middle), float(top), planar, angle)

    def camera(self, robot: NDArray[np.float64], markers: Sequence[Marker]) -> mujoco.MjvCamera:
        """A free camera that sees the robot, at [3], and every marker."""
        goals = [marker.position for marker in markers if marker.kind == "goal"]
        here = (robot[0], robot[1], self.middle)
        # The origin with them, so that the view stands still while the robot walks to its goal.
        corners = np.array([here, (0.0, 0.0, self.middle), *goals] if goals else [here])
        low, high = corners.min(axis=0), corners.max(axis=0)
        room = ABOVE + 0.15 if any(marker.position is None for marker in markers) else 0.0
        radius = float(np.linalg.norm(high - low)) / 2 + self.reach * (1.0 + room)
        camera = mujoco.MjvCamera()
        camera.type = mujoco.mjtCamera.mjCAMERA_FREE
        camera.lookat = (low + high) / 2
        camera.distance = radius / (FILLED * np.sin(np.radians(self.field_of_view / 2)))
        camera.azimuth = 90.0
        camera.elevation = -45.0 if goals else -10.0 if self.planar else -35.0
        return camera

    def arrow(self, marker: Marker, robot: NDArray[np.float64]) -> NDArray[np.float64]:
        """First and last point [2, 3] of a velocity's or a direction's arrow."""
        vector = np.array(marker.vector)
        if marker.kind == "velocity":
            along = LENGTH_OF_SPEED * vector
        else:
            along = self.reach * vector / np.linalg.norm(vector)
        if marker.position is not None:
            return np.array([marker.position, marker.position + along])
        middle = np.array([robot[0], robot[1], self.top + ABOVE * self.reach])
        return np.array([middle - along / 2, middle + along / 2])


@dataclass(frozen=True)
class _Canvas:
    """What OpenGL holds of one kind of model: its textures and meshes, and room for a scene."""

    context: Any
    scene: Any

    @classmethod
    def of(cls, model: mujoco.MjModel) -> _Canvas:
        """Load a model; the OpenGL context must be current."""
        # A copy, because the quality of a picture is a field of the model.
        own = copy.copy(model)
        own.vis.quality.shadowsize, own.vis.quality.offsamples = SHADOW_SIZE, SAMPLES
        own.vis.global_.offwidth = own.vis.global_.offheight = SIZE
        context = mujoco.MjrContext(own, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        scene = mujoco.MjvScene(own, MAX_GEOMS)
        scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = False
        return cls(context, scene)

    def close(self) -> None:
        """Give it back; the OpenGL context must be current."""
        self.context.free()


def _canvas(kept: OrderedDict[Hashable, headless.Closable], model: mujoco.MjModel) -> _Canvas:
    """The canvas for models that look like this one; the OpenGL context must be current."""
    # By content, because every task has a model of its own that differs in dynamics only.
    key = (bytes(model.names), zlib.crc32(model.tex_data), zlib.crc32(model.mesh_vert))
    canvas = kept.get(key)
    if not isinstance(canvas, _Canvas):
        canvas = kept[key] = _Canvas.of(model)
        while len(kept) > KEPT_CANVASES:
            kept.popitem(last=False)[1].close()
    kept.move_to_end(key)
    return canvas


def _draw(
    canvas: _Canvas,
    model: mujoco.MjModel,
    data: mujoco.MjData,
    stage: _Stage,
    markers: Sequence[Marker],
) -> NDArray[np.uint8]:
    robot = data.xpos[1]
    camera, everything = stage.camera(robot, markers), mujoco.mjtCatBit.mjCAT_ALL.value
    options = mujoco.MjvOption()
    mujoco.mjv_updateScene(model, data, options, None, camera, everything, canvas.scene)
    for marker in markers:
        _add(canvas.scene, marker, stage, robot)
    rectangle = mujoco.MjrRect(0, 0, SIZE, SIZE)
    picture = np.empty((SIZE, SIZE, 3), dtype=np.uint8)
    # Before every picture, for OpenGL still has the buffer of the canvas that drew the last one.
    mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, canvas.context)
    mujoco.mjr_render(rectangle, canvas.scene, canvas.context)
    mujoco.mjr_readPixels(picture, None, rectangle, canvas.context)
    # OpenGL's first row is the lowest.
    return picture[::-1].copy()


def _add(scene: Any, marker: Marker, stage: _Stage, robot: NDArray[np.float64]) -> None:
    """Draw a marker into the scene."""
    if marker.kind == "goal":
        foot, up = np.array(marker.position), np.array([0.0, 0.0, 1.0])
        # Just above the floor, for else the two would flicker through each other.
        disc = np.array([foot + 0.005 * up, foot + 0.015 * up])
        _connect(scene, mujoco.mjtGeom.mjGEOM_CYLINDER, GOAL, GOAL_RADIUS, disc)
        post = np.array([foot, foot + GOAL_HEIGHT * up])
        _connect(scene, mujoco.mjtGeom.mjGEOM_CAPSULE, GOAL, GOAL_POST, post)
        return
    ends = stage.arrow(marker, robot)
    # MuJoCo draws an arrow half as long as it is told to.
    told = np.array([ends[0], 2 * ends[1] - ends[0]])
    _connect(scene, mujoco.mjtGeom.mjGEOM_ARROW, TARGET, THICKNESS * stage.reach, told)
    if marker.kind == "velocity":
        label = _geom(scene, mujoco.mjtGeom.mjGEOM_LABEL, TARGET)
        label.pos = ends.mean(axis=0) + np.array([0.0, 0.0, 0.15 * stage.reach])
        label.label = f"target {np.linalg.norm(marker.vector):.2f} m/s"


def _connect(
    scene: Any, kind: mujoco.mjtGeom, color: Point, width: float, ends: NDArray[np.float64]
) -> None:
    """One more shape of the scene, between two points [2, 3]."""
    mujoco.mjv_connector(_geom(scene, kind, color), kind.value, width, ends[0], ends[1])


def _geom(scene: Any, kind: mujoco.mjtGeom, color: Point) -> Any:
    geom, rgba = scene.geoms[scene.ngeom], np.array([*color, 1.0], dtype=np.float32)
    nothing = np.zeros(3)
    mujoco.mjv_initGeom(geom, kind.value, nothing, nothing, np.eye(3).ravel(), rgba)
    geom.category = mujoco.mjtCatBit.mjCAT_DECOR.value
    scene.ngeom += 1
    return geom
