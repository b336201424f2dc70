"""Independent jobs on worker processes: spawned, one thread each, gone when their parent is."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import traceback
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from typing import Any, Generic, TypeVar

J = TypeVar("J")
R = TypeVar("R")
Report = Callable[[int], None]
Work = Callable[[J, Report], R]

THREAD_VARIABLES = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")
"""Read by the numerical libraries when they are loaded, so they are set before a worker starts."""


class WorkerError(RuntimeError):
    """A job could not be done; the message is one sentence.

    Attributes:
        index: of the job.
    """

    def __init__(self, index: int, message: str) -> None:
        """Remember which job it was."""
        super().__init__(message)
        self.index = index


@dataclass(frozen=True)
class Event(Generic[R]):
    """News of a job.

    Attributes:
        index: of the job.
        kind: "started", "step" or "done".
        value: the job's report of progress, or its result.
    """

    index: int
    kind: str
    value: int | R | None = None


@dataclass
class _Worker:
    process: SpawnProcess
    connection: Connection
    index: int = field(default=-1)


def run_jobs(work: Work[J, R], jobs: Sequence[J], workers: int) -> Generator[Event[R], None, None]:
    """Run every job in one of several worker processes, and yield news as they come.

    Jobs start in order; a worker takes the next one when it has finished one. However the iteration
    ends, no worker is left: at the first failure, and when the iterator is closed, all are stopped.

    Args:
        work: a function of a module, called with a job and a function to report progress to.
        jobs: sent to the workers by pickling.
        workers: processes at most.

    Raises:
        WorkerError: a job raised an exception, or its worker died.
    """
    crew: list[_Worker] = []
    waiting = iter(range(len(jobs)))
    try:
        with _one_thread_each():
            for _ in range(min(workers, len(jobs))):
                crew.append(_start(work))
        for worker in crew:
            yield from _next_job(worker, jobs, waiting)
        while any(worker.index >= 0 for worker in crew):
            for worker in _with_news(crew):
                kind, value = _receive(worker)
                yield Event(worker.index, kind, value)
                if kind == "done":
                    yield from _next_job(worker, jobs, waiting)
    finally:
        _stop(crew)


def _start(work: Work[Any, Any]) -> _Worker:
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=_serve, args=(work, theirs), daemon=True)
    with _interrupts_ignored():
        process.start()
    theirs.close()
    return _Worker(process, ours)


@contextmanager
def _one_thread_each() -> Iterator[None]:
    before = {name: os.environ.get(name) for name in THREAD_VARIABLES}
    os.environ.update(dict.fromkeys(THREAD_VARIABLES, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


@contextmanager
def _interrupts_ignored() -> Iterator[None]:
    """A process started meanwhile ignores Ctrl-C from its first moment; it inherits that."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _next_job(worker: _Worker, jobs: Sequence[J], waiting: Iterator[int]) -> Iterator[Event[Any]]:
    worker.index = next(waiting, -1)
    if worker.index < 0:
        return
    try:
        worker.connection.send(jobs[worker.index])
    except OSError:
        raise _death(worker) from None
    yield Event(worker.index, "started")


def _with_news(crew: list[_Worker]) -> list[_Worker]:
    """Workers at work that have sent something or died; waits until there is one."""
    busy = {id(worker.connection): worker for worker in crew if worker.index >= 0}
    # A pipe whose other end is closed is ready too, so that a death is seen at once.
    ready = wait([worker.connection for worker in busy.values()])
    return [busy[id(connection)] for connection in ready]


def _receive(worker: _Worker) -> tuple[str, Any]:
    try:
        kind, value = worker.connection.recv()
    except (EOFError, OSError):
        raise _death(worker) from None
    if kind == "failed":
        raise WorkerError(worker.index, value)
    return kind, value


def _death(worker: _Worker) -> WorkerError:
    worker.process.join(timeout=5)
    code = worker.process.exitcode
    how = f"exit code {code}"
    if code is not None and code < 0:
        how = f"killed by signal {-code}"
        if code == -signal.SIGKILL:
            how += ", as happens when the memory is full"
    return WorkerError(worker.index, f"its worker process died ({how})")


def _stop(crew: list[_Worker]) -> None:
    for worker in crew:
        worker.connection.close()
        if worker.index >= 0:
            worker.process.terminate()
    for worker in crew:
        worker.process.join(timeout=5)
        if worker.process.exitcode is None:
            worker.process.kill()
            worker.process.join()


def _serve(work: Work[Any, Any], connection: Connection) -> None:
    """A worker's life: jobs from the connection until it closes."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_die_with_parent, daemon=True).start()
    while True:
        try:
            job = connection.recv()
        except (EOFError, OSError):
            return
        try:
            connection.send(answer(work, job, lambda step: connection.send(("step", step))))
        except BrokenPipeError:
            return


def answer(work: Work[J, R], job: J, report: Report) -> tuple[str, R | str]:
    """Do a job: "done" and its result, or "failed" and why, as a sentence.

    Raises:
        BrokenPipeError: there is nobody to report to any more.
    """
    try:
        return "done", work(job, report)
    except BrokenPipeError:
        raise
    except (OSError, ValueError) as error:
        return "failed", str(error)
    except Exception:
        return "failed", f"an error in the program\n{traceback.format_exc()}"


def _die_with_parent() -> None:
    """End this process at once when its parent ends, in whatever way it does."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)
