"""Seeds side by side: the bytes of each alone, whatever interrupts them or happens to others."""

from __future__ import annotations

import dataclasses
import io
import json
import multiprocessing
import os
import re
import signal
import sys
from contextlib import closing
from pathlib import Path

import pytest
from rich.console import Console

from ctmrl import seeds
from ctmrl.config import RunConfig
from ctmrl.errors import UsageError
from ctmrl.report import print_report
from ctmrl.seeds import News, SeedsDisplay, Train, each_in_a_process, plan, train_seeds
from ctmrl.summary import find_records
from ctmrl.train import main, parse
from tests.ctmrl.commands import Commands, contents, rows, wait_until
from tests.ctmrl.conftest import FinishedRun
from tests.ctmrl.examples import record, smoke
from tests.ctmrl.seed_jobs import pretend


def living() -> dict[int, int]:
    """Parents of all processes that have not ended, by process."""
    found = {}
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, parent = path.read_text().rpartition(")")[2].split()[:2]
        except OSError:
            continue
        if state != "Z":
            found[int(path.parent.name)] = int(parent)
    return found


def interrupt(commands: Commands, out: Path, row: int, sent: signal.Signals) -> int:
    """End the command once a seed has so many rows, with all its children; its exit code."""
    wait_until(lambda: any(rows(path) > row for path in out.glob("*/metrics.csv")))
    crew = {child for child, parent in living().items() if parent == commands.child}
    assert len(crew) >= 2
    commands.send(sent)
    code = commands.wait()
    wait_until(lambda: not crew & living().keys())
    assert "Traceback" not in commands.output()
    assert not list(out.glob("*/evaluation.json"))
    return code


def printed(console: Console) -> str:
    assert isinstance(console.file, io.StringIO)
    return console.file.getvalue()


def test_seeds_interrupted_and_killed_end_in_the_bytes_of_each_alone(
    finished_run: FinishedRun, commands: Commands, tmp_path: Path
) -> None:
    alone = {0: finished_run.path, 1: tmp_path / "alone"}
    assert commands.run(*finished_run.words, "--seed", "1", "--out", str(alone[1])) == 0
    out = tmp_path / "runs"
    words = (*finished_run.words, "--seeds", "0", "1", "--workers", "2", "--out", str(out))
    paths = {seed: out / f"seed-{seed}" for seed in alone}
    commands.start(*words)
    assert interrupt(commands, out, 3, signal.SIGINT) == 130
    last = "Stopped. The same command goes on from the last checkpoint."
    assert commands.output().splitlines()[-1] == last
    commands.start(*words)
    assert interrupt(commands, out, 13, signal.SIGKILL) == -signal.SIGKILL
    ahead = max(paths, key=lambda seed: rows(paths[seed] / "metrics.csv"))
    assert commands.run(*words) == 0, commands.output()
    lines = commands.output().splitlines()
    # It went on: of ten, twenty, thirty and forty steps the first are not taken again.
    shown = [line.split()[3] for line in lines if line.startswith(f"seed {ahead}: step ")]
    assert "10/40," not in shown
    assert shown[-1] == "40/40,"
    for seed, path in paths.items():
        assert contents(path) == contents(alone[seed])
        assert f"seed {seed}: finished" in lines
    console = Console(file=io.StringIO())
    print_report(find_records([out]), console)
    assert printed(console) in commands.output()
    assert lines[-1] == f"Pictures, metrics and checkpoints: seed-0, seed-1 in {out}"
    before = {path: path.stat().st_mtime_ns for path in out.glob("*/*")}
    assert commands.run(*words) == 0
    assert {path: path.stat().st_mtime_ns for path in out.glob("*/*")} == before
    assert "step" not in commands.output()
    assert printed(console) in commands.output()


