"""Whole datasets: opened, read, and refused after each of 500 accidents."""

from __future__ import annotations

import json
import re
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from datagen import dataset as public
from datagen.dataset import Dataset, DatasetError, Slice, open_dataset, write_index, write_task
from datagen.files import digest
from meta_envs import task_set
from tests.datagen.examples import index_of, task_data, write_dataset

DOCS = Path(__file__).parents[2] / "docs" / "dataset_format.md"
TASKS = (0, 1, 2, 3)


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset of four tasks, not to be written to."""
    return write_dataset(tmp_path_factory.mktemp("datasets") / "point_robot_wind", TASKS)


@pytest.fixture
def folder(original: Path, tmp_path: Path) -> Path:
    """A copy of it."""
    return shutil.copytree(original, tmp_path / "point_robot_wind")


def test_every_public_name_is_there() -> None:
    assert all(hasattr(public, name) for name in public.__all__)


def test_an_opened_dataset_knows_its_tasks(tmp_path: Path) -> None:
    folder = write_dataset(tmp_path / "mine", tasks=(7, 2, 4, 11))
    for path in (folder, str(folder)):
        dataset = open_dataset(path)
        assert dataset.path == folder
        assert dataset.env == "point_robot_wind"
        assert dataset.tasks.tolist() == [2, 4, 7, 11]
        assert dataset.test_tasks.tolist() == [2, 7]
        assert dataset.train_tasks.tolist() == [4, 11]
        assert dataset.tasks.dtype == dataset.test_tasks.dtype == np.int64
        assert (dataset.params == task_set("point_robot_wind").params[[2, 4, 7, 11]]).all()
        assert dataset.hash == dataset.index["sha256"]
        assert dataset.entry(7)["file"] == "task_007.h5"


def test_what_is_written_is_read(original: Path) -> None:
    dataset = open_dataset(original, verify=False)
    for task in TASKS:
        found, written = dataset.read(task), task_data(task)
        assert found.task == task
        for name, column in written.columns.items():
            assert found.columns[name].tobytes() == column.tobytes()


def test_the_hash_stands_for_the_whole_dataset(original: Path, tmp_path: Path) -> None:
    index = json.loads((original / "dataset.json").read_text())
    stated = index.pop("sha256")
    assert stated == digest(json.dumps(index, sort_keys=True, indent=1) + "\n")
    other = write_dataset(tmp_path / "point_robot_wind", TASKS, seed=1)
    assert open_dataset(other).hash != stated


def test_an_index_is_checked_before_it_is_written(folder: Path) -> None:
    before = (folder / "dataset.json").read_bytes()
    index = index_of(folder, "point_robot_wind", TASKS, 4, 0)
    for key, value in (("seed", None), ("config", {"x": float("inf")}), ("versions", {1, 2})):
        with pytest.raises(DatasetError, match=r"dataset\.json: .*; nothing was written"):
            write_index(folder, {**index, key: value})
    assert (folder / "dataset.json").read_bytes() == before
    write_index(folder, {**index, "sha256": "of another time"})
    assert (folder / "dataset.json").read_bytes() == before


def test_ten_megabytes_open_in_well_under_a_second(tmp_path: Path) -> None:
    folder = write_dataset(tmp_path / "point_robot_wind", range(4), episodes=2600)
    size = sum(path.stat().st_size for path in folder.iterdir())
    assert size > 9e6
    start = time.perf_counter()
    dataset = open_dataset(folder)
    opened = time.perf_counter()
    for task in dataset.tasks.tolist():
        dataset.read(task)
    assert opened - start < 0.5
    assert time.perf_counter() - opened < 1.0


def refuse(folder: Path, fault: str, task: int | None = None) -> None:
    """The dataset, or the one task of it, must be refused with this message."""
    with pytest.raises(DatasetError, match=fault):
        open_dataset(folder)
    if task is not None:
        dataset = open_dataset(folder, verify=False)
        with pytest.raises(DatasetError, match=fault):
            dataset.read(task)
        assert len(dataset.read(0)) == 100


def test_what_happened_to_a_file_is_said(folder: Path, tmp_path: Path) -> None:
    path = folder / "task_003.h5"
    content = path.read_bytes()
    remedy = (
        "delete it and run `python -m datagen.collect --env point_robot_wind --tasks 3 "
        f"--budget smoke --seed 0 --engine sb3 --out {folder}`, or fetch it again"
    )
    other_env = write_dataset(tmp_path / "sparse_point_robot", (3,), "sparse_point_robot")
    other_seed = write_dataset(tmp_path / "other", (3,), seed=1)
    with h5py.File(tmp_path / "foreign.h5", "w") as file:
        file["data"] = np.arange(10)
    sizes = (
        rf"\([0-9]+ bytes with the SHA-256 \w+\.\.\., recorded are {len(content)} with \w+\.\.\.\)"
    )
    valid = f"but not the recorded one {sizes}; if dataset.json is what is out .*, otherwise "
    accidents: list[tuple[bytes, str]] = [
        (content[:5000], f"is truncated to 5000 of its {len(content)} bytes {sizes}; "),
        (content + b"123", f"has 3 foreign bytes behind its end {sizes}; "),
        (content[:-100] + b"x" + content[-99:], f"its values are not those .* {sizes}; "),
        (content[:600] + b"x" + content[601:], f"is damaged inside, .* {sizes}; "),
        (b"", f"is empty {sizes}; "),
        (b"once upon a time", f"is not an HDF5 file {sizes}; "),
        (bytes(10**7), f"is a foreign file of 10000000 bytes, must have {len(content)}; "),
        (
            (folder / "task_001.h5").read_bytes(),
            "is really the file of task 1, renamed or copied; ",
        ),
        ((other_env / "task_003.h5").read_bytes(), f"is .* 3 of sparse_point_robot, {valid}"),
        ((other_seed / "task_003.h5").read_bytes(), f"is .* 3 of point_robot_wind, {valid}"),
        ((tmp_path / "foreign.h5").read_bytes(), rf"has the attributes \[\].* {sizes}; "),
    ]
    for bytes_found, fault in accidents:
        path.write_bytes(bytes_found)
        refuse(folder, f"^{re.escape(str(path))}: {fault}{re.escape(remedy)}$", 3)
    path.unlink()
    refuse(folder, f"task_003.h5: is missing; {re.escape(remedy)}", 3)
    path.mkdir()
    refuse(folder, "task_003.h5: is a folder, not a file; move it away and delete", 3)


def test_a_true_hash_of_a_wrong_file_is_found_when_it_is_read(folder: Path) -> None:
    data = task_data(3)
    data.meta["returns"]["expert"] = -4.0
    write_task(folder / "task_003.h5", data)
    index = index_of(folder, "point_robot_wind", TASKS, 4, 0)
    write_index(folder, index)
    with pytest.raises(
        DatasetError, match=r"task_003.h5: differs from dataset.json in its returns"
    ):
        open_dataset(folder).read(3)
    write_task(folder / "task_003.h5", task_data(3))
    index = index_of(folder, "point_robot_wind", TASKS, 4, 0)
    index["tasks"][3]["transitions"] = 101
    write_index(folder, index)
    with pytest.raises(DatasetError, match=r"differs from dataset.json in its transitions; delete"):
        open_dataset(folder).read(3)


def test_an_index_of_another_dataset_is_suspected(folder: Path, tmp_path: Path) -> None:
    other = write_dataset(tmp_path / "other" / "point_robot_wind", TASKS, seed=1)
    shutil.copy(other / "dataset.json", folder)
    fault = "task_000.h5: is a valid file of task 0 of point_robot_wind, but not the recorded one"
    refuse(folder, f"{fault} .*; if dataset.json is what is out of place, replace that, otherwise")


def test_a_task_it_does_not_have(original: Path) -> None:
    dataset = open_dataset(original)
    for ask in (dataset.read, dataset.entry, dataset.verify):
        with pytest.raises(DatasetError, match=r"has no task 9, only 0, 1, 2, 3; .*--tasks 9"):
            ask(9)


def test_no_dataset_is_said(folder: Path, tmp_path: Path) -> None:
    refuse(
        tmp_path / "point_robot",
        "no dataset is there; run .*--env point_robot --out .*point_robot`",
    )
    refuse(folder / "task_000.h5", "is a file, not a dataset's folder; give the folder")
    refuse(folder / "task_000.h5" / "x", "no dataset is there")
    (tmp_path / "loop").symlink_to("loop")
    refuse(tmp_path / "loop", "loop: cannot be read")
    (folder / "dataset.json").unlink()
    refuse(folder, "dataset.json: is missing; run .*--env point_robot_wind .*to finish the dataset")


def test_an_index_of_other_times_is_told_from_damage(folder: Path) -> None:
    index = json.loads((folder / "dataset.json").read_text())
    del index["sha256"]
    edits: list[tuple[dict[str, Any], str]] = [
        ({"format_version": 2}, "is of format version 2, this program reads version 1"),
        ({"task_hash": "0" * 64}, "belongs to another version of point_robot_wind"),
        ({"env": "point_robot_rain"}, "no environment 'point_robot_rain'"),
        ({"tasks": []}, "has no tasks"),
    ]
    for edit, fault in edits:
        edited = {**index, **edit}
        edited["sha256"] = digest(json.dumps(edited, sort_keys=True, indent=1) + "\n")
        (folder / "dataset.json").write_text(json.dumps(edited, sort_keys=True, indent=1) + "\n")
        command = (
            "run `python -m datagen.collect --env point_robot_wind --budget smoke --seed 0 "
            f"--engine sb3 --out {folder}`, which keeps intact task files, or fetch the dataset "
            "again"
        )
        refuse(folder, f"dataset.json: {fault}.*; {re.escape(command)}")
    edited = {**index, "seed": 1, "sha256": digest("something else")}
    (folder / "dataset.json").write_text(json.dumps(edited, sort_keys=True, indent=1) + "\n")
    refuse(folder, "dataset.json: does not have the hash it states")


class Accidents:
    """Random accidents that befall the files of a dataset's copy."""

    def __init__(self, folder: Path, strangers: list[bytes], seed: int) -> None:
        self.folder = folder
        self.strangers = strangers
        self.generator = np.random.default_rng(seed)
        self.whole = {path.name: path.read_bytes() for path in folder.iterdir()}
        self.kinds: list[Callable[[bytearray], None]] = [
            self.flip_bit,
            self.scramble,
            self.zero,
            self.truncate,
            self.extend,
            self.cut_out,
            self.stranger,
        ]

    def draw(self, end: int) -> int:
        return int(self.generator.integers(end))

    def flip_bit(self, content: bytearray) -> None:
        content[self.draw(len(content))] ^= 1 << self.draw(8)

    def scramble(self, content: bytearray) -> None:
        for _ in range(1 + self.draw(20)):
            content[self.draw(len(content))] = self.draw(256)

    def zero(self, content: bytearray) -> None:
        start = self.draw(len(content))
        stop = min(len(content), start + 1 + self.draw(2000))
        content[start:stop] = bytes(stop - start)

    def truncate(self, content: bytearray) -> None:
        del content[self.draw(len(content)) :]

    def extend(self, content: bytearray) -> None:
        content += self.generator.bytes(1 + self.draw(1000))

    def cut_out(self, content: bytearray) -> None:
        start = self.draw(len(content))
        del content[start : start + 1 + self.draw(200)]

    def stranger(self, content: bytearray) -> None:
        content[:] = self.strangers[self.draw(len(self.strangers))]

    def happen(self) -> set[str]:
        """One accident to the whole dataset; returns the names of the files it changed."""
        for name, content in self.whole.items():
            (self.folder / name).write_bytes(content)
        names = sorted(self.whole)
        name = names[self.draw(len(names))]
        if self.draw(8) == 0:
            other = names[(names.index(name) + 1 + self.draw(len(names) - 1)) % len(names)]
            path, changed = self.folder / name, {name}
            kind = self.draw(3)
            if kind == 0:
                path.unlink()
            elif kind == 1:
                path.replace(self.folder / other)
                changed.add(other)
            else:
                path.write_bytes(self.whole[other])
                (self.folder / other).write_bytes(self.whole[name])
                changed.add(other)
            return changed
        changing = bytearray(self.whole[name])
        while bytes(changing) == self.whole[name]:
            self.kinds[self.draw(len(self.kinds))](changing)
        (self.folder / name).write_bytes(changing)
        return {name}


