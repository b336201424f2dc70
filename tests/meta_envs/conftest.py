"""The test environment beside the registered ones, for tests that every environment must pass."""

import random
from collections.abc import Iterator
from typing import Any

import gymnasium
import numpy as np
import pytest

from meta_envs import ENVIRONMENTS
from tests.meta_envs.noisy_robot import ROW


@pytest.fixture
def noisy_robot(monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """Registers the noisy robot for one test; its short name."""
    monkeypatch.setitem(ENVIRONMENTS, ROW.name, ROW)
    gymnasium.register(
        id=ROW.id,
        entry_point="meta_envs.env:MetaEnv",
        vector_entry_point="meta_envs.env:MetaVectorEnv",
        max_episode_steps=ROW.horizon,
        kwargs={"name": ROW.name},
    )
    yield ROW.name
    del gymnasium.registry[ROW.id]


@pytest.fixture(params=[*ENVIRONMENTS, ROW.name])
def any_env(request: pytest.FixtureRequest) -> str:
    """Short name of every registered environment in turn, and of the noisy robot."""
    name: str = request.param
    if name == ROW.name:
        request.getfixturevalue("noisy_robot")
    return name


def _global_states() -> tuple[Any, ...]:
    numpys: Any = np.random.get_state()  # noqa: NPY002 - only looked at
    return (
        random.getstate(),
        *(part.tolist() if n == 1 else part for n, part in enumerate(numpys)),
    )


@pytest.fixture
def untouched_global_rng() -> Iterator[None]:
    """Fails the test if it draws from, or seeds, a generator that everyone shares."""
    kept = random.getstate(), np.random.get_state()  # noqa: NPY002 - put back below
    # A state no code would set, for else one that seeds it again and again would go unseen.
    random.seed(918273645)
    np.random.seed(918273645)  # noqa: NPY002 - the shared generator is the one under test
    before = _global_states()
    yield
    after = _global_states()
    random.setstate(kept[0])
    np.random.set_state(kept[1])  # noqa: NPY002 - as it was
    assert after == before
