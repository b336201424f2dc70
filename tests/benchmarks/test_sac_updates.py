"""Mistakes and accidents of the benchmark of updates are one sentence."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
import sac_updates

Capture = pytest.CaptureFixture[str]


def run(monkeypatch: pytest.MonkeyPatch, *options: str) -> int:
    monkeypatch.setattr(sys, "argv", ["sac_updates.py", *options])
    return sac_updates.main()


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (("--sbx", "/none/python"), "--sbx /none/python: there is no such program\n"),
        (("--out", "/none/a.csv"), "--out /none/a.csv: there is no folder /none\n"),
        (("--seconds", "0"), "--processes, --repetitions and --seconds must be above 0\n"),
    ],
)
def test_mistakes_are_said_first(
    options: tuple[str, ...], sentence: str, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    assert run(monkeypatch, *options) == 2
    assert capsys.readouterr().err == sentence


@pytest.mark.parametrize("first", ["", "print(1.0, flush=True); sys.stdin.close()"])
def test_a_side_that_ends_says_why(
    first: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    side = tmp_path / "side.py"
    side.write_text(f"import sys\n{first}\nraise ImportError('no module named sbx')")
    monkeypatch.setattr(sac_updates, "SIDE", side)
    assert run(monkeypatch, "--processes", "2", "--repetitions", "1") == 1
    said = capsys.readouterr()
    assert (said.out, said.err) == ("", "side.py ended: ImportError: no module named sbx\n")


def test_ctrl_c(monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    def interrupt(*about: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(sac_updates, "measure", interrupt)
    assert run(monkeypatch) == 130
    assert capsys.readouterr().err == "Interrupted; nothing was written.\n"
