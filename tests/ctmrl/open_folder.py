"""Run as a module by test_runs.py: open a run's folder, as it is, in a process of its own."""

from __future__ import annotations

import json
import sys
from pathlib import Path

from ctmrl.runs import RunError, RunFolder

if __name__ == "__main__":
    path = Path(sys.argv[1])
    try:
        RunFolder(path, json.loads((path / "config.json").read_bytes()), restart=False).close()
    except RunError as error:
        sys.stderr.write(f"{error}\n")
        sys.exit(3)
