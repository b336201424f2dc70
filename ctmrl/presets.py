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

_STANDARD = MetaTrainConfig()
_STANDARD_AC = ActorCriticConfig()
_PAPER_AC = ActorCriticConfig(hidden=(256, 256, 256), learning_rate=3e-4)
_PAPER_SIZES: dict[str, Any] = {
    "encoder_hidden": (200, 200, 200),
    "encoder_lr": 3e-4,
    "z_dim": 20,
}
_PAPER_PREDICTORS: dict[str, Any] = {"predictor_hidden": (256, 256, 256)}
_PAPER_CONTEXT = {"point_robot": 1024, "point_robot_wind": 256, "sparse_point_robot": 1024}
_PAPER_CODES = {"point_robot": 8, "point_robot_wind": 8, "sparse_point_robot": 4}
_CONTEXT_STANDARD: dict[str, dict[str, Any]] = {
    "point_robot": {},
    "point_robot_wind": {},
    "sparse_point_robot": {},
}
_TRAIN_STANDARD: dict[str, dict[str, Any]] = {
    "point_robot": {},
    "point_robot_wind": {},
    "sparse_point_robot": {},
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
    if env not in _PAPER_CODES:
        raise UsageError(f"no preset for '{env}' (there are: {', '.join(_PAPER_CODES)})")
    config_class = METHODS[method].config
    fields = {field.name for field in dataclasses.fields(config_class)}
    wanted: dict[str, Any] = {"codes": _PAPER_CODES[env], **_CONTEXT_STANDARD[env]}
    training = dataclasses.replace(_STANDARD, **_TRAIN_STANDARD[env])
    actor_critic = _STANDARD_AC
    meta_test = MetaTestConfig()
    if name == "paper":
        wanted |= _PAPER_SIZES | _PAPER_PREDICTORS
        training = MetaTrainConfig(
            steps=65_000,
            batch_size=256,
            context_size=_PAPER_CONTEXT[env],
            decay=False,
            context_episodes=_PAPER_CONTEXT[env] // ENVIRONMENTS[env].horizon // 10 or 1,
        )
        actor_critic = _PAPER_AC
    elif name == "smoke":
        wanted |= {"codes": 3, "encoder_hidden": (16,), "predictor_hidden": (16,), "z_dim": 4}
        training = MetaTrainConfig(
            steps=60, meta_batch=5, batch_size=7, context_size=11, context_episodes=1
        )
        actor_critic = dataclasses.replace(_STANDARD_AC, hidden=(16,))
        meta_test = MetaTestConfig(random_episodes=2, policy_episodes=2, repetitions=1)
    context = config_class(**{key: wanted[key] for key in wanted if key in fields})
    return RunConfig(
        training, actor_critic, context, meta_test, env=env, method=method, preset=name, **changes
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
    except (KeyError, TypeError) as error:
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
