import numpy as np

from meta_envs.directions import along, arrow, circle, directions


def test_angles_are_equal_and_leave_out_the_end() -> None:
    np.testing.assert_allclose(circle(4), [0.0, np.pi / 2, np.pi, 1.5 * np.pi])
    assert len(circle(40)) == 40


def test_directions_have_the_splits_of_the_field() -> None:
    tasks = directions("ant_dir")
    assert (tasks.env, tasks.param_names) == ("ant_dir", ("direction",))
    np.testing.assert_array_equal(tasks.params[:, 0], circle(40))
    assert tasks.test_tasks.tolist() == list(range(2, 40, 4))
    assert tasks.splits["extrapolate"].train_tasks.tolist() == list(range(10, 30))
    fresh = tasks.sample(seed=0, n_tasks=1000).params[:, 0]
    assert 0.0 <= fresh.min() < 0.05
    assert 2 * np.pi - 0.05 < fresh.max() <= 2 * np.pi
    # Uniform all around, so that they cancel out.
    assert np.hypot(np.cos(fresh).mean(), np.sin(fresh).mean()) < 0.1


def test_the_part_along_a_direction() -> None:
    angles = np.array([0.0, np.pi / 2, np.pi, np.pi / 6])
    moved = np.array([[3.0, 4.0]] * 4)
    expected = [3.0, 4.0, -3.0, 3.0 * np.sqrt(3) / 2 + 2.0]
    np.testing.assert_allclose(along(angles, moved), expected, atol=1e-12)
    alone = [along(angles[i : i + 1], moved[i : i + 1])[0] for i in range(4)]
    np.testing.assert_array_equal(along(angles, moved), alone)


def test_a_marker_points_along() -> None:
    marker = arrow(np.pi / 2)
    assert marker.kind == "direction"
    np.testing.assert_allclose(marker.vector, [0.0, 1.0, 0.0], atol=1e-12)