def message_of(action: Callable[[], Any]) -> str | None:
    """Message of the DatasetError an action raises, None if it raises nothing."""
    try:
        action()
    except DatasetError as error:
        return str(error)
    return None


def read_all(folder: Path) -> None:
    dataset: Dataset = open_dataset(folder, verify=False)
    for task in dataset.tasks.tolist():
        dataset.read(task)


def test_500_random_accidents_are_all_refused(folder: Path, tmp_path: Path) -> None:
    others = [
        write_dataset(tmp_path / "a", (0, 1), "sparse_point_robot"),
        write_dataset(tmp_path / "b", (0, 1), seed=1),
    ]
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["rewards"] = np.zeros(100, "f4")
    strangers = [path.read_bytes() for other in others for path in other.glob("*.h5")]
    strangers += [b"", b"hello\n", (tmp_path / "other.h5").read_bytes(), DOCS.read_bytes()]
    accidents = Accidents(folder, strangers, seed=0)
    befallen: set[str] = set()
    for _ in range(500):
        changed = accidents.happen()
        befallen |= changed
        for message in (
            message_of(lambda: open_dataset(folder)),
            message_of(lambda: read_all(folder)),
        ):
            assert message is not None, changed
            assert any(message.startswith(f"{folder / name}: ") for name in changed), message
            assert "run `python -m datagen.collect --env " in message
            assert str(folder) in message.partition("; ")[2]
    assert befallen == set(accidents.whole)


