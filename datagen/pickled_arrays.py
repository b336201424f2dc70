"""Arrays of objects that NumPy stored as a pickle, read without running anything.

A pickle is a program for a small stack machine, and reading it in the ordinary way runs whatever it
asks for. The machine here knows the instructions that arrays of numbers need, makes nothing but
numbers, texts, bytes, tuples, lists, dictionaries and arrays, and refuses everything else.
"""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import Enum
from typing import Any

import numpy as np

_DTYPE = re.compile(r"([<>|=]?)(b1|\?|[iu][1248]|f[248]|O[48]?)")
_MARK = object()


class Symbol(Enum):
    """The only names a pickle may ask for, and what the machine does in their place."""

    RECONSTRUCT = "an empty array"
    SCALAR = "one number of NumPy's"
    NDARRAY = "the type of arrays"
    DTYPE = "the type of an array's elements"
    ENCODE = "bytes written as a text"
    BYTES = "no bytes"


_SYMBOLS = {
    ("numpy.core.multiarray", "_reconstruct"): Symbol.RECONSTRUCT,
    ("numpy._core.multiarray", "_reconstruct"): Symbol.RECONSTRUCT,
    ("numpy.core.multiarray", "scalar"): Symbol.SCALAR,
    ("numpy._core.multiarray", "scalar"): Symbol.SCALAR,
    ("numpy", "ndarray"): Symbol.NDARRAY,
    ("numpy", "dtype"): Symbol.DTYPE,
    ("_codecs", "encode"): Symbol.ENCODE,
    ("__builtin__", "bytes"): Symbol.BYTES,
    ("builtins", "bytes"): Symbol.BYTES,
}


@dataclass(eq=False)
class PickledArray:
    """An array as its pickle describes it.

    Attributes:
        shape: of the array; set, like the others, by the pickle's last word on it.
        is_object: whether its elements are objects rather than numbers.
        columns_first: whether `numbers` are in Fortran's order; `objects` are always in C's.
        numbers: its elements if they are numbers, [n].
        objects: its elements if they are objects: numbers, texts, `PickledArray`s and so on.
    """

    shape: tuple[int, ...] = ()
    is_object: bool = False
    columns_first: bool = False
    numbers: np.ndarray[Any, Any] | None = None
    objects: list[Any] = field(default_factory=list)


@dataclass(eq=False)
class _Dtype:
    """A type of elements; the byte order comes after the rest."""

    code: str
    order: str = "="

    def numpy(self) -> np.dtype[Any]:
        return np.dtype(self.order.replace("|", "=") + self.code)


