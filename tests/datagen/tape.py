"""CUDA graphs on the processor: a stand-in that records torch's operations and plays them back."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

Call = tuple[Any, tuple[Any, ...], dict[str, Any], Any]


class Tape(TorchDispatchMode):  # type: ignore[no-untyped-call] # torch's own
    """Operations, forwards and backwards, on memory that stays where it was.

    As with a CUDA graph, recording leaves every value as it was, and `replay` runs no Python of
    the function that was recorded: it does the same operations with the same memory.
    """

    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call] # torch's own
        self.calls: list[Call] = []
        self._before: dict[int, tuple[Any, Any]] = {}

    def __torch_dispatch__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: Any = None
    ) -> Any:
        named = kwargs or {}
        for about, value in zip(func._schema.arguments, args, strict=False):
            if about.alias_info is not None and about.alias_info.is_write:
                self._keep(value)
        out = func(*args, **named)
        self.calls.append((func, args, named, out))
        return out

    def _keep(self, written: Any) -> None:
        for tensor in tree_leaves(written):
            storage = tensor.untyped_storage()
            self._before.setdefault(storage.data_ptr(), (storage, storage.clone()))

    def __exit__(self, *about: Any) -> None:
        super().__exit__(*about)  # type: ignore[no-untyped-call] # torch's own
        for storage, before in self._before.values():
            storage.copy_(before)

    @torch.no_grad()
    def replay(self) -> None:
        for func, args, kwargs, out in self.calls:
            again = func(*args, **kwargs)
            for old, new in zip(tree_leaves(out), tree_leaves(again), strict=True):
                if isinstance(old, Tensor) and old.data_ptr() != new.data_ptr():
                    old.copy_(new)


class _Stream:
    def __init__(self, name: str, said: list[str]) -> None:
        self.name, self.said = name, said

    def wait_stream(self, other: _Stream) -> None:
        self.said.append(f"{self.name} waits for {other.name}")


def pretend_cuda(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Put tapes in the place of CUDA's graphs; the list is of what they are told."""
    said: list[str] = []

    class Graph(Tape):  # type: ignore[no-untyped-call] # torch's own
        def replay(self) -> None:
            said.append("replay")
            super().replay()

    @contextmanager
    def graph(one: Graph, stream: _Stream) -> Iterator[None]:
        said.append(f"record on {stream.name}")
        with one:
            yield

    @contextmanager
    def entered(one: _Stream) -> Iterator[None]:
        said.append(f"run on {one.name}")
        yield

    monkeypatch.setattr(torch.cuda, "CUDAGraph", Graph)
    monkeypatch.setattr(torch.cuda, "graph", graph)
    monkeypatch.setattr(torch.cuda, "stream", entered)
    monkeypatch.setattr(torch.cuda, "Stream", lambda device: _Stream("aside", said))
    monkeypatch.setattr(torch.cuda, "current_stream", lambda device: _Stream("main", said))
    return said
