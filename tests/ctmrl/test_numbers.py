"""Random numbers of steps: one stream, drawn when asked for or before."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from ctmrl.numbers import Numbers, NumbersAhead, Source, normal, uniform
from tests.ctmrl.examples import generator

HOST = torch.device("cpu")


def step(source: Source) -> list[Tensor]:
    """What a step takes; copies, because the next one may write over them."""
    taken = [uniform(source, 5, 3), normal(source, 7, 2), normal(source, 3), uniform(source, 1)]
    return [one.clone() for one in taken]


def same(one: list[Tensor], other: list[Tensor]) -> bool:
    return all(a.equal(b) for a, b in zip(one, other, strict=True))


def test_all_sources_give_the_generators_numbers() -> None:
    draw = generator(3)
    plain = [
        [
            torch.rand(5, 3, generator=draw),
            torch.randn(7, 2, generator=draw),
            torch.randn(3, generator=draw),
            torch.rand(1, generator=draw),
        ]
        for _ in range(4)
    ]
    alone, now = generator(3), Numbers(generator(3), HOST)
    ahead = NumbersAhead(generator(3), HOST)
    for wanted in plain:
        ahead.draw()
        ahead.rewind()
        assert same(step(alone), wanted)
        assert same(step(now), wanted)
        assert same(step(ahead), wanted)
    assert ahead.generator.get_state().equal(draw.get_state())


def test_they_are_on_the_device() -> None:
    device = torch.device("meta")
    numbers = Numbers(generator(), device)
    assert uniform(numbers, 2, 3).device == normal(numbers, 2, 3).device == device


def test_numbers_ahead_stay_where_they_are() -> None:
    ahead, places = NumbersAhead(generator(), HOST), []
    for _ in range(3):
        ahead.draw()
        ahead.rewind()
        places.append([uniform(ahead, 5).data_ptr(), normal(ahead, 5).data_ptr()])
    assert places[0] == places[1] == places[2]


def test_a_step_that_asks_for_others_is_an_error() -> None:
    ahead = NumbersAhead(generator(), HOST)
    for _ in range(2):
        ahead.draw()
        ahead.rewind()
        step(ahead)
    with pytest.raises(RuntimeError, match="more random numbers than before"):
        uniform(ahead, 1)
    ahead.rewind()
    with pytest.raises(RuntimeError, match="other random numbers than before"):
        uniform(ahead, 5, 4)
    ahead.rewind()
    with pytest.raises(RuntimeError, match="other random numbers than before"):
        normal(ahead, 5, 3)
