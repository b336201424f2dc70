import warnings
from typing import Any

import gymnasium
import numpy as np
import pytest

from meta_envs import MetaEnv, MetaVectorEnv, TaskSet, task_set
from meta_envs.checks import check_action, check_seeds

NAN = float("nan")


@pytest.fixture
def single() -> MetaEnv:
    env = MetaEnv("point_robot", task=3)
    env.reset(seed=0)
    return env


@pytest.fixture
def vector() -> MetaVectorEnv:
    env = MetaVectorEnv("point_robot", tasks=[1, 2, 3])
    env.reset(seed=0)
    return env


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"name": "pointrobt"}, "no environment 'pointrobt'; did you mean 'point_robot'?"),
        ({"task": 100}, "point_robot has tasks 0 to 99, got task=100"),
        ({"task": 1.5}, r"point_robot: task must be an integer, got 1.5 \(float\)"),
        ({"task_set": 5}, "task_set must be a TaskSet, got int"),
        (
            {"task_set": task_set("point_robot_wind")},
            "task_set belongs to 'point_robot_wind', not to 'point_robot'",
        ),
        ({"render_mode": "human"}, "render_mode must be 'rgb_array' or None, got 'human'"),
    ],
)
@pytest.mark.parametrize("shell", [MetaEnv, MetaVectorEnv])
def test_what_neither_shell_can_be_made_with(
    shell: type, kwargs: dict[str, Any], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        shell(**{"name": "point_robot", **kwargs})


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"tasks": [0, 100]}, "point_robot has tasks 0 to 99, got task=100"),
        ({"tasks": np.array([0, 100])}, "point_robot has tasks 0 to 99, got task=100"),
        ({"tasks": np.array([-1, 1])}, "point_robot has tasks 0 to 99, got task=-1"),
        ({"tasks": np.array([0.0, 1.0])}, "point_robot: task must be an integer, got "),
        ({"tasks": np.array([[0, 1]])}, "point_robot: task must be an integer, got "),
        ({"tasks": [0, 1.0]}, r"point_robot: task must be an integer, got 1.0 \(float\)"),
        ({"tasks": [[0], [1]]}, r"point_robot: task must be an integer, got \[0\] \(list\)"),
        ({"tasks": 7}, "point_robot: tasks must be a sequence of integers, got 7"),
        ({"tasks": "12"}, "point_robot: tasks must be a sequence of integers, got '12'"),
        ({"tasks": []}, "point_robot: tasks is empty; at least one task is needed"),
        ({"tasks": [0, 1], "num_envs": 3}, "num_envs=3 but 2 tasks were given"),
        ({"num_envs": 0}, "num_envs must be an integer of at least 1, got 0"),
        ({"num_envs": 2.0}, "num_envs must be an integer of at least 1, got 2.0"),
        ({"num_envs": True}, "num_envs must be an integer of at least 1, got True"),
        ({"max_episode_steps": 0}, "max_episode_steps must be an integer of at least 1, got 0"),
        ({"max_episode_steps": -1}, "max_episode_steps must be an integer of at least 1, got -1"),
        (
            {"autoreset_mode": "Never"},
            "autoreset_mode must be one of NextStep, SameStep, Disabled, got 'Never'",
        ),
    ],
)
def test_what_the_vector_shell_cannot_be_made_with(kwargs: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        MetaVectorEnv("point_robot", **kwargs)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"tsak": 1}, r"reset has no option 'tsak' \(known: task\)"),
        ({"reset_mask": np.array([True])}, "reset has no option 'reset_mask'"),
        ({"task": 100}, "point_robot has tasks 0 to 99, got task=100"),
        ({"task": None}, "point_robot: task must be an integer, got None"),
        ({"task": [1]}, "point_robot: task must be an integer, got "),
    ],
)
def test_wrong_reset_options(single: MetaEnv, options: dict[str, Any], message: str) -> None:
    single.step(np.ones(2))
    with pytest.raises(ValueError, match=message):
        single.reset(options=options)
    assert single.task == 3


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"options": {"tasks": 1}}, r"no option 'tasks' \(known: task, reset_mask\)"),
        ({"options": {"task": 100}}, "point_robot has tasks 0 to 99, got task=100"),
        ({"options": {"task": [1, 2]}}, "option 'task' needs 3 tasks, got 2"),
        ({"options": {"task": "abc"}}, "point_robot: tasks must be a sequence of integers"),
        ({"options": {"task": None}}, "point_robot: task must be an integer, got None"),
        ({"options": {"task": [[1], [2, 3], [4]]}}, r"task must be an integer, got \[1\]"),
        ({"options": {"reset_mask": [True] * 3}}, r"reset_mask must be a bool array of shape \(3,"),
        ({"options": {"reset_mask": np.ones(3)}}, "reset_mask must be a bool array"),
        ({"options": {"reset_mask": np.ones(2, bool)}}, "reset_mask must be a bool array"),
        ({"options": {"reset_mask": np.zeros(3, bool)}}, "with at least one True, got "),
        ({"seed": [1, 2]}, "seed: 3 are needed, one a sub-environment, got 2"),
        ({"seed": -1}, "seed must be a non-negative integer, got -1"),
        ({"seed": [0, 1, 0.5]}, "seed must be a non-negative integer, got 0.5"),
        ({"seed": "abc"}, "seed must be an integer or one for each sub-environment, got 'abc'"),
        ({"seed": 0.5}, "seed must be an integer or one for each sub-environment, got 0.5"),
    ],
)
def test_wrong_vector_resets(vector: MetaVectorEnv, kwargs: dict[str, Any], message: str) -> None:
    vector.step(np.ones((3, 2)))
    before = vector.state.copy()
    valid: dict[str, Any] = {"options": {"task": 9}} if "seed" in kwargs else {"seed": 1}
    with pytest.raises(ValueError, match=message):
        vector.reset(**{**valid, **kwargs})
    assert vector.tasks.tolist() == [1, 2, 3]
    np.testing.assert_array_equal(vector.state, before)


