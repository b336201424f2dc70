"""A run's folder: whole files, one owner, no mix-ups, a sentence for everything that is wrong."""

from __future__ import annotations

import csv
import json
import os
import shutil
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import torch

from ctmrl import runs
from ctmrl.errors import UsageError
from ctmrl.runs import RunError, RunFolder, begun_with, check_folder
from tests.ctmrl.commands import Commands, contents

SETTINGS: dict[str, Any] = {
    "settings": {"seed": 0, "training": {"steps": 60, "widths": (3, 5)}},
    "dataset": "ab12",
}
STATE = {"step": torch.tensor(7), "method/x": torch.arange(5.0), "generator": torch.arange(3)}


@contextmanager
def opened(
    path: Path, settings: dict[str, Any] = SETTINGS, restart: bool = False
) -> Iterator[RunFolder]:
    folder = RunFolder(path, settings, restart)
    try:
        yield folder
    finally:
        folder.close()


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "runs" / "x" / "seed-0"


def changed(**values: Any) -> dict[str, Any]:
    return {**SETTINGS, "settings": {**SETTINGS["settings"], **values}}


def test_a_new_folder_holds_its_settings_as_json(path: Path) -> None:
    with opened(path) as folder:
        assert folder.path == path
        assert not folder.finished
        assert folder.checkpoint() is None
    assert os.listdir(path) == ["config.json"]
    text = (path / "config.json").read_text()
    assert json.loads(text) == json.loads(json.dumps(SETTINGS))
    assert text.endswith("}\n")
    assert text.index('"dataset"') < text.index('"settings"')


def test_the_same_settings_find_the_folder_again(path: Path) -> None:
    with opened(path) as folder:
        folder.save_checkpoint(STATE)
        folder.write_json("evaluation.json", {"a": 1})
    before = contents(path)
    with opened(path) as folder:
        assert folder.finished
        state = folder.checkpoint()
    assert state is not None
    assert state.keys() == STATE.keys()
    assert all(state[key].equal(value) for key, value in STATE.items())
    assert contents(path) == before


def test_other_settings_are_one_sentence_that_names_the_first(path: Path) -> None:
    with opened(path):
        pass
    before = contents(path)
    for settings, said in (
        (changed(seed=3), "settings.seed = 0, this one has 3"),
        (changed(training={"steps": 61, "widths": (3, 5)}), "settings.training.steps = 60, this"),
        (changed(training={"steps": 60, "widths": (3,)}), "widths = [3, 5], this one has [3]"),
        ({**SETTINGS, "dataset": "cd"}, "dataset = ab12, this one has cd"),
        ({**SETTINGS, "versions": {"torch": "2"}}, "versions.torch = None, this one has 2"),
    ):
        with pytest.raises(RunError) as caught:
            RunFolder(path, settings, restart=False)
        assert said in str(caught.value)
        assert str(caught.value).startswith(f"{path} holds a run with ")
        assert "choose another --out, or --restart to throw it away" in str(caught.value)
    assert contents(path) == before


def test_settings_that_came_later_are_known_of_earlier_runs(path: Path) -> None:
    with opened(path):
        pass
    # What a run had before there was a choice is no other setting, said or unsaid.
    said_before = {"quality": "mixed", "data_episodes": None}
    with opened(path, changed(**said_before, precision="float32", device="cpu")):
        pass
    for settings, said in (
        (changed(quality="expert"), "settings.quality = mixed, this one has expert"),
        (changed(data_episodes=3), "settings.data_episodes = None, this one has 3"),
        (changed(precision="bfloat16"), "settings.precision = float32, this one has bfloat16"),
        (changed(device="cuda"), "settings.device = cpu, this one has cuda"),
    ):
        with pytest.raises(RunError, match=f" holds a run with {said}: choose another --out"):
            RunFolder(path, settings, restart=False)
    with opened(path, changed(quality="expert", data_episodes=3), restart=True):
        pass
    with pytest.raises(RunError, match=r"settings.data_episodes = 3, this one has None: "):
        RunFolder(path, SETTINGS, restart=False)


def test_a_refused_folder_is_not_kept_locked(path: Path) -> None:
    with opened(path):
        pass
    with pytest.raises(RunError):
        RunFolder(path, changed(seed=3), restart=False)
    with opened(path):
        pass


