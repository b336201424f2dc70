import itertools
import warnings
from typing import Any

import gymnasium
import numpy as np
import pytest
import stable_baselines3.common.env_checker
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from meta_envs import ENVIRONMENTS, MetaEnv, MetaVectorEnv, resolve, task_set
from tests.meta_envs.noisy_robot import EDGE

MODES = list(AutoresetMode)


def make(name: str, **kwargs: Any) -> Any:
    return gymnasium.make(resolve(name).id, **kwargs)


def make_vec(name: str, **kwargs: Any) -> Any:
    return gymnasium.make_vec(resolve(name).id, vectorization_mode="vector_entry_point", **kwargs)


def make_sync(name: str, mode: AutoresetMode) -> SyncVectorEnv[Any, Any]:
    tasks = range(len(task_set(name)))
    return SyncVectorEnv(
        [lambda task=task: make(name, task=task, disable_env_checker=True) for task in tasks],  # type: ignore[misc]  # mypy cannot type a lambda's default
        autoreset_mode=mode,
    )


def some_actions(steps: int, num_envs: int) -> Any:
    """Actions with values beyond the box and infinities among them."""
    actions = np.random.default_rng(8).uniform(-1.5, 1.5, (steps, num_envs, 2))
    actions[::5, ::3, 0] = np.inf
    actions[::7, ::2, 1] = -np.inf
    return actions.astype(np.float32)


def assert_same(native: Any, sync: Any) -> None:
    assert (native.dtype, native.shape) == (sync.dtype, sync.shape)
    assert native.tobytes() == sync.tobytes()


def assert_same_info(native: dict[str, Any], sync: dict[str, Any], exact: bool) -> None:
    """Every entry of SyncVectorEnv's info is in the native one; with `exact` and no other."""
    for key in (key for key in sync if not key.startswith("_")):
        mask, held = native["_" + key], sync["_" + key]
        assert (mask == held if exact else mask | ~held).all()
        if key == "final_info":
            assert_same_info(native[key], sync[key], exact=True)
        elif key == "final_obs":
            assert_same(native[key][held], np.stack(sync[key][held]))
        else:
            assert_same(native[key][held], sync[key][held])
    if exact:
        for key in (key for key in native if not key.startswith("_") and key not in sync):
            assert not native["_" + key].any()


@pytest.mark.parametrize("mode", MODES)
def test_the_vector_environment_equals_the_single_one_bit_for_bit(
    any_env: str, mode: AutoresetMode
) -> None:
    sync, n_tasks = make_sync(any_env, mode), len(task_set(any_env))
    native = make_vec(any_env, tasks=range(n_tasks), autoreset_mode=mode)
    for space in ("observation_space", "action_space", "single_action_space"):
        assert getattr(native, space) == getattr(sync, space)
    for mine, its in zip(native.reset(seed=3), sync.reset(seed=3), strict=True):
        assert_same_info(mine, its, True) if isinstance(mine, dict) else assert_same(mine, its)
    ends = 0
    for step, action in enumerate(some_actions(2 * native.horizon + 5, n_tasks)):
        given = action.copy()
        *mine, my_info = native.step(action)
        *its, its_info = sync.step(action)
        for one, other in zip(mine, its, strict=True):
            assert_same(one, other)
        assert_same_info(my_info, its_info, exact=mode is not AutoresetMode.SAME_STEP)
        np.testing.assert_array_equal(action, given)
        over = mine[2] | mine[3]
        ends += int(over.sum())
        # Resetting a third of them midway puts the sub-environments out of step.
        mask = np.arange(n_tasks) % 3 == 0 if step == native.horizon // 2 else np.zeros_like(over)
        if mode is AutoresetMode.DISABLED:
            mask |= over
        if mask.any():
            options = {"reset_mask": mask}
            seeds = [step if task % 2 else None for task in range(n_tasks)]
            mine_reset = native.reset(seed=seeds, options=options)
            assert "reset_mask" in options
            its_reset = sync.reset(seed=seeds, options=options)
            assert_same(mine_reset[0], its_reset[0])
            assert_same(mine_reset[1]["task"][mask], its_reset[1]["task"][mask])
    assert ends > n_tasks


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


