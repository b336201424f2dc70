import itertools
import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from meta_envs import ENVIRONMENTS, MetaEnv, MetaVectorEnv, TaskSet, reference_returns, task_set
from meta_envs.definition import Controller
from meta_envs.registry import definition
from tests.meta_envs.robots import POINT_ROBOTS

Floats = NDArray[np.float64]


def hand_step(
    name: str, x: float, y: float, action: tuple[float, float], task: tuple[float, float]
) -> tuple[float, float, float, float]:
    """The definition in scalars: the next position, the reward and the distance."""
    a, b = (min(max(one, -1.0), 1.0) for one in action)
    windy = name == "point_robot_wind"
    (wind_x, wind_y), (goal_x, goal_y) = (task, (1.0, 0.0)) if windy else ((0.0, 0.0), task)
    x, y = x + a / 10 + wind_x, y + b / 10 + wind_y
    distance = math.sqrt((x - goal_x) ** 2 + (y - goal_y) ** 2)
    if name == "sparse_point_robot":
        return x, y, (0.2 - distance) / 0.2 if distance <= 0.2 else 0.0, distance
    return x, y, -distance, distance


@pytest.mark.parametrize("name", POINT_ROBOTS)
def test_every_step_is_the_hand_written_one(name: str) -> None:
    generator = np.random.default_rng(1)
    successes = 0
    for task in generator.integers(len(task_set(name)), size=12):
        env = MetaEnv(name, task=int(task))
        params = task_set(name).params[task]
        aim = np.array([1.0, 0.0]) if name == "point_robot_wind" else params
        x = y = 0.0
        obs, _ = env.reset()
        assert obs.tolist() == [0.0, 0.0]
        for _ in range(env.definition.horizon):
            # Towards the goal with noise, so that both sides of its radius are seen.
            action = 10 * (aim - [x, y]) + generator.normal(0.0, 0.7, 2)
            x, y, reward, distance = hand_step(name, x, y, tuple(action), tuple(params))
            obs, given, terminated, truncated, info = env.step(action)
            np.testing.assert_allclose(obs, [x, y], rtol=1e-6, atol=1e-7)
            assert given == pytest.approx(reward, abs=1e-12)
            assert info["distance"] == pytest.approx(distance, abs=1e-12)
            assert info["is_success"] is (distance <= 0.2)
            assert info.get("dense_reward", -distance) == pytest.approx(-distance, abs=1e-12)
            assert not terminated
            assert not truncated
            successes += info["is_success"]
    assert 10 < successes < 12 * 18


def test_the_wind_blows_from_the_first_step_on() -> None:
    env = MetaVectorEnv("point_robot_wind", tasks=range(50))
    env.reset()
    obs, reward, *_ = env.step(np.zeros((50, 2)))
    wind = task_set("point_robot_wind").params
    np.testing.assert_array_equal(obs, wind.astype(np.float32))
    np.testing.assert_allclose(reward, -np.hypot(wind[:, 0] - 1.0, wind[:, 1]), atol=1e-12)


def test_the_sparse_reward_at_known_distances() -> None:
    env = MetaEnv("sparse_point_robot", task=0)
    env.reset()
    rewards = [env.step([1.0, 0.0])[1] for _ in range(13)]
    expected = [0, 0, 0, 0, 0, 0, 0, 0, 0.5, 1, 0.5, 0, 0]
    np.testing.assert_allclose(rewards, expected, atol=1e-12)
    env.reset()
    env.step([0.5, 0.0])
    for _ in range(8):
        last = env.step([1.0, 0.0])
    assert last[1] == pytest.approx(0.25)
    assert last[4]["dense_reward"] == pytest.approx(-0.15)


def episode_returns(tasks: TaskSet, controller: Controller, steps: int | None = None) -> Floats:
    env = MetaVectorEnv(tasks.env, tasks=range(len(tasks)), task_set=tasks, max_episode_steps=steps)
    env.reset()
    total = np.zeros(len(tasks))
    for _ in range(env.horizon):
        total += env.step(controller(env.state, env.params))[1]
    return total


def straight(state: Floats, params: Floats) -> Floats:
    """To the goal on a straight line, a tenth a step."""
    offset = params - state
    share: Floats = np.minimum(1.0, 0.1 / np.maximum(np.hypot(*offset.T), 1e-12))
    return 10.0 * offset * share[:, None]


def straight_fast(state: Floats, params: Floats) -> Floats:
    """To the goal on a straight line, a tenth a step on the larger axis."""
    offset = params - state
    share: Floats = np.minimum(1.0, 0.1 / np.maximum(np.abs(offset).max(axis=1), 1e-12))
    return 10.0 * offset * share[:, None]


def mean_reference(name: str, controller: str, rows: Any = slice(None)) -> float:
    return float(reference_returns(task_set(name), episodes=1)[controller][rows].mean())


def test_the_anchors_of_the_point_robot() -> None:
    tasks = task_set("point_robot")
    assert mean_reference("point_robot", "oracle") == pytest.approx(-3.85, abs=0.01)
    assert episode_returns(tasks, straight).mean() == pytest.approx(-4.50, abs=0.01)
    assert episode_returns(tasks, straight_fast).mean() == pytest.approx(-4.02, abs=0.01)