@pytest.mark.parametrize(
    ("action", "message"),
    [
        (np.zeros(3), r"action must have shape \(2,\), got \(3,\)"),
        (np.zeros((1, 2)), r"action must have shape \(2,\), got \(1, 2\)"),
        (0.5, r"action must have shape \(2,\), got \(\)"),
        (None, r"action must have shape \(2,\), got \(\)"),
        ([0.0, NAN], r"action holds NaN, first at index \(1,\)"),
        (["a", "b"], r"action must be numbers of shape \(2,\), got \['a', 'b'\]"),
        ([[0.0], 1.0], r"action must be numbers of shape \(2,\), got "),
        ({}, r"action must be numbers of shape \(2,\), got \{\}"),
    ],
)
def test_wrong_actions(single: MetaEnv, action: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        single.step(action)
    assert single.step(np.zeros(2))[0].tolist() == [0.0, 0.0]


@pytest.mark.parametrize(
    ("action", "message"),
    [
        (np.zeros(2), r"action must have shape \(3, 2\), got \(2,\)"),
        (np.zeros((2, 2)), r"action must have shape \(3, 2\), got \(2, 2\)"),
        (np.zeros((3, 1)), r"action must have shape \(3, 2\), got \(3, 1\)"),
        ([[0, 0], [0, NAN], [NAN, 0]], r"action holds NaN, first at index \(1, 1\)"),
        ([[0, 0], [0, np.inf], [-np.inf, NAN]], r"action holds NaN, first at index \(2, 1\)"),
    ],
)
def test_wrong_vector_actions(vector: MetaVectorEnv, action: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        vector.step(action)
    assert not vector.step(np.zeros((3, 2)))[0].any()


def test_actions_are_clipped_and_never_the_users_own_array() -> None:
    for dtype in (np.float64, np.float32, np.int64):
        given = np.array([[3, -1], [0, -2]], dtype=dtype)
        checked = check_action(given, (2, 2))
        assert checked.tolist() == [[1.0, -1.0], [0.0, -1.0]]
        assert checked.dtype == np.float64
        assert not np.shares_memory(checked, given)
        assert given.tolist() == [[3, -1], [0, -2]]
    assert check_action([np.inf, -np.inf], (2,)).tolist() == [1.0, -1.0]


def test_seeds_count_up_from_an_integer() -> None:
    assert check_seeds(np.int64(4), 3) == [4, 5, 6]
    assert check_seeds((9, None), 2) == [9, None]


def test_what_needs_a_reset_first() -> None:
    single, vector = MetaEnv("point_robot"), MetaVectorEnv("point_robot", num_envs=2)
    for call in (
        lambda: single.step(np.zeros(2)),
        lambda: vector.step(np.zeros((2, 2))),
        lambda: single.state,
        lambda: vector.state,
        MetaEnv("point_robot", render_mode="rgb_array").render,
        MetaVectorEnv("point_robot", render_mode="rgb_array").render,
    ):
        with pytest.raises(gymnasium.error.ResetNeeded, match=r"call reset\(\)"):
            call()
    with pytest.raises(gymnasium.error.ResetNeeded, match="first reset must reset every"):
        vector.reset(options={"reset_mask": np.array([True, False])})


def test_a_finished_sub_environment_must_be_reset_in_the_disabled_mode() -> None:
    env = MetaVectorEnv("point_robot", num_envs=3, max_episode_steps=2, autoreset_mode="Disabled")
    env.reset()
    env.step(np.zeros((3, 2)))
    env.reset(options={"reset_mask": np.array([False, True, False])})
    env.step(np.zeros((3, 2)))
    with pytest.raises(gymnasium.error.ResetNeeded, match=r"sub-environments \[0, 2\] are over"):
        env.step(np.zeros((3, 2)))
    env.reset(options={"reset_mask": np.array([True, False, True])})
    assert env.step(np.zeros((3, 2)))[3].tolist() == [False, True, False]


def test_render_without_its_mode_says_what_is_missing() -> None:
    for env in (MetaEnv("point_robot"), MetaVectorEnv("point_robot")):
        env.reset()
        with pytest.warns(UserWarning, match="render_mode='rgb_array'"):
            assert env.render() is None


def test_a_task_set_of_ones_own_is_accepted() -> None:
    own = task_set("point_robot")
    few = TaskSet(own.env, own.param_names, own.params[:4], np.array([1]), own.sampler)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env: Any = gymnasium.make("PointRobot-v0", task=3, task_set=few)
    assert env.reset()[1] == {"task": 3}
    with pytest.raises(ValueError, match="point_robot has tasks 0 to 3, got task=4"):
        env.reset(options={"task": 4})
