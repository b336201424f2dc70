"""`python -m datagen.check`: every fault is said, nothing but faults is counted as one."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from datagen import check as module
from datagen.check import main
from tests.datagen.examples import write_dataset

Capture = pytest.CaptureFixture[str]


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset of four tasks, not to be written to."""
    return write_dataset(tmp_path_factory.mktemp("datasets") / "point_robot_wind")


@pytest.fixture
def folder(original: Path, tmp_path: Path) -> Path:
    """A copy of it."""
    return shutil.copytree(original, tmp_path / "point_robot_wind")


def run(capsys: Capture, *paths: Path) -> tuple[int, list[str], list[str]]:
    """Exit code, lines on standard output, lines on standard error."""
    code = main([str(path) for path in paths])
    said = capsys.readouterr()
    return code, said.out.splitlines(), said.err.splitlines()


def test_an_intact_dataset_is_one_line(folder: Path, capsys: Capture) -> None:
    (folder / "README.md").write_text("a card")
    size = sum(path.stat().st_size for path in folder.glob("*.h5"))
    code, out, err = run(capsys, folder)
    assert (code, err) == (0, [])
    (line,) = out
    assert line.startswith(
        f"{folder}: ok: point_robot_wind, 4 tasks (3 train, 1 test), 400 transitions in 16 "
        f"episodes (0 end in a terminal, 16 in a timeout), {size:,} bytes, SHA-256 "
    )


def test_a_single_file_is_one_line(folder: Path, capsys: Capture) -> None:
    code, out, err = run(capsys, folder / "task_002.h5", folder)
    assert (code, err) == (0, [])
    assert len(out) == 2
    assert out[0].startswith(
        f"{folder / 'task_002.h5'}: ok: task 2 of point_robot_wind (test), 100 transitions in 4 "
    )


def test_every_bad_file_is_said(folder: Path, original: Path, capsys: Capture) -> None:
    (folder / "task_000.h5").write_bytes(b"text")
    (folder / "task_002.h5").unlink()
    (folder / "task_003.h5").write_bytes((folder / "task_001.h5").read_bytes())
    code, out, err = run(capsys, folder, original, folder / "task_000.h5")
    assert code == 1
    assert [line.partition(": ")[0] for line in out] == [str(original)]
    assert [line.partition(": ")[0] for line in err] == [
        str(folder / "task_000.h5"),
        str(folder / "task_002.h5"),
        str(folder / "task_003.h5"),
        str(folder),
        str(folder / "task_000.h5"),
        str(folder / "task_000.h5"),
    ]
    assert err[3] == f"{folder}: faults: 3, ok: 1"
    assert "is not an HDF5 file" in err[0]
    assert "is missing; delete it and run `python -m datagen.collect" in err[1]
    assert "is really the file of task 1" in err[2]


def test_without_an_index_the_files_are_checked_one_by_one(folder: Path, capsys: Capture) -> None:
    (folder / "dataset.json").write_text("{}")
    (folder / "task_001.h5").write_bytes(b"")
    code, out, err = run(capsys, folder)
    assert (code, out) == (1, [])
    assert err[0].startswith(f"{folder / 'dataset.json'}: is not as it was written")
    assert err[1].startswith(f"{folder / 'task_001.h5'}: is empty; ")
    assert err[2] == f"{folder}: faults: 2, ok: 3"


def test_an_edited_index_is_a_fault(folder: Path, capsys: Capture) -> None:
    index = (folder / "dataset.json").read_text()
    (folder / "dataset.json").write_text(index.replace('"transitions": 100', '"transitions": 99'))
    code, _, err = run(capsys, folder)
    assert code == 1
    assert "does not have the hash it states" in err[0]


def test_strays_are_warned_of_but_no_fault(folder: Path, capsys: Capture) -> None:
    shutil.copy(folder / "task_003.h5", folder / "task_009.h5")
    (folder / ".task_004.h5.123.partial").write_bytes(b"half")
    (folder / ".fleet_004-006_ab.safetensors").write_bytes(b"half")
    (folder / "notes.txt").write_text("mine")
    code, out, err = run(capsys, folder)
    assert code == 0
    assert len(out) == 1
    assert err == [
        f"warning: {folder / '.fleet_004-006_ab.safetensors'}: an unfinished training of a fleet; "
        "finish the collection or delete it",
        f"warning: {folder / '.task_004.h5.123.partial'}: left by an interrupted writer; "
        "delete it if none is at work",
        f"warning: {folder / 'notes.txt'}: no part of the dataset",
        f"warning: {folder / 'task_009.h5'}: no task of dataset.json; finish the collection or "
        "delete it",
    ]


def test_wrong_usage_is_one_sentence(folder: Path, tmp_path: Path, capsys: Capture) -> None:
    code, out, err = run(capsys, folder, tmp_path / "nowhere")
    assert (code, out) == (2, [])
    assert err == [
        f"{tmp_path / 'nowhere'}: no such file or folder; see python -m datagen.check --help"
    ]
    code, out, err = run(capsys)
    assert (code, out) == (2, [])
    assert err == [
        "give at least one dataset's folder or task file; see python -m datagen.check --help"
    ]
    with pytest.raises(SystemExit) as stopped:
        main(["--nonsense"])
    assert stopped.value.code == 2
    capsys.readouterr()


def test_an_interrupt_is_a_sentence(
    folder: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt(path: Path) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(module, "read_task", interrupt)
    code, out, err = run(capsys, folder / "task_000.h5")
    assert (code, out, err) == (130, [], ["interrupted: not everything was checked"])


def test_it_runs_as_a_module(folder: Path) -> None:
    (folder / "task_001.h5").write_bytes(b"text")
    command = [sys.executable, "-m", "datagen.check", str(folder)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert done.stdout == ""
    assert done.stderr.startswith(f"{folder / 'task_001.h5'}: is not an HDF5 file")
    assert "Traceback" not in done.stderr
