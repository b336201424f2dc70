"""The test environment beside the registered ones, for tests that every environment must pass."""

from collections.abc import Iterator

import pytest

from meta_envs.conformance import lent
from meta_envs.conformance.definitions import no_shared_generator
from tests.meta_envs.noisy_robot import ROW
from tests.meta_envs.robots import POINT_ROBOTS


@pytest.fixture
def noisy_robot() -> Iterator[str]:
    """Registers the noisy robot for one test; its short name."""
    with lent(ROW):
        yield ROW.name


@pytest.fixture(params=[*POINT_ROBOTS, ROW.name])
def any_robot(request: pytest.FixtureRequest) -> str:
    """Short name of every point robot in turn, and of the noisy one."""
    name: str = request.param
    if name == ROW.name:
        request.getfixturevalue("noisy_robot")
    return name


@pytest.fixture
def untouched_global_rng() -> Iterator[None]:
    """Fails the test if it draws from, or seeds, a generator that everyone shares."""
    with no_shared_generator():
        yield
