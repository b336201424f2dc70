"""Every preset builds a learner, and settings come back from a run's file."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any, get_args, get_type_hints

import pytest

from ctmrl.actor_critic import ActorCriticConfig
from ctmrl.agent import build_method, empty_statistics
from ctmrl.config import MetaTrainConfig, Preset, RunConfig, check_settings
from ctmrl.errors import UsageError
from ctmrl.meta_test import MetaTestConfig
from ctmrl.methods import METHODS
from ctmrl.methods.base import Dimensions
from ctmrl.methods.ctmrl import CTMRLConfig
from ctmrl.methods.ctmrl_released import CTMRLReleasedConfig
from ctmrl.presets import OF_METHODS, ROWS, SMOKE, config_from_settings, known_preset, preset
from ctmrl.runs import to_json
from ctmrl.settings import without_later_settings
from datagen.budgets import budget
from meta_envs import ENVIRONMENTS, task_set
from tests.meta_envs.robots import POINT_ROBOTS

NAMES = get_args(Preset)
ROBOTS_OF_THE_PAPER = ("half_cheetah_vel", "hopper_params", "walker_params", "ant_goal")
PATH = Path("run") / "config.json"


@pytest.fixture(params=[(e, m, n) for e in ROWS for m in METHODS for n in NAMES], ids=str)
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
    params = len(tasks.param_names)
    statistics = empty_statistics(dims, config.context.next_obs_in_context, params)
    method = build_method(config, statistics, dims)
    check_settings(config)
    sizes = {"oracle_task": params}
    assert method.encoder.z_dim == sizes.get(config.method, config.context.z_dim)
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


def test_the_fields_settings_for_robots() -> None:
    found = {}
    for env in ROBOTS_OF_THE_PAPER:
        config = preset(env, "ctmrl", "paper")
        assert isinstance(config.context, CTMRLConfig)
        actor_critic, training, context = config.actor_critic, config.training, config.context
        assert (actor_critic.gamma, actor_critic.reward_scale) == (0.99, 5.0)
        assert (actor_critic.behavior_regularization, actor_critic.dual_penalty) == (True, "value")
        assert actor_critic.divergence_wind_up
        assert actor_critic.dual_steps == 3
        assert actor_critic.timeouts_as_terminals
        assert (actor_critic.hidden, actor_critic.learning_rate) == ((256, 256, 256), 3e-4)
        found[env] = (
            context.codes, context.z_dim, context.next_obs_in_context,
            training.steps, training.meta_batch, training.context_size,
            actor_critic.divergence_initial, actor_critic.divergence_maximum,
        )  # fmt: skip
    # Table 3 of the paper, and the configurations of the field's code.
    assert found == {
        "half_cheetah_vel": (16, 20, False, 105_000, 16, 100, 50, 2_000),
        "hopper_params": (16, 20, True, 105_000, 16, 256, 50, 10_000),
        "walker_params": (4, 40, True, 105_000, 16, 256, 50, 10_000),
        "ant_goal": (2, 20, False, 210_000, 10, 512, 500, 2_000),
    }


def test_the_fields_weights_of_club() -> None:
    found = {}
    for env in ROWS:
        context = preset(env, "ctmrl_released", "paper").context
        assert isinstance(context, CTMRLReleasedConfig)
        found[env] = context.club_weight
    others = {"half_cheetah_vel": 10, "half_cheetah_dir": 10}
    others |= {"ant_goal": 50, "ant_dir": 50, "humanoid_dir": 50}
    assert found == dict.fromkeys(ROWS, 25) | others


def test_the_data_of_the_same_budget_are_enough(config: RunConfig) -> None:
    episodes = budget(config.env, config.preset).total_episodes
    assert METHODS[config.method].method.context_sets * config.training.context_episodes <= episodes


def test_the_multiplier_winds_up_in_the_released_reading_and_where_the_field_is_meant(
    config: RunConfig,
) -> None:
    robots_of_the_field = config.preset == "paper" and config.env not in POINT_ROBOTS
    wanted = config.method == "ctmrl_released" or robots_of_the_field
    assert config.actor_critic.divergence_wind_up is wanted


def test_the_dual_critic_has_the_fields_steps_where_the_field_is_meant(config: RunConfig) -> None:
    robots_of_the_field = config.preset == "paper" and config.env not in POINT_ROBOTS
    assert config.actor_critic.behavior_regularization is robots_of_the_field
    wanted = config.method == "ctmrl_released" or robots_of_the_field
    assert config.actor_critic.dual_steps == (3 if wanted else 1)


def test_a_run_from_before_the_dual_critics_steps_were_an_option_has_one() -> None:
    config = preset("half_cheetah_vel", "ctmrl", "paper", precision="float32")
    stored = through_a_file(config)
    del stored["settings"]["actor_critic"]["dual_steps"]
    one = dataclasses.replace(config.actor_critic, dual_steps=1)
    found = config_from_settings(stored, PATH)
    assert found == dataclasses.replace(config, actor_critic=one)
    # And its file, written anew, stays what it is.
    assert without_later_settings(through_a_file(found)["settings"]) == without_later_settings(
        stored["settings"]
    )


def test_the_walkers_contexts_form_early_and_differ(config: RunConfig) -> None:
    walker = config.env.startswith("walker") and config.preset != "paper"
    released = config.method == "ctmrl_released"
    assert config.context.standardize_contexts is (walker and not released)
    if walker:
        assert config.context.encoder_lr == 3e-3
    if walker and isinstance(config.context, CTMRLConfig):
        assert (config.context.contrast_weight, config.context.warm_up) == (1.0, 0.03)
    if walker and config.preset == "standard":
        assert config.training.context_size == 128
    if isinstance(config.context, CTMRLReleasedConfig):
        assert config.context.warm_up == 0.3


def test_the_sparse_robots_first_episodes_may_act_on_a_code_each() -> None:
    config = preset("sparse_point_robot", "ctmrl", "standard")
    assert isinstance(config.context, CTMRLConfig)
    assert config.context.codes == config.meta_test.random_episodes == 10
    assert (config.training.context_episodes, config.training.context_size) == (10, 200)
    assert config.context.squared_errors


@pytest.mark.parametrize("method", ["ctmrl", "ctmrl_released"])
@pytest.mark.parametrize(
    ("env", "codes"),
    [("sparse_point_robot", (10, 4, 3)), ("walker_params", (4, 4, 3)), ("ant_goal", (2, 2, 2))],
)
def test_codes_of_standard_paper_and_smoke(env: str, codes: tuple[int, ...], method: str) -> None:
    found = []
    for name in NAMES:
        context = preset(env, method, known_preset(name)).context
        assert isinstance(context, CTMRLConfig | CTMRLReleasedConfig)
        found.append(context.codes)
    assert tuple(found) == codes


def test_a_run_from_before_contexts_could_be_standardised_has_them_as_they_are() -> None:
    config = preset("walker_params", "ctmrl", "standard", precision="float32")
    stored = through_a_file(config)
    del stored["settings"]["context"]["standardize_contexts"]
    found = config_from_settings(stored, PATH)
    plain = dataclasses.replace(config.context, standardize_contexts=False)
    assert found == dataclasses.replace(config, context=plain)
    # And its file, written anew, stays what it is.
    assert without_later_settings(through_a_file(found)["settings"]) == without_later_settings(
        stored["settings"]
    )


def test_every_environment_has_presets() -> None:
    assert list(ROWS) == list(ENVIRONMENTS)


def test_every_setting_of_a_row_is_an_option_of_some_method() -> None:
    parts: list[Any] = [MetaTrainConfig, ActorCriticConfig, MetaTestConfig]
    parts += [row.config for row in METHODS.values()]
    known = {field.name for part in parts for field in dataclasses.fields(part)} | {"precision"}
    for row in ROWS.values():
        for settings in (row.paper, row.standard, SMOKE, *OF_METHODS.values()):
            assert settings.keys() <= known
    assert OF_METHODS.keys() <= METHODS.keys()


def test_changes_are_made() -> None:
    config = preset("point_robot", "focal", "smoke", seed=11, threads=3)
    assert (config.env, config.method, config.preset) == ("point_robot", "focal", "smoke")
    assert (config.seed, config.threads) == (11, 3)


def test_an_unknown_preset_or_environment_is_one_sentence() -> None:
    assert [known_preset(name) for name in NAMES] == list(NAMES)
    with pytest.raises(UsageError, match=r"^no preset 'huge' \(known: standard, paper, smoke\)$"):
        known_preset("huge")
    with pytest.raises(
        UsageError, match=r"^no preset for 'noisy_robot' \(there are: point_robot, "
    ):
        preset("noisy_robot", "ctmrl", "smoke")


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


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("env", ENVIRONMENTS)
def test_numbers_with_a_fraction_are_floats_in_every_preset(env: str, method: str) -> None:
    """A stored run is refused where its numbers have other kinds than the preset's."""
    for name in NAMES:
        config = preset(env, method, name)
        for part in (config, config.training, config.actor_critic, config.context):
            hints = get_type_hints(type(part))
            for field in dataclasses.fields(part):
                value = getattr(part, field.name)
                assert hints[field.name] is not float or type(value) is float, field.name
