from pathlib import Path

import gymnasium
import numpy as np
import pytest

from meta_envs import ENVIRONMENTS, task_set
from meta_envs.conformance import NonConformityError, subject
from meta_envs.conformance.subject import require, require_same
from tests.meta_envs.conformance.examples import broken


def test_a_registered_environment_by_any_name() -> None:
    for name in ("point_robot", "PointRobot-v0", "meta_envs.point_robot:PointRobot"):
        with subject(name) as one:
            assert one.row is ENVIRONMENTS["point_robot"]
            assert one.task_set is task_set("point_robot")


def test_anybodys_definition_is_registered_meanwhile() -> None:
    with subject(broken("Sound")) as sound:
        assert sound.row.id == "Sound-v0"
        assert sound.definition.name == "sound"
        assert gymnasium.make("Sound-v0", task=2).unwrapped.spec is not None
        assert len(task_set("sound")) == len(sound.task_set) == 6
    assert "sound" not in ENVIRONMENTS
    assert "Sound-v0" not in gymnasium.registry


def test_it_is_registered_no_longer_after_a_fault() -> None:
    with pytest.raises(KeyError), subject(broken("Sound")):
        raise KeyError
    assert "sound" not in ENVIRONMENTS


@pytest.mark.parametrize(
    ("env", "message"),
    [
        ("point_robt", "no environment 'point_robt'; did you mean 'point_robot'"),
        ("absent_module:Robot", "there is no module 'absent_module' on Python's path"),
        ("meta_envs.point_robot:Robot", "module 'meta_envs.point_robot' has no 'Robot'"),
        ("meta_envs.tasks:TaskSet", "this is not a subclass of meta_envs.definition.Definition"),
        ("meta_envs.tasks:json", "this is not a subclass of meta_envs.definition.Definition"),
        ("meta_envs.definition:Definition", "it must have a class variable 'name'"),
        (
            "tests.meta_envs.conformance.test_subject:Namesake",
            "there is a 'point_robot' already; give yours another name",
        ),
    ],
)
def test_what_cannot_be_checked_is_told_apart(env: str, message: str) -> None:
    with pytest.raises(ValueError, match=message), subject(env):
        pass


@pytest.mark.parametrize("env", ["robot.py:Robot", "a/robot:Robot", ":Robot", "robot:", "a:b:C"])
def test_what_is_no_module_and_class_is_told_how_to_write_them(env: str) -> None:
    message = f"^{env}: write module:Class, such as my_package.my_robot:MyRobot$"
    with pytest.raises(ValueError, match=message), subject(env):
        pass


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("def f(:", r"importing 'their_robot' ends in SyntaxError: .*\(their_robot.py, line 1\)"),
        ("1 / 0", "importing 'their_robot' ends in ZeroDivisionError: division by zero"),
        ("import absent_module", "there is no module 'absent_module' on Python's path"),
    ],
)
def test_a_module_that_cannot_be_imported(
    content: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "their_robot.py").write_text(content)
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ValueError, match=f"^their_robot:Robot: {message}$"):
        subject("their_robot:Robot").__enter__()


def test_a_name_that_is_no_short_name_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Namesake, "name", "My Robot!")
    named = "tests.meta_envs.conformance.test_subject:Namesake"
    with pytest.raises(ValueError, match=r"its name .*, got 'My Robot!'"), subject(named):
        pass


with subject("point_robot") as _robot:
    Namesake = type("Namesake", (type(_robot.definition),), {})


def test_tasks_are_spread_over_all() -> None:
    with subject("point_robot") as robot:
        assert robot.tasks(3) == [0, 50, 99]
        assert robot.tasks(1) == [0]
        assert len(set(robot.tasks(11))) == 11
    with subject(broken("Sound")) as sound:
        assert sound.tasks(8) == [0, 1, 2, 3, 4, 5, 0, 1]


def test_actions_go_beyond_the_box() -> None:
    with subject("point_robot") as robot:
        actions = robot.actions(20, 4)
        assert actions.shape == (20, 4, 2)
        assert actions.dtype == np.float32
        assert np.isposinf(actions).any()
        assert np.isneginf(actions).any()
        assert not np.isnan(actions).any()
        np.testing.assert_array_equal(actions, robot.actions(20, 4))


def test_sameness_is_of_bits() -> None:
    require(True, "unseen")
    with pytest.raises(NonConformityError, match="seen"):
        require(np.False_, "seen")
    require_same(np.array([np.nan]), np.array([np.nan]), "unseen")
    for one, other, reason in (
        (np.zeros(2), np.array([0.0, 1e-300]), r"differs, first at index \(1,\)"),
        (np.array([0.0]), np.array([-0.0]), "differs$"),
        (np.zeros(2), np.zeros(2, np.float32), r"differs: float64 \[2\] and float32 \[2\]"),
        (1.0, 2.0, r"differs, first at index \(0,\)"),
    ):
        with pytest.raises(NonConformityError, match=reason):
            require_same(one, other, "it differs")
