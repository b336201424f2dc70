import mujoco
import numpy as np
import pytest

from meta_envs import task_set
from tests.meta_envs.gymnasium_twin import assert_same_state, robot_of, twins


def test_it_moves_and_is_seen_as_gymnasiums_is() -> None:
    robot = robot_of("humanoid_dir")
    forwards = np.zeros((1, 1))
    ended = 0
    for twin in twins("humanoid_dir", "Humanoid-v5", forwards[0], 40):
        data = twin.env.data
        assert_same_state(robot, twin.next_state, twin.env)
        obs = robot.observe(twin.next_state)[0]
        parts = [data.qpos[2:], data.qvel, data.cinert, data.cvel, data.qfrc_actuator]
        seen = np.concatenate([part.ravel() for part in parts])
        assert seen.size == 376 - 84
        np.testing.assert_array_equal(obs[:-84], seen.astype(np.float32))
        assert not obs[-84:].any()
        reward, terms = robot.reward(twin.state, twin.action, twin.next_state, forwards)
        info = twin.result[4]
        # Gymnasium's weight of 1.25 is the field's 0.25 with the step's time instead of a fifth.
        assert terms["reward_forward"][0] == pytest.approx(
            info["reward_forward"], rel=1e-6, abs=1e-9
        )
        assert terms["reward_control"][0] == pytest.approx(info["reward_ctrl"], rel=1e-12)
        assert reward[0] == pytest.approx(
            info["reward_forward"] + 5.0 + info["reward_ctrl"], rel=1e-6
        )
        assert bool(robot.terminated(twin.next_state)[0]) == (not twin.env.is_healthy)
        ended += not twin.env.is_healthy
    assert 0 < ended < 40


def test_a_start_has_what_the_bodies_do_in_it() -> None:
    robot = robot_of("humanoid_dir")
    generators = [np.random.default_rng(seed) for seed in (4, 5)]
    state = robot.initial_state(generators)
    again = robot.initial_state([np.random.default_rng(5)])
    np.testing.assert_array_equal(state[1:], again)
    generator = np.random.default_rng(4)
    data = mujoco.MjData(robot.model)
    data.qpos += generator.uniform(-0.01, 0.01, 24)
    data.qvel += generator.uniform(-0.01, 0.01, 23)
    mujoco.mj_forward(robot.model, data)
    parts = [data.qpos, data.qvel, np.zeros(23), data.cinert, data.cvel]
    parts += [data.qfrc_actuator, data.subtree_com]
    np.testing.assert_array_equal(state[0], np.concatenate([part.ravel() for part in parts]))
    assert not data.qfrc_actuator.any()


def test_the_first_step_is_along_the_tasks_direction() -> None:
    robot = robot_of("humanoid_dir")
    state = np.repeat(robot.initial_state([np.random.default_rng(0)]), 4, axis=0)
    next_state = state.copy()
    # The centre of mass of the torso's subtree, the whole robot: the second row of the last part.
    next_state[:, -3 * 14 + 3 : -3 * 14 + 5] += [0.006, 0.003]
    params = np.array([[0.0], [0.5], [1.0], [1.5]]) * np.pi
    reward, terms = robot.reward(state, np.zeros((4, 17)), next_state, params)
    np.testing.assert_allclose(terms["reward_forward"], [0.5, 0.25, -0.5, -0.25], atol=1e-9)
    np.testing.assert_allclose(reward, [5.5, 5.25, 4.5, 4.75], atol=1e-9)


def test_where_an_episode_ends() -> None:
    robot = robot_of("humanoid_dir")
    state = np.repeat(robot.initial_state([np.random.default_rng(0)]), 5, axis=0)
    state[:, 2] = [0.99, 1.0, 2.0, 2.01, np.nan]
    assert robot.terminated(state).tolist() == [True, False, False, True, True]


def test_the_tasks_are_all_around() -> None:
    angles = task_set("humanoid_dir").params[:, 0]
    np.testing.assert_allclose(angles, np.radians(9.0) * np.arange(40), atol=1e-12)
