import numpy as np
import pytest

from meta_envs import task_set
from tests.meta_envs.gymnasium_twin import assert_same_state, robot_of, twins

FIELDS = {
    "hopper_mass": ("body_mass", "body_inertia"),
    "hopper_friction": ("geom_friction",),
    "walker_mass": ("body_mass", "body_inertia"),
    "walker_friction": ("geom_friction",),
}


@pytest.mark.parametrize("name", FIELDS)
def test_the_multipliers_are_the_fields(name: str) -> None:
    tasks = task_set(name)
    assert tasks.param_names == (FIELDS[name][0],)
    values = tasks.params[:, 0]
    assert len(values) == 40
    np.testing.assert_allclose(values[[0, -1]], [4 / 9, 9 / 4], rtol=1e-12)
    np.testing.assert_allclose(values[1:] / values[:-1], 1.5 ** (4 / 39), rtol=1e-12)
    assert tasks.test_tasks.tolist() == list(range(2, 40, 4))
    powers = np.log(tasks.sample(seed=1, n_tasks=500).params[:, 0]) / np.log(1.5)
    assert -2.0 <= powers.min() < -1.95
    assert 1.95 < powers.max() <= 2.0


@pytest.mark.parametrize("name", FIELDS)
def test_the_simulator_has_the_tasks_values_and_no_others(name: str) -> None:
    robot, tasks = robot_of(name), task_set(name)
    rows = [0, 19, 39]
    simulation = robot.simulation(3)
    simulation.set_params(tasks.params[rows])
    every = ("body_mass", "body_inertia", "dof_damping", "geom_friction", "body_subtreemass")
    for row, task in enumerate(rows):
        for field in every:
            factor = tasks.params[task, 0] if field in FIELDS[name] else 1.0
            expected = getattr(robot.model, field) * factor
            np.testing.assert_array_equal(getattr(simulation.model(row), field), expected)
            same = robot.task_model(tasks.params[task])
            np.testing.assert_array_equal(getattr(same, field), expected)


@pytest.mark.parametrize("name", FIELDS)
def test_the_multiplier_changes_the_physics(name: str) -> None:
    robot = robot_of(name)
    simulation = robot.simulation(3)
    simulation.set_params(np.array([[1.0], [2.0], [1.0]]))
    state = robot.initial_state([np.random.default_rng(3) for _ in range(3)])
    # Long enough for a foot to come down and to slide.
    for action in np.random.default_rng(4).uniform(-1.0, 1.0, (40, robot.nu)):
        state = simulation.step(state, np.tile(action, (3, 1)))
    assert (state[0] != state[1]).any()
    np.testing.assert_array_equal(state[0], state[2])


@pytest.mark.parametrize(
    ("name", "env_id", "file"),
    [
        ("hopper_mass", "Hopper-v5", "hopper.xml"),
        ("walker_friction", "Walker2d-v5", "walker2d.xml"),
    ],
)
def test_with_a_multiplier_of_one_it_is_gymnasiums(name: str, env_id: str, file: str) -> None:
    robot = robot_of(name)
    for twin in twins(name, env_id, np.ones(1), 40, xml_file=file):
        assert_same_state(robot, twin.next_state, twin.env)
        assert twin.env.dt == pytest.approx(robot.dt)
