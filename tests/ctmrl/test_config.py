"""Settings are frozen, explained, and in their ranges."""

from __future__ import annotations

import dataclasses
import inspect
import math
from typing import Any

import pytest

from ctmrl.config import RunConfig, check_settings
from ctmrl.errors import UsageError
from ctmrl.methods import METHODS
from ctmrl.presets import preset
from tests.ctmrl.examples import smoke


def parts(config: RunConfig) -> list[Any]:
    """The config and the configs in it."""
    return [config, config.training, config.actor_critic, config.context, config.meta_test]


@pytest.mark.parametrize("method", METHODS)
def test_settings_are_frozen_and_every_one_is_explained(method: str) -> None:
    names: list[str] = []
    for config in parts(preset("point_robot", method, "standard")):
        for cls in type(config).__mro__[:-1]:
            source = inspect.getsource(cls)
            for name in cls.__annotations__:
                value = getattr(config, name)
                if not dataclasses.is_dataclass(value):
                    after = source.split(f"\n    {name}: ")[1].partition("\n")[2]
                    assert after.startswith('    """'), f"{cls.__name__}.{name}"
                    names.append(name)
        with pytest.raises(dataclasses.FrozenInstanceError):
            config.__setattr__(dataclasses.fields(config)[0].name, None)
    # On a command line all of them stand side by side.
    assert len(names) == len(set(names))


@pytest.mark.parametrize("method", METHODS)
def test_presets_pass_the_check(method: str) -> None:
    for name in ("standard", "paper", "smoke"):
        check_settings(preset("point_robot", method, name))


WRONG: list[tuple[str, Any, str]] = [
    ("seed", -1, "from 0 to 9.22337e+18"),
    ("seed", 2**64, "from 0 to 9.22337e+18"),
    ("threads", 0, "from 1 to 1024"),
    ("threads", 100_000, "from 1 to 1024"),
    ("data_episodes", 0, "at least 1"),
    ("steps", 0, "at least 1"),
    ("meta_batch", 1, "at least 2"),
    ("batch_size", 0, "at least 1"),
    ("context_episodes", 0, "at least 1"),
    ("context_size", -5, "at least 1"),
    ("hidden", (16, 0), "at least 1"),
    ("gamma", 1.5, "from 0 to 1"),
    ("gamma", float("nan"), "from 0 to 1"),
    ("reward_scale", 0.0, "at least 1e-09"),
    ("learning_rate", -1e-3, "at least 0"),
    ("learning_rate", math.inf, "a finite number"),
    ("divergence_target", math.nan, "a finite number"),
    ("divergence_target", -math.inf, "a finite number"),
    ("behavior_cloning", -0.5, "at least 0"),
    ("cloning_advantage", -1.0, "at least 0"),
    ("cloning_rank", -1.0, "at least 0"),
    ("value_expectile", 1.5, "from 0 to 1"),
    ("divergence_maximum", -1.0, "at least 0"),
    ("dual_steps", 0, "at least 1"),
    ("contrast_weight", -0.1, "at least 0"),
    ("z_dim", 0, "at least 1"),
    ("tau", 0.0, "at least 1e-09"),
    ("eta", 2.0, "from 0 to 1"),
    ("extra_negatives", -1, "at least 0"),
    ("warm_up", 1.1, "from 0 to 1"),
    ("refresh", -0.1, "from 0 to 1"),
    ("random_episodes", -1, "at least 0"),
    ("scored_episodes", 0, "at least 1"),
    ("repetitions", 0, "at least 1"),
]


@pytest.mark.parametrize(("name", "value", "wanted"), WRONG)
def test_a_value_out_of_its_range_is_one_sentence(name: str, value: Any, wanted: str) -> None:
    config = smoke()
    for field in dataclasses.fields(config):
        inner = getattr(config, field.name)
        if field.name == name:
            config = dataclasses.replace(config, **{name: value})
        elif hasattr(inner, name):
            changed = dataclasses.replace(inner, **{name: value})
            config = dataclasses.replace(config, **{field.name: changed})
    option = name.replace("_", "-")
    with pytest.raises(UsageError) as caught:
        check_settings(config)
    assert str(caught.value) == f"--{option} must be {wanted}, got {value}"


@pytest.mark.parametrize("method", METHODS)
def test_no_option_but_memory_may_be_infinite(method: str) -> None:
    config = preset("point_robot", method, "standard")
    check_settings(dataclasses.replace(config, memory=math.inf))
    for part in parts(config):
        for field in dataclasses.fields(part):
            if isinstance(getattr(part, field.name), float):
                with pytest.raises(UsageError, match=f"--{field.name.replace('_', '-')} must be "):
                    check_settings(dataclasses.replace(part, **{field.name: math.inf}))


@pytest.mark.parametrize(
    ("name", "value"), [("random_episodes", 0), ("policy_episodes", 0), ("repetitions", 1)]
)
def test_the_ends_of_a_range_are_in_it(name: str, value: int) -> None:
    config = smoke()
    protocol = dataclasses.replace(config.meta_test, **{name: value})
    check_settings(dataclasses.replace(config, meta_test=protocol))


def test_an_option_that_is_not_given_is_in_its_range() -> None:
    assert smoke().data_episodes is None
    check_settings(smoke())
    check_settings(dataclasses.replace(smoke(), data_episodes=1))
