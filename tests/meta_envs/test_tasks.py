import copy
import pickle
import re
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from meta_envs import ENVIRONMENTS, TaskSet, task_set
from meta_envs.tasks import Split, interleaved_test_tasks

HASHES = {
    "point_robot": "a453fb994692f0a756485fcec53bae8ba243d66d66be0a9d3443f9cbe442d95f",
    "point_robot_wind": "2e79028263fb6b24a66cd0b617c615571729c5499bd64028f02a126d500ed175",
    "sparse_point_robot": "1134ae62df38d047da872383a7076ee53a8aa34e34d33800db1445f73dbf6958",
    "half_cheetah_vel": "db153c0cc6a9e90497d72f7415b3757aed46924dc6e454418711937c329313e6",
    "hopper_params": "3d12c5dd927873b719b5c36e1fa1b8b90e1c193da9c054b9209d4fde8d13ba6f",
    "walker_params": "76a92fe4cbfdd4f8edbfb2e6a1b5d6863b45ca44c29e1a81fff1f55fc8bf1f26",
    "ant_goal": "35a9e4f284bb3b9f6f350b9e64b25650c662dfc31cb889301e14ee815bc504a2",
    "half_cheetah_dir": "afd31fc45aabc5ba593c6f37dba35d8966b85eb0592c63c65b685a55d274c808",
    "ant_dir": "2820747fc72f38f369e5b3738ae4caaa78cf036d04cf83ea05024644b8d0bbcc",
    "humanoid_dir": "b5c4667b1d1e2119fe6600bf6e97accc66855da8f96f97aa58ababf3044e095b",
    "hopper_mass": "29a23042443931bf7da25847124de13fd506a47a6a32dd8e9988a6eda4883724",
    "hopper_friction": "b28b094a0427504c72fa31adf51432ae4ba854dbad2bf6a239d0b725a0bc1200",
    "walker_mass": "b2b86d0eb2edb4e296f76a8a413e1dac3c87413b259560cfee4c10563eae57bc",
    "walker_friction": "cdafcd4f89b0d9ed6fbf2de30647564d54138aa8015a5df6869cb30899fd4c65",
}
SIZES = {"point_robot_wind": (40, 10), "half_cheetah_dir": (2, 2)}
SIZES |= dict.fromkeys(("point_robot", "sparse_point_robot", "half_cheetah_vel"), (80, 20))
"""Training and test tasks of the default split, where they are not 30 and 10."""


def uniform(generator: np.random.Generator, n_tasks: int) -> NDArray[np.float64]:
    return generator.uniform(size=(n_tasks, 2))