def test_tasks_that_are_for_training_and_for_the_test_are_both(tmp_path: Path) -> None:
    """HalfCheetahDir's two directions, as the field has them; ant_dir's are one or the other."""
    dataset = open_dataset(write_dataset(tmp_path / "both", (0, 1), "half_cheetah_dir", 2))
    for rows in (dataset.tasks, dataset.train_tasks, dataset.test_tasks):
        assert rows.tolist() == [0, 1]
    assert [record["split"] for record in dataset.index["tasks"]] == ["train", "train"]
    others = task_set("ant_dir")
    on_both = {"train": others.train_tasks.tolist(), "test": others.test_tasks.tolist()}
    for side, rows in on_both.items():
        assert {others.split_of(task) for task in rows} == {side}


def test_the_documented_snippets_work(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(folder.parent)
    Path("datasets").mkdir()
    shutil.copytree(folder, "datasets/point_robot_wind")
    snippets = re.findall(r"```python\n(.*?)```", DOCS.read_text(), flags=re.DOTALL)
    assert len(snippets) == 3
    names: dict[str, Any] = {}
    for snippet in snippets:
        exec(snippet, names)
    assert capsys.readouterr().out == "point_robot_wind 3 (100,)\n"
    assert names["expert"].part == Slice("expert", 2)
    assert names["data"].task == 3
    assert names["rows"] == 4 * 50
    with h5py.File("datasets/point_robot_wind/task_003.h5", "r+") as file:
        file["rewards"][7] += 1.0
    with pytest.raises(AssertionError):
        exec(snippets[1], {})


def test_the_documented_tables_are_complete() -> None:
    text = DOCS.read_text()
    for name, dtype in public.COLUMNS.items():
        assert re.search(rf"^\| `{name}` \| {dtype.name} \|", text, flags=re.MULTILINE), name
    for key in (*task_data(0).meta, "content_sha256", "budget", "file", "bytes", "transitions"):
        assert f"`{key}`" in text, key