def test_a_restart_throws_the_run_away(path: Path) -> None:
    with opened(path) as folder:
        folder.save_checkpoint(STATE)
        folder.append_metrics({"step": 1, "loss": 0.5})
        folder.write_json("evaluation.json", {})
        for name in ("adaptation.png", "contexts.png", ".checkpoint.pt.1.partial"):
            (path / name).write_bytes(b"x")
        (path / "tensorboard").mkdir()
        (path / "tensorboard" / "events").write_bytes(b"x")
    with opened(path, changed(seed=3), restart=True) as folder:
        assert not folder.finished
        assert folder.checkpoint() is None
    assert os.listdir(path) == ["config.json"]
    assert json.loads((path / "config.json").read_text())["settings"]["seed"] == 3


def test_a_restart_of_nothing_is_a_start(path: Path) -> None:
    with opened(path, restart=True):
        assert os.listdir(path) == ["config.json"]


@pytest.mark.parametrize("name", ["notes.txt", "src"])
def test_a_restart_never_deletes_what_is_not_of_a_run(name: str, path: Path) -> None:
    # config.json is a common name: the folder may be somebody's project.
    with opened(path):
        pass
    if name == "src":
        (path / name).mkdir()
    else:
        (path / name).write_text("dear diary")
    before = sorted(path.iterdir())
    with pytest.raises(RunError, match=f"also holds {name}, which is not of a run"):
        RunFolder(path, SETTINGS, restart=True)
    assert sorted(path.iterdir()) == before


def test_a_folder_of_something_else_is_left_alone(tmp_path: Path) -> None:
    for name in ("thesis.tex", ".thesis.tex.1.partial"):
        (tmp_path / name).write_text("x")
    for restart in (False, True):
        with pytest.raises(RunError, match="holds files that are not of a run: choose another"):
            RunFolder(tmp_path, SETTINGS, restart)
    assert sorted(os.listdir(tmp_path)) == [".thesis.tex.1.partial", "thesis.tex"]


def test_what_is_refused_is_refused_before_the_settings_are_complete(
    path: Path, tmp_path: Path
) -> None:
    known = {"settings": SETTINGS["settings"]}
    assert not check_folder(path, known, restart=False)
    assert not path.parent.exists()
    with opened(path) as folder:
        with pytest.raises(RunError, match="another process is at work"):
            check_folder(path, known, restart=False)
        folder.save_checkpoint(STATE)
    assert not check_folder(path, known, restart=False)
    (path / "evaluation.json").write_text("{}")
    before = contents(path)
    assert check_folder(path, known, restart=False)
    other = {"settings": changed(seed=3)["settings"]}
    with pytest.raises(RunError, match=r"holds a run with settings.seed = 0, this one has 3: "):
        check_folder(path, other, restart=False)
    assert not check_folder(path, other, restart=True)
    assert contents(path) == before
    (path / "thesis.tex").write_text("x")
    with pytest.raises(RunError, match=r"also holds thesis\.tex, which is not of a run"):
        check_folder(path, known, restart=True)
    (path / "config.json").unlink()
    with pytest.raises(RunError, match="holds files that are not of a run"):
        check_folder(path, known, restart=False)
    with pytest.raises(RunError, match=r"tex cannot be written to \(.*\): choose another --out$"):
        check_folder(path / "thesis.tex", known, restart=False)
    # Nothing is kept locked.
    for name in ("thesis.tex", "evaluation.json", "checkpoint.pt"):
        (path / name).unlink()
    with opened(path):
        pass


def test_what_a_kill_left_before_the_first_file_is_no_obstacle(path: Path) -> None:
    path.mkdir(parents=True)
    (path / ".config.json.1.partial").write_bytes(b'{"sett')
    with opened(path):
        assert os.listdir(path) == ["config.json"]


def test_a_file_in_the_way_is_one_sentence(tmp_path: Path) -> None:
    (tmp_path / "x").write_text("")
    for path in (tmp_path / "x", tmp_path / "x" / "y"):
        for refuse in (RunFolder, check_folder):
            with pytest.raises(RunError, match=r"x(/y)? cannot be written to \(.*\): choose "):
                refuse(path, SETTINGS, restart=False)
    assert not check_folder(tmp_path / "a", {}, restart=False)
    assert [*tmp_path.iterdir()] == [tmp_path / "x"]


