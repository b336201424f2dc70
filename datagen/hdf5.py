"""The bytes of a task's file: columns and meta to HDF5 and back, in memory or part by part."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from io import BufferedReader
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from datagen.columns import COLUMNS
from datagen.files import canonical_json, parse_canonical

SIGNATURE = b"\x89HDF\r\n\x1a\n"
"""First bytes of every HDF5 file."""
_HEAD = 48
"""Bytes of the superblock, with which every HDF5 file of the present generation begins."""
# This generation of the file format guards all of its own structures by checksums, so that damage
# is found by the library instead of being followed. Every HDF5 since 1.8 reads it.
_LIBRARY_VERSION = ("v108", "v108")
# H5LT_FILE_IMAGE_DONT_COPY and H5LT_FILE_IMAGE_DONT_RELEASE, which h5py has no names for: read the
# bytes where they are, five times as fast. They are not written to and outlive the open file.
_IN_PLACE = 0x2 | 0x4


def encode(columns: Mapping[str, NDArray[Any]], meta: Mapping[str, Any]) -> bytes:
    """The HDF5 file of these columns and this meta; the same ones give the same bytes."""
    # Built in memory: the library cannot close a file that a full disk cut short.
    with h5py.File(
        "memory", "w", driver="core", backing_store=False, libver=_LIBRARY_VERSION
    ) as file:
        for name in (name for name in COLUMNS if name in columns):
            file.create_dataset(name, data=columns[name], track_times=False)
        text = canonical_json(meta).encode()
        file.attrs.create("meta", np.array(text, dtype=f"S{len(text)}"))
        file.flush()
        return bytes(file.id.get_file_image())


def decode(content: bytes) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """Columns and meta of an HDF5 file; reads nothing but the given bytes.

    Raises:
        ValueError: what is wrong with the file.
    """
    _check_length(content, len(content))
    with _readable(), h5py.File(h5py.h5f.open_file_image(content, flags=_IN_PLACE)) as file:
        fault = _structure_fault(file)
        if not fault:
            columns = {name: file[name][...] for name in COLUMNS if name in file}
            text = bytes(file.attrs["meta"])
    if fault:
        raise ValueError(fault)
    return columns, _parse_meta(text)


@dataclass(frozen=True, eq=False)
class ColumnFile:
    """An open HDF5 file of columns, of which parts can be read; made by `opened`.

    Attributes:
        meta: content of the attribute of this name.
        columns: the columns on the disk, by name.
    """

    meta: dict[str, Any]
    columns: dict[str, h5py.Dataset]

    def read(self, name: str, start: int, stop: int) -> NDArray[Any]:
        """Rows start to stop of a column.

        Raises:
            ValueError: HDF5 cannot read them.
        """
        with _readable():
            values: NDArray[Any] = self.columns[name][start:stop]
            return values


@contextmanager
def opened(handle: BufferedReader) -> Iterator[ColumnFile]:
    """Open an HDF5 file of columns without reading them; opens no other file.

    Args:
        handle: the file, open for reading; it stays open.

    Raises:
        ValueError: what is wrong with the file.
    """
    handle.seek(0)
    _check_length(handle.read(_HEAD), os.fstat(handle.fileno()).st_size)
    with _readable():
        file = h5py.File(handle, "r")
    with file:
        with _readable():
            fault = _structure_fault(file)
            text = b"" if fault else bytes(file.attrs["meta"])
        if fault:
            raise ValueError(fault)
        yield ColumnFile(_parse_meta(text), {name: file[name] for name in COLUMNS if name in file})


@contextmanager
def _readable() -> Iterator[None]:
    """Turn what HDF5 raises on damaged files, exceptions of nearly every type, into a ValueError.

    Raises:
        ValueError: it cannot read the file.
    """
    try:
        yield
    except Exception as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise ValueError(f"is damaged inside, HDF5 cannot read it ({reason})") from error


def _parse_meta(text: bytes) -> dict[str, Any]:
    try:
        return parse_canonical(text)
    except ValueError as error:
        raise ValueError(f"its attribute 'meta' {error}") from error


def _check_length(content: bytes, size: int) -> None:
    """Compare the length with the one the file itself states, before HDF5 looks at it.

    Args:
        content: the file, or its beginning.
        size: of the whole file in bytes.
    """
    if not size:
        raise ValueError("is empty")
    if not content.startswith(SIGNATURE):
        raise ValueError("is not an HDF5 file")
    if size < _HEAD:
        raise ValueError(f"is truncated to {size} bytes")
    # Superblock versions 2 and 3: version, sizes of addresses and lengths, flags, then three
    # addresses, of which the third is that of the end of the file.
    if content[8] not in (2, 3) or content[9] != 8:
        return
    stated = int.from_bytes(content[28:36], "little")
    if size < stated:
        raise ValueError(f"is truncated to {size} of its {stated} bytes")
    if size > stated:
        raise ValueError(f"has {size - stated} foreign bytes behind its end")


def _structure_fault(file: h5py.File) -> str:
    """What, if anything, an HDF5 file has that no task's file has; opens no other file."""
    if list(file.attrs) != ["meta"]:
        return f"has the attributes {sorted(map(ascii, file.attrs))}, must have 'meta' alone"
    meta = file.attrs.get_id("meta")
    if meta.dtype.kind != "S" or meta.shape != ():
        return f"its attribute 'meta' is not a fixed-length text but {meta.dtype} {meta.shape}"
    for name in file:
        if not isinstance(file.get(name, getlink=True), h5py.HardLink):
            return f"{name!a} is a soft or external link, which could lead anywhere"
        if not isinstance(file[name], h5py.Dataset):
            return f"{name!a} is a group or a type, not a column"
        fault = _dataset_fault(name, file[name])
        if fault:
            return fault
    return ""


def _dataset_fault(name: str, dataset: h5py.Dataset) -> str:
    """What keeps one HDF5 dataset from being read as a column."""
    if name not in COLUMNS:
        return f"has a column {name!a} the format does not know"
    if dataset.dtype != COLUMNS[name]:
        return f"column {name} is {dataset.dtype}, must be {COLUMNS[name]}"
    if list(dataset.attrs):
        return f"column {name} has attributes, must have none"
    if dataset.shape is None:
        return f"column {name} has no shape"
    layout = dataset.id.get_create_plist()
    if layout.get_layout() == h5py.h5d.VIRTUAL or layout.get_external_count():
        return f"column {name} keeps its values in another file"
    if layout.get_layout() != h5py.h5d.CONTIGUOUS or layout.get_nfilters():
        return f"column {name} is chunked or compressed, must be contiguous"
    # A dataset without storage reads as zeros of any size at all, up to filling the memory.
    if dataset.id.get_storage_size() != dataset.size * dataset.dtype.itemsize:
        return f"column {name} has no values stored"
    return ""
