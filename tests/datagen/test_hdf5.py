"""Columns and meta to HDF5 and back; nothing but columns is ever followed or read."""

from __future__ import annotations

import pickle
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from datagen.hdf5 import decode, encode
from tests.datagen.examples import hand_made_file, task_data

EXAMPLE = task_data(3)
N = len(EXAMPLE)


def test_the_same_data_give_the_same_bytes_at_any_time() -> None:
    first = encode(EXAMPLE.columns, EXAMPLE.meta)
    time.sleep(1.1)
    shuffled = dict(reversed(EXAMPLE.columns.items()))
    assert encode(shuffled, dict(reversed(EXAMPLE.meta.items()))) == first


def test_what_goes_in_comes_out() -> None:
    columns, meta = decode(encode(EXAMPLE.columns, EXAMPLE.meta))
    assert meta == EXAMPLE.meta
    assert list(columns) == list(EXAMPLE.columns)
    for name, column in columns.items():
        assert column.dtype == EXAMPLE.columns[name].dtype
        assert column.tobytes() == EXAMPLE.columns[name].tobytes()


def test_a_meta_larger_than_an_hdf5_message_comes_out_too() -> None:
    meta = {**EXAMPLE.meta, "config": {"text": "x" * 200_000}}
    assert decode(encode(EXAMPLE.columns, meta))[1] == meta


def test_columns_are_contiguous_and_the_file_has_no_slack(tmp_path: Path) -> None:
    content = encode(EXAMPLE.columns, EXAMPLE.meta)
    (tmp_path / "x.h5").write_bytes(content)
    with h5py.File(tmp_path / "x.h5") as file:
        assert list(file.attrs) == ["meta"]
        for dataset in file.values():
            assert dataset.chunks is None
            assert dataset.compression is None
            assert len(dataset) == N
    values = sum(column.nbytes for column in EXAMPLE.columns.values())
    assert len(content) < values + 5_000


def replace_column(name: str, **kwargs: Any) -> Callable[[h5py.File], None]:
    """An edit that makes a column anew with these arguments of create_dataset."""

    def edit(file: h5py.File) -> None:
        values = file[name][...]
        del file[name]
        file.create_dataset(name, **{"data": values, **kwargs})

    return edit


def external_link(file: h5py.File) -> None:
    other = Path(file.filename).with_name("other.h5")
    with h5py.File(other, "w") as target:
        target["rewards"] = file["rewards"][...]
    del file["rewards"]
    file["rewards"] = h5py.ExternalLink(str(other), "rewards")


def soft_link(file: h5py.File) -> None:
    file.move("rewards", "elsewhere")
    file["rewards"] = h5py.SoftLink("/elsewhere")


def dangling_link(file: h5py.File) -> None:
    del file["rewards"]
    file["rewards"] = h5py.SoftLink("/nowhere")


def external_storage(file: h5py.File) -> None:
    other = Path(file.filename).with_name("raw.bin")
    other.write_bytes(file["rewards"][...].tobytes())
    del file["rewards"]
    file.create_dataset("rewards", (N,), "<f4", external=[(str(other), 0, 4 * N)])


def virtual_dataset(file: h5py.File) -> None:
    other = Path(file.filename).with_name("other.h5")
    with h5py.File(other, "w") as target:
        target["rewards"] = file["rewards"][...]
    layout = h5py.VirtualLayout((N,), "<f4")
    layout[:] = h5py.VirtualSource(str(other), "rewards", shape=(N,))
    del file["rewards"]
    file.create_virtual_dataset("rewards", layout)


def huge_without_values(file: h5py.File) -> None:
    del file["rewards"]
    file.create_dataset("rewards", (2**40,), "<f4")


def group(file: h5py.File) -> None:
    del file["rewards"]
    file.create_group("rewards")["data"] = np.zeros(N, "f4")


def named_type(file: h5py.File) -> None:
    del file["rewards"]
    file["rewards"] = np.dtype("f4")


def pickled_objects(file: h5py.File) -> None:
    del file["rewards"]
    kind = h5py.vlen_dtype(np.uint8)
    objects = file.create_dataset("rewards", (N,), dtype=kind)
    objects[0] = np.frombuffer(pickle.dumps({"a": 1}), np.uint8)


