"""When a codebook's contexts are collected and clustered."""

from __future__ import annotations

COLLECTIONS = 10
"""Times the contexts of all training tasks are collected for one run of K-means."""


class Schedule:
    """Which steps collect contexts and which run K-means.

    Attributes:
        start: the step before which K-means runs first; no codebook is used earlier.
    """

    def __init__(self, warm_up: float, refresh: float, steps: int) -> None:
        """Turn shares of the run into steps.

        Args:
            warm_up: share before the codebook is used; its last third collects.
            refresh: share between two further runs of K-means; all of it collects.
            steps: gradient steps of the run.
        """
        self.start = max(round(warm_up * steps), 1)
        self.period = max(round(refresh * steps), 1)
        self.first = max(round(warm_up * steps / 3), 1)

    def _interval(self, step: int) -> tuple[int, int]:
        """First step and length of the collecting interval that ends at or after `step`."""
        if step <= self.start:
            return self.start - self.first, self.first
        passed = (step - self.start - 1) // self.period
        return self.start + passed * self.period, self.period

    def ends_interval(self, step: int) -> bool:
        """Whether K-means runs before this step."""
        begin, length = self._interval(step)
        return step == begin + length

    def slots(self, step: int) -> range:
        """Slots of the collection to fill before this step, none for most steps."""
        begin, length = self._interval(step)
        if step <= begin:
            return range(0)
        before, now = (((step - begin - k) * COLLECTIONS) // length for k in (1, 0))
        return range(before, now)
