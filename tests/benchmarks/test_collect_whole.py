"""Mistakes and Ctrl-C in the benchmark of whole collections are one sentence."""

from __future__ import annotations

import sys
from pathlib import Path

import collect_whole
import pytest

Capture = pytest.CaptureFixture[str]


def run(monkeypatch: pytest.MonkeyPatch, work: Path, *options: str) -> int:
    monkeypatch.setattr(sys, "argv", ["collect_whole.py", "--work", str(work), *options])
    return collect_whole.main()


def test_a_missing_folder_is_said_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    assert run(monkeypatch, tmp_path, "--out", "/none/a.csv") == 2
    assert capsys.readouterr().err == "--out /none/a.csv: there is no folder /none\n"
    assert not list(tmp_path.iterdir())


def test_ctrl_c(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    def interrupt(*about: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(collect_whole, "measure", interrupt)
    assert run(monkeypatch, tmp_path, "--envs", "point_robot", "ant_goal") == 130
    sentence = "Interrupted with 0 of 2 environments done; the same command goes on, and times what"
    assert capsys.readouterr().err == f"{sentence} is left.\n"