def test_the_anchors_of_the_sparse_robot() -> None:
    assert mean_reference("sparse_point_robot", "oracle") == pytest.approx(12.47, abs=0.01)
    angles = np.linspace(0.0, np.pi, 40)
    goals = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    own = task_set("sparse_point_robot")
    forty = TaskSet(own.env, own.param_names, goals, np.array([2]), own.sampler)
    oracle = reference_returns(forty, episodes=1)["oracle"]
    assert oracle.mean() == pytest.approx(12.46, abs=0.01)


def test_the_anchors_of_the_wind_robot() -> None:
    tasks = task_set("point_robot_wind")
    made = definition("point_robot_wind")
    for rows, oracle, blind in (
        (slice(None), -5.11, -5.65),
        (tasks.test_tasks, -5.50, -6.07),
        (tasks.train_tasks, -5.02, -5.54),
    ):
        found = mean_reference("point_robot_wind", "oracle", rows)
        assert found == pytest.approx(oracle, abs=0.01)
        found = mean_reference("point_robot_wind", "wind_blind", rows)
        assert found == pytest.approx(blind, abs=0.01)
    short = {name: episode_returns(tasks, made.controllers[name], 20) for name in made.controllers}
    assert short["oracle"].mean() == pytest.approx(-5.11, abs=0.01)
    assert short["wind_blind"].mean() == pytest.approx(-5.46, abs=0.01)


def test_the_optimum_has_a_closed_form() -> None:
    """Each axis closes its distance at its top speed, so the distance at each step is known."""
    steps = np.arange(1, 21)[:, None, None]
    left = np.maximum(np.abs(task_set("point_robot").params) - 0.1 * steps, 0.0)
    expected = -np.sqrt((left**2).sum(axis=2)).sum(axis=0)
    found = reference_returns(task_set("point_robot"), episodes=1)["oracle"]
    np.testing.assert_allclose(found, expected, atol=1e-9)

    winds = task_set("point_robot_wind").params
    left = np.maximum(1.0 - (0.1 + winds[:, 0]) * np.arange(1, 26)[:, None], 0.0)
    found = reference_returns(task_set("point_robot_wind"), episodes=1)["oracle"]
    np.testing.assert_allclose(found, -left.sum(axis=0), atol=1e-9)


def returns_of(name: str, start: Floats, task: int, sequences: Floats) -> Floats:
    """Returns [n] of action sequences [n, steps, 2] from one state on one task."""
    made, params = definition(name), task_set(name).params[task : task + 1]
    state = np.repeat(start[None], len(sequences), axis=0)
    params = np.repeat(params, len(sequences), axis=0)
    total = np.zeros(len(sequences))
    for step in range(sequences.shape[1]):
        moved = made.advance(state, sequences[:, step], params)
        total += made.reward(state, sequences[:, step], moved, params)[0]
        state = moved
    return total


def oracle_sequence(name: str, start: Floats, task: int, steps: int) -> Floats:
    made, params = definition(name), task_set(name).params[task : task + 1]
    state, actions = start[None], []
    for _ in range(steps):
        actions.append(made.controllers["oracle"](state, params))
        state = made.advance(state, actions[-1], params)
    return np.stack(actions, axis=1)


@pytest.mark.parametrize("name", POINT_ROBOTS)
def test_no_sequence_on_a_grid_beats_the_optimum(name: str) -> None:
    grid = np.array(list(itertools.product(np.linspace(-1.0, 1.0, 5), repeat=2)))
    three = np.array(list(itertools.product(grid, repeat=3)))
    assert three.shape == (25**3, 3, 2)
    generator = np.random.default_rng(2)
    for task in generator.integers(len(task_set(name)), size=5):
        made, params = definition(name), task_set(name).params[task : task + 1]
        goal = np.array([1.0, 0.0]) if name == "point_robot_wind" else params[0]
        for start in (np.zeros(2), goal + generator.uniform(-0.25, 0.25, 2)):
            best = returns_of(name, start, task, oracle_sequence(name, start, task, 3))[0]
            rivals = returns_of(name, start, task, three)
            assert rivals.max() <= best + 1e-12
            assert rivals.min() < best - 0.1 or made.sparse
            # The grid comes near the optimum, so beating it means something.
            assert rivals.max() > best - 0.25 * (5 if made.sparse else 1)


@pytest.mark.parametrize("name", POINT_ROBOTS)
def test_no_perturbation_improves_the_optimum(name: str) -> None:
    generator = np.random.default_rng(3)
    steps = ENVIRONMENTS[name].horizon
    for task in range(0, len(task_set(name)), 5):
        optimum = oracle_sequence(name, np.zeros(2), task, steps)
        best = returns_of(name, np.zeros(2), task, optimum)[0]
        scale = 10 ** generator.uniform(-4, 0, (400, 1, 1))
        where = generator.uniform(size=(400, steps, 1)) < generator.uniform(size=(400, 1, 1))
        rivals = optimum + scale * where * generator.normal(size=(400, steps, 2))
        found = returns_of(name, np.zeros(2), task, np.clip(rivals, -1.0, 1.0))
        assert found.max() <= best + 1e-12
        assert found.min() < best - 0.1


def test_an_unknown_wind_costs_the_wind_blind_controller() -> None:
    found = reference_returns(task_set("point_robot_wind"), episodes=1)
    assert (found["wind_blind"] <= found["oracle"] + 1e-12).all()
    calm = np.zeros((1, 2))
    own = task_set("point_robot_wind")
    still = TaskSet(own.env, own.param_names, calm, np.array([0]), own.sampler)
    found = reference_returns(still, episodes=1)
    assert found["wind_blind"] == pytest.approx(found["oracle"])
