from __future__ import annotations

import os
from typing import Any

import torch

from ctmrl.threads import settle_threads


def test_the_settings_are_made() -> None:
    torch.set_flush_denormal(False)
    torch.use_deterministic_algorithms(False)
    deterministic: Any = torch.utils.deterministic
    deterministic.fill_uninitialized_memory = True
    tiny = torch.tensor(1e-38)
    assert tiny / 100 > 0
    try:
        settle_threads(2)
        assert torch.get_num_threads() == 2
        assert torch.are_deterministic_algorithms_enabled()
        assert tiny / 100 == 0
        assert not deterministic.fill_uninitialized_memory
        assert os.environ["CUBLAS_WORKSPACE_CONFIG"] in (":4096:8", ":16:8")
    finally:
        settle_threads(1)
    assert torch.get_num_threads() == 1
