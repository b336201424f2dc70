"""What the hardware multiplies fast, devices that are not there, and recorded functions."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from datagen import accelerator
from datagen.accelerator import (
    WARM_UP,
    Inlet,
    best_precision,
    bfloat16_gain,
    check_precision,
    recorded,
)
from tests.datagen.tape import pretend_cuda

CUDA = torch.device("cuda")


def test_the_best_precision_is_that_of_the_hardware(monkeypatch: pytest.MonkeyPatch) -> None:
    assert best_precision() in ("float32", "bfloat16")
    only_avx512 = {"avx512_bf16": True, "amx_bf16": False}
    for capabilities, gain, best in (
        ({"amx_bf16": True}, 0.0, "bfloat16"),
        (only_avx512, 4.0, "bfloat16"),
        (only_avx512, 1.4, "float32"),
        ({"avx512_f": True, "avx512_bf16": False}, 9.0, "float32"),
        ({}, 9.0, "float32"),
    ):
        monkeypatch.setattr(accelerator, "bfloat16_gain", lambda held=gain: held)
        monkeypatch.setattr(
            torch.cpu, "get_capabilities", lambda held=capabilities: held, raising=False
        )
        assert best_precision("cpu") == check_precision("auto", "cpu") == best
    monkeypatch.delattr(torch.cpu, "get_capabilities")
    assert best_precision() == "float32"


def test_the_gain_of_bfloat16_is_measured_once() -> None:
    accelerator.bfloat16_gain.cache_clear()
    gain = bfloat16_gain()
    assert 0 < gain < float("inf")
    assert bfloat16_gain() == gain


def test_a_precision_that_is_given_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    for precision in ("float32", "bfloat16"):
        monkeypatch.setattr(accelerator, "best_precision", lambda device: "nothing")
        assert check_precision(precision, "cpu") == precision


@pytest.mark.parametrize("device", ["nonsense", "cuda:99", ""])
@pytest.mark.parametrize("precision", ["auto", "float32"])
def test_a_device_that_is_not_there(device: str, precision: str) -> None:
    with pytest.raises(ValueError, match=f"--device {device} cannot be used here: ") as caught:
        check_precision(precision, device)
    assert "\n" not in str(caught.value)


def refuse(*about: Any, **more: Any) -> None:
    raise AssertionError("called")


def test_an_inlet_stays_where_it_is() -> None:
    inlet = Inlet((2, 3), torch.device("cpu"))
    place, view = inlet.tensor.data_ptr(), inlet.tensor[1]
    for value in (1.0, 2.0):

        def write(into: NDArray[np.float32], value: float = value) -> None:
            into[1] = value

        inlet.fill(write)
        assert inlet.tensor.tolist() == [[0.0] * 3, [value] * 3]
        assert view.tolist() == [value] * 3
    assert inlet.tensor.data_ptr() == place


def test_on_a_processor_it_is_the_function_itself() -> None:
    assert recorded(refuse, torch.device("cpu")) is refuse


def test_every_call_counts_once(monkeypatch: pytest.MonkeyPatch) -> None:
    said, total, calls = pretend_cuda(monkeypatch), torch.zeros(2), list[int]()

    def function() -> None:
        calls.append(1)
        total.add_(torch.ones(2) * 3)

    call = recorded(function, CUDA)
    for number in range(1, WARM_UP + 4):
        call()
        assert total.tolist() == [3.0 * number] * 2
    warm_up = ["aside waits for main", "run on aside", "main waits for aside"] * WARM_UP
    assert said == [*warm_up, "record on aside", "replay", "replay", "replay"]
    assert len(calls) == WARM_UP + 1
