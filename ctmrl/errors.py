"""The learners' one kind of error that is the user's to mend."""


class UsageError(ValueError):
    """What was asked for cannot be done: one sentence that says what, where and what to do."""
