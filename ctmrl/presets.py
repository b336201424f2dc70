"""Defaults of every run, by environment, method and preset, and settings read back from a run."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any, get_args

from ctmrl.actor_critic import ActorCriticConfig
from ctmrl.config import MetaTrainConfig, Preset, RunConfig
from ctmrl.errors import UsageError
from ctmrl.meta_test import MetaTestConfig
from ctmrl.methods import METHODS
from meta_envs import ENVIRONMENTS

CODES = {"point_robot": 8, "point_robot_wind": 8, "sparse_point_robot": 4}
"""Codes of the paper's headline results, by environment."""
PAPER_CONTEXT_SIZE = {"point_robot": 1024, "point_robot_wind": 256, "sparse_point_robot": 1024}
# Random actions stay near the origin, where rewards differ little from goal to goal: only a larger
# encoder on longer contexts learns to tell the goal from them.
GOAL_TRAINING: dict[str, Any] = {"steps": 12_000, "context_episodes": 3, "context_size": 60}
GOAL_CONTEXT: dict[str, Any] = {"encoder_hidden": (200, 200, 200), "predictor_hidden": (128, 128)}
STANDARD: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "point_robot": (GOAL_TRAINING, GOAL_CONTEXT),
    "point_robot_wind": ({}, {}),
    "sparse_point_robot": (
        GOAL_TRAINING | {"steps": 6_000},
        GOAL_CONTEXT | {"squared_errors": True},
    ),
}
"""Where an environment's standard training and context differ from the defaults."""
PAPER_CONTEXT = {
    "z_dim": 20,
    "encoder_hidden": (200, 200, 200),
    "encoder_lr": 3e-4,
    "predictor_hidden": (256, 256, 256),
    "warm_up": 0.3,
    "code_contrast_weight": 1.0,
    "cross_prediction_weight": 1.0,
    "contrast_weight": 1.0,
}
SMOKE_CONTEXT = {"codes": 3, "z_dim": 4, "encoder_hidden": (16,), "predictor_hidden": (16,)}


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
    if env not in CODES:
        raise UsageError(f"no preset for '{env}' (there are: {', '.join(CODES)})")
    standard_training, standard_context = STANDARD[env]
    training = MetaTrainConfig(**standard_training)
    actor_critic, meta_test = ActorCriticConfig(), MetaTestConfig()
    context: dict[str, Any] = {"codes": CODES[env], **standard_context}
    if name == "paper":
        context |= PAPER_CONTEXT
        size = PAPER_CONTEXT_SIZE[env]
        # The field draws a context's transitions from all of a task's data.
        episodes = size // ENVIRONMENTS[env].horizon
        training = MetaTrainConfig(
            steps=65_000,
            batch_size=256,
            context_episodes=episodes,
            context_size=size,
            decay=False,
        )
        actor_critic = ActorCriticConfig(
            hidden=(256, 256, 256),
            gamma=0.9,
            reward_scale=100.0,
            learning_rate=3e-4,
            target_rate=0.005,
        )
    elif name == "smoke":
        context |= SMOKE_CONTEXT
        training = MetaTrainConfig(
            steps=60, meta_batch=5, batch_size=7, context_size=11, context_episodes=1
        )
        actor_critic = ActorCriticConfig(hidden=(16,))
        meta_test = MetaTestConfig(random_episodes=2, policy_episodes=2, repetitions=1)
    config_class = METHODS[method].config
    known = {field.name for field in dataclasses.fields(config_class)}
    wanted = {key: value for key, value in context.items() if key in known}
    return RunConfig(
        training,
        actor_critic,
        config_class(**wanted),
        meta_test,
        env=env,
        method=method,
        preset=name,
        **changes,
    )


def config_from_settings(stored: dict[str, Any], path: Path) -> RunConfig:
    """The RunConfig that a run's config.json holds.

    Args:
        stored: content of config.json.
        path: of that file, for messages.

    Raises:
        UsageError: the file does not fit this version of the package.
    """
    try:
        settings = stored["settings"]
        base = preset(settings["env"], settings["method"], settings["preset"])
        restored: RunConfig = _restored(base, settings)
        return restored
    except (KeyError, TypeError, AttributeError) as error:
        raise UsageError(
            f"{path} does not fit this version of ctmrl ({error}): train again with --restart"
        ) from None


def _restored(base: Any, values: dict[str, Any]) -> Any:
    """`base` with its fields taken from JSON, where tuples have become lists."""
    found: dict[str, Any] = {}
    for key, value in values.items():
        if dataclasses.is_dataclass(getattr(base, key, None)):
            found[key] = _restored(getattr(base, key), value)
        else:
            found[key] = tuple(value) if isinstance(value, list) else value
    return dataclasses.replace(base, **found)
