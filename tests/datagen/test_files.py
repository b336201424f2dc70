"""Files are whole or absent; JSON is canonical; what is wrong is said with a remedy."""

from __future__ import annotations

import hashlib
import json
import multiprocessing
import os
import pickle
import resource
import shlex
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from datagen.budgets import FleetSettings, budget
from datagen.files import (
    DatasetError,
    canonical_json,
    collect_command,
    digest,
    file_digest,
    file_size,
    parse_canonical,
    read_bytes,
    task_file,
    task_of,
    write_whole,
)

SIZE = 3_000_000


def write_on_full_disk(path: Path) -> None:
    """Child: write more than the system lets it; exit 7 if that is an OSError that names it."""
    resource.setrlimit(resource.RLIMIT_FSIZE, (SIZE // 2, SIZE // 2))
    try:
        write_whole(path, b"b" * SIZE)
    except OSError as error:
        os._exit(7 if error.filename == str(path) else 8)


def test_a_killed_writer_leaves_the_file_whole_or_absent(tmp_path: Path) -> None:
    script = Path(__file__).with_name("kill_writers.py")
    command = [sys.executable, str(script), str(tmp_path), "40"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    found = json.loads(done.stdout)
    assert len(found) == 40
    assert all(kill["whole"] for kill in found if kill["there"])
    assert all(kill["only_its_own"] for kill in found)
    # That the kills came in the middle of writing, before and after a first whole file:
    assert sum(kill["partial"] for kill in found) >= 5
    assert sum(kill["there"] for kill in found) >= 5


def test_a_full_disk_leaves_the_old_file_and_no_partial(tmp_path: Path) -> None:
    path = tmp_path / "task_000.h5"
    path.write_bytes(b"old")
    process = multiprocessing.get_context("forkserver").Process(
        target=write_on_full_disk, args=(path,)
    )
    process.start()
    process.join()
    assert process.exitcode == 7
    assert os.listdir(tmp_path) == ["task_000.h5"]
    assert path.read_bytes() == b"old"


def test_an_interrupt_while_writing_leaves_no_partial(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt(handle: int) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "fsync", interrupt)
    with pytest.raises(KeyboardInterrupt):
        write_whole(tmp_path / "x", b"new")
    assert os.listdir(tmp_path) == []


def test_a_missing_folder_is_the_writers_error(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        write_whole(tmp_path / "nowhere" / "x", b"")


def test_canonical_json_is_one_text_for_one_value() -> None:
    value: dict[Any, Any] = {"b": (1, 2.5), 100: np.float64(0.1), 20: np.array([1, 2]), "a": "é"}
    text = canonical_json(value)
    assert text == (
        '{\n "100": 0.1,\n "20": [\n  1,\n  2\n ],\n "a": "\\u00e9",\n "b": [\n  1,\n  2.5\n ]\n}\n'
    )
    assert canonical_json(parse_canonical(text.encode())) == text


def test_canonical_json_refuses_what_json_does_not_know() -> None:
    with pytest.raises(ValueError, match="not JSON compliant"):
        canonical_json({"x": float("nan")})
    with pytest.raises(TypeError, match="set has no place in JSON"):
        canonical_json({"x": {1, 2}})


@pytest.mark.parametrize(
    ("content", "fault"),
    [
        (b"", "is not JSON"),
        (b"{", "is not JSON"),
        (b"\xff", "not text"),
        (b"[]\n", "edited or damaged"),
        (b'{"a": 1}\n', "edited or damaged"),
        (b'{\n "a": 1\n}', "edited or damaged"),
        (b'{\n "a": 1.0e0\n}\n', "edited or damaged"),
        (b'{\n "a": 1,\n "a": 1\n}\n', "edited or damaged"),
        (b'{\n "b": 1,\n "a": 1\n}\n', "edited or damaged"),
        (b'{\n "a": NaN\n}\n', "should not have"),
        (b'{\n "a": 1e999\n}\n', "should not have"),
        (b'{\n "a": ' + b"1" * 5000 + b"\n}\n", "should not have"),
        (b"[" * 100_000, "should not have"),
    ],
)
def test_what_is_not_canonical_is_refused(content: bytes, fault: str) -> None:
    with pytest.raises(ValueError, match=fault):
        parse_canonical(content)


def test_digests_are_sha256(tmp_path: Path) -> None:
    path = tmp_path / "x"
    path.write_bytes(b"abc" * 1_000_000)
    assert file_digest(path) == hashlib.sha256(b"abc" * 1_000_000).hexdigest()
    assert digest("é") == digest("é".encode()) == hashlib.sha256("é".encode()).hexdigest()


def test_names_of_task_files() -> None:
    assert [task_file(task) for task in (0, 42, 1234)] == [
        "task_000.h5",
        "task_042.h5",
        "task_1234.h5",
    ]
    for name, task in (("task_007.h5", 7), ("task_1234.h5", 1234), ("task_7.h5", None)):
        assert task_of(Path("somewhere") / name) == task
    for name in ("task_.h5", "task_0007.h5", "task_007.h5.bak", ".task_007.h5", "task_-01.h5"):
        assert task_of(Path(name)) is None


def test_the_remedy_is_a_command_that_shells_understand() -> None:
    folder = Path("my data/point_robot_wind")
    command = collect_command(folder, {"budget": "smoke", "seed": 3}, 7)
    head, folder_word = shlex.split(command)[:-1], shlex.split(command)[-1]
    assert folder_word == "my data/point_robot_wind"
    assert " ".join(head) == (
        "python -m datagen.collect --env point_robot_wind --tasks 7 --budget smoke --seed 3 --out"
    )
    thinned = collect_command(folder, {"budget": "smoke", "seed": 3, "config": {"episodes": 7}})
    assert "--seed 3 --episodes 7 --engine sb3 --out" in thinned
    own = {
        "budget": "smoke",
        "seed": 3,
        "config": {"episodes": budget("point_robot", "smoke").episodes},
    }
    assert "--episodes" not in collect_command(folder, own)
    assert "--env sparse_point_robot " in collect_command(folder, {"env": "sparse_point_robot"})
    assert "--env point_robot_wind " in collect_command(folder, {"env": "; rm", "seed": [1]})
    assert "--env ENVIRONMENT " in collect_command(Path("x"), {"env": None})


def test_the_remedy_says_how_the_policies_were_trained() -> None:
    def options(env: str, fleet: FleetSettings | None, more: dict[str, Any]) -> str:
        rows = replace(budget(env, "smoke"), fleet=fleet)
        source = {"env": env, "budget": "smoke", "seed": 3, "config": {**rows.config(), **more}}
        command = collect_command(Path("data"), source)
        return command.removesuffix(" --out data").rpartition("--seed 3")[2]

    robot, hopper = "point_robot_wind", "hopper_params"
    assert options(robot, None, {}) == options(hopper, None, {}) == " --engine sb3"
    assert options(robot, FleetSettings(25, "float32"), {}) == " --precision float32"
    assert options(robot, FleetSettings(25, "float32", "cuda"), {}).endswith(" --device cuda")
    assert options(hopper, FleetSettings(25, "bfloat16"), {}) == " --precision bfloat16"
    thin = options(hopper, FleetSettings(9, "float32"), {"episodes": 1})
    assert thin == " --episodes 1 --fleet-size 9 --precision float32"
    assert options(hopper, None, {"fleet": "nonsense"}) == ""
    assert options(hopper, None, {"fleet": {"size": 3}}) == ""


def test_what_is_no_readable_file_is_a_dataset_error(tmp_path: Path) -> None:
    (tmp_path / "loop").symlink_to("loop")
    (tmp_path / "folder").mkdir()
    os.mkfifo(tmp_path / "pipe")
    faults = {
        "missing": "is missing; mend it",
        "loop": "cannot be read .*; check",
        "folder": "is a folder, not a file; move it away and mend it",
        "pipe": "is a device, a pipe or a socket, not a file; move it away and mend it",
        "x" * 300: "cannot be read .File name too long.; check",
    }
    for name, fault in faults.items():
        for read in (file_size, read_bytes):
            with pytest.raises(DatasetError, match=f"{name}: {fault}"):
                read(tmp_path / name, "mend it")


def test_errors_survive_the_way_from_a_worker_process() -> None:
    error = DatasetError(Path("a/task_001.h5"), "is empty", "delete it")
    copy = pickle.loads(pickle.dumps(error))
    assert str(copy) == str(error) == "a/task_001.h5: is empty; delete it"
    assert (copy.path, copy.fault, copy.remedy) == (error.path, error.fault, error.remedy)


def test_a_task_of_a_fleet_is_collected_again_in_its_group() -> None:
    config = {"episodes": 2, "fleet": {"size": 3, "precision": "float32", "device": "cpu"}}
    index = {
        "env": "hopper_params",
        "budget": "smoke",
        "seed": 0,
        "config": config,
        "tasks": [{"task": task} for task in (1, 2, 5, 7, 9)],
    }
    words = collect_command(Path("data"), index, 5).split()
    # Five tasks in groups of three at most are two and three.
    assert words[words.index("--tasks") + 1] == "5,7,9"
    assert words[words.index("--fleet-size") + 1] == "3"
    alone = {key: value for key, value in index.items() if key != "tasks"}
    said = collect_command(Path("data"), {**alone, "group": "4-6"}, 5).split()
    assert said[said.index("--tasks") + 1] == "4-6", "a file says its group itself"
    for source, task in ((alone, 5), (index, 4)):
        words = collect_command(Path("data"), source, task).split()
        assert words[words.index("--tasks") + 1] == str(task)
