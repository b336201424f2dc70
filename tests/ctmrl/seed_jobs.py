"""A training that worker processes of tests can import: one seed ends well, others do not."""

from __future__ import annotations

import os
import signal

from rich.console import Console

from ctmrl.config import RunConfig
from ctmrl.errors import Diverged
from ctmrl.seeds import Watch


def pretend(config: RunConfig, console: Console, watch: Watch) -> None:
    """Show a row; seeds 1 and 2 diverge, 3 is killed, and all are sent Ctrl-C in vain."""
    os.kill(os.getpid(), signal.SIGINT)
    watch({"step": 6, "return/training_tasks": -1.5 - config.seed})
    if config.seed in (1, 2):
        raise Diverged("training diverged: q is nan")
    if config.seed == 3:
        os.kill(os.getpid(), signal.SIGKILL)
