"""`python -m datagen.collect`: what it makes, and that no accident on the way changes it."""

from __future__ import annotations

import os
import random
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from datagen import check, collect, estimate
from datagen.budgets import budget
from datagen.collect import main
from datagen.collect_task import collect_task
from datagen.dataset import open_dataset
from datagen.files import machine
from datagen.job import Job, origin

Capture = pytest.CaptureFixture[str]
TASKS = range(8)
ROBOTS = ("--env", "point_robot_wind", "--budget", "smoke", "--seed", "5", "--tasks", "0-7")
ARGUMENTS = (*ROBOTS, "--engine", "sb3")
SMOKE = replace(budget("point_robot_wind", "smoke"), fleet=None)
# Ctrl-C is ignored by programs that a shell starts in the background, and by their children.
PROGRAM = (
    "import signal, sys\n"
    "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
    "from datagen.collect import main\n"
    "if __name__ == '__main__': sys.exit(main())"
)


def command(folder: Path, workers: int) -> list[str]:
    options = ["--out", str(folder), "--workers", str(workers)]
    return [sys.executable, "-c", PROGRAM, *ARGUMENTS, *options]


def finish(folder: Path, workers: int) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command(folder, workers), capture_output=True, text=True, timeout=300)


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> subprocess.CompletedProcess[str]:
    """A collection that nothing disturbed; its folder is the last argument but two."""
    return finish(tmp_path_factory.mktemp("collected") / "data", workers=2)


@pytest.fixture(scope="module")
def original(finished: subprocess.CompletedProcess[str]) -> Path:
    """Its folder, not to be written to."""
    return Path(finished.args[-3])


@pytest.fixture
def folder(original: Path, tmp_path: Path) -> Path:
    """A copy of it."""
    return shutil.copytree(original, tmp_path / "data")


def test_it_says_what_it_does(finished: subprocess.CompletedProcess[str], original: Path) -> None:
    assert (finished.returncode, finished.stderr) == (0, "")
    *lines, size, look, learn = finished.stdout.splitlines()
    number = r"-\d+\.\d\d"
    for count, line in enumerate(lines, start=1):
        assert re.match(
            rf"task [0-7] \({count}/8\): behaviour {number}, random {number}, expert {number}; ",
            line,
        )
    assert len(lines) == len(TASKS)
    assert size == f"{original}: 8 tasks, 1,600 transitions, 0.1 MB"
    assert look == f"look at it: python -m datagen.inspect {original}"
    assert learn.endswith(f"python -m ctmrl.train --env point_robot_wind --data {original}")


def test_it_makes_an_intact_dataset_with_a_card(original: Path, capsys: Capture) -> None:
    assert check.main([str(original)]) == 0
    said = capsys.readouterr()
    assert "8 tasks (6 train, 2 test), 1,600 transitions in 64 episodes" in said.out
    assert said.err == "", "a warning would name a file that does not belong there"
    dataset = open_dataset(original)
    assert dataset.tasks.tolist() == list(TASKS)
    assert dataset.index["config"] == SMOKE.config()
    card = (original / "README.md").read_text()
    assert "--env point_robot_wind --budget smoke --engine sb3 --tasks 0-7 --seed 5\n" in card


def test_a_file_does_not_depend_on_what_else_ran(original: Path, tmp_path: Path) -> None:
    # Task 7 alone in this very process, the fixture's in workers that did others before.
    job = Job("point_robot_wind", 7, SMOKE, 5, tmp_path)
    collect_task(job)
    assert (tmp_path / "task_007.h5").read_bytes() == (original / "task_007.h5").read_bytes()


@pytest.mark.slow
def test_a_shard_has_the_same_files(original: Path, tmp_path: Path) -> None:
    options = ["--shard", "1/2", "--workers", "1", "--out", str(tmp_path)]
    assert main([*ARGUMENTS, *options]) == 0
    made = {name: content for name, content in contents(tmp_path).items() if name[-3:] == ".h5"}
    assert sorted(made) == [f"task_{task:03d}.h5" for task in (1, 3, 5, 7)]
    assert {name: (original / name).read_bytes() for name in made} == made
    assert open_dataset(tmp_path).tasks.tolist() == [1, 3, 5, 7]


