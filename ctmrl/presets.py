"""Defaults of every run, by environment, method and preset, and settings read back from a run."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any, NamedTuple, get_args

from ctmrl.actor_critic import ActorCriticConfig
from ctmrl.config import MetaTrainConfig, Preset, RunConfig
from ctmrl.errors import UsageError
from ctmrl.meta_test import MetaTestConfig
from ctmrl.methods import METHODS
from ctmrl.settings import with_later_settings

Settings = dict[str, Any]
"""Options by name, where they are not the defaults of their dataclasses."""


class Row(NamedTuple):
    """An environment's presets.

    Attributes:
        codes: of the paper's headline results, or those of its nearest relative there, unless
            settings have their own; fewer than there are training tasks.
        paper: the field's settings.
        standard: the default.
    """

    codes: int
    paper: Settings
    standard: Settings


PAPER: Settings = {
    "steps": 65_000,
    "batch_size": 256,
    "decay": False,
    "hidden": (256, 256, 256),
    "gamma": 0.9,
    "reward_scale": 100.0,
    "learning_rate": 3e-4,
    "target_rate": 0.005,
    "z_dim": 20,
    "encoder_hidden": (200, 200, 200),
    "encoder_lr": 3e-4,
    "predictor_hidden": (256, 256, 256),
    "warm_up": 0.3,
    "code_contrast_weight": 1.0,
    "cross_prediction_weight": 1.0,
    "contrast_weight": 1.0,
}
# The field draws a context's transitions from all of a task's data.
PAPER_GOAL = PAPER | {"context_size": 1024, "context_episodes": 51}
PAPER_WIND = PAPER | {"context_size": 256, "context_episodes": 10}
PAPER_ROBOT = PAPER | {
    "steps": 105_000,
    "precision": "auto",
    # As many as every budget but smoke has of two contexts.
    "context_episodes": 50,
    "gamma": 0.99,
    "reward_scale": 5.0,
    "timeouts_as_terminals": True,
    "behavior_regularization": True,
    "divergence_wind_up": True,
    "dual_steps": 3,
    # 600 steps as in the field's code, half of them random and no fewer.
    "random_episodes": 2,
    "policy_episodes": 1,
}
PAPER_CHEETAH = PAPER_ROBOT | {
    "context_size": 100,
    "next_obs_in_context": False,
    "club_weight": 10.0,
}
# A random hopper or walker is down after 9 steps.
PAPER_LEGS = PAPER_ROBOT | {
    "context_size": 256,
    "divergence_maximum": 10_000.0,
    "random_episodes": 30,
}
PAPER_HUMANOID = PAPER_ROBOT | {
    "context_size": 256,
    "divergence_initial": 500.0,
    "next_obs_in_context": False,
    "club_weight": 50.0,
}
PAPER_ANT = PAPER_HUMANOID | {
    "steps": 210_000,
    "meta_batch": 10,
    "context_size": 512,
    "policy_episodes": 2,
}

# Random actions stay near the origin, where rewards differ little from goal to goal: only a larger
# encoder on longer contexts learns to tell the goal from them.
GOAL: Settings = {
    "steps": 12_000,
    "context_episodes": 3,
    "context_size": 60,
    "encoder_hidden": (200, 200, 200),
    "predictor_hidden": (128, 128),
    # Twice as wide, the actor-critic comes within 3% of the optimum on data of weak policies.
    "hidden": (256, 256),
}
SQUARED: Settings = {"squared_errors": True}
# Its return counts hundredths of the way, which take twice as many steps, at half the rate: at
# PointRobot's, one actor of three was stuck (docs/decisions.md). Half of its data's episodes never
# see a reward, so contexts are of more of them. As many codes as a meta-test's first episodes,
# which may act on each.
SPARSE = (
    GOAL
    | SQUARED
    | {
        "steps": 24_000,
        "learning_rate": 5e-4,
        "context_episodes": 10,
        "context_size": 200,
        "codes": 10,
    }
)
# Sized for minutes of a small machine. docs/methods/actor_critic.md compares what holds a policy to
# the data; the rest was not searched.
ROBOT: Settings = {
    "steps": 3_000,
    "precision": "auto",
    "batch_size": 16,
    "context_size": 64,
    "encoder_hidden": (128, 128),
    "predictor_hidden": (128, 128),
    "hidden": (256, 256),
    "gamma": 0.98,
    "reward_scale": 50.0,
    "learning_rate": 5e-4,
    "target_rate": 0.01,
    "behavior_cloning": 0.5,
    "cloning_advantage": 1.0,
    "value_from_data": True,
    "random_episodes": 2,
    "policy_episodes": 2,
}
# Weights by an episode's return tell good actions from bad, those by advantage do not
# (docs/methods/actor_critic.md).
LEGS = ROBOT | {
    "random_episodes": 10,
    "behavior_cloning": 2.0,
    "cloning_advantage": 0.0,
    "cloning_rank": 10.0,
}
# Half as wide, some tasks' gaits are not learned (docs/methods/actor_critic.md). Contexts that form
# late and differ little are not used by the policy (docs/methods/ctmrl.md).
WALKER = LEGS | {
    "hidden": (512, 512),
    "context_size": 128,
    "standardize_contexts": True,
    "encoder_lr": 3e-3,
    "contrast_weight": 1.0,
    "warm_up": 0.03,
}
# With the value of the policy's own actions returns are those of standing still
# (docs/methods/actor_critic.md).
ANT = ROBOT | {
    "steps": 30_000,
    "batch_size": 32,
    "behavior_cloning": 5.0,
    "cloning_advantage": 3.0,
    "value_expectile": 0.8,
}

SMOKE: Settings = {
    "steps": 60,
    "meta_batch": 5,
    "batch_size": 7,
    "context_size": 11,
    "context_episodes": 1,
    "hidden": (16,),
    "codes": 3,
    "z_dim": 4,
    "encoder_hidden": (16,),
    "predictor_hidden": (16,),
    "random_episodes": 2,
    "policy_episodes": 2,
    "repetitions": 1,
}
"""What every environment's smoke preset has on top of its standard one."""

