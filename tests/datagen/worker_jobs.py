"""Work for the worker processes of test_workers.py; a worker imports it by name."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable
from typing import Any

from datagen.workers import THREAD_VARIABLES

Report = Callable[[int], None]


def square(job: int, report: Report) -> dict[str, Any]:
    """The square, and what the job sees of its process."""
    report(job)
    return {
        "square": job * job,
        "pid": os.getpid(),
        "threads": {os.environ.get(name) for name in THREAD_VARIABLES},
        "ignores_interrupts": signal.getsignal(signal.SIGINT) is signal.SIG_IGN,
    }


def raise_it(job: BaseException, report: Report) -> None:
    """Raises the job."""
    raise job


def die(job: int, report: Report) -> int:
    """Dies by its own signal at job 1, takes its time otherwise."""
    if job == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    report(os.getpid())
    time.sleep(60)
    return job


def run_and_say() -> None:
    """What the parent does in the test that kills it: two long jobs, their process ids printed."""
    from datagen.workers import run_jobs

    for event in run_jobs(die, [2, 3], 2):
        if event.kind == "step":
            print(event.value, flush=True)  # noqa: T201 - the test reads it from here
