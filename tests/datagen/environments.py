"""Virtual environments with one more package than this one, for tests of other people's loaders."""

from __future__ import annotations

import os
import subprocess
import sys
import sysconfig
from pathlib import Path


def other_environment(folder: Path, *packages: str) -> Path:
    """Make a virtual environment, install packages with pip and return its Python.

    What is installed here is there too, so that PyTorch need not be fetched again; where a package
    wants another version of something, the new environment has its own, and nothing changes here.
    """
    subprocess.run([sys.executable, "-m", "venv", folder], check=True)
    python = folder / ("Scripts" if os.name == "nt" else "bin") / "python"
    where = "import sysconfig; print(sysconfig.get_path('purelib'))"
    own = Path(run(python, where).strip())
    here = [sysconfig.get_path("purelib"), str(Path(__file__).parents[2])]
    lines = [f"import site; site.addsitedir({path!r})" for path in here]
    (own / "beside.pth").write_text("\n".join(lines) + "\n")
    pip = [str(python), "-m", "pip", "install", "--quiet", "--disable-pip-version-check", *packages]
    done = subprocess.run(pip, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return python


def run(python: Path, code: str, *arguments: str, **variables: str) -> str:
    """Run code in an environment and return what it prints."""
    done = subprocess.run(
        [python, "-c", code, *arguments],
        capture_output=True,
        text=True,
        env={**os.environ, "OMP_NUM_THREADS": "1", **variables},
    )
    assert done.returncode == 0, done.stderr
    return done.stdout