def small_set(**changes: object) -> TaskSet:
    content: dict[str, object] = {
        "env": "e",
        "param_names": ("a", "b"),
        "params": np.arange(6.0).reshape(3, 2),
        "test_tasks": np.array([1]),
        "sampler": uniform,
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
    assert (len(tasks.train_tasks), len(tasks.test_tasks)) == SIZES.get(name, (30, 10))
    assert set(tasks.train_tasks) | set(tasks.test_tasks) == set(range(len(tasks)))
    # Of two directions, both are for training and for the test.
    shared = {0, 1} if name == "half_cheetah_dir" else set()
    assert set(tasks.train_tasks) & set(tasks.test_tasks) == shared


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
    fresh = tasks.sample(seed=3, n_tasks=7)
    np.testing.assert_array_equal(fresh.params, tasks.sample(seed=3, n_tasks=7).params)
    assert fresh.hash == tasks.sample(seed=3, n_tasks=7).hash
    other = tasks.sample(seed=4, n_tasks=7).params
    assert (other != fresh.params).any()
    # There are but two directions of the half-cheetah.
    assert np.isin(other, fresh.params).any() == (name == "half_cheetah_dir")
    assert fresh.test_tasks.tolist() == list(range(7))
    assert fresh.train_tasks.size == 0
    assert fresh.env == tasks.env
    assert fresh.param_names == tasks.param_names
    assert fresh.sample(seed=1, n_tasks=5).hash == tasks.sample(seed=1, n_tasks=5).hash


def largest_gap(sample: NDArray[np.float64], low: float, high: float) -> float:
    """Kolmogorov's distance between a sample and the uniform distribution on [low, high]."""
    ranks = (np.sort(sample) - low) / (high - low)
    steps = np.arange(len(ranks) + 1) / len(ranks)
    return float(max(np.abs(ranks - steps[:-1]).max(), np.abs(ranks - steps[1:]).max()))


def test_fresh_tasks_are_from_the_same_distribution() -> None:
    n = 4000
    limit = 1.95 / np.sqrt(n)  # exceeded once in a thousand samples
    winds = task_set("point_robot_wind").sample(seed=0, n_tasks=n).params
    assert largest_gap(winds[:, 0], -0.05, 0.05) < limit
    assert largest_gap(winds[:, 1], -0.05, 0.05) < limit
    assert abs(np.mean(winds[:, 0] * winds[:, 1])) < 3 * (0.1**2 / 12) / np.sqrt(n)
    for name in ("point_robot", "sparse_point_robot"):
        goals = task_set(name).sample(seed=0, n_tasks=n).params
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
        (
            {"splits": {"far": Split(np.array([0, 0]), np.array([1]))}},
            "e: train_tasks of split 'far' must be sorted rows between 0 and 2",
        ),
        (
            {"splits": {"far": Split(np.array([0]), np.array([3]))}},
            "e: test_tasks of split 'far' must be sorted rows between 0 and 2",
        ),
        ({"bounds": {"c": (0.0, 1.0)}}, r"e: no task parameter 'c' \(known: a, b\)"),
        ({"choices": {"c": (0.0,)}}, r"e: no task parameter 'c' \(known: a, b\)"),
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
        task_set("point_robot").sample(seed, n_tasks)


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


def rows(*numbers: int) -> NDArray[np.int64]:
    return np.array(numbers, dtype=np.int64)


def test_every_task_set_has_the_default_split() -> None:
    tasks = small_set()
    assert list(tasks.splits) == ["interpolate"]
    assert tasks.splits["interpolate"].train_tasks.tolist() == tasks.train_tasks.tolist() == [0, 2]
    assert tasks.splits["interpolate"].test_tasks.tolist() == tasks.test_tasks.tolist() == [1]
    assert list(tasks.sample(seed=0, n_tasks=2).splits) == ["interpolate"]


def test_a_split_need_not_hold_every_task() -> None:
    tasks = small_set(splits={"extrapolate": Split(rows(1), rows(0))})
    assert list(tasks.splits) == ["interpolate", "extrapolate"]
    assert tasks.train_tasks.tolist() == [0, 2]
    outer = tasks.splits["extrapolate"]
    assert (outer.train_tasks.tolist(), outer.test_tasks.tolist()) == ([1], [0])
    assert outer.train_tasks.dtype == outer.test_tasks.dtype == np.int64


def test_the_default_split_can_train_on_what_it_tests() -> None:
    both = Split(rows(0, 1), rows(0, 1))
    tasks = small_set(test_tasks=rows(0, 1), splits={"interpolate": both})
    assert tasks.train_tasks.tolist() == tasks.test_tasks.tolist() == [0, 1]
    with pytest.raises(ValueError, match="e: test_tasks are not those of split 'interpolate'"):
        small_set(test_tasks=rows(1), splits={"interpolate": both})


def test_splits_bounds_and_choices_cannot_be_written_to() -> None:
    given = rows(1)
    tasks = small_set(
        splits={"extrapolate": Split(given, rows(0))},
        bounds={"a": (0.0, 9.0)},
        choices={"b": (1.0, 3.0, 5.0)},
    )
    given[:] = 2
    assert tasks.splits["extrapolate"].train_tasks.tolist() == [1]
    copied: Any
    for copied in (tasks, copy.deepcopy(tasks), pickle.loads(pickle.dumps(tasks))):
        assert copied.hash == tasks.hash
        assert copied.bounds == {"a": (0.0, 9.0)}
        assert copied.choices == {"b": (1.0, 3.0, 5.0)}
        for mapping in (copied.splits, copied.bounds, copied.choices):
            with pytest.raises(TypeError, match="does not support item assignment"):
                mapping["a"] = 1
        arrays = [copied.params, copied.test_tasks]
        for split in (*copied.splits.values(), copy.deepcopy(copied.splits["extrapolate"])):
            arrays += [split.train_tasks, split.test_tasks]
        for array in arrays:
            with pytest.raises(ValueError, match="read-only"):
                array[0] = 1


def test_the_hash_sees_every_split_but_the_plain_default() -> None:
    rest = Split(rows(0, 2), rows(1))
    assert small_set(splits={"interpolate": rest}).hash == small_set().hash
    hashes = {
        small_set(splits=splits).hash
        for splits in (
            {},
            {"interpolate": Split(rows(0), rows(1))},
            {"extrapolate": Split(rows(1), rows(0))},
            {"extrapolate": Split(rows(1), rows(0, 2))},
            {"other": Split(rows(1), rows(0))},
        )
    }
    assert len(hashes) == 5


def test_bounds_hold_for_every_task() -> None:
    bounds = {"a": (0.0, 4.0)}
    tasks = small_set(bounds=bounds)
    message = "e: task parameter a must be between 0 and 4, got 4.5"
    with pytest.raises(ValueError, match=message):
        small_set(bounds=bounds, params=np.array([[1.0, 9.0], [4.5, 9.0]]), test_tasks=rows(0))
    with pytest.raises(ValueError, match=message):
        tasks.with_params({"a": 4.5, "b": 9.0})
    with pytest.raises(ValueError, match=r"e: task parameter a must be between 0 and 4, got -0\.1"):
        tasks.with_params({"a": -0.1, "b": 9.0})
    assert tasks.with_params({"a": 4.0, "b": 9.0}).bounds == bounds
    with pytest.raises(ValueError, match="e: task parameter a must be between 0 and 4, got 7"):
        small_set(bounds=bounds, sampler=lambda generator, n: np.full((n, 2), 7.0)).sample(
            seed=0, n_tasks=1
        )


def test_a_parameter_with_choices_has_no_other_value() -> None:
    choices = {"a": (0.0, 2.0, 4.0)}
    tasks = small_set(choices=choices)
    assert tasks.with_params({"a": 4, "b": 9.0}).choices == choices
    message = "e: task parameter a must be 0 or 2 or 4, got 1"
    with pytest.raises(ValueError, match=message):
        tasks.with_params({"a": 1.0, "b": 9.0})
    with pytest.raises(ValueError, match=message):
        small_set(choices=choices, params=np.array([[0.0, 0.0], [1.0, 0.0]]))
    sampled = small_set(choices=choices, sampler=lambda generator, n: np.full((n, 2), 1.0))
    with pytest.raises(ValueError, match=message):
        sampled.sample(seed=0, n_tasks=1)


def test_of_one_task_it_is_said_that_there_is_no_other() -> None:
    one = task_set("point_robot").with_params({"goal_x": 0.0, "goal_y": 1.0})
    with pytest.raises(ValueError, match=r"^point_robot has only task 0 here, got task=3$"):
        one.check_task(3)


def test_of_many_parameters_a_message_lists_a_few() -> None:
    names = tuple(f"p{number}" for number in range(10))
    tasks = TaskSet("e", names, np.zeros((1, 10)), rows(0), uniform)
    few = "p0, p1, p2, p3, p4, p5 and 4 more of TaskSet.param_names"
    for given, message in (
        ({"q": 1.0}, f"e: no task parameter 'q' (known: {few})"),
        ({"p9": 1.0}, "e: task_params lacks p0, p1, p2, p3, p4, p5 and 3 more of "),
        ({"p9": 1.0}, f" (needed: {few})"),
    ):
        with pytest.raises(ValueError, match=re.escape(message)):
            tasks.with_params(given)


def test_tasks_of_ones_own() -> None:
    tasks = task_set("point_robot")
    one = tasks.with_params({"goal_y": 0.75, "goal_x": np.float64(0.5)})
    assert one.params.tolist() == [[0.5, 0.75]]
    assert one.test_tasks.tolist() == [0]
    assert one.train_tasks.size == 0
    assert (one.env, one.param_names) == (tasks.env, tasks.param_names)
    others: Any = [{"goal_x": 0, "goal_y": 1}, {"goal_x": np.float32(-1), "goal_y": np.int64(2)}]
    two = tasks.with_params(others)
    assert two.params.tolist() == [[0.0, 1.0], [-1.0, 2.0]]
    assert two.test_tasks.tolist() == [0, 1]
    assert one.sample(seed=1, n_tasks=3).hash == tasks.sample(seed=1, n_tasks=3).hash


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (
            {"gaol_x": 1.0, "goal_y": 0.0},
            r"point_robot: no task parameter 'gaol_x'; did you mean 'goal_x'\? "
            r"\(known: goal_x, goal_y\)",
        ),
        ({"mass": 1.0}, r"point_robot: no task parameter 'mass' \(known: goal_x, goal_y\)"),
        ({3: 1.0}, r"point_robot: no task parameter '3' \(known: goal_x, goal_y\)"),
        (
            {"goal_x": 1.0},
            r"point_robot: task_params lacks goal_y \(needed: goal_x, goal_y\)",
        ),
        ({}, r"point_robot: task_params lacks goal_x, goal_y \(needed: goal_x, goal_y\)"),
        (
            {"goal_x": float("nan"), "goal_y": 0.0},
            "point_robot: task parameter goal_x must be a finite number, got nan",
        ),
        ({"goal_x": 0.0, "goal_y": np.inf}, "parameter goal_y must be a finite number, got inf"),
        ({"goal_x": 0.0, "goal_y": 10**400}, "goal_y must be a finite number, got 1000"),
        ({"goal_x": "1", "goal_y": 0.0}, "goal_x must be a finite number, got '1'"),
        ({"goal_x": True, "goal_y": 0.0}, "goal_x must be a finite number, got True"),
        ({"goal_x": [1.0], "goal_y": 0.0}, r"goal_x must be a finite number, got \[1.0\]"),
        (5, "point_robot: task_params must be a mapping from goal_x, goal_y to numbers, or"),
        ("ab", "point_robot: task_params must be a mapping from goal_x, goal_y to numbers, or"),
        ([], r"point_robot: task_params must be a mapping from .*, got \[\]"),
        ([{"goal_x": 0.0, "goal_y": 0.0}, 3], "point_robot: task_params must be a mapping, got 3"),
    ],
)
def test_wrong_tasks_of_ones_own_are_refused(given: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        task_set("point_robot").with_params(given)
