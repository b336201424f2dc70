"""What the hardware multiplies fast, and devices that are not there."""

from __future__ import annotations

import pytest
import torch

from datagen import accelerator
from datagen.accelerator import best_precision, check_precision


def test_the_best_precision_is_that_of_the_hardware(monkeypatch: pytest.MonkeyPatch) -> None:
    assert best_precision() in ("float32", "bfloat16")
    for capabilities, best in (
        ({"amx_bf16": True}, "bfloat16"),
        ({"avx512_bf16": True, "amx_bf16": False}, "float32"),
        ({"avx512_f": True, "avx512_bf16": False}, "float32"),
        ({}, "float32"),
    ):
        monkeypatch.setattr(
            torch.cpu, "get_capabilities", lambda held=capabilities: held, raising=False
        )
        assert best_precision("cpu") == check_precision("auto", "cpu") == best
    monkeypatch.delattr(torch.cpu, "get_capabilities")
    assert best_precision() == "float32"


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
