"""Batched perceptrons: against one `torch.nn` network a task, values, gradients and first draws."""

from __future__ import annotations

import gc
import weakref

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from datagen.budgets import Precision
from datagen.fleet.networks import BatchedMLP
from tests.datagen.fleet.fleets import generators

TASKS, BATCH, SIZES = 3, 7, (5, 11, 13, 2)


def mlp(precision: Precision = "float32", sizes: tuple[int, ...] = SIZES) -> BatchedMLP:
    return BatchedMLP(sizes, generators(TASKS), precision)


def alone(net: BatchedMLP, task: int, dtype: torch.dtype = torch.float32) -> nn.Sequential:
    """One task's network, of PyTorch's own layers."""
    layers: list[nn.Module] = []
    for weight, bias in zip(net.weights, net.biases, strict=True):
        layer = nn.Linear(weight.shape[1], weight.shape[2])
        layer.weight.data, layer.bias.data = weight[task].detach().T.clone(), bias[task, 0].detach()
        layers += [layer, nn.ReLU()]
    return nn.Sequential(*layers[:-1]).to(dtype)


def normal(*shape: int, seed: int = 0) -> Tensor:
    return torch.from_numpy(np.random.default_rng(seed).standard_normal(shape, dtype=np.float32))


def expected(
    net: BatchedMLP, inputs: Tensor, gradient: Tensor, dtype: torch.dtype = torch.float32
) -> tuple[Tensor, ...]:
    """Outputs, gradients of the inputs, and of each layer's weight and bias, over all tasks."""
    rows = []
    for task in range(TASKS):
        one = alone(net, task, dtype)
        into = inputs[task].detach().to(dtype, copy=True).requires_grad_(True)
        out = one(into)
        out.backward(gradient[task].to(dtype))
        assert into.grad is not None
        linear = [layer for layer in one if isinstance(layer, nn.Linear)]
        weights = [layer.weight.grad for layer in linear]
        biases = [layer.bias.grad for layer in linear]
        rows.append(
            [
                out.detach(),
                into.grad,
                *(value.T for value in weights if value is not None),
                *(value[None] for value in biases if value is not None),
            ]
        )
    return tuple(torch.stack(parts).float() for parts in zip(*rows, strict=True))


def found(
    net: BatchedMLP, inputs: Tensor, gradient: Tensor, learn: bool = True
) -> tuple[Tensor, ...]:
    into = inputs.clone().requires_grad_(True)
    out = net(into, learn=learn)
    out.backward(gradient)
    assert into.grad is not None
    grads = [value.grad.clone() for value in net.parameters() if value.grad is not None]
    return (out.detach(), into.grad, *grads)


@pytest.mark.parametrize("sizes", [SIZES, (5, 2), (5, 4, 1)])
def test_each_task_is_a_network_of_its_own(sizes: tuple[int, ...]) -> None:
    net = mlp(sizes=sizes)
    inputs, gradient = normal(TASKS, BATCH, 5), normal(TASKS, BATCH, sizes[-1], seed=1)
    wanted, got = expected(net, inputs, gradient), found(net, inputs, gradient)
    assert len(wanted) == len(got) == 2 + 2 * (len(sizes) - 1)
    for one, other in zip(wanted, got, strict=True):
        assert one.shape == other.shape
        torch.testing.assert_close(other, one, rtol=1e-5, atol=1e-6)


def test_a_second_pass_writes_over_the_gradients_of_the_first() -> None:
    net, inputs, gradient = mlp(), normal(TASKS, BATCH, 5), normal(TASKS, BATCH, 2, seed=1)
    memory = [value.grad.data_ptr() for value in net.parameters() if value.grad is not None]
    first = found(net, 3 * inputs, gradient)
    again, fresh = found(net, inputs, gradient), found(mlp(), inputs, gradient)
    assert not torch.equal(first[2], again[2])
    for one, other in zip(fresh, again, strict=True):
        assert torch.equal(one, other)
    kept = [value.grad.data_ptr() for value in net.parameters() if value.grad is not None]
    assert kept == memory


def test_without_learning_only_the_inputs_have_a_gradient() -> None:
    net, inputs, gradient = mlp(), normal(TASKS, BATCH, 5), normal(TASKS, BATCH, 2, seed=1)
    before = [value.clone() for value in found(net, inputs, gradient)[2:]]
    other = 2 * inputs + 1
    out, into, *after = found(net, other, gradient, learn=False)
    for one, two in zip(before, after, strict=True):
        assert torch.equal(one, two)
    wanted = expected(net, other, gradient)
    torch.testing.assert_close((out, into), wanted[:2], rtol=1e-5, atol=1e-6)
    assert not net(inputs, learn=False).requires_grad


