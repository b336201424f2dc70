"""Every preset builds a learner, and settings come back from a run's file."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any, get_args

import pytest

from ctmrl.agent import build_method, empty_statistics
from ctmrl.config import Preset, RunConfig
from ctmrl.errors import UsageError
from ctmrl.methods import METHODS
from ctmrl.methods.base import Dimensions
from ctmrl.methods.ctmrl import CTMRLConfig
from ctmrl.presets import config_from_settings, known_preset, preset
from ctmrl.runs import to_json
from meta_envs import task_set
from tests.meta_envs.robots import POINT_ROBOTS

NAMES = get_args(Preset)
PATH = Path("run") / "config.json"


@pytest.fixture(params=[(e, m, n) for e in POINT_ROBOTS for m in METHODS for n in NAMES], ids=str)
def config(request: pytest.FixtureRequest) -> RunConfig:
    """Every preset in turn."""
    return preset(*request.param)


def through_a_file(config: RunConfig) -> dict[str, Any]:
    settings = {
        key: value
        for key, value in dataclasses.asdict(config).items()
        if key not in ("data", "out", "restart", "loggers")
    }
    found: dict[str, Any] = json.loads(to_json({"settings": settings}))
    return found


def test_it_builds(config: RunConfig) -> None:
    tasks = task_set(config.env)
    dims = Dimensions(2, 2, len(tasks.train_tasks), config.training.steps)
    statistics = empty_statistics(dims, config.context.next_obs_in_context)
    method = build_method(config, statistics, dims)
    assert method.encoder.z_dim == config.context.z_dim
    assert isinstance(method, METHODS[config.method].method)
    assert type(config.context) is METHODS[config.method].config


def test_its_settings_come_back(config: RunConfig) -> None:
    assert config_from_settings(through_a_file(config), PATH) == config


def test_changed_settings_come_back() -> None:
    config = preset("point_robot", "ctmrl", "smoke", seed=7, validate=True)
    context = dataclasses.replace(config.context, encoder_hidden=(3, 5, 7), z_dim=11)
    config = dataclasses.replace(config, context=context)
    assert config_from_settings(through_a_file(config), PATH) == config


def test_the_papers_sizes() -> None:
    codes, sizes = {}, {}
    for env in POINT_ROBOTS:
        config = preset(env, "ctmrl", "paper")
        assert isinstance(config.context, CTMRLConfig)
        codes[env], sizes[env] = config.context.codes, config.training.context_size
        assert config.actor_critic.hidden == (256, 256, 256)
        assert config.context.encoder_hidden == (200, 200, 200)
        assert config.context.z_dim == 20
        assert (config.training.meta_batch, config.training.batch_size) == (16, 256)
        # The starter protocol leaves 700 episodes a task, and two sets are drawn at a time.
        assert 2 * config.training.context_episodes <= 700
    # Table 3 of the paper, and the field's context sizes.
    assert codes == {"point_robot": 8, "point_robot_wind": 8, "sparse_point_robot": 4}
    assert sizes == {"point_robot": 1024, "point_robot_wind": 256, "sparse_point_robot": 1024}


def test_changes_are_made() -> None:
    config = preset("point_robot", "focal", "smoke", seed=11, threads=3)
    assert (config.env, config.method, config.preset) == ("point_robot", "focal", "smoke")
    assert (config.seed, config.threads) == (11, 3)


def test_an_unknown_preset_or_environment_is_one_sentence() -> None:
    assert [known_preset(name) for name in NAMES] == list(NAMES)
    with pytest.raises(UsageError, match=r"^no preset 'huge' \(known: standard, paper, smoke\)$"):
        known_preset("huge")
    with pytest.raises(UsageError, match=r"^no preset for 'ant_goal' \(there are: point_robot, "):
        preset("ant_goal", "ctmrl", "smoke")


@pytest.mark.parametrize(
    "stored",
    [
        {},
        {"settings": None},
        {"settings": []},
        {"settings": {"env": "point_robot"}},
        {"settings": {"env": "point_robot", "method": "nobody", "preset": "smoke"}},
        {"settings": {"env": "point_robot", "method": "ctmrl", "preset": "smoke", "new": 1}},
        {"settings": {"env": "point_robot", "method": "ctmrl", "preset": "smoke", "training": 5}},
        {
            "settings": {
                "env": "point_robot",
                "method": "focal",
                "preset": "smoke",
                "context": {"codes": 3},
            }
        },
    ],
)
def test_a_file_of_another_version_is_one_sentence(stored: dict[str, Any]) -> None:
    with pytest.raises(UsageError, match=r"^run/config\.json does not fit this version of ctmrl"):
        config_from_settings(stored, PATH)
