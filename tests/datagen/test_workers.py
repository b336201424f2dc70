"""Worker processes: news, failures, deaths, and that none outlives its parent."""

from __future__ import annotations

import errno
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import closing

import pytest

from datagen.workers import THREAD_VARIABLES, Event, WorkerError, run_jobs
from tests.datagen.worker_jobs import die, raise_it, square


def alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    # A process nobody has waited for is dead, but still has its number.
    with open(f"/proc/{pid}/stat") as file:
        return file.read().rpartition(")")[2].split()[0] != "Z"


def wait_until(holds: Callable[[], bool], seconds: float = 30.0) -> bool:
    end = time.monotonic() + seconds
    while not holds() and time.monotonic() < end:
        time.sleep(0.02)
    return holds()


@pytest.fixture(scope="module")
def events() -> list[Event[dict[str, object]]]:
    return list(run_jobs(square, [3, 4, 5, 6, 7], 2))


def test_every_job_is_started_reports_and_is_done(events: list[Event[dict[str, object]]]) -> None:
    for index, job in enumerate([3, 4, 5, 6, 7]):
        own = [event for event in events if event.index == index]
        assert [event.kind for event in own] == ["started", "step", "done"]
        assert own[1].value == job
        assert isinstance(own[2].value, dict)
        assert own[2].value["square"] == job * job
    starts = [event.index for event in events if event.kind == "started"]
    assert starts == sorted(starts)


def test_workers_have_one_thread_and_ignore_ctrl_c(events: list[Event[dict[str, object]]]) -> None:
    values = [event.value for event in events if isinstance(event.value, dict)]
    assert 1 <= len({value["pid"] for value in values}) <= 2
    assert os.getpid() not in {value["pid"] for value in values}
    assert all(value["threads"] == {"1"} for value in values)
    assert all(value["ignores_interrupts"] for value in values)


def test_the_parent_keeps_its_own_settings(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(THREAD_VARIABLES[0], "7")
    monkeypatch.delenv(THREAD_VARIABLES[1], raising=False)
    handler = signal.getsignal(signal.SIGINT)
    assert [event.kind for event in run_jobs(square, [1], 4)] == ["started", "step", "done"]
    assert os.environ[THREAD_VARIABLES[0]] == "7"
    assert THREAD_VARIABLES[1] not in os.environ
    assert signal.getsignal(signal.SIGINT) is handler


def test_no_jobs_start_no_workers() -> None:
    assert list(run_jobs(square, [], 3)) == []


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (OSError(errno.ENOSPC, "No space left on device"), r"^\[Errno \d+\] No space left"),
        (ValueError("one sentence"), "^one sentence$"),
        (KeyError("x"), "(?s)^an error in the program.*Traceback.*KeyError"),
    ],
)
def test_an_exception_comes_back_as_a_sentence(error: Exception, message: str) -> None:
    with pytest.raises(WorkerError, match=message) as caught:
        list(run_jobs(raise_it, [error], 1))
    assert caught.value.index == 0


def test_a_dead_worker_is_an_error_and_ends_the_others() -> None:
    before = set(multiprocessing.active_children())
    with pytest.raises(WorkerError, match=r"died \(killed by signal 9, as happens") as caught:
        list(run_jobs(die, [0, 1, 2], 3))
    assert caught.value.index == 1
    assert set(multiprocessing.active_children()) <= before


def test_leaving_the_loop_ends_the_workers() -> None:
    with closing(run_jobs(die, [0], 1)) as events:
        pid = next(event.value for event in events if event.kind == "step")
        assert isinstance(pid, int)
        assert alive(pid)
    assert not alive(pid)


@pytest.mark.parametrize("sent", [signal.SIGKILL, signal.SIGTERM])
def test_workers_end_with_a_killed_parent(sent: signal.Signals) -> None:
    code = "from tests.datagen.worker_jobs import run_and_say; run_and_say()"
    parent = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    with parent.stdout:
        pids = [int(parent.stdout.readline()) for _ in range(2)]
        parent.send_signal(sent)
        parent.wait()
    assert wait_until(lambda: not any(map(alive, pids)))