def test_next_step_ignores_the_action_of_the_resetting_step(any_env: str) -> None:
    env = make_vec(any_env, num_envs=2, max_episode_steps=1)
    env.reset(seed=0)
    env.step(np.ones((2, 2)))
    obs, reward, terminated, truncated, info = env.step(np.ones((2, 2)))
    assert (np.abs(obs) <= 0.1).all()
    for zero in (reward, terminated, truncated, info["distance"], info["_distance"]):
        assert not zero.any()


@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_only_the_time_limit_ends_an_episode(name: str) -> None:
    env, horizon = make(name), resolve(name).horizon
    env.reset(seed=0)
    ends = [env.step(env.action_space.sample())[2:4] for _ in range(horizon)]
    assert ends == [(False, False)] * (horizon - 1) + [(False, True)]
    vector = make_vec(name, num_envs=3, max_episode_steps=4)
    vector.reset()
    ends = [vector.step(vector.action_space.sample())[3].tolist() for _ in range(10)]
    assert ends == [[step in (3, 8)] * 3 for step in range(10)]


@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_the_checkers_of_gymnasium_and_stable_baselines_find_nothing(name: str) -> None:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for task in (0, len(task_set(name)) - 1):
            env = make(name, task=task, render_mode="rgb_array")
            check_env(env.unwrapped)
            stable_baselines3.common.env_checker.check_env(env, skip_render_check=False)
    assert [str(warning.message) for warning in caught] == []


def test_the_farthest_a_robot_gets_is_inside_the_observation_space() -> None:
    for name in ENVIRONMENTS:
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


def test_another_task_set() -> None:
    fresh = task_set("point_robot").sample(3, seed=0)
    env = MetaEnv("point_robot", task=2, task_set=fresh)
    vector = MetaVectorEnv("PointRobot-v0", tasks=[2], task_set=fresh)
    env.reset()
    vector.reset()
    expected = -np.hypot(*fresh.params[2])
    assert env.step(np.zeros(2))[1] == pytest.approx(expected)
    assert vector.step(np.zeros((1, 2)))[1][0] == pytest.approx(expected)


def test_info_has_the_same_keys_and_types_every_step(any_env: str) -> None:
    terms = {"distance": float, "is_success": bool}
    if any_env == "sparse_point_robot":
        terms["dense_reward"] = float
    env, vector = make(any_env), make_vec(any_env, num_envs=3)
    env.reset(seed=0)
    vector.reset(seed=0)
    for action in some_actions(2 * vector.horizon + 3, 3):
        _, reward, terminated, truncated, info = env.step(action[0])
        assert {key: type(value) for key, value in info.items()} == {"task": int, **terms}
        assert (type(reward), type(terminated), type(truncated)) == (float, bool, bool)
        if terminated or truncated:
            env.reset()
        info = vector.step(action)[4]
        kinds: dict[str, type] = {"task": int, **terms}
        expected: dict[str, Any] = {key: np.dtype(kind) for key, kind in kinds.items()}
        expected |= {"_" + key: np.dtype(bool) for key in kinds}
        assert {key: value.dtype for key, value in info.items()} == expected
        assert all(value.shape == (3,) for value in info.values())


def arrays_in(result: Any) -> list[Any]:
    if isinstance(result, dict):
        return [array for value in result.values() for array in arrays_in(value)]
    if isinstance(result, tuple):
        return [array for value in result for array in arrays_in(value)]
    return [result]


@pytest.mark.parametrize("mode", MODES)
def test_returned_arrays_share_no_memory(any_env: str, mode: AutoresetMode) -> None:
    env = make_vec(any_env, num_envs=2, autoreset_mode=mode, max_episode_steps=3)
    twin = make_vec(any_env, num_envs=2, autoreset_mode=mode, max_episode_steps=3)
    seen = arrays_in(env.reset(seed=0))
    twin.reset(seed=0)
    inner = [value for value in vars(env).values() if isinstance(value, np.ndarray)]
    for action in some_actions(8, 2):
        result, expected = env.step(action), twin.step(action)
        for one, other in zip(arrays_in(result), arrays_in(expected), strict=True):
            assert_same(one, other)
        seen += arrays_in(result)
        inner += [value for value in vars(env).values() if isinstance(value, np.ndarray)]
        for one, other in itertools.combinations(seen, 2):
            assert not np.shares_memory(one, other)
        for one, other in itertools.product(seen, inner):
            assert not np.shares_memory(one, other)
        for array in seen:  # what a user writes into them must not matter
            array[...] = 1
        if mode is AutoresetMode.DISABLED and (expected[2] | expected[3]).any():
            seen += arrays_in(env.reset(seed=1))
            twin.reset(seed=1)