class _Machine:
    """Runs one pickle."""

    def __init__(self, content: bytes) -> None:
        self.content = content
        self.position = 0
        self.stack: list[Any] = []
        self.memo: dict[int, Any] = {}

    def run(self) -> Any:
        stop = ord(".")
        while (code := self.content[self.position]) != stop:
            self.position += 1
            action = _INSTRUCTIONS.get(code)
            if action is None:
                raise ValueError(f"has the instruction {code:#04x}, which arrays do not need")
            action(self)
        self.position += 1
        if len(self.stack) != 1:
            raise ValueError("is not one object")
        return self.stack.pop()

    def take(self, size: int) -> bytes:
        start, end = self.position, self.position + size
        if end > len(self.content):
            raise ValueError("is truncated")
        self.position = end
        return self.content[start:end]

    def integer(self, size: int, signed: bool = False) -> int:
        return int.from_bytes(self.take(size), "little", signed=signed)

    def line(self) -> str:
        end = self.content.index(b"\n", self.position)
        text = self.content[self.position : end].decode("ascii")
        self.position = end + 1
        return text

    def above_mark(self) -> list[Any]:
        """Take everything above the last mark from the stack, and the mark."""
        position = len(self.stack) - 1
        while self.stack[position] is not _MARK:
            position -= 1
            if position < 0:
                raise ValueError("misses a mark")
        found = self.stack[position + 1 :]
        del self.stack[position:]
        return found

    def protocol(self) -> None:
        self.integer(1)

    def frame(self) -> None:
        self.integer(8)

    def memoize(self) -> None:
        self.memo[len(self.memo)] = self.stack[-1]

    def tuple_above_mark(self) -> None:
        found = tuple(self.above_mark())
        self.stack.append(found)

    def append(self) -> None:
        value = self.stack.pop()
        self._list().append(value)

    def appends(self) -> None:
        values = self.above_mark()
        self._list().extend(values)

    def _list(self) -> list[Any]:
        if type(self.stack[-1]) is not list:
            raise ValueError("appends to something that is no list")
        found: list[Any] = self.stack[-1]
        return found

    def set_items(self) -> None:
        values = self.above_mark()
        self._set(values)

    def set_item(self) -> None:
        values = self.stack[-2:]
        del self.stack[-2:]
        self._set(values)

    def _set(self, values: list[Any]) -> None:
        if type(self.stack[-1]) is not dict or any(type(key) is not str for key in values[::2]):
            raise ValueError("sets an item of something that is no dictionary of texts")
        self.stack[-1].update(zip(values[::2], values[1::2], strict=True))

    def name(self) -> None:
        self._symbol(self.line(), self.line())

    def name_of_stack(self) -> None:
        name, module = self.stack.pop(), self.stack.pop()
        self._symbol(module, name)

    def _symbol(self, module: object, name: object) -> None:
        if not isinstance(module, str) or not isinstance(name, str):
            raise ValueError("asks for something without a name")
        symbol = _SYMBOLS.get((module, name))
        if symbol is None:
            wanted = ascii(f"{module}.{name}"[:60])
            raise ValueError(f"asks for {wanted}, which no array needs: do not trust it")
        self.stack.append(symbol)

    def call(self) -> None:
        arguments, symbol = self.stack.pop(), self.stack.pop()
        if not isinstance(symbol, Symbol) or type(arguments) is not tuple:
            raise ValueError("calls something that cannot be called")
        self.stack.append(_CALLS[symbol](*arguments))

    def build(self) -> None:
        state, target = self.stack.pop(), self.stack[-1]
        if isinstance(target, _Dtype):
            order = state[1]
            if order not in ("<", ">", "=", "|") or any(part is not None for part in state[2:5]):
                raise ValueError("has a type of elements that is not plain")
            target.order = order
        elif isinstance(target, PickledArray):
            _fill(target, *state[1:])
        else:
            raise ValueError("changes something that is no array")


def _reconstruct(kind: object, shape: object, code: object) -> PickledArray:
    if kind is not Symbol.NDARRAY:
        raise ValueError("makes an array of an unknown type")
    return PickledArray()


def _dtype(code: object, align: object = False, copy: object = True) -> _Dtype:
    match = _DTYPE.fullmatch(code) if isinstance(code, str) else None
    if match is None:
        raise ValueError("has elements that are neither numbers nor objects")
    return _Dtype(match[2], match[1] or "=")


def _scalar(dtype: object, content: object = b"") -> float:
    if not isinstance(dtype, _Dtype) or not isinstance(content, bytes) or dtype.code[0] == "O":
        raise ValueError("has a number that is none")
    (value,) = np.frombuffer(content, dtype.numpy()).tolist()
    return float(value)


def _encode(text: object, codec: object = "latin1") -> bytes:
    if not isinstance(text, str) or codec not in ("latin1", "latin-1", "iso-8859-1"):
        raise ValueError("has bytes in an unknown writing")
    return text.encode("latin1")


def _no_bytes() -> bytes:
    return b""


def _not_callable(*arguments: object) -> None:
    raise ValueError("calls a type of arrays")


_CALLS: dict[Symbol, Callable[..., Any]] = {
    Symbol.RECONSTRUCT: _reconstruct,
    Symbol.DTYPE: _dtype,
    Symbol.SCALAR: _scalar,
    Symbol.ENCODE: _encode,
    Symbol.BYTES: _no_bytes,
    Symbol.NDARRAY: _not_callable,
}


def _fill(
    array: PickledArray, shape: object, dtype: object, columns_first: object, content: object
) -> None:
    # The limit is NumPy's own; it keeps the product below from taking ages.
    if type(shape) is not tuple or len(shape) > 64:
        raise ValueError("has an array without a shape")
    if not all(type(size) is int and 0 <= size < 2**63 for size in shape):
        raise ValueError("has an array without a shape")
    if not isinstance(dtype, _Dtype):
        raise ValueError("has an array without a type")
    is_object = dtype.code[0] == "O"
    count = math.prod(shape)
    if is_object and type(content) is list and len(content) == count:
        array.objects = content
    elif (
        not is_object and type(content) is bytes and len(content) == count * dtype.numpy().itemsize
    ):
        array.numbers = np.frombuffer(content, dtype.numpy())
    else:
        raise ValueError("has an array whose values do not fill its shape")
    array.shape, array.is_object, array.columns_first = shape, is_object, bool(columns_first)


