from __future__ import annotations

from ctmrl.errors import UsageError


def test_it_is_a_value_error_that_is_its_sentence() -> None:
    error = UsageError("--codes must be at least 1, got 0")
    assert isinstance(error, ValueError)
    assert str(error) == "--codes must be at least 1, got 0"
