"""The learners' errors that are the user's to mend."""


class UsageError(ValueError):
    """What was asked for cannot be done: one sentence that says what, where and what to do."""


class Diverged(UsageError):
    """Training has gone wrong: which quantity did first, and when."""