OF_METHODS: dict[str, Settings] = {
    "ctmrl_released": {
        "divergence_wind_up": True,
        "dual_steps": 3,
        "standardize_contexts": False,
        "warm_up": 0.3,
    }
}
"""What a method has in every preset of every environment on top of those."""

ROWS: dict[str, Row] = {
    "point_robot": Row(8, PAPER_GOAL, GOAL),
    "point_robot_wind": Row(8, PAPER_WIND, {}),
    "sparse_point_robot": Row(4, PAPER_GOAL | SQUARED, SPARSE),
    "half_cheetah_vel": Row(16, PAPER_CHEETAH, ROBOT),
    "hopper_params": Row(16, PAPER_LEGS, LEGS),
    "walker_params": Row(4, PAPER_LEGS | {"z_dim": 40}, WALKER),
    "ant_goal": Row(2, PAPER_ANT, ANT),
    "half_cheetah_dir": Row(1, PAPER_CHEETAH, ROBOT),
    "ant_dir": Row(2, PAPER_ANT, ROBOT),
    "humanoid_dir": Row(2, PAPER_HUMANOID, ROBOT),
    "hopper_mass": Row(16, PAPER_LEGS, LEGS),
    "hopper_friction": Row(16, PAPER_LEGS, LEGS),
    "walker_mass": Row(4, PAPER_LEGS | {"z_dim": 40}, WALKER),
    "walker_friction": Row(4, PAPER_LEGS | {"z_dim": 40}, WALKER),
}


def known_preset(name: str) -> Preset:
    """`name` as a Preset.

    Raises:
        UsageError: there is none of that name.
    """
    for known in get_args(Preset):
        if name == known:
            found: Preset = known
            return found
    raise UsageError(f"no preset '{name}' (known: {', '.join(get_args(Preset))})")


def preset(env: str, method: str, name: Preset, **changes: Any) -> RunConfig:
    """The defaults of a run.

    Args:
        env: short name of the environment.
        method: a row of METHODS.
        name: of the preset.
        **changes: fields of RunConfig to set.

    Raises:
        UsageError: no preset for that environment.
    """
    if env not in ROWS:
        raise UsageError(f"no preset for '{env}' (there are: {', '.join(ROWS)})")
    codes, paper, standard = ROWS[env]
    chosen = {"paper": paper, "standard": standard, "smoke": standard | SMOKE}[name]
    chosen = {"codes": codes} | chosen | OF_METHODS.get(method, {})
    if name == "smoke":
        chosen["codes"] = min(codes, chosen["codes"])
    return RunConfig(
        _with(MetaTrainConfig, chosen),
        _with(ActorCriticConfig, chosen),
        _with(METHODS[method].config, chosen),
        _with(MetaTestConfig, chosen),
        env=env,
        method=method,
        preset=name,
        **({"precision": chosen.get("precision", "float32")} | changes),
    )


def _with(config: type[Any], settings: Settings) -> Any:
    """A config with those of the settings that it has."""
    names = {field.name for field in dataclasses.fields(config)}
    return config(**{key: value for key, value in settings.items() if key in names})


def config_from_settings(stored: dict[str, Any], path: Path) -> RunConfig:
    """The RunConfig that a run's config.json holds.

    Args:
        stored: content of config.json.
        path: of that file, for messages.

    Raises:
        UsageError: the file does not fit this version of the package.
    """
    try:
        settings = with_later_settings(stored["settings"])
        base = preset(settings["env"], settings["method"], settings["preset"])
        restored: RunConfig = _restored(base, settings)
        return restored
    except (KeyError, TypeError, AttributeError) as error:
        raise UsageError(
            f"{path} does not fit this version of ctmrl ({error}): train again with --restart"
        ) from None


def _restored(base: Any, values: dict[str, Any]) -> Any:
    """`base` with its fields taken from JSON, where tuples have become lists.

    Raises:
        TypeError: a value has a type that its field has not.
    """
    found: dict[str, Any] = {}
    for key, stored in values.items():
        default = getattr(base, key, None)
        if dataclasses.is_dataclass(default):
            found[key] = _restored(default, stored)
            continue
        value = found[key] = tuple(stored) if isinstance(stored, list) else stored
        kinds = (int, float) if isinstance(default, float) else type(default)
        if default is not None and not isinstance(value, kinds):
            raise TypeError(f"{key} is {stored!r}")
    return dataclasses.replace(base, **found)
