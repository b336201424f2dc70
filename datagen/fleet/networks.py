"""Multi-layer perceptrons of many tasks at once, as batched weights [task, in, out]."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor, nn

from datagen.budgets import Precision


class BatchedMLP(nn.Module):
    """One perceptron a task, ReLU between its layers; the tasks share nothing.

    A backward pass writes the gradients of the parameters over those of the last one, into memory
    of their own: they need no zeroing, and they do not add up.
    """

    def __init__(
        self,
        sizes: Sequence[int],
        generators: Sequence[np.random.Generator],
        precision: Precision = "float32",
    ) -> None:
        """Draw the weights as `torch.nn.Linear` does, each task from a generator of its own.

        Args:
            sizes: of the input, each hidden layer and the output.
            generators: one a task.
            precision: of the matrix products. The last layer's output is float32's always: a value
                of 100 and more differs between actions by less than bfloat16's 8 bits can tell.
        """
        super().__init__()
        self.dtype = getattr(torch, precision)
        self.weights, self.biases = nn.ParameterList(), nn.ParameterList()
        for size, out in pairwise(sizes):
            for shape, target in (((size, out), self.weights), ((1, out), self.biases)):
                drawn = np.stack([_uniform(one, shape, size**-0.5) for one in generators])
                target.append(nn.Parameter(torch.from_numpy(drawn)))
        for parameter in self.parameters():
            parameter.grad = torch.zeros_like(parameter)
        self._lower: list[tuple[Tensor, Tensor]] = []
        self.refresh()

    def forward(self, inputs: Tensor, learn: bool = True) -> Tensor:
        """Outputs [task, batch, out] of inputs [task, batch, in], both float32.

        Args:
            inputs: the gradient reaches them either way.
            learn: whether it reaches the parameters.
        """
        parameters = tuple(self.parameters()) if learn else ()
        outputs: Tensor = _Pass.apply(inputs, self, *parameters)  # type: ignore[no-untyped-call] # torch's own
        return outputs

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        # Moved to another device, the network computes with weights that are there.
        super()._apply(fn, recurse)  # type: ignore[no-untyped-call] # torch's own
        self._lower = []
        self.refresh()
        return self

    @property
    def lower(self) -> list[tuple[Tensor, Tensor]]:
        """Weight and bias of each layer as it is computed with, the last one's in float32."""
        return self._lower

    @torch.no_grad()
    def refresh(self) -> None:
        """Take over what an optimiser has done to the parameters; call it after each step."""
        pairs = zip(self.weights, self.biases, strict=True)
        if self.dtype == torch.float32:
            self._lower = [(w.detach(), b.detach()) for w, b in pairs]
            return
        if not self._lower:
            *hidden, last = [(w.detach().clone(), b.detach().clone()) for w, b in pairs]
            self._lower = [*((w.to(self.dtype), b.to(self.dtype)) for w, b in hidden), last]
            return
        for (weight, bias), (w, b) in zip(self._lower, pairs, strict=True):
            weight.copy_(w)
            bias.copy_(b)


class _Pass(torch.autograd.Function):
    """All layers forwards and backwards, without a copy of anything that is not needed."""

    @staticmethod
    def forward(ctx: Any, inputs: Tensor, net: BatchedMLP, *parameters: Tensor) -> Tensor:
        last = len(net.lower) - 1
        values = [inputs.to(net.dtype)]
        for weight, bias in net.lower[:last]:
            values.append(torch.baddbmm(bias, values[-1], weight).relu_())
        # Without the output: it knows its way back to here, and the circle would keep both.
        ctx.net, ctx.values, ctx.parameters = net, values, len(parameters)
        weight, bias = net.lower[last]
        if net.dtype == torch.float32:
            return torch.baddbmm(bias, values[last], weight)
        # Transposed: a product with one column is slow, one with a single row is not.
        product = torch.bmm(weight.transpose(1, 2), values[last].float().transpose(1, 2))
        return product.transpose(1, 2) + bias

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Any:
        net, values = ctx.net, ctx.values
        nothing = (None,) * ctx.parameters
        gradient = gradients[0].to(net.dtype)
        for layer in reversed(range(len(net.lower))):
            if ctx.parameters:
                below = values[layer].transpose(1, 2)
                net.weights[layer].grad.copy_(torch.bmm(below, gradient))
                net.biases[layer].grad.copy_(gradient.sum(1, keepdim=True))
            if layer == 0 and not ctx.needs_input_grad[0]:
                return (None, None, *nothing)
            across = net.lower[layer][0].transpose(1, 2).to(net.dtype)
            # Of a single output this is an outer product, which needs no product of matrices.
            outer = across.shape[1] == 1
            gradient = gradient * across if outer else torch.bmm(gradient, across)
            if layer > 0:
                gradient = torch.ops.aten.threshold_backward(gradient, values[layer], 0)
        return (gradient.float(), None, *nothing)


def _uniform(
    generator: np.random.Generator, shape: tuple[int, int], bound: float
) -> np.ndarray[Any, np.dtype[np.float32]]:
    drawn = generator.random(shape, dtype=np.float32)
    return (2 * drawn - 1) * np.float32(bound)
