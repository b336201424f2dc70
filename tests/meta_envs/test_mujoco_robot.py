import copy
from typing import Any

import numpy as np
import pytest

from meta_envs import MetaEnv, MetaVectorEnv, reference_returns, task_set
from meta_envs.mujoco_robot import BEYOND, sum_of_squares
from tests.meta_envs.gymnasium_twin import Floats, robot_of
from tests.meta_envs.robots import MUJOCO_ROBOTS


def episode(name: str, action: Floats, steps: int, **kwargs: Any) -> list[Any]:
    env = MetaVectorEnv(name, tasks=[0, 1], **kwargs)
    found: list[Any] = [env.reset(seed=[8, 9])[0]]
    for _ in range(steps):
        found += env.step(action)[:4]
    return found


@pytest.mark.parametrize("name", MUJOCO_ROBOTS)
def test_the_declared_sizes_are_the_models(name: str) -> None:
    robot = robot_of(name)
    model = robot.model
    assert (model.nq, model.nv, model.nu, model.na) == (robot.nq, robot.nv, robot.nu, 0)
    assert model.opt.timestep == robot.timestep
    assert robot.action_space.shape == (robot.nu,)
    assert robot.observation_space.shape == (robot.observation_size,)
    np.testing.assert_array_equal(model.actuator_ctrlrange[:, 0], -model.actuator_ctrlrange[:, 1])
    assert robot.horizon == 200


def test_steps_take_the_fields_times() -> None:
    times = {name: (robot_of(name).dt, robot_of(name).render_fps) for name in MUJOCO_ROBOTS}
    expected = {
        "half_cheetah_vel": (0.05, 20),
        "half_cheetah_dir": (0.05, 20),
        "ant_goal": (0.05, 20),
        "ant_dir": (0.05, 20),
        "humanoid_dir": (0.015, 67),
        "hopper_params": (0.016, 62),
        "walker_params": (0.016, 62),
        "hopper_mass": (0.008, 125),
        "hopper_friction": (0.008, 125),
        "walker_mass": (0.01, 100),
        "walker_friction": (0.01, 100),
    }
    assert times.keys() == expected.keys()
    for name, (dt, fps) in expected.items():
        assert times[name][0] == pytest.approx(dt)
        assert times[name][1] == fps


def test_observations_are_bounded_far_away() -> None:
    for name in MUJOCO_ROBOTS:
        box = robot_of(name).observation_space
        assert np.isfinite(box.high).all()
        assert (box.low == -box.high).all()
    high = robot_of("hopper_params").observation_space.high
    assert high.tolist() == [np.float32(BEYOND)] * 5 + [10.0] * 6


@pytest.mark.parametrize("name", ["hopper_params", "ant_goal"])
def test_threads_change_no_bit(name: str) -> None:
    robot = robot_of(name)
    action = np.linspace(-1.0, 1.0, 2 * robot.nu).reshape(2, -1)
    one, two = (episode(name, action, 30, threads=threads) for threads in (1, 2))
    for first, second in zip(one, two, strict=True):
        np.testing.assert_array_equal(first, second)
    assert MetaVectorEnv(name, num_envs=3, threads=8).threads == 3
    assert MetaVectorEnv(name, num_envs=3, threads=2).threads == 2
    assert MetaVectorEnv(name, num_envs=1).threads == 1


@pytest.mark.parametrize("threads", [0, -1, 1.5, True])
def test_wrong_numbers_of_threads_are_refused(threads: Any) -> None:
    with pytest.raises(ValueError, match="threads must be an integer of at least 1, got"):
        MetaVectorEnv("half_cheetah_dir", num_envs=2, threads=threads)


@pytest.mark.parametrize("name", ["walker_params", "humanoid_dir"])
def test_a_start_depends_on_its_own_seed_alone(name: str) -> None:
    """Also where others beside it end early and start again."""
    env = MetaVectorEnv(name, tasks=[5, 6, 7], autoreset_mode="SameStep")
    starts = env.reset(seed=[1, 2, 3])[0]
    assert len(np.unique(starts, axis=0)) == 3
    alone = MetaEnv(name, task=6)
    np.testing.assert_array_equal(alone.reset(seed=2)[0], starts[1])
    actions, resets = np.random.default_rng(0), 0
    for _ in range(60):
        action = actions.uniform(-1.0, 1.0, (3, robot_of(name).nu))
        obs, _, terminated, _, _ = env.step(action)
        expected, _, over, _, _ = alone.step(action[1])
        if over:
            expected, resets = alone.reset()[0], resets + 1
        assert terminated[1] == over
        np.testing.assert_array_equal(obs[1], expected)
        np.testing.assert_array_equal(env.state[1], alone.state)
    assert resets > 1


