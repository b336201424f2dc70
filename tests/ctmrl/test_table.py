"""Where a table lies, what is left of its file, and that reading ahead reads what it should."""

from __future__ import annotations

import os
import threading
from pathlib import Path

import pytest
import torch
from torch import Tensor

from ctmrl import table
from ctmrl.errors import UsageError
from ctmrl.table import READERS, Room, available_memory


@pytest.fixture
def machine(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> tuple[Path, Path]:
    """A machine with 4,000,000 bytes available, in a container without a limit."""
    meminfo, limit = tmp_path / "meminfo", tmp_path / "group" / "memory.max"
    limit.parent.mkdir()
    meminfo.write_text("MemTotal:  9000 kB\nMemAvailable:    3906 kB\nHugePages_Total:  0\n")
    limit.write_text("max\n")
    monkeypatch.setattr(table, "MEMINFO", meminfo)
    monkeypatch.setattr(table, "GROUP", limit.parent)
    return meminfo, limit


def test_the_memory_that_is_available(machine: tuple[Path, Path]) -> None:
    meminfo, limit = machine
    assert available_memory() == 3906 * 1024
    limit.write_text("5000\n")
    assert available_memory() == 5000
    limit.unlink()
    assert available_memory() == 3906 * 1024
    everything = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    for unknown in ("MemTotal:  9000 kB\n", "MemAvailable: much\n", "nothing"):
        meminfo.write_text(unknown)
        assert available_memory() == everything
    meminfo.unlink()
    assert available_memory() == everything


def test_what_a_container_holds_is_not_available(machine: tuple[Path, Path]) -> None:
    limit = machine[1]
    limit.write_text("5000\n")
    limit.with_name("memory.current").write_text("3000\n")
    stat = limit.with_name("memory.stat")
    # What it holds of files that it has read it can give away.
    stat.write_text("anon 1200\nfile 1800\ninactive_file 700\nactive_file 1100\n")
    assert available_memory() == 5000 - (3000 - 700)
    limit.with_name("memory.current").write_text("9000\n")
    assert available_memory() == 0
    limit.write_text("9000000\n")
    assert available_memory() == 3906 * 1024
    limit.write_text("5000\n")
    limit.with_name("memory.current").write_text("3000\n")
    stat.write_text("anon 1200\n")
    assert available_memory() == 2000
    for unknown in ("inactive_file much\n", "nothing\n"):
        stat.write_text(unknown)
        assert available_memory() == 5000


@pytest.mark.parametrize(
    ("memory", "rows", "in_file"),
    [
        # Half of 3906 kB are 49996 rows of 40 bytes.
        (None, 49_996, False),
        (None, 49_997, True),
        (0.001, 25_000, False),
        (0.001, 25_001, True),
        (0, 1, True),
        (1, 49_997, False),
    ],
)
@pytest.mark.usefixtures("machine")
def test_where_a_table_lies(memory: float | None, rows: int, in_file: bool, tmp_path: Path) -> None:
    made = Room(memory, tmp_path).table(rows, 10)
    assert made.in_file == in_file
    assert made.values.shape == (rows, 10)
    assert made.values.dtype == torch.float32


def test_a_file_holds_what_is_put_into_it_and_has_no_name(tmp_path: Path) -> None:
    # The run's folder may not be there yet, and is not made.
    one, other = (Room(0, tmp_path / "runs" / "seed-0").table(1009, 7) for _ in range(2))
    wanted = torch.rand(1009, 7)
    one.values[:] = wanted
    other.values[:] = -wanted
    one.filled()
    assert one.values.equal(wanted)
    assert other.values.equal(-wanted)
    assert not list(tmp_path.iterdir())
    maps = Path("/proc/self/maps")
    if maps.exists():
        assert str(tmp_path) in maps.read_text()
        del one, other
        assert str(tmp_path) not in maps.read_text()


def test_a_full_disk_is_one_sentence(tmp_path: Path) -> None:
    with pytest.raises(UsageError) as caught:
        Room(0, tmp_path).table(10**14, 10)
    assert str(caught.value) == (
        f"the training data take 4000000.00 GB as a table, and {tmp_path} cannot hold them "
        "(No space left on device): make room, give --out on another disk, or raise --memory"
    )
    assert not list(tmp_path.iterdir())


def test_a_promise_that_memory_does_not_keep_is_one_sentence(tmp_path: Path) -> None:
    with pytest.raises(UsageError) as caught:
        Room(1e12, tmp_path).table(10**14, 1000)
    assert str(caught.value) == (
        "the training data take 400000000.00 GB as a table, more memory than there is: "
        "--memory 0 keeps them in a file"
    )


class Spied:
    """Remembers which rows were read in which thread."""

    def __init__(self) -> None:
        self.read: list[tuple[int, list[int]]] = []

    def index_select(self, dim: int, rows: Tensor) -> None:
        assert dim == 0
        self.read.append((threading.get_ident(), rows.tolist()))


@pytest.mark.parametrize("in_file", [False, True])
def test_reading_ahead_reads_each_row_once_in_other_threads(in_file: bool, tmp_path: Path) -> None:
    made = Room(0 if in_file else None, tmp_path).table(1009, 7)
    spied = Spied()
    made.values = spied  # type: ignore[assignment]
    rows = torch.randperm(1009)[:101]
    made.page_in(rows)
    if made._readers:
        made._readers.shutdown()
    assert sorted(row for _, part in spied.read for row in part) == sorted(rows.tolist()) * in_file
    assert len(spied.read) == READERS * in_file
    assert threading.get_ident() not in {thread for thread, _ in spied.read}
