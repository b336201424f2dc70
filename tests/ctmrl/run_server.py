"""Run as a script: starts the learners' commands in processes that have torch loaded already.

Reads one JSON object a line, {"words": [module, *arguments], "folder": ..., "log": ...}, forks a
child that runs the module as `python -m` would, and writes the child's id; when the child is over
it writes its exit code. A process of its own, since a test runner has threads and a process with
threads should not fork. Loading torch for each command would take the tests minutes.
"""

from __future__ import annotations

import importlib
import json
import os
import runpy
import signal
import sys
import traceback
from typing import Any

from ctmrl.threads import settle_threads

LOADED = (
    "matplotlib.backends.backend_agg",
    "sklearn.cluster",
    "ctmrl.console",
    "ctmrl.meta_train",
    "ctmrl.presets",
    "ctmrl.report",
    "ctmrl.runs",
)
"""What the commands import, all but the commands themselves."""


def _run(request: dict[str, Any]) -> int:
    """In the child: run the command and return its exit code."""
    # Background jobs of a shell inherit that Ctrl-C is ignored.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    os.chdir(request["folder"])
    log = os.open(request["log"], os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(log, 1)
    os.dup2(log, 2)
    module, *sys.argv[1:] = request["words"]
    try:
        runpy.run_module(module, run_name="__main__", alter_sys=True)
    except SystemExit as error:
        return int(error.code or 0)
    except BaseException:
        traceback.print_exc()
        return 1
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
    return 0


def _answer(number: int) -> None:
    sys.stdout.write(f"{number}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    for name in LOADED:
        importlib.import_module(name)
    # It loads more of torch, and the children do it again for themselves.
    settle_threads(1)
    for line in sys.stdin:
        child = os.fork()
        if child == 0:
            os._exit(_run(json.loads(line)))
        _answer(child)
        _answer(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
    # Tearing an interpreter with torch down takes a second that nobody needs.
    os._exit(0)