def test_a_seed_that_fails_does_not_stop_the_others(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for seed in range(5):
        path = tmp_path / f"seed-{seed}" / "evaluation.json"
        path.parent.mkdir()
        path.write_text(json.dumps(record(seed=seed)))
    config = dataclasses.replace(smoke(60), seeds=(1, 2, 3, 0, 4), workers=2)
    console = Console(file=io.StringIO(), width=80)
    assert train_seeds(pretend, config, tmp_path, console) == 1
    # What two say is said once.
    assert sorted(re.sub("seed [12]:", "seed 1 or 2:", capsys.readouterr().err).splitlines()) == [
        "error: seed 1 or 2: training diverged: q is nan",
        "error: seed 3: its process was killed by signal 9; the same command goes on with it",
    ]
    lines = printed(console).splitlines()
    for seed in config.seeds:
        own = [line for line in lines if line.startswith(f"seed {seed}: ")]
        assert own == [
            f"seed {seed}: step 6/60, return on training tasks {-1.5 - seed:.2f}",
            f"seed {seed}: {'failed' if seed in (1, 2, 3) else 'finished'}",
        ]
    assert "ctmrl, seed by seed: -9.000, -13.000" in lines
    assert lines[-1] == f"Pictures, metrics and checkpoints: seed-0, seed-4 in {tmp_path}"


def test_no_more_at_a_time_than_asked_for_and_none_is_left() -> None:
    before = set(multiprocessing.active_children())
    runs = [dataclasses.replace(smoke(), seed=seed) for seed in (0, 4, 5)]
    with closing(each_in_a_process(pretend, runs, 2)) as told:
        assert next(told).kind == "row"
        crew = set(multiprocessing.active_children()) - before
        assert 1 <= len(crew) <= 2
    assert set(multiprocessing.active_children()) <= before


def test_mistakes_all_seeds_share_are_one_sentence(
    commands: Commands, wind_path: Path, tmp_path: Path
) -> None:
    words = ("ctmrl.train", "--preset", "smoke", "--out", str(tmp_path / "runs"))
    for more, said in (
        (("--data", str(tmp_path / "none")), f"{tmp_path / 'none'}: no dataset is there; "),
        (("--steps", "0"), "--steps must be at least 1, got 0\n"),
        (("--workers", "0"), "--workers must be at least 1, got 0\n"),
        (("--loggers", "tensorbord"), "no logger 'tensorbord'; "),
    ):
        assert commands.run(*words, "--data", str(wind_path), "--seeds", "0", "1", *more) == 2
        assert commands.output().startswith(f"error: {said}")
        assert commands.output().count("\n") == 1
    assert not (tmp_path / "runs").exists()


def test_a_runs_own_folder_is_none_of_seeds(finished_run: FinishedRun, commands: Commands) -> None:
    before = contents(finished_run.path)
    words = (*finished_run.words, "--seeds", "0", "1", "--out", str(finished_run.path))
    assert commands.run(*words) == 2
    assert commands.output() == (
        f"error: {finished_run.path} is the folder of one run, and --seeds makes a folder for each "
        "below it: choose another --out\n"
    )
    assert contents(finished_run.path) == before


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("--seed 0 --seeds 1 2", "--seed and --seeds exclude each other: give one of them"),
        ("--seeds 1 2 1", "--seeds has 1 2 times: give each seed once"),
        ("--seeds", "--seeds needs seeds, such as --seeds 0 1 2"),
        ("--seed 0 --workers 2", "--workers is for --seeds, which is not given"),
    ],
)
def test_options_that_do_not_tell_the_seeds_are_one_sentence(words: str, said: str) -> None:
    with pytest.raises(UsageError) as caught:
        parse(words.split())
    assert str(caught.value) == said


