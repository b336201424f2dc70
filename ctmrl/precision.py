"""The precision of the networks' matrix products.

Parameters, optimisers, losses and all that is not a layer of a network are float32 always. The
layers of a network are in bfloat16, matrix products and what lies between them, where they are
called inside `products_in("bfloat16")`: a network takes float32 and gives float32. The last layer
of critics is float32 always.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Literal

import torch
from torch import Tensor

Precision = Literal["float32", "bfloat16"]

_bfloat16: ContextVar[bool] = ContextVar("bfloat16", default=False)


@contextmanager
def products_in(precision: Precision) -> Iterator[None]:
    """Networks that are called inside multiply in this precision, and differentiate in it later."""
    token = _bfloat16.set(precision == "bfloat16")
    try:
        yield
    finally:
        _bfloat16.reset(token)


def lowered(tensor: Tensor) -> Tensor:
    """A tensor in the precision that is set; for float32 the tensor itself, of whatever type.

    Each call makes a copy, so calls of a network that shall not are given the same copies.
    """
    return tensor.to(torch.bfloat16) if _bfloat16.get() else tensor
