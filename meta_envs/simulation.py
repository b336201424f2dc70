"""Many MuJoCo simulations at once, each with parameters of its own, on native threads."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from meta_envs import headless
from meta_envs.definition import Floats, Simulation

try:
    import mujoco
    from mujoco.batch import Batch
except ImportError as error:
    if error.name not in ("mujoco", "mujoco.batch"):
        raise
    raise ImportError(
        "this environment needs MuJoCo 3.17 or newer, the first that steps many simulations on "
        'native threads (mujoco.batch): pip install "mujoco>=3.17"',
        name=error.name,
    ) from error
except Exception as error:
    # MuJoCo loads the OpenGL library that MUJOCO_GL names as soon as it is imported.
    if not os.environ.get("MUJOCO_GL"):
        raise
    raise headless.unavailable(headless.backend(), error) from error

if TYPE_CHECKING:
    from meta_envs.mujoco_robot import MujocoRobot

MODELS = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets"
"""Folder of Gymnasium's own model files."""


def load_model(file: str, timestep: float) -> mujoco.MjModel:
    """Compile one of Gymnasium's model files.

    Args:
        file: its name, such as "hopper.xml".
        timestep: of the integrator, seconds; everything else is the file's.
    """
    spec = mujoco.MjSpec.from_file(str(MODELS / file))
    total = spec.compiler.settotalmass
    # MuJoCo warns of this attribute whenever it compiles it, so it is applied afterwards.
    spec.compiler.settotalmass = -1.0
    model = spec.compile()
    if total > 0:
        mujoco.mj_setTotalmass(model, total)
        mujoco.mj_setConst(model, mujoco.MjData(model))
    model.opt.timestep = timestep
    return model


class MujocoSimulation(Simulation):
    """Simulations of one robot on native threads, each with its own values of some model fields.

    A state holds everything the next step depends on, so neither the number of simulations nor that
    of threads changes a bit of it.
    """

    def __init__(self, robot: MujocoRobot, num_envs: int, threads: int = 1) -> None:
        """Set up the simulations.

        Args:
            robot: what is simulated; its model is copied.
            num_envs: number of simulations.
            threads: native threads that share them, the caller's among them.
        """
        self._robot = robot
        self._params: Floats | None = None
        self._batch = Batch(robot.model, num_envs, threads)
        self._strength = robot.model.actuator_ctrlrange[:, 1].copy()
        self._control = self._batch.bind("ctrl")
        self._width = robot.nq + 2 * robot.nv
        # In MuJoCo's row of a simulation these stand together, behind the time, on which nothing in
        # a robot depends. (It has no memory of its own, which would come before the warm start.)
        start = mujoco.mj_stateSize(robot.model, mujoco.mjtState.mjSTATE_TIME.value)
        self._motion = self._batch.state[:, start : start + self._width]
        self._carried: list[tuple[slice, Floats]] = []
        end = self._width
        for name in robot.carried:
            output = self._batch.bind(name).reshape(num_envs, -1)
            self._carried.append((slice(end, end + output.shape[1]), output))
            end += output.shape[1]
        self._shape = (num_envs, end)

    def set_params(self, params: Floats) -> None:
        """Put simulation i on the task of row i, params [n, P]."""
        self._params = params
        for name, values in self._robot.fields(params).items():
            self._batch.expand(name)[...] = values

    def step(self, state: Floats, action: Floats, rows: NDArray[np.bool_] | None = None) -> Floats:
        """Next states [n, S]; simulations that are not among `rows` keep theirs."""
        self._motion[...] = state[:, : self._width]
        np.multiply(action, self._strength, out=self._control)
        self._batch.step(rows, nstep=self._robot.frame_skip)
        moved = np.empty(self._shape)
        # Of a simulation that was not stepped, this is still what was put there.
        moved[:, : self._width] = self._motion
        for columns, output in self._carried:
            moved[:, columns] = (
                output if rows is None else np.where(rows[:, None], output, state[:, columns])
            )
        return moved

    def __reduce__(self) -> tuple[Any, ...]:
        """Copied and pickled as what it is made from, with threads of its own."""
        batch = self._batch
        return _remade, (self._robot, batch.nsim, batch.nthread, self._params)

    def model(self, row: int) -> mujoco.MjModel:
        """A copy of the model that simulation `row` runs on, with its task's values."""
        return self._batch.get_model(row)


def _remade(
    robot: MujocoRobot, num_envs: int, threads: int, params: Floats | None
) -> MujocoSimulation:
    simulation = MujocoSimulation(robot, num_envs, threads)
    if params is not None:
        simulation.set_params(params)
    return simulation