def test_a_finished_collection_is_left_as_it_is(folder: Path, capsys: Capture) -> None:
    before = {path.name: path.stat().st_mtime_ns for path in folder.glob("*.h5")}
    whole = contents(folder)
    (folder / "dataset.json").unlink()
    (folder / "README.md").write_text("an old card")
    (folder / f".task_003.h5.{machine()}.999999999.partial").write_text("half")
    assert main([*ARGUMENTS, "--out", str(folder)]) == 0
    assert capsys.readouterr().out.startswith("8 of 8 tasks are already finished.\n")
    assert contents(folder) == whole
    assert {path.name: path.stat().st_mtime_ns for path in folder.glob("*.h5")} == before


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (["--seed", "6"], "was collected with seed 5, not 6"),
        (["--episodes", "9"], "was collected with config.episodes 4, not 9"),
        (["--budget", "paper"], "was collected with budget 'smoke', not 'paper'"),
        # Also where the tasks asked for are not there yet: one folder, one dataset.
        (["--tasks", "20", "--seed", "6"], "was collected with seed 5, not 6"),
    ],
)
def test_another_collection_in_the_folder(
    folder: Path, options: list[str], sentence: str, capsys: Capture
) -> None:
    before = contents(folder)
    assert main([*ARGUMENTS, *options, "--out", str(folder)]) == 2
    assert sentence in capsys.readouterr().err
    assert contents(folder) == before


def test_other_versions_matter_only_where_a_task_is_missing(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    whole = contents(folder)

    def newer(*arguments: Any) -> dict[str, Any]:
        asked = origin(*arguments)
        return {**asked, "versions": {**asked["versions"], "torch": "99.0"}}

    monkeypatch.setattr(collect, "origin", newer)
    assert main([*ARGUMENTS, "--out", str(folder)]) == 0
    assert contents(folder) == whole
    (folder / "task_003.h5").unlink()
    assert main([*ARGUMENTS, "--out", str(folder)]) == 2
    assert re.search(r"versions\.torch '[\d.]+', not '99\.0'", capsys.readouterr().err)


def test_a_damaged_file_is_named(folder: Path, capsys: Capture) -> None:
    path = folder / "task_004.h5"
    path.write_bytes(path.read_bytes()[:5000])
    assert main([*ARGUMENTS, "--out", str(folder)]) == 2
    said = capsys.readouterr().err
    assert f"{path}: is truncated to 5000 of its" in said
    assert "delete it and run" in said


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (["--env", "point_robot_wimd"], "did you mean 'point_robot_wind'?"),
        (["--budget", "big"], "has no budget 'big' (known: paper, standard, quick, smoke)"),
        (["--tasks", "3-"], "--tasks takes numbers and ranges such as 0-9,12, got '3-'"),
        (["--tasks", "49-50"], "has tasks 0 to 49, got '49-50'"),
        (["--shard", "2/2"], "--shard takes i/n with i from 0 to n - 1"),
        (["--shard", "8/9"], "--shard 8/9 is empty: of these tasks there are 8 groups"),
        (["--seed", "-1"], "--seed must not be negative, got -1"),
        (["--workers", "0"], "--workers must be at least 1, got 0"),
        (["--episodes", "0"], "episodes must be at least 1, got 0"),
    ],
)
def test_mistakes_are_one_sentence(
    options: list[str], sentence: str, tmp_path: Path, capsys: Capture
) -> None:
    assert main([*ARGUMENTS, "--out", str(tmp_path / "new"), *options]) == 2
    said = capsys.readouterr()
    assert sentence in said.err
    assert said.err.count("\n") == 1
    assert said.out == ""
    assert not (tmp_path / "new").exists()