def test_state_and_params_are_read_only() -> None:
    env = make_vec("point_robot_wind", num_envs=2)
    env.reset()
    for array in (env.state, env.params):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1.0
    env.tasks[0] = 9
    assert env.tasks.tolist() == [0, 0]


@pytest.mark.usefixtures("untouched_global_rng")
def test_no_shared_generator_is_touched(any_env: str) -> None:
    for env, actions in (
        (make(any_env, task=1), np.ones((20, 2))),
        (make_vec(any_env, tasks=[1, 2, 3]), np.ones((20, 3, 2))),
    ):
        env.reset(seed=3)
        env.reset(options={"task": 4})
        env.action_space.seed(1)
        env.action_space.sample()
        for action in actions:
            if any(np.atleast_1d(end).any() for end in env.step(action)[2:4]):
                env.reset()
    task_set(any_env).sample(5, seed=0)


def test_environments_do_not_affect_each_other(any_env: str) -> None:
    def trace(disturb: bool) -> list[Any]:
        env, vector = make(any_env, task=5), make_vec(any_env, tasks=[5, 6])
        found = [env.reset(seed=3)[0], vector.reset(seed=3)[0]]
        env.action_space.seed(11)
        vector.action_space.seed(12)
        vector.single_action_space.seed(13)
        if disturb:
            others = (make(any_env, task=1), make_vec(any_env, tasks=[1, 2, 3]))
            for other in others:
                other.reset(seed=9)
                other.action_space.seed(0)
                other.observation_space.seed(0)
                other.step(other.action_space.sample())
            others[1].single_action_space.seed(0)
        for _ in range(5):
            found += [env.action_space.sample(), vector.single_action_space.sample()]
            found += [*env.step(env.action_space.sample())[:2]]
            found += [*vector.step(vector.action_space.sample())[:4]]
        return found

    for alone, disturbed in zip(trace(False), trace(True), strict=True):
        np.testing.assert_array_equal(alone, disturbed)


def test_the_same_seed_gives_the_same_episode(noisy_robot: str) -> None:
    env = make_vec(noisy_robot, num_envs=2)
    first = env.reset(seed=5)[0]
    np.testing.assert_array_equal(first, env.reset(seed=[5, 6])[0])
    np.testing.assert_array_equal(first, env.reset(seed=np.array([5, 6]))[0])
    assert (first != env.reset(seed=7)[0]).all()
    assert (env.reset(seed=[5, None])[0][0] == first[0]).all()


def test_a_spec_rebuilds_the_environment(any_env: str) -> None:
    env = make(any_env, task=3)
    again: Any = gymnasium.make(EnvSpec.from_json(env.spec.to_json()))
    assert again.unwrapped.task == 3
    assert again.unwrapped.definition.name == any_env
    vector = make_vec(any_env, tasks=[3, 5], autoreset_mode="SameStep")
    rebuilt: Any = gymnasium.make_vec(EnvSpec.from_json(vector.spec.to_json()))
    assert type(rebuilt) is MetaVectorEnv
    assert rebuilt.tasks.tolist() == [3, 5]
    assert rebuilt.autoreset_mode is AutoresetMode.SAME_STEP
    assert rebuilt.horizon == resolve(any_env).horizon


def test_pictures_from_both_shells(any_env: str) -> None:
    env = make(any_env, task=3, render_mode="rgb_array")
    vector = make_vec(any_env, tasks=[3, 4], render_mode="rgb_array")
    env.reset(seed=0)
    vector.reset(seed=0)
    for _ in range(2):
        picture, pictures = env.render(), vector.render()
        assert (picture.shape, picture.dtype) == ((400, 400, 3), np.uint8)
        assert type(pictures) is tuple
        assert_same(pictures[0], picture)
        assert (pictures[1] != picture).any()
        env.step(np.array([-0.5, 0.5]))
        vector.step(np.full((2, 2), [-0.5, 0.5]))


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
