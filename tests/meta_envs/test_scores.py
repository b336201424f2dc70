import math

import numpy as np
import pytest

from meta_envs import ENVIRONMENTS, MetaEnv, normalized_score, reference_returns, task_set
from tests.meta_envs.robots import POINT_ROBOTS


def random_return(name: str, task: tuple[float, float], seed: int, episodes: int) -> list[float]:
    """Returns of random episodes by a plain loop over scalars, apart from the package's code."""
    generator = np.random.default_rng(seed)
    windy = name == "point_robot_wind"
    (wind_x, wind_y), (goal_x, goal_y) = (task, (1.0, 0.0)) if windy else ((0.0, 0.0), task)
    returns = []
    for _ in range(episodes):
        x = y = total = 0.0
        for a, b in generator.uniform(-1.0, 1.0, (ENVIRONMENTS[name].horizon, 2)):
            x, y = x + 0.1 * a + wind_x, y + 0.1 * b + wind_y
            distance = math.hypot(x - goal_x, y - goal_y)
            sparse = max(0.0, 1.0 - distance / 0.2)
            total += sparse if name == "sparse_point_robot" else -distance
        returns.append(total)
    return returns


@pytest.mark.parametrize("name", POINT_ROBOTS)
def test_the_random_return_is_that_of_random_episodes(name: str) -> None:
    tasks, episodes = task_set(name), 400
    found = reference_returns(tasks)["random"]
    assert found.shape == (len(tasks),)
    for task in (0, 7, len(tasks) - 1):
        x, y = tasks.params[task]
        sample = random_return(name, (float(x), float(y)), task, episodes)
        error = np.std(sample) * math.sqrt(1 / episodes + 1 / 1000)
        assert abs(found[task] - np.mean(sample)) <= 4 * error + 1e-3


def test_references_are_reproducible_and_of_the_tasks_given() -> None:
    tasks = task_set("point_robot_wind")
    first, again = (reference_returns(tasks, episodes=20) for _ in range(2))
    assert list(first) == ["random", "oracle", "wind_blind"]
    for name, values in first.items():
        assert values.dtype == np.float64
        np.testing.assert_array_equal(values, again[name])
    other = reference_returns(tasks, episodes=20, seed=1)
    assert (other["random"] != first["random"]).all()
    np.testing.assert_array_equal(other["oracle"], first["oracle"])
    fresh = tasks.sample(seed=0, n_tasks=6)
    found = reference_returns(fresh, episodes=2)
    left = np.maximum(1.0 - (0.1 + fresh.params[:, 0]) * np.arange(1, 26)[:, None], 0.0)
    np.testing.assert_allclose(found["oracle"], -left.sum(axis=0), atol=1e-9)


@pytest.mark.usefixtures("untouched_global_rng")
def test_references_touch_no_shared_generator() -> None:
    reference_returns(task_set("point_robot"), episodes=2)


def test_a_return_ends_with_its_episode(noisy_robot: str) -> None:
    tasks = task_set(noisy_robot)
    found = reference_returns(tasks, episodes=1)["oracle"]
    lengths = []
    for task in range(len(tasks)):
        env = MetaEnv(noisy_robot, task=task)
        position, _ = env.reset(seed=task)
        rewards: list[float] = []
        terminated = False
        while not terminated and len(rewards) < env.definition.horizon:
            aim = 10.0 * (tasks.params[task] - position)
            position, reward, terminated, _, _ = env.step(aim)
            rewards.append(reward)
        lengths.append(len(rewards))
        assert found[task] == pytest.approx(sum(rewards), abs=1e-5)
    assert len(set(lengths)) > 2


def test_the_normalized_score_by_hand() -> None:
    assert normalized_score(-5.0, -25.0, -5.0) == 100.0
    assert normalized_score(-25.0, -25.0, -5.0) == 0.0
    assert normalized_score(-15.0, -25.0, -5.0) == 50.0
    assert normalized_score(-35.0, -25.0, -5.0) == -50.0
    scores = normalized_score([[1.0, 2.0], [3.0, 4.0]], [0.0, 1.0], [2.0, 5.0])
    np.testing.assert_allclose(scores, [[50.0, 25.0], [150.0, 75.0]])
    assert scores.dtype == np.float64


def test_there_is_no_score_without_a_scale() -> None:
    scores = normalized_score([1.0, 1.0, 1.0], [0.0, 1.0, 2.0], [1.0, 1.0, 1.0])
    np.testing.assert_array_equal(scores, [100.0, np.nan, np.nan])
