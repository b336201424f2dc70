"""Independent jobs on a Ray cluster: the interface of `datagen.workers`, on many machines."""

from __future__ import annotations

import os
import socket
from collections.abc import Generator, Iterator, Sequence
from contextlib import contextmanager, suppress
from importlib import metadata
from itertools import islice
from types import ModuleType
from typing import Any, TypeVar

from datagen.job import versions
from datagen.workers import THREAD_VARIABLES, Event, Report, Work, WorkerError, answer

J = TypeVar("J")
R = TypeVar("R")

RETRIES = 3
"""Times that a job is begun again where its process or its machine dies."""
POLL_SECONDS = 0.5
"""Time between two looks at the news."""
CONNECT_SECONDS = 5.0
"""Time a machine has to answer."""
QUIET = {"RAY_USAGE_STATS_ENABLED": "0", "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0"}
"""Variables that Ray reads when it is loaded: no statistics are sent, and no warning is shown."""


def load_ray() -> ModuleType:
    """Ray, which is an optional extra.

    Raises:
        ValueError: it, or something it needs itself, is not installed.
    """
    for name, value in QUIET.items():
        os.environ.setdefault(name, value)
    try:
        import ray
    except ImportError as error:
        raise ValueError(
            f"--ray needs the package ray ({error}): run `pip install 'ctmrl[ray]'`"
        ) from error
    module: ModuleType = ray
    return module


@contextmanager
def connected(address: str) -> Iterator[None]:
    """A connection to a cluster; at the end, what it has started on this machine is gone.

    Args:
        address: "auto" for the cluster that runs here, HOST:PORT, or "local" to start one.

    Raises:
        ValueError: there is no Ray, or nobody answers there.
    """
    ray = load_ray()
    # Ray has it before it looks for one that runs here.
    _check_answer(os.environ.get("RAY_ADDRESS", address) if address == "auto" else address)
    try:
        ray.init(
            address=address,
            log_to_driver=False,
            logging_level="ERROR",
            include_dashboard=False,
            runtime_env={"env_vars": dict.fromkeys(THREAD_VARIABLES, "1")},
        )
    except (ConnectionError, RuntimeError, ValueError, ray.exceptions.RayError) as error:
        reason = str(error).strip().partition("\n")[0]
        raise ValueError(f"--ray {address} cannot be connected to: {reason}") from None
    try:
        yield
    finally:
        ray.shutdown()


def _check_answer(address: str) -> None:
    """Raise a ValueError where nobody answers; Ray itself would try for minutes and then exit."""
    if address in ("auto", "local"):
        return
    host, _, port = address.rpartition("://")[2].rpartition(":")
    if not host or not port.isdigit():
        raise ValueError(f"--ray takes auto, local or HOST:PORT, got '{address}'")
    try:
        socket.create_connection((host, int(port)), CONNECT_SECONDS).close()
    except (OSError, OverflowError) as error:
        raise ValueError(f"--ray {address}: nobody answers there ({error})") from None


def run_jobs(
    work: Work[J, R], jobs: Sequence[J], workers: int, gpus: int = 0
) -> Generator[Event[R], None, None]:
    """Run every job as a task of the connected cluster, and yield news as they come.

    A task has a core to itself. However the iteration ends, no task is left: at the first failure,
    and when the iterator is closed, all are stopped.

    Args:
        work: a function of a module, called with a job and a function to report progress to.
        jobs: sent to the cluster's machines by pickling.
        workers: tasks at once, at most.
        gpus: that a task needs.

    Raises:
        WorkerError: a job raised an exception, or its process or machine died again and again.
    """
    ray = load_ray()
    news = ray.remote(num_cpus=0, max_restarts=-1)(_News).remote()
    task = ray.remote(num_cpus=1, num_gpus=gpus, max_retries=RETRIES)(_serve)
    here, waiting, started = _software(), iter(enumerate(jobs)), set()
    running: dict[Any, int] = {}
    try:
        while True:
            for index, job in islice(waiting, workers - len(running)):
                running[task.remote(work, job, index, news, here)] = index
            if not running:
                return
            ready, _ = ray.wait(list(running), timeout=POLL_SECONDS)
            for index, step in [*_take(ray, news), *((running[ref], None) for ref in ready)]:
                # What a finished task has said may come late, and one begun again starts twice.
                if index in running.values() and index not in started:
                    started.add(index)
                    yield Event(index, "started")
                if index in running.values() and step is not None:
                    yield Event(index, "step", step)
            for ref in ready:
                index = running[ref]
                value = _result(ray, ref, index)
                del running[ref]
                yield Event(index, "done", value)
    finally:
        _stop(ray, list(running))
        ray.kill(news)


class _News:
    """What tasks report until it is fetched; one process of the cluster has it."""

    def __init__(self) -> None:
        self._items: list[tuple[int, int | None]] = []

    def add(self, index: int, step: int | None) -> None:
        """A job is at this step, or at its start."""
        self._items.append((index, step))

    def take(self) -> list[tuple[int, int | None]]:
        """What is new since the last time."""
        items, self._items = self._items, []
        return items


def _software() -> dict[str, str]:
    """Versions of all that decides the bytes, this package among them."""
    return {**versions(), "ctmrl": metadata.version("ctmrl")}


def _serve(
    work: Work[Any, Any], job: Any, index: int, news: Any, wanted: dict[str, str]
) -> tuple[str, Any]:
    """One task, in a process of the cluster."""
    here = _software()
    if here != wanted:
        name = next(name for name in wanted if here.get(name) != wanted[name])
        return "failed", (
            f"a machine of the cluster has {name} {here.get(name)}, this one {wanted[name]}: "
            "install the same versions"
        )
    report: Report = lambda step: news.add.remote(index, step)  # noqa: E731 - as a worker's
    news.add.remote(index, None)
    return answer(work, job, report)


def _take(ray: ModuleType, news: Any) -> list[tuple[int, int | None]]:
    """The news; none while their process is begun again."""
    with suppress(ray.exceptions.RayError):
        items: list[tuple[int, int | None]] = ray.get(news.take.remote())
        return items
    return []


def _result(ray: ModuleType, ref: Any, index: int) -> Any:
    try:
        kind, value = ray.get(ref)
    except ray.exceptions.RayTaskError as error:
        raise WorkerError(index, f"Ray cannot run it ({str(error).splitlines()[-1]})") from None
    except ray.exceptions.RayError as error:
        name, known = type(error).__name__, ray.exceptions
        deaths = (known.WorkerCrashedError, known.NodeDiedError, known.OutOfMemoryError)
        if isinstance(error, deaths):
            times = f"{RETRIES + 1} times ({name})"
            fault = f"its worker process died {times}, as happens when the memory is full"
        else:
            reason = str(error).strip().partition("\n")[0]
            fault = f"Ray cannot run it ({name}: {reason})"
        raise WorkerError(index, fault) from None
    if kind == "failed":
        raise WorkerError(index, value)
    return value


def _stop(ray: ModuleType, tasks: list[Any]) -> None:
    """Stop tasks and wait until they are."""
    for ref in tasks:
        ray.cancel(ref, force=True)
    if tasks:
        ray.wait(tasks, num_returns=len(tasks), timeout=CONNECT_SECONDS)
