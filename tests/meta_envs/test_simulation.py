import copy
import os
import pickle
import subprocess
import sys
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from meta_envs import task_set
from meta_envs.simulation import MODELS, load_model
from tests.meta_envs.gymnasium_twin import Floats, robot_of

FILES = ("half_cheetah.xml", "hopper.xml", "walker2d.xml", "ant.xml", "humanoid.xml")


def arrays_of(model: mujoco.MjModel) -> dict[str, Any]:
    values = {name: getattr(model, name) for name in dir(model) if not name.startswith("_")}
    return {name: value for name, value in values.items() if isinstance(value, np.ndarray)}


def some_states(name: str, n: int, steps: int = 12) -> tuple[Floats, Floats, Floats]:
    """States in contact with the floor, actions and params of n sub-environments."""
    robot, tasks = robot_of(name), task_set(name)
    params = tasks.params[np.arange(n) % len(tasks)]
    generator = np.random.default_rng(7)
    simulation = robot.simulation(n)
    simulation.set_params(params)
    state = robot.initial_state([np.random.default_rng(i) for i in range(n)])
    for _ in range(steps):
        action = generator.uniform(-1.0, 1.0, (n, robot.nu))
        state = simulation.step(state, action)
    return state, generator.uniform(-1.0, 1.0, (n, robot.nu)), params


@pytest.mark.parametrize("file", FILES)
def test_a_loaded_model_is_gymnasiums_and_says_nothing(
    file: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    # MuJoCo writes warnings to the standard error and to a file in the working directory.
    monkeypatch.chdir(tmp_path)
    model = load_model(file, 0.0025)
    assert capfd.readouterr() == ("", "")
    assert list(tmp_path.iterdir()) == []
    assert model.opt.timestep == 0.0025
    theirs = arrays_of(mujoco.MjModel.from_xml_path(str(MODELS / file)))
    mine = arrays_of(model)
    assert mine.keys() == theirs.keys()
    for name, values in theirs.items():
        np.testing.assert_array_equal(mine[name], values, err_msg=name)


@pytest.mark.parametrize(
    ("name", "mass"),
    [
        ("half_cheetah_vel", 14.0),
        ("hopper_params", 15.820013),
        ("walker_params", 23.677137),
        ("ant_goal", 0.910880),
        ("humanoid_dir", 42.116030),
    ],
)
def test_a_robot_weighs_what_it_always_did(name: str, mass: float) -> None:
    """Another mass is another version of Gymnasium's files, so of our environments."""
    assert robot_of(name).model.body_mass.sum() == pytest.approx(mass, abs=5e-7)


def test_without_native_threads_there_is_one_clear_sentence() -> None:
    code = (
        "import sys, gymnasium, meta_envs\n"
        "sys.modules['mujoco.batch'] = None\n"
        "try:\n    gymnasium.make('HopperRandParams-v0')\n"
        "except ImportError as error:\n    print(error)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == (
        "this environment needs MuJoCo 3.17 or newer, the first that steps many simulations on "
        'native threads (mujoco.batch): pip install "mujoco>=3.17"\n'
    )


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "ImportError: this environment needs MuJoCo 3.17 or newer"),
        ("raise ImportError('initialization failed')", "ImportError: initialization failed"),
        ("raise RuntimeError('broken')", "RuntimeError: broken"),
    ],
)
def test_only_an_old_mujoco_is_called_old(content: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "mujoco").mkdir()
    (tmp_path / "mujoco" / "__init__.py").write_text(content)
    code = "import gymnasium, meta_envs\ngymnasium.make('HopperRandParams-v0')"
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=tmp_path,
        env={name: value for name, value in os.environ.items() if name != "MUJOCO_GL"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1].startswith(message)


@pytest.mark.parametrize("name", ["half_cheetah_vel", "walker_params", "ant_goal"])
def test_a_step_is_a_plain_loop_of_mujocos(name: str) -> None:
    robot = robot_of(name)
    state, action, params = some_states(name, 3)
    simulation = robot.simulation(3, threads=2)
    simulation.set_params(params)
    moved = state
    for _ in range(4):
        moved = simulation.step(moved, action)
    for row in range(3):
        model = robot.task_model(params[row])
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:], data.qacc_warmstart[:] = np.split(
            state[row], [robot.nq, robot.nq + robot.nv]
        )
        data.ctrl[:] = action[row]
        for _ in range(4 * robot.frame_skip):
            mujoco.mj_step(model, data)
        expected = np.concatenate([data.qpos, data.qvel, data.qacc_warmstart])
        np.testing.assert_array_equal(moved[row], expected)


