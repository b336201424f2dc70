"""The field's extrapolating splits of tasks in a row, such as velocities from slow to fast."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from meta_envs.tasks import Split


def outer_splits(n_tasks: int) -> Mapping[str, Split]:
    """Training on the middle half of the tasks, the meta-test on what is outside.

    Of 40 tasks, 10 to 29 are for training. "moderate" tests on 5 to 9 and 30 to 34, "extreme" on 0
    to 4 and 35 to 39, "extrapolate" on both.

    Args:
        n_tasks: number of tasks, in the order of the parameter that varies.
    """
    quarter, eighth = n_tasks // 4, n_tasks // 8
    rows = np.arange(n_tasks)
    # How many steps it is to the nearer end.
    depth = np.minimum(rows, rows[::-1])
    train = np.flatnonzero(depth >= quarter)
    return {
        "extrapolate": Split(train, np.flatnonzero(depth < quarter)),
        "moderate": Split(train, np.flatnonzero((depth < quarter) & (depth >= eighth))),
        "extreme": Split(train, np.flatnonzero(depth < eighth)),
    }
