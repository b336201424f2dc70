"""Recorded updates: fit to be recorded, and what they compute, on a stand-in for CUDA's graphs."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor
from torch._subclasses.fake_tensor import FakeTensorMode

from datagen.accelerator import WARM_UP, Recorded, recorded
from datagen.budgets import Precision
from datagen.fleet.algorithm import FleetSAC
from datagen.fleet.state import learner_counts, learner_tensors, load_state, restore, save_state
from tests.datagen.fleet.fleets import NEVER, SETTINGS, fleet
from tests.datagen.tape import Tape, pretend_cuda

CUDA = torch.device("cuda")
PRECISIONS: tuple[Precision, ...] = ("float32", "bfloat16")
both = pytest.mark.parametrize("precision", PRECISIONS)


def begun(precision: Precision, updates: int = 10) -> FleetSAC:
    """A fleet with data in its memory, after some updates."""
    model = fleet((0, 2), precision=precision)
    model.learn((40 + updates) * 2, log_interval=NEVER)
    assert model._n_updates == updates
    return model


def learnt(model: FleetSAC) -> dict[str, Tensor]:
    return {**learner_tensors(model), "losses": model._losses}


def same(one: FleetSAC, other: FleetSAC) -> bool:
    ours, theirs = learnt(one), learnt(other)
    assert ours.keys() == theirs.keys()
    return all(torch.equal(ours[name], theirs[name]) for name in ours)


def on_tape(model: FleetSAC) -> FleetSAC:
    """A learner that believes its updates to be a GPU's."""
    model._recorded = recorded(model._update, CUDA)
    return model


@both
def test_recorded_updates_compute_the_same(
    precision: Precision, monkeypatch: pytest.MonkeyPatch
) -> None:
    said = pretend_cuda(monkeypatch)
    eager, taped = begun(precision), on_tape(begun(precision))
    for model in (eager, taped):
        model.train(WARM_UP + 5, SETTINGS.batch_size)
        # Acting in between, as in a training.
        model.learn(20, log_interval=NEVER, reset_num_timesteps=False)
        model.train(4, SETTINGS.batch_size)
    assert said.count("replay") >= 9
    assert sum("record" in one for one in said) == 1
    assert same(eager, taped)
    assert eager.logger.name_to_value == taped.logger.name_to_value


