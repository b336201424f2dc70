"""Settings that came after the first runs, and are in a run's folder only where they are new."""

from __future__ import annotations

from typing import Any

SETTINGS_FILE = "settings.json"
"""Beside an evaluation outside its run's folder: the settings and the dataset of the run."""
LATER_SETTINGS: dict[str, Any] = {
    "quality": "mixed",
    "data_episodes": None,
    "precision": "float32",
    "device": "cpu",
    "context": {"standardize_contexts": False},
    "actor_critic": {
        "behavior_cloning": 0.0,
        "cloning_advantage": 0.0,
        "cloning_rank": 0.0,
        "value_expectile": 0.0,
        "value_from_data": False,
        "dual_steps": 1,
    },
}
"""Settings that came after the first runs, and what a run has that does not name them. Where they
are this, config.json leaves them out: such a run is the same in every version, byte for byte."""


def with_later_settings(
    settings: dict[str, Any], later: dict[str, Any] = LATER_SETTINGS
) -> dict[str, Any]:
    """A run's settings, with those it does not name because they came later."""
    found = {**later, **settings}
    nested = [key for key, value in later.items() if isinstance(value, dict)]
    return found | {key: with_later_settings(found[key], later[key]) for key in nested}


def without_later_settings(
    settings: dict[str, Any], later: dict[str, Any] = LATER_SETTINGS
) -> dict[str, Any]:
    """A run's settings, without those that came later and are as they were before."""
    found = {k: v for k, v in settings.items() if k not in later or v != later[k]}
    nested = [key for key, value in later.items() if isinstance(value, dict) and key in found]
    return found | {key: without_later_settings(found[key], later[key]) for key in nested}
