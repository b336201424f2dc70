"""The contract: every conformance check on every registered environment, none of them named."""

import pytest

from meta_envs import ENVIRONMENTS
from meta_envs.conformance import CHECKS, NotApplicableError, episodes, subject
from meta_envs.conformance.checklist import Check
from tests.meta_envs import opengl

NOISY_ROBOT = "tests.meta_envs.noisy_robot:NoisyRobot"
"""With what a registered one may lack: random starts and episodes that end early."""


@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__)
@pytest.mark.parametrize("env", [*ENVIRONMENTS, NOISY_ROBOT])
def test_every_environment_keeps_the_contract(env: str, check: Check) -> None:
    with subject(env) as checked:
        try:
            check(checked)
        except NotApplicableError:
            # Nothing else may be left out of what is registered.
            if check is not episodes.pictures_are_arrays or not opengl.reason():
                raise
            pytest.skip(opengl.reason())


@pytest.mark.parametrize("env", [NOISY_ROBOT, "point_robot", "point_robot_wind"])
def test_many_sub_environments_equal_single_ones_bit_for_bit(env: str) -> None:
    with subject(env) as checked:
        episodes.vector_equals_single(checked, num_envs=100)
