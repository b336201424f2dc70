import subprocess
import sys
from dataclasses import replace
from typing import Any

import gymnasium
import pytest

from meta_envs import ENVIRONMENTS, MetaEnv, MetaVectorEnv, register, resolve, task_set
from meta_envs.registry import definition, unregister


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
    camel = "".join(word.capitalize() for word in row.alias.split("-"))
    assert row.id == f"{camel}-v0"
    assert task_set(name).env == name
    env: Any = gymnasium.make(row.id).unwrapped
    assert isinstance(env, MetaEnv)
    assert env.metadata["render_fps"] == made.render_fps
    vector = gymnasium.make_vec(row.id, num_envs=2, vectorization_mode="vector_entry_point")
    assert isinstance(vector, MetaVectorEnv)
    assert vector.horizon == row.horizon


def test_nothing_is_imported_before_it_is_needed() -> None:
    """No definition by importing the package, no MuJoCo by looking at an environment's tasks."""
    code = (
        "import sys, meta_envs\n"
        "from meta_envs.registry import definition\n"
        "heavy = {'torch', 'mujoco', 'matplotlib', 'PIL', 'stable_baselines3', 'h5py', 'scipy'}\n"
        "meta_envs.resolve('point_robot')\n"
        "assert 'meta_envs.point_robot' not in sys.modules\n"
        "meta_envs.task_set('point_robot')\n"
        "assert 'meta_envs.point_robot' in sys.modules\n"
        "for name in meta_envs.ENVIRONMENTS:\n"
        "    meta_envs.task_set(name).hash, definition(name).observation_space\n"
        "assert not heavy & set(sys.modules), heavy & set(sys.modules)\n"
        "meta_envs.MetaEnv('half_cheetah_dir')\n"
        "assert 'mujoco' in sys.modules\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_the_fields_names_are_known() -> None:
    names = {
        "half-cheetah-vel": "half_cheetah_vel",
        "hopper-rand-params": "hopper_params",
        "HopperRandParams-v0": "hopper_params",
        "walker-rand-params": "walker_params",
        "WalkerRandParams": "walker_params",
        "ant-goal": "ant_goal",
        "humanoid-dir": "humanoid_dir",
    }
    assert {spelling: resolve(spelling).name for spelling in names} == names


def test_an_environment_of_ones_own_is_like_the_others() -> None:
    row = replace(ENVIRONMENTS["point_robot"], name="own_robot", id="OwnRobot-v0", alias="own")
    register(row)
    try:
        assert resolve("own") is ENVIRONMENTS["own_robot"] is row
        assert gymnasium.spec("OwnRobot-v0").max_episode_steps == row.horizon
        with pytest.raises(ValueError, match="there is an environment 'own_robot' or OwnRobot-v0"):
            register(row)
    finally:
        unregister(row)
    assert "own_robot" not in ENVIRONMENTS
    assert "OwnRobot-v0" not in gymnasium.registry


@pytest.mark.parametrize(
    ("given", "error"),
    [
        ({"name": "point_robot"}, ValueError),
        ({"id": "PointRobotWind-v0"}, ValueError),
        ({"id": "Own Robot"}, gymnasium.error.Error),
    ],
)
def test_a_name_that_cannot_be_is_refused_and_nothing_changes(
    given: dict[str, Any], error: type[Exception]
) -> None:
    before, known = dict(ENVIRONMENTS), set(gymnasium.registry)
    own = replace(ENVIRONMENTS["point_robot"], name="own_robot", id="OwnRobot-v0")
    with pytest.raises(error, match=r"there is an environment|Malformed environment ID"):
        register(replace(own, **given))
    assert before == ENVIRONMENTS
    assert known == set(gymnasium.registry)
