"""Settings that came after the first runs."""

from __future__ import annotations

from ctmrl.settings import LATER_SETTINGS, with_later_settings, without_later_settings


def test_settings_that_came_later_are_left_out_where_they_change_nothing() -> None:
    inner = LATER_SETTINGS["actor_critic"] | {"gamma": 0.5, "value_from_data": True}
    settings = {"seed": 3, "quality": "mixed", "data_episodes": 3, "actor_critic": inner}
    kept = {
        "seed": 3,
        "data_episodes": 3,
        "actor_critic": {"gamma": 0.5, "value_from_data": True},
    }
    assert without_later_settings(settings) == kept
    assert with_later_settings(kept) == LATER_SETTINGS | settings
    assert with_later_settings({})["actor_critic"] == LATER_SETTINGS["actor_critic"]
