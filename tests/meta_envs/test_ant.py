import gymnasium
import numpy as np
import pytest

from meta_envs import MetaVectorEnv, task_set
from tests.meta_envs.gymnasium_twin import assert_same_state, robot_of, twins


def test_the_goals_are_the_fields() -> None:
    tasks = task_set("ant_goal")
    goals = tasks.params
    assert tasks.param_names == ("goal_x", "goal_y")
    assert goals.shape == (40, 2)
    np.testing.assert_allclose(goals[0], [2.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(goals[10], [0.0, 2.0], atol=1e-12)
    turn = np.radians(9.0)
    np.testing.assert_allclose(goals[39], [2 * np.cos(turn), -2 * np.sin(turn)], atol=1e-12)
    np.testing.assert_allclose(np.hypot(*goals.T), 2.0, atol=1e-12)
    assert tasks.test_tasks.tolist() == list(range(2, 40, 4))
    assert list(tasks.splits) == ["interpolate"]
    fresh = tasks.sample(seed=0, n_tasks=500).params
    np.testing.assert_allclose(np.hypot(*fresh.T), 2.0, atol=1e-12)
    assert np.abs(fresh.mean(axis=0)).max() < 0.3


def test_it_moves_as_gymnasiums_does() -> None:
    goal, ant_dir = robot_of("ant_goal"), robot_of("ant_dir")
    params = np.array([0.6, -1.9])
    kwargs = {"terminate_when_unhealthy": False, "include_cfrc_ext_in_observation": False}
    for twin in twins("ant_goal", "Ant-v5", params, 60, **kwargs):
        assert_same_state(goal, twin.next_state, twin.env)
        x, y, height = twin.env.data.qpos[:3]
        effort = float(np.square(twin.action).sum())
        reward, terms = goal.reward(twin.state, twin.action, twin.next_state, params[None])
        expected = -abs(x - 0.6) - abs(y + 1.9) - 0.1 * effort
        assert reward[0] == pytest.approx(expected, rel=1e-12)
        assert terms["distance"][0] == pytest.approx(np.hypot(x - 0.6, y + 1.9), rel=1e-12)
        obs = ant_dir.observe(twin.next_state)[0]
        np.testing.assert_array_equal(obs, twin.result[0].astype(np.float32))
        whole = goal.observe(twin.next_state)[0]
        np.testing.assert_array_equal(whole[2:], obs)
        np.testing.assert_array_equal(whole[:2], np.array([x, y], dtype=np.float32))
        over = bool(ant_dir.terminated(twin.next_state)[0])
        assert over == (not twin.env.is_healthy) == (not 0.2 <= height <= 1.0)
        assert not goal.terminated(twin.next_state).any()


def test_it_starts_as_gymnasiums_does() -> None:
    theirs = gymnasium.make("Ant-v5").unwrapped
    theirs.reset(seed=11)
    mine = MetaVectorEnv("ant_goal", num_envs=1).reset(seed=11)[0][0]
    data = theirs.data  # type: ignore[attr-defined]  # MujocoEnv's
    np.testing.assert_array_equal(mine, np.concatenate([data.qpos, data.qvel]).astype(np.float32))


def test_a_success_is_near_the_goal() -> None:
    robot = robot_of("ant_goal")
    state = np.zeros((3, robot.nq + 2 * robot.nv))
    state[:, :2] = [[1.0, 1.0], [1.0, 1.19], [1.0, 1.21]]
    params = np.ones((3, 2))
    reward, terms = robot.reward(state, np.zeros((3, 8)), state, params)
    np.testing.assert_allclose(reward, [0.0, -0.19, -0.21], atol=1e-12)
    assert terms["is_success"].tolist() == [True, True, False]


def test_standing_still() -> None:
    """-508 over all tasks, -505.1 over the ten test tasks; the ant only settles on its feet."""
    robot, tasks = robot_of("ant_goal"), task_set("ant_goal")
    simulation = robot.simulation(len(tasks), threads=2)
    state = np.zeros((len(tasks), robot.nq + 2 * robot.nv))
    state[:, : robot.nq] = robot.model.qpos0
    still, total = np.zeros((len(tasks), robot.nu)), np.zeros(len(tasks))
    for _ in range(robot.horizon):
        next_state = simulation.step(state, still)
        total += robot.reward(state, still, next_state, tasks.params)[0]
        state = next_state
    assert total.mean() == pytest.approx(-508.25, abs=0.1)
    assert total[tasks.test_tasks].mean() == pytest.approx(-505.1, abs=0.1)


def test_the_velocity_counts_in_the_tasks_direction() -> None:
    robot = robot_of("ant_dir")
    state = np.zeros((5, robot.nq + 2 * robot.nv))
    next_state = state.copy()
    next_state[:, :2] = [0.1, 0.05]
    params = np.array([[0.0], [0.5], [1.0], [1.5], [0.25]]) * np.pi
    action = np.full((5, 8), 0.5)
    reward, terms = robot.reward(state, action, next_state, params)
    expected = np.array([2.0, 1.0, -2.0, -1.0, 3.0 / np.sqrt(2.0)])
    np.testing.assert_allclose(terms["reward_forward"], expected, atol=1e-12)
    np.testing.assert_allclose(reward, expected + 1.0 - 0.5 * 8 * 0.25, atol=1e-12)


def test_where_an_episode_ends() -> None:
    robot = robot_of("ant_dir")
    state = np.zeros((6, robot.nq + 2 * robot.nv))
    state[:, 2] = [0.19, 0.2, 1.0, 1.01, 0.5, np.nan]
    state[4, 20] = np.inf
    assert robot.terminated(state).tolist() == [True, False, False, True, True, True]
