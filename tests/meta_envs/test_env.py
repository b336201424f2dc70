"""The shells; what every environment must do in them is in test_contract.py."""

import itertools
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from meta_envs import MetaEnv, MetaVectorEnv, resolve, task_set
from tests.meta_envs.noisy_robot import EDGE
from tests.meta_envs.robots import POINT_ROBOTS

MODES = list(AutoresetMode)


def make(name: str, **kwargs: Any) -> Any:
    return gymnasium.make(resolve(name).id, **kwargs)


def make_vec(name: str, **kwargs: Any) -> Any:
    return gymnasium.make_vec(resolve(name).id, vectorization_mode="vector_entry_point", **kwargs)


def some_actions(steps: int, num_envs: int) -> Any:
    """Actions with values beyond the box and infinities among them."""
    actions = np.random.default_rng(8).uniform(-1.5, 1.5, (steps, num_envs, 2))
    actions[::5, ::3, 0] = np.inf
    actions[::7, ::2, 1] = -np.inf
    return actions.astype(np.float32)


def assert_same(native: Any, sync: Any) -> None:
    assert (native.dtype, native.shape) == (sync.dtype, sync.shape)
    assert native.tobytes() == sync.tobytes()


def test_same_step_keeps_the_last_observation_and_info(noisy_robot: str) -> None:
    env = make_vec(noisy_robot, num_envs=4, autoreset_mode="SameStep", max_episode_steps=6)
    env.reset(seed=0)
    goal = task_set(noisy_robot).params[0]
    ends = np.zeros((2, 4), dtype=bool)
    for _ in range(6):
        obs, _, *flags, info = env.step([[1.0, 0.0], [1.0, 0.0], [-1.0, 0.0], [-1.0, 0.0]])
        ends |= flags
        over = flags[0] | flags[1]
        assert ("final_obs" in info) == over.any()
        if over.any():
            last = info["final_obs"][over]
            assert (np.abs(last[:, 0]) > EDGE).all()
            assert (np.abs(obs[over]) <= 0.1).all()
            for mask in (info["_final_obs"], info["_final_info"], info["final_info"]["_distance"]):
                np.testing.assert_array_equal(mask, over)
            distance = np.hypot(*(last - goal).T)
            np.testing.assert_allclose(info["final_info"]["distance"][over], distance, rtol=1e-6)
    assert ends.tolist() == [[True, True, False, False], [False, False, True, True]]


def test_next_step_ignores_the_action_of_the_resetting_step(any_robot: str) -> None:
    env = make_vec(any_robot, num_envs=2, max_episode_steps=1)
    env.reset(seed=0)
    env.step(np.ones((2, 2)))
    obs, reward, terminated, truncated, info = env.step(np.ones((2, 2)))
    assert (np.abs(obs) <= 0.1).all()
    for zero in (reward, terminated, truncated, info["distance"], info["_distance"]):
        assert not zero.any()


@pytest.mark.parametrize("name", POINT_ROBOTS)
def test_only_the_time_limit_ends_an_episode(name: str) -> None:
    env, horizon = make(name), resolve(name).horizon
    env.reset(seed=0)
    ends = [env.step(env.action_space.sample())[2:4] for _ in range(horizon)]
    assert ends == [(False, False)] * (horizon - 1) + [(False, True)]
    vector = make_vec(name, num_envs=3, max_episode_steps=4)
    vector.reset()
    ends = [vector.step(vector.action_space.sample())[3].tolist() for _ in range(10)]
    assert ends == [[step in (3, 8)] * 3 for step in range(10)]


def test_the_farthest_a_robot_gets_is_inside_the_observation_space() -> None:
    for name in POINT_ROBOTS:
        env = make_vec(name, tasks=range(len(task_set(name))))
        for direction in itertools.product((-1.0, 1.0), repeat=2):
            env.reset()
            for _ in range(env.horizon):
                obs = env.step(np.tile(direction, (env.num_envs, 1)))[0]
            assert env.observation_space.contains(obs)


