import numpy as np
import pytest
from numpy.typing import NDArray

from meta_envs import ENVIRONMENTS, TaskSet, task_set
from meta_envs.tasks import interleaved_test_tasks

HASHES = {
    "point_robot": "a453fb994692f0a756485fcec53bae8ba243d66d66be0a9d3443f9cbe442d95f",
    "point_robot_wind": "2e79028263fb6b24a66cd0b617c615571729c5499bd64028f02a126d500ed175",
    "sparse_point_robot": "1134ae62df38d047da872383a7076ee53a8aa34e34d33800db1445f73dbf6958",
}


def small_set(**changes: object) -> TaskSet:
    content: dict[str, object] = {
        "env": "e",
        "param_names": ("a", "b"),
        "params": np.arange(6.0).reshape(3, 2),
        "test_tasks": np.array([1]),
        "sampler": lambda generator, n_tasks: generator.uniform(size=(n_tasks, 2)),
    }
    return TaskSet(**{**content, **changes})  # type: ignore[arg-type]  # wrong types are the test


def test_the_wind_table_is_the_fields() -> None:
    winds = task_set("point_robot_wind").params
    assert winds.shape == (50, 2)
    published = [[-0.0238, 0.0336], [-0.0341, 0.0110], [-0.0222, 0.0065]]
    np.testing.assert_allclose(winds[:3], published, atol=5.1e-5)
    assert np.abs(winds).max() <= 0.05


def test_the_goals_are_at_equal_angles_over_the_half_circle() -> None:
    for name in ("point_robot", "sparse_point_robot"):
        goals = task_set(name).params
        assert goals.shape == (100, 2)
        np.testing.assert_allclose(goals[0], [1.0, 0.0], atol=1e-12)
        np.testing.assert_allclose(goals[99], [-1.0, 0.0], atol=1e-12)
        np.testing.assert_allclose(np.hypot(*goals.T), 1.0, atol=1e-12)
        angles = np.degrees(np.arctan2(goals[1:99, 1], goals[1:99, 0]))
        np.testing.assert_allclose(angles, 180.0 * np.arange(1, 99) / 99, atol=1e-9)


@pytest.mark.parametrize(
    ("n_train", "n_test", "expected"),
    [
        (30, 10, [2, 6, 10, 14, 18, 22, 26, 30, 34, 38]),
        (80, 20, list(range(2, 98, 5))),
        (40, 10, [2, 7, 12, 17, 22, 27, 32, 37, 42, 47]),
    ],
)
def test_the_split_is_the_fields(n_train: int, n_test: int, expected: list[int]) -> None:
    assert interleaved_test_tasks(n_train, n_test).tolist() == expected


@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_the_hash_pins_every_task_set(name: str) -> None:
    assert task_set(name).hash == HASHES[name]


def test_the_hash_sees_every_part() -> None:
    hashes = {
        small_set(**change).hash
        for change in (
            {},
            {"env": "f"},
            {"param_names": ("a", "c")},
            {"params": np.arange(6.0).reshape(3, 2) + 1e-8},
            {"test_tasks": np.array([2])},
        )
    }
    assert len(hashes) == 5
    assert small_set(params=np.arange(6.0).reshape(3, 2) + 1e-13).hash == small_set().hash


@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_train_and_test_tasks_share_nothing_and_are_everything(name: str) -> None:
    tasks = task_set(name)
    assert not set(tasks.train_tasks) & set(tasks.test_tasks)
    assert sorted([*tasks.train_tasks, *tasks.test_tasks]) == list(range(len(tasks)))
    expected = (40, 10) if name == "point_robot_wind" else (80, 20)
    assert (len(tasks.train_tasks), len(tasks.test_tasks)) == expected


@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_a_task_set_cannot_be_written_to(name: str) -> None:
    tasks = task_set(name)
    with pytest.raises(ValueError, match="read-only"):
        tasks.params[0, 0] = 1.0
    with pytest.raises(ValueError, match="read-only"):
        tasks.test_tasks[0] = 1
    with pytest.raises(AttributeError):
        tasks.env = "other"  # type: ignore[misc]  # writing is the test


def test_a_task_set_keeps_its_own_copy() -> None:
    params, rows = np.zeros((3, 2)), np.array([1])
    tasks = small_set(params=params, test_tasks=rows)
    params[:] = 7.0
    rows[:] = 2
    assert not tasks.params.any()
    assert tasks.test_tasks.tolist() == [1]


