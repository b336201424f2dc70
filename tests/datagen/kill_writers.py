"""Run as a script by test_files.py: kill processes while they write, and look at what is left.

Usage: python kill_writers.py FOLDER KILLS. A process of its own, since a test runner has threads
and a process with threads should not fork.
"""

from __future__ import annotations

import json
import os
import random
import signal
import sys
import time
from pathlib import Path

from datagen.files import machine, write_whole

SIZE = 3_000_000
CONTENTS = (b"a" * SIZE, b"b" * SIZE)


def kill_one(folder: Path, delay: float) -> dict[str, bool]:
    """Kill a process that writes two contents in turn, `delay` seconds after its first byte."""
    folder.mkdir()
    path = folder / "task_000.h5"
    child = os.fork()
    if child == 0:
        while True:
            for content in CONTENTS:
                write_whole(path, content)
    while not any(folder.iterdir()):
        time.sleep(0.0005)
    time.sleep(delay)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    names = set(os.listdir(folder))
    return {
        "there": path.exists(),
        "whole": path.exists() and path.read_bytes() in CONTENTS,
        "partial": bool(names - {path.name}),
        "only_its_own": names <= {path.name, f".{path.name}.{machine()}.{child}.partial"},
    }


if __name__ == "__main__":
    generator = random.Random(0)
    print(  # noqa: T201 - its parent reads the result from here
        json.dumps(
            [
                kill_one(Path(sys.argv[1]) / str(number), generator.uniform(0.0, 0.03))
                for number in range(int(sys.argv[2]))
            ]
        )
    )