@pytest.mark.parametrize("name", ["hopper_params", "humanoid_dir"])
def test_neither_batch_nor_threads_nor_the_past_change_a_bit(name: str) -> None:
    robot, n = robot_of(name), 7
    state, action, params = some_states(name, n)
    expected = np.concatenate(
        [robot.advance(state[i : i + 1], action[i : i + 1], params[i : i + 1]) for i in range(n)]
    )
    for threads in (1, 2, 3):
        simulation = robot.simulation(n, threads)
        simulation.set_params(params)
        for _ in range(2):
            np.testing.assert_array_equal(simulation.step(state, action), expected)
            simulation.step(state[::-1], -action)
    # Two simulations side by side, on tasks the other way round.
    other = robot.simulation(n, threads=2)
    other.set_params(params[::-1])
    backwards = other.step(state[::-1], action[::-1])
    np.testing.assert_array_equal(backwards[::-1], expected)
    np.testing.assert_array_equal(simulation.step(state, action), expected)


def test_rows_that_are_not_wanted_keep_their_state() -> None:
    robot, n = robot_of("humanoid_dir"), 5
    state, action, params = some_states("humanoid_dir", n)
    simulation = robot.simulation(n, threads=2)
    simulation.set_params(params)
    every = simulation.step(state, action)
    rows = np.array([True, False, False, True, False])
    some = simulation.step(state, action, rows)
    np.testing.assert_array_equal(some[rows], every[rows])
    np.testing.assert_array_equal(some[~rows], state[~rows])
    none = simulation.step(state, action, np.zeros(n, dtype=np.bool_))
    np.testing.assert_array_equal(none, state)
    for array in (every, some, none):
        assert array.flags.owndata
        assert array.flags.writeable


def test_tasks_never_compound() -> None:
    robot, tasks, n = robot_of("walker_params"), task_set("walker_params"), 3
    state, action, _ = some_states("walker_params", n)
    nominal = {key: value.copy() for key, value in arrays_of(robot.model).items()}
    simulation = robot.simulation(n)
    simulation.set_params(tasks.params[:n])
    first, fields = simulation.step(state, action), arrays_of(simulation.model(1))
    for start in range(0, len(tasks), n):
        simulation.set_params(tasks.params[(start + np.arange(n)) % len(tasks)])
        simulation.step(state, action)
    simulation.set_params(tasks.params[:n])
    np.testing.assert_array_equal(simulation.step(state, action), first)
    for key, value in arrays_of(simulation.model(1)).items():
        np.testing.assert_array_equal(value, fields[key], err_msg=key)
    for key, value in arrays_of(robot.model).items():
        np.testing.assert_array_equal(value, nominal[key], err_msg=key)


def test_copies_and_pickles_have_simulations_of_their_own() -> None:
    robot = robot_of("hopper_params")
    state, action, params = some_states("hopper_params", 2)
    simulation = robot.simulation(2)
    simulation.set_params(params)
    expected = simulation.step(state, action)
    for other in (copy.deepcopy(simulation), pickle.loads(pickle.dumps(simulation))):
        np.testing.assert_array_equal(other.step(state, action), expected)
        other.set_params(params[::-1])
        assert (other.step(state, action) != expected).any()
        np.testing.assert_array_equal(simulation.step(state, action), expected)
    assert copy.deepcopy(robot) is robot
    again = pickle.loads(pickle.dumps(robot))
    np.testing.assert_array_equal(again.advance(state, action, params), expected)


def test_a_simulation_that_blows_up_stays_finite(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # MuJoCo puts it back to its rest and says so in a file in the working directory.
    monkeypatch.chdir(tmp_path)
    robot = robot_of("half_cheetah_vel")
    state, action, params = some_states("half_cheetah_vel", 2)
    calm = robot.advance(state, action, params)
    state[1, robot.nq] = 1e15
    moved = robot.advance(state, action, params)
    np.testing.assert_array_equal(moved[0], calm[0])
    assert np.abs(moved[1]).max() < 1e3
    assert (tmp_path / "MUJOCO_LOG.TXT").exists()