@pytest.mark.parametrize("code", [0, 1])
def test_where_seeds_go_and_how_the_command_exits(
    code: int, wind_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folders = []

    def note(train: Train, config: RunConfig, folder: Path, console: Console) -> int:
        folders.append((folder, config.seeds))
        return code

    monkeypatch.setattr(seeds, "train_seeds", note)
    words = ["train", "--method", "focal", "--data", str(wind_path), "--seeds", "4", "2"]
    for more in (["--validate"], ["--out", "here"]):
        monkeypatch.setattr(sys, "argv", [*words, *more])
        with pytest.raises(SystemExit) as caught:
            main()
        assert caught.value.code == code
    default = Path("runs/point_robot_wind/focal-validation")
    assert folders == [(default, (4, 2)), (Path("here"), (4, 2))]


def test_the_options_are_explained(capsys: pytest.CaptureFixture[str]) -> None:
    assert (parse(["--seeds", "3", "0"]).seeds, parse([]).seeds) == ((3, 0), ())
    with pytest.raises(SystemExit):
        parse(["--help"])
    shown = capsys.readouterr().out
    assert "--seeds" in shown
    assert "--workers" in shown


def test_the_plan(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(seeds, "cores", lambda: 4)
    monkeypatch.setattr(seeds, "available_memory", lambda: 8 * 10**9)
    config = dataclasses.replace(smoke(), seeds=(7, 5, 3), threads=2)
    runs, workers = plan(config, tmp_path)
    assert [(run.seed, run.out) for run in runs] == [
        (seed, tmp_path / f"seed-{seed}") for seed in config.seeds
    ]
    # Cores are shared by threads and seeds, and what is left of memory by those at work.
    assert (workers, {(run.memory, run.workers) for run in runs}) == (2, {(2.0, 2)})
    single = dataclasses.replace(config, threads=1, memory=1.5)
    runs, workers = plan(single, tmp_path)
    assert (workers, {run.memory for run in runs}) == (3, {1.5})
    assert plan(dataclasses.replace(config, threads=9), tmp_path)[1] == 1
    assert plan(dataclasses.replace(config, workers=3), tmp_path)[1] == 3


def begin_in(folder: Path, precision: str) -> None:
    """Leave what a run that has begun in a precision leaves."""
    folder.mkdir(exist_ok=True)
    settings = {} if precision == "float32" else {"precision": precision}
    (folder / "config.json").write_text(json.dumps({"settings": settings}))


def test_seeds_have_one_precision(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(seeds, "best_precision", lambda device: "bfloat16")
    config = dataclasses.replace(smoke(), seeds=(7, 5, 3), precision="auto")

    def precisions(config: RunConfig) -> list[str]:
        return [run.precision for run in plan(config, tmp_path)[0]]

    assert precisions(config) == ["bfloat16"] * 3
    begin_in(tmp_path / "seed-5", "float32")
    assert precisions(config) == ["float32"] * 3
    assert precisions(dataclasses.replace(config, restart=True)) == ["bfloat16"] * 3
    assert precisions(dataclasses.replace(config, precision="bfloat16")) == ["bfloat16"] * 3
    begin_in(tmp_path / "seed-3", "bfloat16")
    with pytest.raises(UsageError, match="have begun in bfloat16, some in float32, and no report"):
        precisions(config)


def test_cores() -> None:
    assert 1 <= seeds.cores() <= (os.cpu_count() or 1)


def test_bars_on_a_terminal_of_80_columns() -> None:
    runs = [dataclasses.replace(smoke(105_000), seed=seed) for seed in (0, 12, 3)]
    console = Console(file=io.StringIO(), force_terminal=True, width=80, color_system=None)
    with SeedsDisplay(console, runs) as display:
        display.show(News(12, "row", (50_000, -1234.567)))
        display.show(News(12, "row", (60_000, None)))
        display.show(News(3, "failed", "q is nan"))
    plain = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", printed(console)).replace("\r", "\n")
    lines = [line.rstrip() for line in plain.splitlines() if line.strip()]
    assert max(map(len, lines)) <= 80
    first, second, third = lines[-3:]
    assert first.startswith("seed 0 ")
    # The last return stays in sight.
    assert re.match(r"seed 12 .* 60000/105000 return on training tasks -1234.57 ", second)
    assert re.match(r"seed 3 .* failed ", third)