@pytest.mark.parametrize("content", [b"", b'{"settings": {"se', b"\xff\xfe\x00", b"[]", b"3"])
def test_a_damaged_config_is_one_sentence(content: bytes, path: Path) -> None:
    path.mkdir(parents=True)
    (path / "config.json").write_bytes(content)
    with pytest.raises(RunError, match=r"train again with --restart$"):
        RunFolder(path, SETTINGS, restart=False)
    with opened(path, restart=True):
        pass


def test_one_process_at_a_time(path: Path, commands: Commands) -> None:
    words = ("tests.ctmrl.open_folder", str(path))
    with opened(path):
        assert commands.run(*words) == 3
        assert commands.output() == f"another process is at work in {path}: wait for it\n"
        with pytest.raises(RunError, match="another process is at work"):
            RunFolder(path, SETTINGS, restart=True)
    assert commands.run(*words) == 0, commands.output()


def test_a_checkpoints_bytes_depend_on_its_values_alone(path: Path) -> None:
    shuffled = {key: STATE[key].clone() for key in reversed(STATE)}
    shared = torch.arange(9.0)
    # A view of a larger tensor, as optimisers and modules may hold.
    shuffled["method/x"] = shared[:5]
    found = []
    with opened(path) as folder:
        for state in (STATE, shuffled, {**STATE, "method/x": STATE["method/x"] + 1}):
            folder.save_checkpoint(state)
            found.append((path / "checkpoint.pt").read_bytes())
    assert found[0] == found[1]
    assert found[0] != found[2]