def _pusher(make: Callable[[_Machine], Any]) -> Callable[[_Machine], None]:
    return lambda machine: machine.stack.append(make(machine))


def _text(size: int) -> Callable[[_Machine], Any]:
    return lambda machine: machine.take(machine.integer(size)).decode("utf-8", "surrogatepass")


def _bytes(size: int) -> Callable[[_Machine], Any]:
    return lambda machine: machine.take(machine.integer(size))


def _integer(size: int, signed: bool) -> Callable[[_Machine], Any]:
    return lambda machine: machine.integer(size, signed)


def _getter(size: int) -> Callable[[_Machine], Any]:
    return lambda machine: machine.memo[machine.integer(size)]


def _putter(size: int) -> Callable[[_Machine], None]:
    def put(machine: _Machine) -> None:
        machine.memo[machine.integer(size)] = machine.stack[-1]

    return put


def _tuple(size: int) -> Callable[[_Machine], None]:
    def pack(machine: _Machine) -> None:
        if len(machine.stack) < size:
            raise ValueError("packs more than there is")
        packed = tuple(machine.stack[-size:])
        machine.stack[-size:] = [packed]

    return pack


def _constant(value: Any) -> Callable[[_Machine], None]:
    return lambda machine: machine.stack.append(value)


_INSTRUCTIONS: dict[int, Callable[[_Machine], None]] = {
    0x80: _Machine.protocol,
    0x95: _Machine.frame,
    ord("("): _constant(_MARK),
    ord("N"): _constant(None),
    0x88: _constant(True),
    0x89: _constant(False),
    ord("K"): _pusher(_integer(1, False)),
    ord("M"): _pusher(_integer(2, False)),
    ord("J"): _pusher(_integer(4, True)),
    0x8A: _pusher(lambda machine: machine.integer(machine.integer(1), True)),
    ord("G"): _pusher(lambda machine: struct.unpack(">d", machine.take(8))[0]),
    0x8C: _pusher(_text(1)),
    ord("X"): _pusher(_text(4)),
    0x8D: _pusher(_text(8)),
    ord("C"): _pusher(_bytes(1)),
    ord("B"): _pusher(_bytes(4)),
    0x8E: _pusher(_bytes(8)),
    ord(")"): _constant(()),
    0x85: _tuple(1),
    0x86: _tuple(2),
    0x87: _tuple(3),
    ord("t"): _Machine.tuple_above_mark,
    ord("]"): _pusher(lambda machine: []),
    ord("a"): _Machine.append,
    ord("e"): _Machine.appends,
    ord("}"): _pusher(lambda machine: {}),
    ord("s"): _Machine.set_item,
    ord("u"): _Machine.set_items,
    ord("h"): _pusher(_getter(1)),
    ord("j"): _pusher(_getter(4)),
    ord("q"): _putter(1),
    ord("r"): _putter(4),
    0x94: _Machine.memoize,
    ord("c"): _Machine.name,
    0x93: _Machine.name_of_stack,
    ord("R"): _Machine.call,
    ord("b"): _Machine.build,
}
"""What each instruction does; those of the protocols 2 to 4 that NumPy's arrays are made of."""


def read_pickled_array(content: bytes) -> PickledArray:
    """The array that a pickle describes; runs nothing that the pickle asks for.

    Args:
        content: the pickle, as `numpy.save` writes it behind the header of an array of objects.

    Raises:
        ValueError: it is damaged, or is more than an array; the message says what is wrong.
    """
    machine = _Machine(content)
    try:
        found = machine.run()
    except ValueError as error:
        raise ValueError(f"its pickle {error}") from error
    except (IndexError, KeyError, TypeError, OverflowError, RecursionError) as error:
        raise ValueError("its pickle is damaged or truncated") from error
    if not isinstance(found, PickledArray):
        raise ValueError("its pickle is no array")
    if machine.position != len(content):
        raise ValueError("its pickle has foreign bytes behind its end")
    return found
