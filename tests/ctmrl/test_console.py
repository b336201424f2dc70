"""What commands show: exit codes, sentences, progress."""

from __future__ import annotations

import errno
import io
import re
import runpy
import sys
from pathlib import Path

import pytest
import tyro
from rich.console import Console

from ctmrl.console import TrainingDisplay, run_command
from ctmrl.errors import Diverged, UsageError
from datagen.dataset import DatasetError
from tests.ctmrl.commands import Commands

ROW: dict[str, float | None] = {
    "step": 30,
    "loss/encoder/contrast": 0.125,
    "loss/actor": 1234.5,
    "codes/perplexity": 2.5,
    "codes/share/0": 0.62,
    "codes/share/1": 0.0,
    "codes/share/2": 0.38,
    "policy/q": -7.0,
    "return/training_tasks": -12.345,
}


def failing(error: BaseException) -> None:
    raise error


@pytest.mark.parametrize(
    ("error", "code", "said"),
    [
        (Diverged("training diverged: q is nan"), 1, "error: training diverged: q is nan\n"),
        (UsageError("no method 'x'"), 2, "error: no method 'x'\n"),
        (DatasetError(Path("d"), "is gone", "get it"), 2, "error: d: is gone; get it\n"),
        (
            OSError(errno.ENOSPC, "No space left on device", "runs/x"),
            2,
            "error: [Errno 28] No space left on device: 'runs/x'; "
            "make room and give the same command again\n",
        ),
        (
            PermissionError(errno.EACCES, "Permission denied", "runs/x"),
            2,
            "error: [Errno 13] Permission denied: 'runs/x'\n",
        ),
        (KeyboardInterrupt(), 130, "Stopped. The same command goes on from the last checkpoint.\n"),
    ],
)
def test_what_ends_a_command(
    error: BaseException, code: int, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_command(lambda: failing(error)) == code
    assert capsys.readouterr() == ("", said)


def test_ctrl_c_in_a_command_that_does_not_go_on(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_command(lambda: failing(KeyboardInterrupt()), stopped="Stopped.") == 130
    assert capsys.readouterr() == ("", "Stopped.\n")


def test_a_command_that_ends_well(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_command(lambda: None) == 0
    assert capsys.readouterr() == ("", "")


def test_a_fault_of_ours_is_not_hidden() -> None:
    with pytest.raises(ZeroDivisionError):
        run_command(lambda: failing(ZeroDivisionError()))


def shown(
    rows: list[dict[str, float | None]], terminal: bool, n_codes: int | None = 3, width: int = 150
) -> str:
    file = io.StringIO()
    console = Console(file=file, force_terminal=terminal, width=width, color_system=None)
    with TrainingDisplay(console, 60, 0, n_codes) as display:
        for row in rows:
            display.show(row)
    return file.getvalue()


def test_lines_where_there_is_no_terminal() -> None:
    (line,) = shown([ROW], terminal=False).splitlines()
    assert line.startswith("step 30/60: contrast 0.125, actor 1.23e+03; codes in use 2.5 of 3; ")
    assert "return on training tasks -12.35; " in line
    assert line.endswith(" s left")


def test_a_line_for_measured_returns_only() -> None:
    rows = [{**ROW, "step": step, "return/training_tasks": None} for step in (10, 20)]
    assert shown(rows, terminal=False) == ""
    assert len(shown([*rows, ROW], terminal=False).splitlines()) == 1


def test_a_return_of_0_is_a_return() -> None:
    # The sparse robot's, as long as it has not found the goal.
    first = shown([{**ROW, "return/training_tasks": 0.0}], terminal=False)
    assert "return on training tasks 0.00; " in first
    later = shown([ROW, {**ROW, "return/training_tasks": 0.0}], terminal=False)
    assert "return on training tasks 0.00; " in later.splitlines()[1]


def test_a_method_without_codes() -> None:
    row = {key: value for key, value in ROW.items() if key != "codes/perplexity"}
    (line,) = shown([row], terminal=False, n_codes=None).splitlines()
    assert "codes" not in line


def test_the_live_table() -> None:
    rows = [ROW, {**ROW, "step": 40, "return/training_tasks": None}]
    last = shown(rows, terminal=True, width=80)
    last = last[last.index("67%") :]
    assert "steps/s" in last
    # Names and values, a kind of metric in each row; the last measured return stays in sight.
    for kind, said in {
        "return ": "training tasks -12.3",
        "encoder losses ": "contrast 0.125",
        "losses ": "actor 1.23e+03",
        "codes ": "perplexity 2.5   shares 62 0 38 %",
        "policy ": "q -7",
    }.items():
        (line,) = [line for line in last.splitlines() if line.startswith(kind)]
        assert said in line
    assert not [line for line in last.splitlines() if line.startswith("contexts")]


def test_a_return_of_0_replaces_the_last_one() -> None:
    later = shown([ROW, {**ROW, "step": 40, "return/training_tasks": 0.0}], terminal=True)
    assert "training tasks 0 " in later[later.index("67%") :]


def test_everything_fits_a_terminal_of_80_columns() -> None:
    many = {f"loss/encoder/quite_a_long_name_{index}": -1.23456e-30 for index in range(9)}
    shares = {f"codes/share/{index}": 0.05 for index in range(20)}
    lines = shown([{**ROW, **many, **shares}], terminal=True, width=80).splitlines()
    plain = [re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", line) for line in lines]
    assert max(len(line) for line in plain) <= 80
    assert "quite a long name 8 -1.23e-30" in "".join(plain)


def test_the_live_table_ends_with_an_error() -> None:
    console = Console(file=io.StringIO(), force_terminal=True)
    with pytest.raises(UsageError), TrainingDisplay(console, 60, 0, 3):
        raise UsageError("diverged")
    with TrainingDisplay(console, 60, 0, 3):
        pass


@pytest.mark.parametrize(
    ("module", "said"),
    [
        ("train", "Stopped. The same command goes on from the last checkpoint.\n"),
        *((name, "Stopped.\n") for name in ("evaluate", "report", "profile")),
    ],
)
def test_only_training_says_that_it_goes_on(
    module: str, said: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def stopped(*arguments: object, **options: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(tyro, "cli", stopped)
    monkeypatch.setattr(sys, "argv", [module])
    monkeypatch.delitem(sys.modules, f"ctmrl.{module}", raising=False)
    with pytest.raises(SystemExit) as end:
        runpy.run_module(f"ctmrl.{module}", run_name="__main__")
    assert (end.value.code, capsys.readouterr().err) == (130, said)


@pytest.mark.parametrize("module", ["train", "evaluate", "report", "profile"])
def test_help_has_the_command_as_it_is_typed(module: str, commands: Commands) -> None:
    assert commands.run(f"ctmrl.{module}", "--help") == 0
    assert f"usage: python -m ctmrl.{module} " in commands.output()