@pytest.mark.usefixtures("untouched_global_rng")
@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_fresh_tasks_depend_on_the_seed_alone(name: str) -> None:
    tasks = task_set(name)
    fresh = tasks.sample(7, seed=3)
    np.testing.assert_array_equal(fresh.params, tasks.sample(7, seed=3).params)
    assert fresh.hash == tasks.sample(7, seed=3).hash
    assert not np.isin(tasks.sample(7, seed=4).params, fresh.params).any()
    assert fresh.test_tasks.tolist() == list(range(7))
    assert fresh.train_tasks.size == 0
    assert fresh.env == tasks.env
    assert fresh.param_names == tasks.param_names
    assert fresh.sample(5, seed=1).hash == tasks.sample(5, seed=1).hash


def largest_gap(sample: NDArray[np.float64], low: float, high: float) -> float:
    """Kolmogorov's distance between a sample and the uniform distribution on [low, high]."""
    ranks = (np.sort(sample) - low) / (high - low)
    steps = np.arange(len(ranks) + 1) / len(ranks)
    return float(max(np.abs(ranks - steps[:-1]).max(), np.abs(ranks - steps[1:]).max()))


def test_fresh_tasks_are_from_the_same_distribution() -> None:
    n = 4000
    limit = 1.95 / np.sqrt(n)  # exceeded once in a thousand samples
    winds = task_set("point_robot_wind").sample(n, seed=0).params
    assert largest_gap(winds[:, 0], -0.05, 0.05) < limit
    assert largest_gap(winds[:, 1], -0.05, 0.05) < limit
    assert abs(np.mean(winds[:, 0] * winds[:, 1])) < 3 * (0.1**2 / 12) / np.sqrt(n)
    for name in ("point_robot", "sparse_point_robot"):
        goals = task_set(name).sample(n, seed=0).params
        np.testing.assert_allclose(np.hypot(*goals.T), 1.0, atol=1e-12)
        assert largest_gap(np.arctan2(goals[:, 1], goals[:, 0]), 0.0, np.pi) < limit


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"params": np.zeros(3)}, r"e: params must be \[n_tasks, 2\], got \(3,\)"),
        ({"params": np.zeros((3, 1))}, r"e: params must be \[n_tasks, 2\], got \(3, 1\)"),
        ({"params": np.full((3, 2), np.nan)}, "e: params must be finite"),
        ({"test_tasks": np.array([3])}, "e: test_tasks must be sorted rows between 0 and 2"),
        ({"test_tasks": np.array([-1])}, "e: test_tasks must be sorted rows between 0 and 2"),
        ({"test_tasks": np.array([1, 1])}, "e: test_tasks must be sorted rows between 0 and 2"),
        ({"test_tasks": np.array([2, 1])}, "e: test_tasks must be sorted rows between 0 and 2"),
        ({"test_tasks": np.array([[1]])}, "e: test_tasks must be sorted rows between 0 and 2"),
    ],
)
def test_a_faulty_task_set_is_refused(changes: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        small_set(**changes)


@pytest.mark.parametrize(
    ("n_tasks", "seed", "message"),
    [
        (0, 0, "point_robot: n_tasks must be an integer of at least 1, got 0"),
        (2.5, 0, "point_robot: n_tasks must be an integer of at least 1, got 2.5"),
        (True, 0, "point_robot: n_tasks must be an integer of at least 1, got True"),
        (3, -1, "point_robot: seed must be an integer of at least 0, got -1"),
        (3, None, "point_robot: seed must be an integer of at least 0, got None"),
    ],
)
def test_faulty_wishes_for_fresh_tasks_are_refused(n_tasks: int, seed: int, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        task_set("point_robot").sample(n_tasks, seed)


@pytest.mark.parametrize(
    ("task", "message"),
    [
        (50, "point_robot_wind has tasks 0 to 49, got task=50"),
        (-1, "point_robot_wind has tasks 0 to 49, got task=-1"),
        (np.int64(50), "point_robot_wind has tasks 0 to 49, got task=50"),
        (1.0, r"point_robot_wind: task must be an integer, got 1.0 \(float\)"),
        (True, r"point_robot_wind: task must be an integer, got True \(bool\)"),
        ("3", r"point_robot_wind: task must be an integer, got '3' \(str\)"),
        (None, r"point_robot_wind: task must be an integer, got None \(NoneType\)"),
    ],
)
def test_a_wrong_task_is_refused(task: object, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        task_set("point_robot_wind").check_task(task)


def test_a_right_task_comes_back_as_an_int() -> None:
    checked = task_set("point_robot_wind").check_task(np.int32(49))
    assert (checked, type(checked)) == (49, int)
