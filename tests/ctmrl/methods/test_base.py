"""What every method must keep to: one set of tests, run on each row of the table."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from ctmrl.methods import METHODS
from ctmrl.methods.base import Method, Reference
from ctmrl.networks import ContextEncoder
from tests.ctmrl.examples import (
    ACT,
    BATCH,
    OBS,
    PARAMS,
    TASKS,
    Z,
    contexts,
    dimensions,
    generator,
    normal,
    statistics,
)

STEPS = 20


def build(name: str, next_obs: bool = True) -> Method:
    row = METHODS[name]
    config = dataclasses.replace(
        row.config(), z_dim=Z, encoder_hidden=(23,), next_obs_in_context=next_obs
    )
    return row.method(config, statistics(next_obs), dimensions(STEPS))


def loss_at_the_end(method: Method) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
    """The loss when every part of the method's schedule has begun."""
    for step in range(STEPS):
        method.before_step(step, lambda: normal(TASKS, Z).float())
    h = contexts(method.context_sets)
    return method.context_loss(h, method.encoder(h), generator())


LEARNT = [name for name, row in METHODS.items() if not issubclass(row.method, Reference)]
REFERENCES = [name for name in METHODS if name not in LEARNT]


@pytest.fixture(params=METHODS)
def name(request: pytest.FixtureRequest) -> str:
    found: str = request.param
    return found


def test_the_table_names_each_method_with_its_own_config() -> None:
    for key, row in METHODS.items():
        assert key == key.lower()
        assert issubclass(row.method, Method)
        assert row.summary
        assert row.method.__module__ == row.config.__module__ == f"ctmrl.methods.{key}"


@pytest.mark.parametrize("next_obs", [True, False])
@pytest.mark.parametrize("name", LEARNT)
def test_a_loss_trains_every_parameter_of_the_encoder(name: str, next_obs: bool) -> None:
    method = build(name, next_obs)
    assert isinstance(method.encoder, ContextEncoder)
    assert method.encoder.in_dim == OBS + ACT + 1 + OBS * next_obs
    loss, _ = loss_at_the_end(method)
    assert loss.shape == ()
    loss.backward()  # type: ignore[no-untyped-call]
    for key, parameter in method.encoder.named_parameters():
        assert parameter.grad is not None, key
        assert parameter.grad.isfinite().all()
        assert parameter.grad.abs().sum() > 0, key


def test_metrics_are_finite_scalars_of_the_same_names_every_step(name: str) -> None:
    method = build(name)
    h = contexts(method.context_sets)
    _, before = method.context_loss(h, method.encoder(h), generator())
    _, after = loss_at_the_end(method)
    assert list(before) == list(after)
    for metrics in (before, after):
        for value in metrics.values():
            assert value.shape == ()
            assert value.isfinite()
            assert not value.requires_grad


def test_the_same_draws_give_the_same_loss(name: str) -> None:
    method = build(name)
    twin = build(name)
    twin.load_state_dict(method.state_dict())
    first, second = (loss_at_the_end(one)[0].item() for one in (method, twin))
    assert first == second


def test_the_codes_of_contexts(name: str) -> None:
    found = build(name).code_of(normal(BATCH, Z).float())
    if found is not None:
        assert found.dtype == torch.int64
        assert found.shape == (BATCH,)


@pytest.mark.parametrize("name", LEARNT)
def test_no_method_sees_a_tasks_parameters(name: str) -> None:
    method, z = build(name), normal(BATCH, Z).float()
    assert method.encoder.told(z, torch.full((BATCH, PARAMS), torch.nan)) is z
    assert not method.note


@pytest.mark.parametrize("name", REFERENCES)
def test_a_reference_has_nothing_to_train_and_says_what_it_is(name: str) -> None:
    method = build(name)
    assert not list(method.parameters())
    loss, metrics = loss_at_the_end(method)
    assert (loss.item(), loss.requires_grad, metrics) == (0.0, False, {})
    assert method.note.startswith("reference, ")
    assert METHODS[name].summary.startswith("reference: ")
