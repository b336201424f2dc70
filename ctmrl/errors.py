"""The learners' errors that are the user's to mend."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

REFUSALS = ("can't allocate memory", "out of memory", "size calculation overflowed")
"""What torch's errors say where there is too little memory; only a GPU's have a class."""


class UsageError(ValueError):
    """What was asked for cannot be done: one sentence that says what, where and what to do."""


class Diverged(UsageError):
    """Training has gone wrong: which quantity did first, and when."""


class OutOfMemory(UsageError):
    """What was asked for takes more memory than there is."""


@contextmanager
def within_memory() -> Iterator[None]:
    """Turn the refusal of memory into a sentence.

    Raises:
        OutOfMemory: the machine or its GPU refused some.
    """
    try:
        yield
    except (MemoryError, RuntimeError) as error:
        if not isinstance(error, MemoryError) and not any(said in str(error) for said in REFUSALS):
            raise
        raise OutOfMemory(
            "this takes more memory than there is: lower --batch-size, --meta-batch, "
            "--context-size, --repetitions or the widths of the networks (--hidden and others)"
        ) from None