def test_a_dry_run_touches_nothing(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    monkeypatch.setattr(estimate, "MEASURED_SECONDS", 0.1)
    (folder / "task_004.h5").unlink()
    before = contents(folder)
    assert main([*ARGUMENTS, "--workers", "1", "--out", str(folder), "--dry-run"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[1] == "tasks:       0-7 (8 tasks, 1 to collect)"
    assert lines[-2].endswith("at most 1,600 rows, 0.1 MB")
    assert re.fullmatch(r"time: +about \d+ s with 1 worker", lines[-1])
    assert contents(folder) == before
    fleet = ("--fleet-size", "3", "--out", str(folder / "new"), "--dry-run")
    assert main([*ROBOTS, *fleet, "--shard", "0/2"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[1:3] == [
        "tasks:       0-1,5-7 (5 tasks, 5 to collect)",
        "groups:      2 of 2 or 3 tasks",
    ]
    line = r"meanwhile:   up to \d\.\d MB beside it, until all tasks are done"
    assert re.fullmatch(line, lines[-2])
    assert not (folder / "new").exists()


def test_a_long_collection_says_first_how_long_it_will_take(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    monkeypatch.setattr(collect, "seconds_of", lambda plan, missing: 60.0 * len(missing))
    (folder / "task_004.h5").unlink()
    arguments = [*ARGUMENTS, "--workers", "1", "--out", str(folder)]
    # One task has this many updates.
    monkeypatch.setattr(collect, "LONG", SMOKE.updates)
    assert main(arguments) == 0
    assert capsys.readouterr().out.splitlines()[1] == "about 60 s with 1 worker"
    # With no task missing there is nothing to measure.
    assert main(arguments) == 0
    assert "about" not in capsys.readouterr().out


@pytest.mark.parametrize(
    ("module", "heavy"),
    [("collect", {"torch", "stable_baselines3"}), ("inspect", {"torch", "matplotlib"})],
)
def test_help_is_light(module: str, heavy: set[str]) -> None:
    code = (
        f"import sys\nfrom datagen.{module} import main\n"
        "try: main(['--help'])\n"
        f"except SystemExit: print('heavy:', *({heavy!r} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "heavy:"


@pytest.mark.slow
def test_a_full_disk_is_said_and_leaves_nothing_half_written(tmp_path: Path) -> None:
    folder = tmp_path / "data"
    # Files of more than four blocks of 512 or 1,024 bytes cannot be written.
    limited = ["sh", "-c", 'ulimit -f 4; exec "$@"', "sh", *command(folder, 1)]
    done = subprocess.run(limited, capture_output=True, text=True, timeout=300)
    assert done.returncode == 1
    assert re.fullmatch(
        r"task 0: .*File too large.*; 0 of 8 tasks are done, and the same command continues\n",
        done.stderr,
    )
    assert contents(folder) == {}


def test_a_full_disk_at_the_very_end(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    def full(*arguments: object) -> None:
        raise OSError("No space left on device")

    monkeypatch.setattr(collect, "write_summary", full)
    assert main([*ARGUMENTS, "--out", str(folder)]) == 1
    assert "all tasks are done, but not the index (No space left" in capsys.readouterr().err


def workers_of(pid: int) -> list[int]:
    """Process ids of a collection's workers."""
    columns = ["-o", "pid=", "-o", "ppid=", "-o", "args="]
    listing = subprocess.run(["ps", "-Aww", *columns], capture_output=True, text=True, check=True)
    rows = [line.split(maxsplit=2) for line in listing.stdout.splitlines()]
    return [int(row[0]) for row in rows if int(row[1]) == pid and "spawn_main" in row[2]]


def wait_until(holds: Callable[[], object], seconds: float = 120.0) -> None:
    end = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.01)


def gone(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return True
    return False


def wait_until_gone(pids: list[int]) -> None:
    wait_until(lambda: all(map(gone, pids)))


@contextmanager
def collecting(folder: Path, workers: int = 1) -> Iterator[subprocess.Popen[str]]:
    """A collection at work, in a process group of its own."""
    pipe = subprocess.PIPE
    process = subprocess.Popen(
        command(folder, workers), stdout=pipe, stderr=pipe, text=True, start_new_session=True
    )
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def test_ctrl_c_then_kill_then_a_dead_worker_then_the_same_bytes(
    original: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "data"

    def done() -> int:
        return len(list(folder.glob("task_*.h5")))

    with collecting(folder) as process:
        wait_until(lambda: done() >= 1)
        os.killpg(process.pid, signal.SIGINT)
        _, said = process.communicate(timeout=60)
    assert process.returncode == 130
    sentence = r"stopped with (\d) of 8 tasks done; the same command continues\n"
    match = re.fullmatch(sentence, said)
    assert match, said
    assert 1 <= int(match[1]) == done() < 8
    assert set(contents(folder)) <= {f"task_{task:03d}.h5" for task in TASKS}

    before = done()
    with collecting(folder) as process:
        wait_until(lambda: done() > before)
        workers = workers_of(process.pid)
        process.kill()
        process.wait()
        assert len(workers) == 1
        wait_until_gone(workers)

    before = done()
    assert before < 8
    with collecting(folder) as process:
        wait_until(lambda: workers_of(process.pid))
        os.kill(workers_of(process.pid)[0], signal.SIGKILL)
        _, said = process.communicate(timeout=60)
    assert process.returncode == 1
    assert re.fullmatch(
        r"task \d: its worker process died \(killed by signal 9, as happens when the memory is "
        rf"full\); {before} of 8 tasks are done, and the same command continues\n",
        said,
    )

    assert finish(folder, workers=1).returncode == 0
    assert contents(folder) == contents(original)


@pytest.mark.slow
def test_killed_at_20_random_moments_it_ends_in_the_same_bytes(
    original: Path, tmp_path: Path
) -> None:
    generator = random.Random(0)
    begin = time.monotonic()
    finish(tmp_path / "timed", workers=2)
    whole = time.monotonic() - begin
    folder = tmp_path / "data"
    kills = 0
    while kills < 20:
        shutil.rmtree(folder, ignore_errors=True)
        for _ in range(4):
            with collecting(folder, workers=2) as process:
                time.sleep(generator.uniform(0.0, whole))
                workers = workers_of(process.pid)
                victim = generator.choice([process.pid, *workers])
                if gone(victim) or process.poll() is not None:
                    break
                os.kill(victim, signal.SIGKILL)
                kills += 1
                process.wait(timeout=60)
                wait_until_gone(workers)
        assert finish(folder, workers=2).returncode == 0
        assert contents(folder) == contents(original)
