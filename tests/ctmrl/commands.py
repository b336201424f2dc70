"""Commands of the learners in processes that tests can interrupt, kill and wait for."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

FILES = (
    "adaptation.png",
    "checkpoint.pt",
    "config.json",
    "contexts.png",
    "evaluation.json",
    "metrics.csv",
)
"""What a finished run's folder holds, sorted."""


class Commands:
    """Runs one command after the other; `run_server.py` is what it talks to."""

    def __init__(self, folder: Path) -> None:
        """Start the server.

        Args:
            folder: working directory of the commands; their output goes into a file there.
        """
        self.folder = folder
        self.log = folder / "log.txt"
        script = Path(__file__).with_name("run_server.py")
        root = str(Path(__file__).parents[2])
        self._server = subprocess.Popen(
            [sys.executable, str(script)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "PYTHONPATH": root, "OMP_NUM_THREADS": "1"},
        )
        self.child = 0

    def __enter__(self) -> Commands:
        """Itself."""
        return self

    def __exit__(self, *error: object) -> None:
        """Stop the server."""
        self._server.communicate()

    def start(self, *words: str) -> None:
        """Start `python -m` with these words."""
        assert self._server.stdin
        request = {"words": words, "folder": str(self.folder), "log": str(self.log)}
        self._server.stdin.write(json.dumps(request) + "\n")
        self._server.stdin.flush()
        self.child = self._answer()

    def send(self, number: signal.Signals) -> None:
        """Send the command a signal."""
        os.kill(self.child, number)

    def wait(self) -> int:
        """Wait for the command; its exit code, minus the signal's number if one ended it."""
        return self._answer()

    def run(self, *words: str) -> int:
        """Start a command and wait for it."""
        self.start(*words)
        return self.wait()

    def output(self) -> str:
        """All that the last command wrote."""
        return self.log.read_text()

    def _answer(self) -> int:
        assert self._server.stdout
        return int(self._server.stdout.readline())


def wait_until(condition: Callable[[], bool], seconds: float = 60.0) -> None:
    """Wait for something another process does.

    Raises:
        TimeoutError: it does not.
    """
    end = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > end:
            raise TimeoutError("what the test waits for did not happen")
        time.sleep(0.002)


def rows(path: Path) -> int:
    """Whole lines of a file, 0 while it is missing."""
    return path.read_bytes().count(b"\n") if path.exists() else 0


def contents(folder: Path) -> dict[str, bytes]:
    """Every file of a run's folder."""
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}