def test_two_environments_share_no_simulation() -> None:
    first, second = (MetaEnv("hopper_params", task=task) for task in (0, 1))
    lonely = MetaEnv("hopper_params", task=0)
    for env in (first, second, lonely):
        env.reset(seed=4)
    for _ in range(4):
        action = np.array([0.3, -0.2, 0.1])
        mine, other = first.step(action)[0], second.step(-action)[0]
        np.testing.assert_array_equal(mine, lonely.step(action)[0])
        assert (mine != other).any()
    copied = copy.deepcopy(first)
    np.testing.assert_array_equal(copied.step(action)[0], first.step(action)[0])


def test_moving_to_another_task_changes_the_physics_and_back() -> None:
    env = MetaEnv("walker_params", task=3)

    def after_a_step(**options: int) -> Floats:
        env.reset(seed=1, options=options)
        return env.step(np.full(6, 0.4))[0].astype(np.float64)

    first = after_a_step()
    assert (after_a_step(task=4) != first).any()
    np.testing.assert_array_equal(after_a_step(task=3), first)


def test_a_task_of_ones_own() -> None:
    tasks = task_set("hopper_mass")
    env = MetaEnv("hopper_mass", task_params={"body_mass": 2.5})
    assert env.task_set.params.tolist() == [[2.5]]
    env.reset(seed=0)
    heavy = env.step(np.ones(3))[0]
    many = MetaVectorEnv("hopper_mass", task_params=[{"body_mass": 2.5}, {"body_mass": 1.0}])
    assert many.num_envs == 2
    many.reset(seed=[0, 0])
    obs = many.step(np.ones((2, 3)))[0]
    np.testing.assert_array_equal(obs[0], heavy)
    assert (obs[1] != heavy).any()
    same = MetaVectorEnv("hopper_mass", num_envs=3, task_params={"body_mass": 2.5})
    assert same.params.tolist() == [[2.5]] * 3
    with pytest.raises(ValueError, match=r"body_mass must be between 0\.01 and 100, got 0"):
        MetaEnv("hopper_mass", task_params={"body_mass": 0.0})
    with pytest.raises(ValueError, match="hopper_mass: no task parameter 'mass'"):
        MetaVectorEnv("hopper_mass", task_params={"mass": 1.0})
    for shell in (MetaEnv, MetaVectorEnv):
        with pytest.raises(ValueError, match="give task_set or task_params, not both"):
            shell("hopper_mass", task_params={"body_mass": 1.0}, task_set=tasks)


def test_references_of_a_robot_without_an_optimum() -> None:
    tasks = task_set("half_cheetah_dir")
    found = reference_returns(tasks)
    assert list(found) == ["random", "still"]
    assert all(values.shape == (2,) for values in found.values())
    np.testing.assert_allclose(found["still"], 0.0, atol=2.0)
    ten = reference_returns(tasks, episodes=robot_of("half_cheetah_dir").random_episodes)
    np.testing.assert_array_equal(ten["random"], found["random"])


def test_a_picture_shows_what_the_task_asks_for() -> None:
    markers = {}
    for name in MUJOCO_ROBOTS:
        params = task_set(name).params[0]
        found = robot_of(name).markers(np.zeros(99), params)
        markers[name] = [(one.kind, one.position, one.vector) for one in found]
    forwards = ("direction", None, (1.0, 0.0, 0.0))
    expected = {
        "half_cheetah_vel": [("velocity", None, (1.0, 0.0, 0.0))],
        "half_cheetah_dir": [("direction", None, (-1.0, 0.0, 0.0))],
        "ant_goal": [("goal", (2.0, 0.0, 0.0), (0.0, 0.0, 0.0))],
        "ant_dir": [forwards],
        "humanoid_dir": [forwards],
    }
    assert markers == {name: expected.get(name, []) for name in MUJOCO_ROBOTS}


def test_a_sum_of_squares_is_that_of_each_row_alone() -> None:
    generator = np.random.default_rng(1)
    for size in (1, 3, 6, 8, 17):
        action = generator.uniform(-1.0, 1.0, (41, size))
        every = sum_of_squares(action)
        alone = [sum_of_squares(action[i : i + 1])[0] for i in range(41)]
        np.testing.assert_array_equal(every, alone)
        np.testing.assert_allclose(every, np.linalg.norm(action, axis=1) ** 2, rtol=1e-12)