def test_tasks_and_how_to_change_them() -> None:
    env = make("point_robot_wind", task=3)
    assert env.unwrapped.task == 3
    assert env.reset()[1] == {"task": 3}
    assert env.reset(options={"task": 7})[1] == {"task": 7}
    assert env.reset()[1] == {"task": 7}
    assert env.reset(options={})[1] == {"task": 7}
    vector = make_vec("point_robot_wind", tasks=[3, 5, 3])
    assert vector.reset()[1]["task"].tolist() == [3, 5, 3]
    assert vector.reset(options={"task": 8})[1]["task"].tolist() == [8, 8, 8]
    assert vector.reset(options={"task": np.array([1, 2, 4])})[1]["task"].tolist() == [1, 2, 4]
    mask = np.array([False, True, True])
    info = vector.reset(options={"task": [6, 7, 9], "reset_mask": mask})[1]
    assert info["task"].tolist() == vector.tasks.tolist() == [1, 7, 9]
    np.testing.assert_array_equal(vector.params, task_set("point_robot_wind").params[[1, 7, 9]])
    assert make_vec("point_robot", num_envs=2, task=4).tasks.tolist() == [4, 4]
    obs, *_ = vector.step(np.zeros((3, 2)))
    np.testing.assert_allclose(obs, vector.params, rtol=1e-6)


