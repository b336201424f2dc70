"""The documentation's worked example passes every check; its list of metrics is complete."""

import dataclasses
import importlib
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from ctmrl.data import OfflineData
from ctmrl.meta_train import Learner, meta_train
from ctmrl.methods import METHODS
from ctmrl.presets import preset
from meta_envs.__main__ import main
from meta_envs.conformance import CHECKS
from meta_envs.registry import ENVIRONMENTS, unregister
from tests.ctmrl.conftest import wind_data, wind_path

__all__ = ["wind_data", "wind_path"]

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


def documented(page: Path) -> set[str]:
    """Names of the metrics in the page's table."""
    _, _, table = page.read_text().partition("| metric |")
    return set(re.findall(r"^\| `([^`]+)` \|", table, re.MULTILINE))


def test_every_metric_is_documented_and_every_documented_one_exists(
    wind_data: OfflineData,
) -> None:
    found = {"return/training_tasks"}
    for method in METHODS:
        config = preset("point_robot_wind", method, "smoke")
        policy = dataclasses.replace(
            config.actor_critic, behavior_regularization=True, behavior_cloning=1.0
        )
        training = dataclasses.replace(config.training, steps=1)
        config = dataclasses.replace(config, training=training, actor_critic=policy)
        (row,) = meta_train(Learner(config, wind_data), 1, lambda: None, 1)
        found |= {re.sub(r"/\d+$", "/<i>", name) for name in row}
    assert found == documented(DOCS / "metrics.md")
