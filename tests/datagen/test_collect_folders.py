"""`python -m datagen.collect` where its folder cannot be made, read or written to."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest

from datagen.collect import main

Capture = pytest.CaptureFixture[str]
ARGUMENTS = ("--env", "point_robot_wind", "--budget", "smoke", "--engine", "sb3")


def test_a_folder_that_cannot_be_made(tmp_path: Path, capsys: Capture) -> None:
    (tmp_path / "file").write_text("")
    for folder in (tmp_path / "file", tmp_path / "file" / "below"):
        assert main([*ARGUMENTS, "--out", str(folder)]) == 2
        assert f"--out {folder} cannot be made (" in capsys.readouterr().err


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root may write")
def test_a_folder_that_cannot_be_written_to(tmp_path: Path, capsys: Capture) -> None:
    tmp_path.chmod(0o500)
    assert main([*ARGUMENTS, "--out", str(tmp_path)]) == 2
    assert f"--out {tmp_path} cannot be written to" in capsys.readouterr().err


@pytest.mark.parametrize("options", [(), ("--dry-run",)])
def test_a_folder_that_cannot_be_read(
    options: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    def refuse(folder: Path) -> None:
        raise PermissionError(errno.EACCES, "Permission denied", str(folder))

    monkeypatch.setattr(Path, "iterdir", refuse)
    assert main([*ARGUMENTS, *options, "--out", str(tmp_path)]) == 2
    said = capsys.readouterr()
    sentence = "cannot be read (Permission denied); check its permissions and the disk"
    assert (said.out, said.err) == ("", f"{tmp_path}: {sentence}\n")
