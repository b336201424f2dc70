import sys
from dataclasses import replace
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec

from meta_envs import MetaVectorEnv
from meta_envs.conformance import NonConformityError, NotApplicableError, Subject, episodes, subject
from meta_envs.conformance.checklist import Check
from meta_envs.headless import RenderingUnavailableError
from meta_envs.point_robot import PointRobot
from tests.meta_envs.conformance.examples import broken


@pytest.mark.parametrize(
    ("check", "name", "reason"),
    [
        (episodes.vector_equals_single, "LooksAside", "in the mode NextStep, .* differs at step"),
        (
            episodes.vector_equals_single,
            "LooksAsideUnseen",
            "in the mode .*, state differs at step",
        ),
        (episodes.seed_decides_everything, "StartsByChance", r"seed=3 is not seed=\[3, 4\]"),
        (episodes.seed_decides_everything, "HasAClock", "two runs from the same seed differ"),
        (episodes.info_is_constant, "TermsComeAndGo", "info was .*late.* and becomes "),
        (episodes.spaces_hold, "LeavesItsSpace", "at step 0 is not in its space"),
        (episodes.arrays_are_fresh, "OneBuffer", "returned arrays share memory"),
        (episodes.copies_go_their_own_way, "HasAClock", "a copy goes on otherwise"),
        (episodes.pictures_are_arrays, "GrowingPicture", "pictures have several sizes"),
        (episodes.pictures_are_arrays, "FloatPicture", r"a picture is float64 \[400, 400, 3\]"),
        (episodes.pictures_are_arrays, "BlankPicture", "a picture is of one colour"),
    ],
)
def test_a_check_sees_the_fault(check: Check, name: str, reason: str) -> None:
    with subject(broken("Sound")) as sound:
        check(sound)
    with subject(broken(name)) as faulty, pytest.raises(NonConformityError, match=reason):
        check(faulty)


@pytest.mark.parametrize(
    "check",
    [episodes.passes_gymnasiums_checker, episodes.passes_stable_baselines3s_checker],
)
def test_the_checkers_of_others_see_an_observation_outside_its_space(check: Check) -> None:
    with subject(broken("Sound")) as sound:
        check(sound)
    with subject(broken("LeavesItsSpace")) as faulty:
        with pytest.raises(Exception) as caught:  # noqa: PT011 - each has an exception of its own
            check(faulty)
        assert not isinstance(caught.value, NotApplicableError)


def test_a_warning_of_a_checker_is_a_fault(monkeypatch: pytest.MonkeyPatch) -> None:
    def warns(env: Any, skip_render_check: bool) -> None:
        gymnasium.logger.warn("looks odd")

    monkeypatch.setattr(episodes, "check_env", warns)
    with (
        subject(broken("Sound")) as sound,
        pytest.raises(NonConformityError, match=r"it warns: .*looks odd"),
    ):
        episodes.passes_gymnasiums_checker(sound)


def test_a_time_limit_other_than_the_horizon_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    with subject(broken("Sound")) as sound:
        episodes.only_the_horizon_truncates(sound)
        shorter = Subject(replace(sound.row, horizon=7))
        with pytest.raises(NonConformityError, match="side by side the time limit is 9"):
            episodes.only_the_horizon_truncates(shorter)
        monkeypatch.setattr(MetaVectorEnv, "_truncated", lambda env: np.zeros(2, np.bool_))
        with pytest.raises(NonConformityError, match="side by side, truncated is wrong"):
            episodes.only_the_horizon_truncates(sound)


@pytest.mark.parametrize(
    ("function", "accepted"),
    [
        ("meta_envs.checks.check_action", "an action of NaN is accepted"),
        ("meta_envs.checks.check_options", "an unknown option is accepted"),
        ("meta_envs.tasks.TaskSet.check_task", "a task too many is accepted"),
    ],
)
def test_an_environment_that_accepts_anything_is_seen(
    function: str, accepted: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    with subject(broken("Sound")) as sound:
        episodes.nonsense_is_refused(sound)
        lenient = {
            "check_action": lambda action, shape: np.resize(np.nan_to_num(action), shape),
            "check_options": lambda options, known: options or {},
            "check_task": lambda tasks, task: int(task) % len(tasks),
        }
        monkeypatch.setattr(function, lenient[function.rpartition(".")[2]])
        with pytest.raises(NonConformityError, match=accepted):
            episodes.nonsense_is_refused(sound)


def test_a_spec_that_forgets_the_task_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    with subject(broken("Sound")) as sound:
        episodes.specs_rebuild_it(sound)
        forgetful = gymnasium.spec(sound.row.id)
        monkeypatch.setattr(EnvSpec, "from_json", lambda text: forgetful)
        with pytest.raises(NonConformityError, match="the single environment has another task"):
            episodes.specs_rebuild_it(sound)


def test_what_cannot_be_done_here_is_skipped(monkeypatch: pytest.MonkeyPatch) -> None:
    def without_opengl(*given: Any) -> None:
        raise RenderingUnavailableError("no OpenGL")

    def without_copies(*given: Any) -> None:
        raise TypeError("no copies")

    with subject("point_robot") as robot:
        monkeypatch.setattr(PointRobot, "__deepcopy__", without_copies, raising=False)
        with pytest.raises(NotApplicableError, match="it cannot be copied: no copies"):
            episodes.copies_go_their_own_way(robot)
        monkeypatch.setitem(sys.modules, "stable_baselines3.common.env_checker", None)
        with pytest.raises(NotApplicableError, match="stable-baselines3 is not installed"):
            episodes.passes_stable_baselines3s_checker(robot)
        monkeypatch.setattr(PointRobot, "render", without_opengl)
        with pytest.raises(NotApplicableError, match="no OpenGL"):
            episodes.pictures_are_arrays(robot)
        episodes._can_draw.cache_clear()
        episodes.passes_gymnasiums_checker(robot)
        episodes._can_draw.cache_clear()
