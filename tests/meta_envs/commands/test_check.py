import pytest

from meta_envs.__main__ import main
from meta_envs.conformance import CHECKS, describe
from tests.meta_envs.conformance.examples import broken


def test_a_sound_environment_passes_every_check(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", "PointRobotWind-v0"]) == 0
    printed = capsys.readouterr().out
    assert f"{len(CHECKS)} passed, 0 failed, 0 skipped" in printed
    for check in CHECKS:
        assert describe(check) in printed


def test_a_faulty_one_fails_with_the_reason(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", broken("ShowsTheRow")]) == 1
    printed = " ".join(capsys.readouterr().out.split())
    assert "1 failed" not in printed  # it starts elsewhere in another place of the row, too
    assert "components [0, 1] of the first" in printed
    assert "failed" in printed


def test_what_could_not_be_checked_is_skipped_with_the_reason(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["check", broken("EndsAtOnce")]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert f"{len(CHECKS) - 1} passed, 0 failed, 1 skipped" in printed
    assert "episodes are too short to tell" in printed


@pytest.mark.parametrize(
    ("env", "message"),
    [
        ("point_robt", "no environment 'point_robt'; did you mean 'point_robot'?"),
        ("absent:Robot", "absent:Robot: there is no module 'absent' on Python's path"),
        (
            "meta_envs.tasks:TaskSet",
            "meta_envs.tasks:TaskSet: this is not a subclass of meta_envs.definition.Definition",
        ),
    ],
)
def test_a_mistake_is_one_sentence(
    env: str, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["check", env]) == 2
    captured = capsys.readouterr()
    assert captured.err.startswith(message)
    assert captured.out == ""
