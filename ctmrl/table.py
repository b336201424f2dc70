"""A table of float32 rows: in memory, or in a file where memory would not hold it.

The file has no name: whatever happens to the process, nothing of it stays. It is mapped into
memory, so rows are read the same way wherever they are, and the system keeps as many of them at
hand as it has room for.
"""

from __future__ import annotations

import errno
import mmap
import os
import shutil
import tempfile
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ctmrl.errors import UsageError

SHARE = 0.5
"""Most of the available memory that a table may take."""
READERS = 8
"""Threads that wait for the disk: so many reads are on their way at once."""
MEMINFO = Path("/proc/meminfo")
GROUP = Path("/sys/fs/cgroup")
"""Linux's account of its memory, and the folder of a container's."""


def available_memory() -> int:
    """Bytes of memory that can be had without taking them from others; all there is if unknown."""
    try:
        fields = dict(line.split(":") for line in MEMINFO.read_text().splitlines())
        available = 1024 * int(fields["MemAvailable"].split()[0])
    except (OSError, KeyError, ValueError):
        available = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    try:
        limit = int((GROUP / "memory.max").read_text())
    except (OSError, ValueError):
        return available
    return min(available, max(limit - _taken(), 0))


def _taken() -> int:
    """Bytes of memory that a container holds and cannot give away; 0 if unknown."""
    try:
        fields = dict(line.split() for line in (GROUP / "memory.stat").read_text().splitlines())
        # Of the copies of files, those it has not read lately are given away first.
        return int((GROUP / "memory.current").read_text()) - int(fields.get("inactive_file", 0))
    except (OSError, ValueError):
        return 0


@dataclass(frozen=True)
class Room:
    """Where a table may lie.

    Attributes:
        memory: most GB (1e9 bytes) of memory it may take; None for `SHARE` of what is available.
        folder: where its file would be, or else in the nearest folder above that exists.
    """

    memory: float | None = None
    folder: Path = Path()

    def table(self, rows: int, width: int) -> Table:
        """An empty table, in memory if it may lie there.

        Raises:
            UsageError: neither memory nor the disk has the room.
        """
        size = rows * width * np.dtype(np.float32).itemsize
        limit = SHARE * available_memory() if self.memory is None else 1e9 * self.memory
        need = f"the training data take {size / 1e9:.2f} GB as a table, "
        if size <= limit:
            try:
                return Table(torch.from_numpy(np.empty((rows, width), dtype=np.float32)))
            except MemoryError:
                raise UsageError(
                    f"{need}more memory than there is: --memory 0 keeps them in a file"
                ) from None
        folder = next(one for one in (self.folder, *self.folder.parents) if one.is_dir())
        try:
            # Some file systems find out only when they are full.
            if size > shutil.disk_usage(folder).free:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            with tempfile.TemporaryFile(dir=folder) as file:
                file.truncate(size)
                # Where the system can promise the room, it is full now rather than later.
                if hasattr(os, "posix_fallocate"):
                    os.posix_fallocate(file.fileno(), 0, size)
                mapping = mmap.mmap(file.fileno(), size)
        except OSError as error:
            raise UsageError(
                f"{need}and {folder} cannot hold them ({error.strerror}): make room, give --out "
                "on another disk, or raise --memory"
            ) from None
        values = np.frombuffer(mapping, dtype=np.float32).reshape(rows, width)
        return Table(torch.from_numpy(values), mapping)


class Table:
    """Rows of float32, made by `Room.table`.

    Attributes:
        values: [rows, width], to be filled.
        in_file: whether they are in a file.
    """

    def __init__(self, values: Tensor, mapping: mmap.mmap | None = None) -> None:
        """Wrap them.

        Args:
            values: the rows.
            mapping: of the file they are in, if they are.
        """
        self.values = values
        self._mapping = mapping
        self._readers = ThreadPoolExecutor(READERS) if mapping else None

    @property
    def in_file(self) -> bool:
        """Whether the rows are in a file."""
        return self._mapping is not None

    def filled(self) -> None:
        """From now on rows are read here and there, so nothing beside them is worth reading."""
        if self._mapping:
            self._mapping.madvise(mmap.MADV_RANDOM)

    def page_in(self, rows: Tensor) -> None:
        """Begin to read rows, numbers [n], from the file, if they are in one; returns at once.

        What is read is thrown away: the system has it then, and the next one to ask need not wait.
        """
        if self._readers:
            for part in rows.chunk(READERS):
                self._readers.submit(self.values.index_select, 0, part)