def set_meta(value: Any) -> Callable[[h5py.File], None]:
    def edit(file: h5py.File) -> None:
        del file.attrs["meta"]
        if value is not None:
            file.attrs["meta"] = value

    return edit


FOREIGN: list[tuple[Callable[[h5py.File], Any], str]] = [
    (external_link, "'rewards' is a soft or external link"),
    (soft_link, "(is a soft or external link|does not know)"),
    (dangling_link, "'rewards' is a soft or external link"),
    (external_storage, "rewards keeps its values in another file"),
    (virtual_dataset, "rewards keeps its values in another file"),
    (huge_without_values, "rewards has no values stored"),
    (group, "'rewards' is a group or a type"),
    (named_type, "'rewards' is a group or a type"),
    (pickled_objects, "column rewards is object"),
    (lambda f: f.create_dataset("extra", data=np.zeros(3)), "has a column 'extra'"),
    (lambda f: f.create_dataset("Ünknown", data=[1]), "has a column 'Ãnknown'|'.xdcnknown'"),
    (lambda f: f.create_group("infos"), "'infos' is a group"),
    (replace_column("rewards", dtype="f8"), "rewards is float64"),
    (replace_column("rewards", dtype=">f4"), "rewards is >f4"),
    (replace_column("terminals", dtype="u1"), "terminals is uint8"),
    (replace_column("rewards", data=["text"] * N), "rewards is object"),
    (replace_column("rewards", chunks=(10,)), "rewards is chunked or compressed"),
    (replace_column("rewards", compression="gzip"), "rewards is chunked or compressed"),
    (replace_column("rewards", data=h5py.Empty("f4")), "rewards has no shape"),
    (lambda f: f["rewards"].attrs.create("note", 1), "column rewards has attributes"),
    (lambda f: f.attrs.create("code", np.void(pickle.dumps(1))), "has the attributes"),
    (set_meta(None), r"has the attributes \[\]"),
    (set_meta("a text of any length"), "'meta' is not a fixed-length text but object"),
    (set_meta(np.void(pickle.dumps({"a": 1}))), "'meta' is not a fixed-length text"),
    (set_meta(np.array([b"{}", b"{}"])), "'meta' is not a fixed-length text"),
    (set_meta(np.bytes_(b"{")), "'meta' is not JSON"),
    (set_meta(np.bytes_(b"{}")), "'meta' is not as it was written"),
    (set_meta(np.bytes_(b"\x80\x04}\x94.")), "'meta' holds bytes that are not text"),
]


@pytest.mark.parametrize(("edit", "fault"), FOREIGN)
def test_what_is_no_column_is_refused(
    tmp_path: Path, edit: Callable[[h5py.File], Any], fault: str
) -> None:
    path = hand_made_file(tmp_path / "x.h5", EXAMPLE.columns, EXAMPLE.meta, edit)
    with pytest.raises(ValueError, match=fault):
        decode(path.read_bytes())


def test_a_hand_made_file_is_as_good_as_a_written_one(tmp_path: Path) -> None:
    path = hand_made_file(tmp_path / "x.h5", EXAMPLE.columns, EXAMPLE.meta)
    columns, meta = decode(path.read_bytes())
    assert {**EXAMPLE.meta, "content_sha256": meta["content_sha256"]} == meta
    assert all((columns[name] == EXAMPLE.columns[name]).all() for name in columns)


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        (lambda content: b"", "is empty"),
        (lambda content: b"obs,act\n" * 100, "is not an HDF5 file"),
        (lambda content: content[:20], "is truncated to 20 bytes"),
        (lambda content: content[:3000], "is truncated to 3000 of its [0-9]+ bytes"),
        (lambda content: content + b"12345", "has 5 foreign bytes behind its end"),
        (lambda content: content[:13] + b"\xff" + content[14:], "is damaged inside"),
        (lambda content: content[:8] + bytes(len(content) - 8), "is damaged inside"),
    ],
)
def test_damage_is_said_in_plain_words(change: Callable[[bytes], bytes], fault: str) -> None:
    with pytest.raises(ValueError, match=fault):
        decode(change(encode(EXAMPLE.columns, EXAMPLE.meta)))
