import subprocess
import sys

import gymnasium
import pytest

from meta_envs import ENVIRONMENTS, MetaEnv, MetaVectorEnv, resolve, task_set
from meta_envs.registry import definition


@pytest.mark.parametrize(
    "spelling",
    [
        "point_robot_wind",
        "PointRobotWind-v0",
        "PointRobotWind",
        "point-robot-wind",
        "POINTROBOTWIND-V0",
        "  point_robot_wind ",
    ],
)
def test_an_environment_has_many_spellings(spelling: str) -> None:
    assert resolve(spelling).name == "point_robot_wind"
    assert task_set(spelling) is task_set("point_robot_wind")
    assert definition(spelling) is definition("point_robot_wind")
    assert MetaEnv(spelling).definition.name == "point_robot_wind"


def test_every_spelling_is_of_one_environment_only() -> None:
    for row in ENVIRONMENTS.values():
        for spelling in (row.name, row.id, row.alias):
            assert resolve(spelling) is row


@pytest.mark.parametrize(
    ("typo", "nearest"),
    [
        ("point_robt", "point_robot"),
        ("PointRobotWindy-v0", "point_robot_wind"),
        ("PointRobotWind-v1", "point_robot_wind"),
        ("sparse_robot", "sparse_point_robot"),
        ("spars-point-robot", "sparse_point_robot"),
    ],
)
def test_a_typo_is_told_the_nearest_name(typo: str, nearest: str) -> None:
    with pytest.raises(ValueError, match=f"no environment '{typo}'; did you mean '{nearest}'?"):
        resolve(typo)


@pytest.mark.parametrize("name", ["", "zzz", "cartpole"])
def test_what_is_near_nothing_is_told_every_name(name: str) -> None:
    with pytest.raises(ValueError, match="no environment") as caught:
        resolve(name)
    assert "did you mean" not in str(caught.value)
    assert all(known in str(caught.value) for known in ENVIRONMENTS)


@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_a_row_agrees_with_its_definition_and_with_gymnasium(name: str) -> None:
    row, made, spec = ENVIRONMENTS[name], definition(name), gymnasium.spec(ENVIRONMENTS[name].id)
    assert (row.name, row.horizon) == (made.name, made.horizon)
    assert spec.max_episode_steps == row.horizon
    assert row.alias == name.replace("_", "-")
    assert task_set(name).env == name
    assert "oracle" in made.controllers
    assert isinstance(gymnasium.make(row.id).unwrapped, MetaEnv)
    vector = gymnasium.make_vec(row.id, num_envs=2, vectorization_mode="vector_entry_point")
    assert isinstance(vector, MetaVectorEnv)
    assert vector.horizon == row.horizon


def test_importing_the_package_imports_no_definition() -> None:
    code = (
        "import sys, meta_envs; meta_envs.resolve('point_robot'); "
        "assert 'meta_envs.point_robot' not in sys.modules; "
        "meta_envs.task_set('point_robot'); "
        "assert 'meta_envs.point_robot' in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
