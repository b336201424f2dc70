import numpy as np
import pytest

from meta_envs import task_set
from meta_envs.splits import outer_splits


def test_forty_tasks_are_split_as_in_the_field() -> None:
    splits = outer_splits(40)
    assert list(splits) == ["extrapolate", "moderate", "extreme"]
    for split in splits.values():
        assert split.train_tasks.tolist() == list(range(10, 30))
    assert splits["moderate"].test_tasks.tolist() == [*range(5, 10), *range(30, 35)]
    assert splits["extreme"].test_tasks.tolist() == [*range(5), *range(35, 40)]
    assert splits["extrapolate"].test_tasks.tolist() == [*range(10), *range(30, 40)]


@pytest.mark.parametrize("n_tasks", [8, 41, 100])
def test_the_test_is_outside_of_the_training_on_both_sides(n_tasks: int) -> None:
    splits = outer_splits(n_tasks)
    train = splits["extrapolate"].train_tasks
    assert train.tolist() == list(range(train[0], train[-1] + 1))
    assert train[0] == n_tasks - 1 - train[-1] == n_tasks // 4
    parts = [splits[name].test_tasks for name in ("moderate", "extreme")]
    np.testing.assert_array_equal(np.sort(np.concatenate(parts)), splits["extrapolate"].test_tasks)
    everything = np.concatenate([train, *parts])
    assert sorted(everything.tolist()) == list(range(n_tasks))


def test_who_has_them() -> None:
    names = ("half_cheetah_vel", "ant_dir", "humanoid_dir", "hopper_mass", "walker_friction")
    for name in names:
        assert list(task_set(name).splits)[1:] == ["extrapolate", "moderate", "extreme"]
    for name in ("hopper_params", "walker_params", "ant_goal", "half_cheetah_dir", "point_robot"):
        assert list(task_set(name).splits) == ["interpolate"]
