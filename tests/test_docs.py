"""The documentation's worked example is an environment that passes every check."""

import importlib
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from meta_envs.__main__ import main
from meta_envs.conformance import CHECKS
from meta_envs.registry import ENVIRONMENTS, unregister

DOCS = Path(__file__).parent.parent / "docs"
PAGE = DOCS / "new_environment.md"
EXAMPLE, USE = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)
MAX_LINES = 60


@pytest.fixture
def puck(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The example as a module of its own, `puck`."""
    (tmp_path / "puck.py").write_text(EXAMPLE)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    importlib.invalidate_caches()
    yield
    sys.modules.pop("puck", None)


def test_the_gallery_is_small() -> None:
    assert (DOCS / "environments" / "gallery.png").stat().st_size < 500_000


def test_it_is_short() -> None:
    assert len(EXAMPLE.splitlines()) < MAX_LINES


@pytest.mark.usefixtures("puck")
def test_it_passes_every_check(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", "puck:PuckMass"]) == 0
    assert f"{len(CHECKS)} passed, 0 failed, 0 skipped" in capsys.readouterr().out


@pytest.mark.usefixtures("puck")
def test_it_can_be_registered_as_the_page_says() -> None:
    names: dict[str, Any] = {}
    try:
        exec(compile(USE, PAGE.name, "exec"), names)
        for name, mass in (("env", 0.5 + 3 * 1.5 / 39), ("own", 1.3)):
            env = names[name]
            start, _ = env.reset(seed=0)
            obs = env.step([1.0])[0]
            velocity = 0.99 * start[1] + 0.1 / mass
            assert obs.tolist() == pytest.approx([start[0] + 0.1 * velocity, velocity])
    finally:
        unregister(ENVIRONMENTS["puck_mass"])