def test_parameters_learn_also_where_the_inputs_need_nothing() -> None:
    net, inputs, gradient = mlp(), normal(TASKS, BATCH, 5), normal(TASKS, BATCH, 2, seed=1)
    net(inputs).backward(gradient)
    for value, wanted in zip(net.parameters(), expected(net, inputs, gradient)[2:], strict=True):
        torch.testing.assert_close(value.grad, wanted, rtol=1e-5, atol=1e-6)


def test_bfloat16_is_as_close_as_torchs_own() -> None:
    net, low = mlp(), mlp("bfloat16")
    assert all(value.dtype == torch.float32 for value in low.parameters())
    inputs, gradient = normal(TASKS, 500, 5), normal(TASKS, 500, 2, seed=1)
    exact = expected(net, inputs, gradient)
    torchs = expected(net, inputs, gradient, torch.bfloat16)
    ours = found(low, inputs, gradient)
    for number, (one, theirs, other) in enumerate(zip(exact, torchs, ours, strict=True)):
        assert other.dtype == torch.float32
        error = ((other - one).norm() / one.norm()).item()
        # How far off is right: what PyTorch's layers of bfloat16 have, half as much again for luck
        # with values near 0, where a ReLU falls on the one side or the other.
        assert 1e-4 < error < 1.5 * ((theirs - one).norm() / one.norm()).item()
        # Eight significant bits: a rounding is within 0.2% of the value, and an output has been
        # through seven, of inputs, weights and sums.
        assert number > 0 or error < 0.014


def test_values_far_from_0_are_told_apart() -> None:
    net, low = mlp(), mlp("bfloat16")
    inputs = normal(TASKS, 500, 5)
    with torch.no_grad():
        near = low(inputs)
        for value in (net, low):
            value.biases[-1].fill_(200.0)
            value.refresh()
        # 1 apart are the numbers of bfloat16 there.
        torch.testing.assert_close(low(inputs), near + low.biases[-1] - mlp().biases[-1])
        assert 0 < (low(inputs) - net(inputs)).abs().amax() < 0.05


@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_after_a_step_it_must_be_refreshed(precision: Precision) -> None:
    net, inputs = mlp(precision), normal(TASKS, BATCH, 5)
    before = net(inputs).detach()
    with torch.no_grad():
        for value in net.parameters():
            value.mul_(2.0)
    if precision == "bfloat16":
        assert torch.equal(net(inputs), before), "the copy of lower precision is the old one"
    net.refresh()
    # A power of two is exact in every precision.
    twice = mlp(precision)
    twice.load_state_dict(net.state_dict())
    twice.refresh()
    assert not torch.equal(net(inputs), before)
    assert torch.equal(net(inputs), twice(inputs))


def test_moved_it_computes_where_it_is() -> None:
    # No processor is behind "meta", but tensors of two devices do not mix there either.
    for precision in ("float32", "bfloat16"):
        net = mlp(precision).to("meta")
        assert net(torch.empty(TASKS, BATCH, 5, device="meta")).device.type == "meta"


@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_a_pass_that_is_over_leaves_no_circle_of_objects(precision: Precision) -> None:
    net = mlp(precision)
    gc.disable()
    try:
        out = net(normal(TASKS, BATCH, 5).requires_grad_(True))
        node = weakref.ref(out.grad_fn)
        out.sum().backward()
        del out
        assert node() is None, "it would stay until the garbage is collected, activations and all"
    finally:
        gc.enable()


def test_first_weights_have_the_bounds_of_torchs() -> None:
    net = BatchedMLP((50, 400, 3), generators(2))
    for size, weight, bias in zip((50, 400), net.weights, net.biases, strict=True):
        bound = size**-0.5
        torchs = nn.Linear(size, 4000).requires_grad_(False)
        assert torchs.weight.abs().max().item() == pytest.approx(bound, rel=1e-3)
        for drawn in (weight, bias):
            assert drawn.abs().max() <= bound
        assert weight.std().item() == pytest.approx(torchs.weight.std().item(), rel=0.05)
        assert abs(weight.mean().item()) < 0.05 * bound
        assert weight.abs().max().item() == pytest.approx(bound, rel=0.01)
        assert bias.abs().max() > 0.3 * bound


def test_first_weights_depend_on_the_tasks_own_generator() -> None:
    three, other = mlp(), BatchedMLP(SIZES, generators(1, first=1))
    for many, one in zip(three.parameters(), other.parameters(), strict=True):
        assert torch.equal(many[1], one[0])
        assert not torch.equal(many[0], many[1])