@both
def test_recorded_updates_go_on_from_a_file(
    precision: Precision, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    saved = begun(precision)
    save_state(tmp_path / "state", learner_tensors(saved), learner_counts(saved))
    said = pretend_cuda(monkeypatch)
    monkeypatch.setattr(FleetSAC, "record", on_tape)
    # It has recorded its updates before it is put back into the state.
    again = begun(precision)
    assert "replay" in said
    said.clear()
    restore(again, *load_state(tmp_path / "state"))
    for model in (saved, again):
        model.train(WARM_UP + 4, SETTINGS.batch_size)
    assert said.count("replay") == 4
    assert same(saved, again)


@both
def test_nothing_moves(precision: Precision) -> None:
    model = begun(precision)

    def places() -> list[int]:
        policy = model.policy
        nets = (policy.actor, *policy.critics, *policy.targets)
        tensors = [model.log_temperature, *policy.parameters(), model._losses]
        tensors += [one.grad for one in tensors if one.grad is not None]
        tensors += [one for net in nets for pair in net.lower for one in pair]
        tensors += [one.tensor for one in (model._rows, *model._noises)]
        for optimizer in model.optimizers.values():
            tensors += [part for held in optimizer.state.values() for part in held.values()]
        return [one.data_ptr() for one in tensors]

    before = places()
    # 17 parameters learn, 8 more are targets'; all of 3 layers have copies of lower precision.
    assert len(before) >= 25 + 1 + 19 + 30 + 3 + 3 * 19
    for _ in range(3):
        model.train(2, SETTINGS.batch_size)
        assert places() == before


def refuse(*about: Any, **more: Any) -> None:
    raise AssertionError("between the host and a device")


@both
def test_an_update_waits_for_nothing_and_leaves_the_device_nowhere(
    precision: Precision, monkeypatch: pytest.MonkeyPatch
) -> None:
    model, plain = begun(precision), torch.Tensor.to
    for name in ("cpu", "cuda", "numpy", "tolist", "pin_memory"):
        monkeypatch.setattr(torch.Tensor, name, refuse)
    for name in ("tensor", "as_tensor", "from_numpy"):
        monkeypatch.setattr(torch, name, refuse)

    def to(tensor: Tensor, dtype: torch.dtype) -> Tensor:
        return plain(tensor, dtype)

    monkeypatch.setattr(torch.Tensor, "to", to)
    # Tensors without values: to ask for one, or for a shape that depends on one, is an error.
    with FakeTensorMode(allow_non_fake_inputs=True):
        model._update()


@pytest.mark.parametrize(
    "ask",
    [
        lambda values: values.sum().item(),
        lambda values: bool(values.sum() > 0),
        lambda values: values[values > 0],
        lambda values: values.sum().tolist(),
    ],
)
def test_asking_for_a_value_would_be_seen(ask: Callable[[Tensor], Any]) -> None:
    with (
        FakeTensorMode(allow_non_fake_inputs=True),
        pytest.raises(RuntimeError, match="aten"),
    ):
        ask(torch.ones(3))


@both
def test_an_update_does_the_same_operations_each_time(precision: Precision) -> None:
    model, taken = begun(precision), list[list[Any]]()
    for _ in range(2):
        with Tape() as tape:
            model._update()
        taken.append([func for func, *_ in tape.calls])
        model.train(3, SETTINGS.batch_size)
    assert taken[0] == taken[1]
    assert not any(torch.Tag.nondeterministic_seeded in func.tags for func in taken[0])
    products = taken[0].count(torch.ops.aten.bmm.default)
    # Backwards, of 3 layers: the actor's 3 + 2, and of each critic 3 + 1 as it learns and 2 for the
    # actor; a critic's last layer has an outer product.
    backwards = 5 + 2 * (3 + 1 + 2)
    # Forwards, in lower precision: last layers, in 2 passes of the actor and 3 of each critic.
    assert products == backwards + (2 + 2 * 3 if precision == "bfloat16" else 0)


def test_batches_are_of_the_settings_size() -> None:
    model = begun("float32")
    with pytest.raises(ValueError, match="batches are of 16 transitions, not 17"):
        model.train(1, 17)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
@both
def test_a_gpu_learns_as_a_processor_does(precision: Precision, tmp_path: Path) -> None:
    if precision == "bfloat16" and not torch.cuda.is_bf16_supported(including_emulation=False):
        pytest.skip("needs a GPU with bfloat16")
    start = fleet((0, 2), precision=precision)
    begin = {name: value.clone() for name, value in start.policy.state_dict().items()}
    start.learn(50 * 2, log_interval=NEVER)
    save_state(tmp_path / "state", learner_tensors(start), learner_counts(start))
    processor, gpu = (fleet((0, 2), precision=precision, device=name) for name in ("cpu", "cuda"))
    for model in (processor, gpu):
        restore(model, *load_state(tmp_path / "state"))
        model.train(WARM_UP + 20, SETTINGS.batch_size)
    assert isinstance(gpu._recorded, Recorded)
    assert gpu._recorded._graph is not None
    # On one processor, rows of the memory that are 1e-6 larger make 2e-6 and 1e-3 of a difference.
    bound = 1e-3 if precision == "float32" else 0.1
    for name, value in processor.policy.state_dict().items():
        moved = torch.linalg.norm(value - begin[name])
        other = gpu.policy.state_dict()[name].cpu()
        assert torch.linalg.norm(other - value) < bound * moved, name
    torch.testing.assert_close(gpu._losses.cpu(), processor._losses, rtol=bound, atol=bound)