@pytest.mark.parametrize("mode", list(AutoresetMode))
@pytest.mark.parametrize("name", ["sparse_point_robot", "noisy_robot", "hopper_params", "ant_goal"])
def test_what_rests_stands_still_and_changes_nothing_for_the_others(
    name: str, mode: AutoresetMode, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> None:
    if name == "noisy_robot":
        request.getfixturevalue("noisy_robot")
    steps = 12
    env, other = (
        MetaVectorEnv(name, tasks=[3, 0, 2], autoreset_mode=mode, max_episode_steps=2 * steps)
        for _ in range(2)
    )
    shape = env.action_space.shape or ()
    for one in (env, other):
        one.reset(seed=4)
    draw = np.random.default_rng(0)
    mask = np.array([False, True, False])
    simulated: list[list[bool]] = []
    step = env._simulation.step

    def spied(*given: Any) -> Any:
        simulated.append([True] * 3 if given[2] is None else given[2].tolist())
        return step(*given)

    monkeypatch.setattr(env._simulation, "step", spied)
    still = env.step(np.zeros(shape))[0][1]
    other.step(np.zeros(shape))
    env.rest(mask)
    for _ in range(steps):
        if mode is AutoresetMode.DISABLED:
            for one in (env, other):
                if one._over.any():
                    one.reset(options={"reset_mask": one._over.copy()})
        action = draw.uniform(-1, 1, shape)
        found, wanted = env.step(action), other.step(action)
        for index in range(4):
            own, others = np.asarray(found[index]), np.asarray(wanted[index])
            assert own[~mask].tobytes() == others[~mask].tobytes()
        obs, reward, terminated, truncated, info = found
        assert obs[1].tobytes() == still.tobytes()
        assert (reward[1], terminated[1], truncated[1]) == (0, False, False)
        assert not any(info[key][1] for key in info if key.startswith("_") and key != "_task")
    assert not any(rows[1] for rows in simulated[1:])
    # Reset, it goes on with its random stream where that was.
    twin = MetaVectorEnv(name, tasks=[3, 0, 2])
    twin.reset(seed=4)
    begun, wanted_obs = (one.reset(options={"reset_mask": mask})[0] for one in (env, twin))
    assert begun[1].tobytes() == wanted_obs[1].tobytes()
    assert simulated[0] == [True] * 3
    moved = env.step(np.ones(shape))
    assert simulated[-1][1]
    assert moved[0][1].tobytes() != begun[1].tobytes()


def test_what_is_over_and_rests_is_not_started_anew() -> None:
    env = MetaVectorEnv("point_robot", tasks=[3, 0], max_episode_steps=1)
    env.reset(seed=0)
    last = env.step(np.ones((2, 2)))[0]
    env.rest(np.array([True, False]))
    obs, _, _, truncated, _ = env.step(np.ones((2, 2)))
    assert obs[0].tolist() == last[0].tolist()
    assert obs[1].tolist() == [0, 0]
    assert env.step(np.ones((2, 2)))[3].tolist() == [False, True]
    assert not truncated.any()
    with pytest.raises(ValueError, match="mask must be a bool array"):
        env.rest(np.array([1, 0]))
    with pytest.raises(gymnasium.error.ResetNeeded):
        MetaVectorEnv("point_robot").rest(np.array([True]))


def test_another_task_set() -> None:
    fresh = task_set("point_robot").sample(seed=0, n_tasks=3)
    env = MetaEnv("point_robot", task=2, task_set=fresh)
    vector = MetaVectorEnv("PointRobot-v0", tasks=[2], task_set=fresh)
    env.reset()
    vector.reset()
    expected = -np.hypot(*fresh.params[2])
    assert env.step(np.zeros(2))[1] == pytest.approx(expected)
    assert vector.step(np.zeros((1, 2)))[1][0] == pytest.approx(expected)


def test_info_has_the_documented_terms(any_robot: str) -> None:
    terms = {"distance": float, "is_success": bool}
    if any_robot == "sparse_point_robot":
        terms["dense_reward"] = float
    env = make(any_robot)
    env.reset(seed=0)
    info = env.step(np.zeros(2))[4]
    assert {key: type(value) for key, value in info.items()} == {"task": int, **terms}


def test_state_and_params_are_read_only() -> None:
    env = make_vec("point_robot_wind", num_envs=2)
    env.reset()
    for array in (env.state, env.params):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1.0
    env.tasks[0] = 9
    assert env.tasks.tolist() == [0, 0]
    single = MetaEnv("point_robot_wind")
    single.reset()
    single.step(np.ones(2))
    with pytest.raises(ValueError, match="read-only"):
        single.state[0] = 1.0
    np.testing.assert_array_equal(single.state, 0.1 + single.task_set.params[0])


def test_the_same_seed_gives_the_same_episode(noisy_robot: str) -> None:
    env = make_vec(noisy_robot, num_envs=2)
    first = env.reset(seed=5)[0]
    np.testing.assert_array_equal(first, env.reset(seed=[5, 6])[0])
    np.testing.assert_array_equal(first, env.reset(seed=np.array([5, 6]))[0])
    assert (first != env.reset(seed=7)[0]).all()
    assert (env.reset(seed=[5, None])[0][0] == first[0]).all()


def test_a_picture_is_of_the_sub_environments_own_task(any_robot: str) -> None:
    vector = make_vec(any_robot, tasks=[3, 4], render_mode="rgb_array")
    vector.reset(seed=[0, 0])
    pictures = vector.render()
    assert pictures[0].shape == (400, 400, 3)
    assert (pictures[0] != pictures[1]).any()


@pytest.mark.parametrize("mode", MODES)
def test_a_picture_shows_the_running_episode_alone(mode: AutoresetMode) -> None:
    kwargs = {"autoreset_mode": mode, "max_episode_steps": 3, "render_mode": "rgb_array"}
    env, fresh = (make_vec("point_robot", num_envs=2, **kwargs) for _ in range(2))
    env.reset()
    fresh.reset()
    start = fresh.render()
    actions = some_actions(4, 2)
    for action in actions[:3]:
        env.step(action)
    if mode is AutoresetMode.NEXT_STEP:
        env.step(actions[3])
    elif mode is AutoresetMode.DISABLED:
        env.reset(options={"reset_mask": np.array([True, True])})
    assert_same(env.render()[0], start[0])
    env.step(actions[0])
    fresh.step(actions[0])
    assert_same(env.render()[1], fresh.render()[1])
