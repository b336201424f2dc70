"""Where metrics go: every logger gets every row once, also of a run that was interrupted."""

from __future__ import annotations

import importlib.util
import json
import sqlite3
import sys
from collections.abc import Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from ctmrl.errors import UsageError
from ctmrl.loggers import LOGGERS, LoggedRun, Loggers, check_loggers, open_loggers

ROW: dict[str, float | None] = {"step": 3, "loss/a": 0.5, "return/training_tasks": None}
FAKE = """
calls = []
class Settings(dict):
    pass
class Run:
    def log(self, row, step):
        calls.append(("log", step, row))
    def finish(self):
        calls.append(("finish",))
def init(**options):
    calls.append(("init", options))
    return Run()
def login(prompt, verify):
    assert not prompt and not verify
    return LOGGED_IN
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A run's folder."""
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "config.json").write_text('{"settings": {"seed": 1}}')
    return tmp_path / "run"


def log_one(names: tuple[str, ...], folder: Path, step: int) -> None:
    with open_loggers(names, folder, "wind/ctmrl/seed-1", step) as loggers:
        loggers.log(step + 1, {**ROW, "step": step + 1})
        loggers.pass_on()


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("tensorbord", "no logger 'tensorbord'; did you mean 'tensorboard'? (known: tensorboard, "),
        ("x", "no logger 'x' (known: tensorboard, trackio, wandb)"),
    ],
)
def test_an_unknown_logger(name: str, said: str) -> None:
    with pytest.raises(UsageError) as caught:
        check_loggers([name])
    assert str(caught.value).startswith(said)


@pytest.mark.parametrize("name", LOGGERS)
def test_a_logger_that_is_not_installed(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda module: None)
    with pytest.raises(UsageError) as caught:
        check_loggers([name])
    assert str(caught.value) == (
        f"--loggers {name} needs a package that is not installed: pip install 'ctmrl[{name}]'"
    )


class Kept:
    """A logger that keeps what it gets."""

    def __init__(self) -> None:
        self.rows: list[tuple[int, Mapping[str, float]]] = []
        self.closed = 0

    def log(self, step: int, row: Mapping[str, float]) -> None:
        self.rows.append((step, row))

    def close(self) -> None:
        self.closed += 1


def test_rows_wait_for_their_checkpoint_and_go_out_once() -> None:
    kept = [Kept(), Kept()]
    loggers = Loggers(kept)
    loggers.log(3, ROW)
    loggers.log(4, {"step": 4, "loss/a": 0.25, "return/training_tasks": 0.0})
    assert [one.rows for one in kept] == [[], []]
    loggers.pass_on()
    loggers.pass_on()
    wanted = [(3, {"loss/a": 0.5}), (4, {"loss/a": 0.25, "return/training_tasks": 0.0})]
    assert [one.rows for one in kept] == [wanted, wanted]


def test_loggers_are_closed_and_rows_without_a_checkpoint_dropped(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept = Kept()
    told: list[LoggedRun] = []

    def opened(run: LoggedRun) -> Kept:
        told.append(run)
        return kept

    monkeypatch.setitem(LOGGERS, "kept", opened)

    def interrupted() -> None:
        with open_loggers(["kept", "kept"], folder, "name", 12) as loggers:
            loggers.log(13, ROW)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert (kept.closed, kept.rows) == (1, [])
    (run,) = told
    assert (run.name, run.step, run.settings) == ("name", 12, {"settings": {"seed": 1}})


def test_without_loggers_nothing_is_written(folder: Path) -> None:
    log_one((), folder, 0)
    assert [path.name for path in folder.iterdir()] == ["config.json"]


def fake(name: str, monkeypatch: pytest.MonkeyPatch, login: bool = False) -> list[Any]:
    """Put a package in the place of another; what is asked of it is in the list."""
    module = ModuleType(name)
    names: dict[str, Any] = module.__dict__
    names["LOGGED_IN"] = login
    exec(FAKE, names)
    monkeypatch.setitem(sys.modules, name, module)
    calls: list[Any] = names["calls"]
    return calls


def test_trackio_goes_on_with_its_run(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls = fake("trackio", monkeypatch)
    log_one(("trackio",), folder, 0)
    log_one(("trackio",), folder, 1)
    run_id = json.loads((folder / "loggers.json").read_bytes())["id"]
    begun, row, end, again, *_ = calls
    assert begun == again
    assert begun[1]["name"] == f"wind/ctmrl/seed-1-{run_id}"
    assert begun[1]["project"] == "ctmrl"
    assert begun[1]["resume"] == "allow"
    assert row == ("log", 1, {"loss/a": 0.5})
    assert end == ("finish",)


@pytest.mark.parametrize(
    ("variable", "login", "mode"),
    [(None, False, "offline"), (None, True, "online"), ("disabled", True, "disabled")],
)
def test_wandb_never_asks(
    variable: str | None,
    login: bool,
    mode: str,
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delenv("WANDB_MODE", raising=False)
    if variable is not None:
        monkeypatch.setenv("WANDB_MODE", variable)
    calls = fake("wandb", monkeypatch, login)
    log_one(("wandb",), folder, 0)
    log_one(("wandb",), folder, 1)
    (_, options), row, end, again, *_ = calls
    assert options["mode"] == mode
    assert options["dir"] == str(folder)
    assert (options["resume"], options["id"]) == ("allow", again[1]["id"])
    assert row == ("log", 1, {"loss/a": 0.5})
    assert end == ("finish",)


def test_a_run_trained_anew_has_another_id(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fake("trackio", monkeypatch)
    ids = set()
    for _ in range(2):
        log_one(("trackio",), folder, 0)
        ids.add((folder / "loggers.json").read_text())
        (folder / "loggers.json").unlink()
    assert len(ids) == 2


def test_an_id_that_is_not_there_is_one_sentence(folder: Path) -> None:
    (folder / "loggers.json").write_text("{}")
    with pytest.raises(UsageError) as caught:
        log_one(("tensorboard",), folder, 0)
    assert str(caught.value) == (
        f"{folder / 'loggers.json'} does not fit its run ('id'): train again with --restart"
    )


def test_tensorboard_itself(folder: Path) -> None:
    accumulator = pytest.importorskip(
        "tensorboard.backend.event_processing.event_accumulator"
    ).EventAccumulator
    for step in range(2):
        log_one(("tensorboard",), folder, step)
    events = accumulator(str(folder / "tensorboard"))
    events.Reload()
    assert [(event.step, event.value) for event in events.Scalars("loss/a")] == [(1, 0.5), (2, 0.5)]


@pytest.mark.filterwarnings("default")
def test_trackio_itself(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TRACKIO_DIR", str(tmp_path / "trackio"))
    pytest.importorskip("trackio")
    for step in range(2):
        log_one(("trackio",), folder, step)
    (path,) = (tmp_path / "trackio").glob("*.db")
    found = sqlite3.connect(path).execute("select run_name, step from metrics order by step")
    (first, one), (second, two) = found.fetchall()
    assert (first, one, two) == (second, 1, 2)


@pytest.mark.filterwarnings("default")
def test_wandb_itself(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("WANDB_MODE", "offline")
    pytest.importorskip("wandb")
    log_one(("wandb",), folder, 0)
    (path,) = (folder / "wandb").glob("offline-run-*/*.wandb")
    assert b"loss/a" in path.read_bytes()
