import numpy as np

from meta_envs import MetaEnv, resolve
from meta_envs.commands.episode import pictures, who_acts


def test_pictures_are_of_the_first_the_last_and_every_so_many_steps() -> None:
    row = resolve("point_robot_wind")
    every = list(pictures(row, 3, every=1))
    assert len(every) == 26
    fourth = list(pictures(row, 3, every=4))
    assert len(fourth) == 8
    for found, expected in zip(fourth, [*every[::4], every[25]], strict=True):
        np.testing.assert_array_equal(found, expected)
    (last,) = pictures(row, 3)
    np.testing.assert_array_equal(last, every[25])
    (early,) = pictures(row, 3, steps=10)
    np.testing.assert_array_equal(early, every[10])


def test_the_optimum_acts() -> None:
    row = resolve("point_robot_wind")
    env = MetaEnv("point_robot_wind", task=3, render_mode="rgb_array")
    env.reset()
    wind = env.task_set.params[3]
    position = np.zeros(2, dtype=np.float32)
    for _ in range(25):
        position, *_ = env.step(10.0 * ([1.0, 0.0] - wind - position))
    (last,), expected = pictures(row, 3), env.render()
    assert expected is not None
    assert np.abs(last.astype(int) - expected).mean() < 0.1
    assert who_acts(row, 5) == "the optimum's episode"


def test_an_episode_that_ends_early_has_its_last_picture(noisy_robot: str) -> None:
    found = list(pictures(resolve(noisy_robot), 0, every=1))
    assert len(found) <= 10
    assert (found[0] != found[-1]).any()


def test_without_an_optimum_actions_are_random() -> None:
    assert who_acts(resolve("ant_goal"), 5) == "an episode of random actions (seed 5)"
