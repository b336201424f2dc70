"""What counts as divergence."""

import math

import pytest
import torch

from ctmrl.errors import Diverged
from ctmrl.soundness import check_sound, q_limit


def test_the_limit_is_a_hundred_times_what_rewards_add_up_to() -> None:
    # r = 3 and c = 0.5 for ever at gamma = 0.75: 14.
    assert q_limit(3.0, 0.5, 0.75) == pytest.approx(1400)
    # Rewards that are hardly any leave room for what untrained networks give.
    assert q_limit(1e-3, 1e-4, 0.5) == 100
    assert q_limit(1.0, 0.0, 1.0) == math.inf


def test_sound_quantities_of_any_shape() -> None:
    check_sound(3, {"a": torch.tensor(-5.0), "b": torch.full((2, 3), 5.0)}, {"b": 5.0})


@pytest.mark.parametrize(
    ("bad", "said"),
    [
        ([1.0, math.nan], "b is nan at step 7"),
        ([math.inf, 1.0], "b is inf at step 7"),
        ([-math.inf, 1.0], "b is inf at step 7"),
        ([-5.5, 1.0], "b is 5.5 at step 7, beyond its limit 5"),
    ],
)
def test_the_first_bad_one_is_named(bad: list[float], said: str) -> None:
    quantities = {"a": torch.ones(()), "b": torch.tensor(bad), "c": torch.tensor([math.nan])}
    with pytest.raises(Diverged) as caught:
        check_sound(7, quantities, {"b": 5.0})
    assert str(caught.value) == said
