import copy

import numpy as np
import pytest

from meta_envs import task_set
from meta_envs.registry import definition
from tests.meta_envs.robots import POINT_ROBOTS


@pytest.mark.parametrize("name", POINT_ROBOTS)
def test_without_a_simulator_a_simulation_is_the_definitions_own_step(name: str) -> None:
    made, tasks = definition(name), task_set(name)
    generator = np.random.default_rng(0)
    state, action = generator.uniform(-1.0, 1.0, (2, 3, 2))
    first, second = made.simulation(3), made.simulation(3, threads=2)
    first.set_params(tasks.params[:3])
    second.set_params(tasks.params[3:6])
    for simulation, params in ((first, tasks.params[:3]), (second, tasks.params[3:6])):
        expected = made.advance(state, action, params)
        np.testing.assert_array_equal(simulation.step(state, action), expected)
        some = simulation.step(state, action, np.array([True, False, True]))
        np.testing.assert_array_equal(some[[0, 2]], expected[[0, 2]])
        assert np.isfinite(some).all()
    first.set_params(tasks.params[3:6])
    np.testing.assert_array_equal(first.step(state, action), expected)


def test_copies_of_an_environment_share_its_definition() -> None:
    made = definition("point_robot")
    assert copy.deepcopy(made) is made
    assert copy.deepcopy([made.simulation(1)])[0] is not made.simulation(1)