def damaged_checkpoints(path: Path) -> Iterator[tuple[str, bytes]]:
    whole = path.read_bytes()
    yield "empty", b""
    yield "cut short", whole[: len(whole) // 2]
    yield "cut at the end", whole[:-1]
    yield "text", b"this is not a checkpoint\nat all\n"
    yield "flipped", whole[:300] + bytes(byte ^ 255 for byte in whole[300:400]) + whole[400:]
    other = path.with_name("other.zip")
    with zipfile.ZipFile(other, "w") as archive:
        archive.writestr("hello", "world")
    yield "a foreign archive", other.read_bytes()
    for name, content in (
        ("list", [torch.zeros(3)]),
        ("numbers", {"step": 3}),
        ("tensor", torch.zeros(3)),
    ):
        torch.save(content, other)
        yield name, other.read_bytes()
    torch.save({"path": Path("x")}, other)
    yield "an object", other.read_bytes()


def test_a_damaged_checkpoint_is_one_sentence(path: Path, tmp_path: Path) -> None:
    with opened(path) as folder:
        folder.save_checkpoint(STATE)
    whole = tmp_path / "checkpoint.pt"
    shutil.copy(path / "checkpoint.pt", whole)
    for name, content in damaged_checkpoints(whole):
        (path / "checkpoint.pt").write_bytes(content)
        with opened(path) as folder, pytest.raises(RunError) as caught:
            folder.checkpoint()
        said = str(caught.value)
        assert said.startswith(f"{path / 'checkpoint.pt'} is "), name
        assert said.endswith(": train again with --restart"), name
        assert "\n" not in said, name


def test_a_missing_file_is_one_sentence(path: Path) -> None:
    with pytest.raises(RunError, match=r"has no checkpoint\.pt yet: train it first$"):
        runs.load_checkpoint(path / "checkpoint.pt")
    with pytest.raises(RunError, match=r"is not a run's folder: it has no config\.json"):
        runs.read_json(path / "config.json")


def test_what_does_not_fit_is_one_sentence() -> None:
    for error in (
        KeyError("step"),
        RuntimeError("size mismatch\nfor x"),
        TypeError("no"),
        ValueError(),
    ):
        with pytest.raises(RunError) as caught, runs.fitting(Path("checkpoint.pt")):
            raise error
        assert str(caught.value).startswith("checkpoint.pt does not fit its run (")
        assert "\n" not in str(caught.value)
    with pytest.raises(UsageError, match=r"^mine$"), runs.fitting(Path("checkpoint.pt")):
        raise UsageError("mine")
    with pytest.raises(ZeroDivisionError), runs.fitting(Path("checkpoint.pt")):
        raise ZeroDivisionError


def rows(path: Path) -> list[dict[str, str]]:
    with (path / "metrics.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def test_metrics_are_appended(path: Path) -> None:
    with opened(path) as folder:
        folder.append_metrics({"step": 1, "a,b": 0.25, "c": None})
        folder.append_metrics({"step": 2, "a,b": 1e-17, "c": -3.0})
    assert (path / "metrics.csv").read_bytes().splitlines(keepends=True)[0] == b'step,"a,b",c\n'
    assert rows(path) == [
        {"step": "1", "a,b": "0.25", "c": ""},
        {"step": "2", "a,b": "1e-17", "c": "-3.0"},
    ]


@pytest.mark.parametrize(("step", "kept"), [(0, 0), (3, 3), (5, 5)])
@pytest.mark.parametrize("torn", [b"", b"6,", b"6,0.12", b"6"])
def test_metrics_are_rewound(step: int, kept: int, torn: bytes, path: Path) -> None:
    with opened(path) as folder:
        for number in range(1, 6):
            folder.append_metrics({"step": number, "loss": number / 7})
        whole = (path / "metrics.csv").read_bytes()
        with (path / "metrics.csv").open("ab") as file:
            file.write(torn)
        folder.rewind_metrics(step)
        lines = whole.splitlines(keepends=True)
        assert (path / "metrics.csv").read_bytes() == b"".join(lines[: kept + 1])
        for number in range(kept + 1, 6):
            folder.append_metrics({"step": number, "loss": number / 7})
        assert (path / "metrics.csv").read_bytes() == whole


@pytest.mark.parametrize("torn", [b"", b"st", b"step,loss"])
def test_metrics_whose_header_is_torn_begin_anew(torn: bytes, path: Path) -> None:
    with opened(path) as folder:
        folder.rewind_metrics(0)
        assert not (path / "metrics.csv").exists()
        (path / "metrics.csv").write_bytes(torn)
        folder.rewind_metrics(0)
        folder.append_metrics({"step": 1, "loss": 0.5})
        assert (path / "metrics.csv").read_bytes() == b"step,loss\n1,0.5\n"


@pytest.mark.parametrize("content", [b"step,loss\nhello,1\n", b"step\n\xff\xff\n", b"a\n\n\n"])
def test_damaged_metrics_are_one_sentence(content: bytes, path: Path) -> None:
    with opened(path) as folder:
        (path / "metrics.csv").write_bytes(content)
        with pytest.raises(RunError, match=r"metrics\.csv is damaged .*with --restart$"):
            folder.rewind_metrics(3)


def test_json_has_a_fixed_order_and_no_nan() -> None:
    assert runs.to_json({"b": [1, 2.5], "a": None}) == (
        b'{\n "a": null,\n "b": [\n  1,\n  2.5\n ]\n}\n'
    )
    with pytest.raises(ValueError, match="not JSON compliant"):
        runs.to_json({"a": float("nan")})


def test_flatten() -> None:
    nested = {"a": {"b": 1, "c": {"d": [2]}}, "e": None}
    assert runs.flatten(nested) == {"a.b": 1, "a.c.d": [2], "e": None}


def test_rows_of_a_later_version_keep_the_columns(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path / "run", {}, restart=False)
    folder.append_metrics({"step": 1, "a": 0.5, "b": 2.0})
    folder.append_metrics({"step": 2, "new": 9.0, "b": 3.0})
    folder.close()
    assert (tmp_path / "run" / "metrics.csv").read_text() == "step,a,b\n1,0.5,2.0\n2,,3.0\n"


def test_the_setting_of_a_damaged_run_is_one_sentence(tmp_path: Path) -> None:
    (tmp_path / "config.json").write_text('{"settings": {"actor_critic": 3}}')
    with pytest.raises(RunError, match=r"config\.json does not fit its run \('int' object"):
        begun_with(tmp_path, "precision")
    assert begun_with(tmp_path / "none", "precision") is None


def test_settings_that_differ_are_told_before_what_follows_from_them(tmp_path: Path) -> None:
    there, asked = ({"groups": {"seen": [n]}, "settings": {"validate": n > 1}} for n in (1, 2))
    (tmp_path / "config.json").write_text(json.dumps(there))
    with pytest.raises(RunError, match=r"holds a run with settings\.validate = False, this one"):
        check_folder(tmp_path, asked, restart=False)
