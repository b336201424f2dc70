"""Pickled arrays are read as NumPy reads them, and nothing they ask for is run."""

from __future__ import annotations

import contextlib
import os
import pickle
from collections import OrderedDict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from datagen.pickled_arrays import PickledArray, read_pickled_array


def plain(value: object) -> Any:
    """What an element should be, from what was read."""
    if not isinstance(value, PickledArray):
        return value
    assert value.numbers is not None
    order = "F" if value.columns_first else "C"
    return value.numbers.reshape(value.shape, order=order)  # type: ignore[call-overload]  # a str


def objects(*elements: Any) -> NDArray[np.object_]:
    made = np.empty(len(elements), dtype=object)
    for place, element in enumerate(elements):
        made[place] = element
    return made


ELEMENTS: tuple[Any, ...] = (
    np.array([0.1, -2.5e300]),
    np.array([1.5, 2.0], dtype=np.float32),
    np.array([1, -(2**40)], dtype=">i8"),
    np.array([True, False]),
    np.asfortranarray(np.arange(6.0).reshape(2, 3)),
    np.array(3.5),
    np.float32(0.1),
    np.float64(-7.25),
    np.int64(12),
    np.array([], dtype=np.float32),
    0.1,
    -3,
    70_000,
    2**40,
    True,
    None,
    "text",
    b"\x00\xff",
    (1.5, 2, 3, 4),
    [1, [2.0]],
    [],
    {"TimeLimit.truncated": True, "x": 1.0},
)


@pytest.mark.parametrize("protocol", [2, 3, 4])
@pytest.mark.parametrize("old_name", [False, True])
def test_every_kind_of_element_is_read(protocol: int, old_name: bool) -> None:
    content = pickle.dumps(objects(*ELEMENTS), protocol)
    if old_name and protocol < 4:
        content = content.replace(b"numpy._core.multiarray\n", b"numpy.core.multiarray\n")
    found = read_pickled_array(content)
    assert (found.shape, found.is_object) == ((len(ELEMENTS),), True)
    for element, value in zip(ELEMENTS, found.objects, strict=True):
        if isinstance(element, np.ndarray):
            read = plain(value)
            assert read.dtype == element.dtype
            assert np.array_equal(read, element)
        else:
            assert plain(value) == element


def test_memoised_elements_are_shared() -> None:
    same = np.arange(3.0)
    found = read_pickled_array(pickle.dumps(objects(same, same), 4))
    assert found.objects[0] is found.objects[1]


def test_objects_are_in_the_order_of_rows() -> None:
    array = np.asfortranarray(objects(*range(6)).reshape(2, 3))
    found = read_pickled_array(pickle.dumps(array, 4))
    assert found.shape == (2, 3)
    assert found.objects == [0, 1, 2, 3, 4, 5]


class Evil:
    """Makes a file when it is read in the usual way."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (str(self.path),)


@pytest.mark.parametrize("protocol", [2, 3, 4])
def test_nothing_is_run(protocol: int, tmp_path: Path) -> None:
    content = pickle.dumps(objects(1.0, Evil(tmp_path / "run")), protocol)
    with pytest.raises(ValueError, match=r"asks for '(posix|nt)\.mkdir', which no array needs"):
        read_pickled_array(content)
    assert not (tmp_path / "run").exists()
    pickle.loads(content)
    assert (tmp_path / "run").exists(), "the pickle was harmless, so the test shows nothing"


@pytest.mark.parametrize(
    ("content", "fault"),
    [
        (pickle.dumps(objects(OrderedDict()), 4), "asks for 'collections.OrderedDict'"),
        (pickle.dumps(objects(np.array(["text"])), 4), "neither numbers nor objects"),
        (pickle.dumps(objects(np.array([1 + 2j])), 4), "neither numbers nor objects"),
        (pickle.dumps(objects(np.zeros(1, [("a", "f4")])), 4), "neither numbers nor objects"),
        (pickle.dumps(objects({1, 2}), 4), "has the instruction 0x8f"),
        (pickle.dumps(objects(1.0), 5)[:2] + b"(i__main__\nA\n.", "has the instruction 0x69"),
        (pickle.dumps([1.0], 4), "is no array"),
        (pickle.dumps(objects(1.0), 4) + b".", "foreign bytes behind its end"),
        (b"\x80\x02cnumpy\nndarray\n)R.", "calls a type of arrays"),
        (b"\x80\x02cnumpy\ndtype\n(cnumpy\ndtype\ntR.", "neither numbers"),
        (b"\x80\x02K\x01K\x02\x86)R.", "cannot be called"),
        (b"\x80\x02]K\x01b.", "no array"),
        (b"\x80\x02K\x01K\x02a.", "no list"),
        (b"\x80\x02}K\x01K\x02s.", "no dictionary of texts"),
        (b"\x80\x02K\x01t.", "misses a mark"),
        (b"\x80\x02h\x07.", "damaged"),
        (b"\x80\x02N\x85N.", "not one object"),
        (b"\x80\x02.", "not one object"),
        (b"", "damaged"),
    ],
)  # fmt: skip
def test_a_refusal_says_why(content: bytes, fault: str) -> None:
    with pytest.raises(ValueError, match=fault):
        read_pickled_array(content)


def test_an_array_must_have_the_values_its_shape_says() -> None:
    content = pickle.dumps(objects(np.arange(3.0)), 4)
    with pytest.raises(ValueError, match="do not fill its shape"):
        read_pickled_array(content.replace(b"K\x01K\x03\x85", b"K\x01K\x04\x85"))


def test_nesting_without_end_is_refused() -> None:
    deep = b"\x80\x02" + b"(" * 100_000 + b"t" * 100_000 + b"."
    with pytest.raises(ValueError, match="is no array"):
        read_pickled_array(deep)
    with pytest.raises(ValueError, match="without a name"):
        read_pickled_array(deep[:-1] + b"K\x01\x93.")


def test_damage_is_a_value_error_or_another_value() -> None:
    content = pickle.dumps(objects(*ELEMENTS), 4)
    for length in range(len(content)):
        with pytest.raises(ValueError, match="pickle"):
            read_pickled_array(content[:length])
    generator = np.random.default_rng(0)
    for _ in range(3_000):
        damaged = bytearray(content)
        for place in generator.integers(len(content), size=3):
            damaged[place] = generator.integers(256)
        with contextlib.suppress(ValueError):
            read_pickled_array(bytes(damaged))
