"""What the learners' commands show on a terminal."""

from __future__ import annotations

import errno
import sys
import time
from collections.abc import Callable, Mapping
from types import TracebackType

from rich.columns import Columns
from rich.console import Console
from rich.live import Live
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn
from rich.table import Table

from ctmrl.errors import Diverged, UsageError
from datagen.dataset import DatasetError

MISTAKES = (UsageError, DatasetError, OSError)
"""Errors whose message is the sentence a user needs: their own mistake, or a disk's refusal."""
NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
"""A disk's refusals that end when there is room."""

KINDS = {
    "return": "return",
    "loss/encoder": "encoder losses",
    "contexts": "contexts",
    "codes": "codes",
    "loss": "losses",
    "policy": "policy",
    "divergence": "divergence",
}
"""Kinds of metrics as the live table has them, by what the metrics' names begin with."""


RESUMES = "Stopped. The same command goes on from the last checkpoint."


def run_command(command: Callable[[], None], stopped: str = RESUMES) -> int:
    """Run a command; a user's mistake, or a disk's refusal, becomes one sentence on stderr.

    Args:
        command: what to run.
        stopped: what Ctrl-C makes it say.

    Returns:
        The exit code: 0, 1 for a run that diverged, 2 for a mistake or a refusal, 130 for Ctrl-C.
    """
    try:
        command()
    except KeyboardInterrupt:
        sys.stderr.write(f"{stopped}\n")
        return 130
    except MISTAKES as error:
        full = isinstance(error, OSError) and error.errno in NO_ROOM
        way_on = "; make room and give the same command again"
        sys.stderr.write(f"error: {error}{way_on if full else ''}\n")
        return 1 if isinstance(error, Diverged) else 2
    return 0


class TrainingDisplay:
    """Live metrics on a terminal; a line every tenth of the run elsewhere."""

    def __init__(self, console: Console, steps: int, start: int, n_codes: int | None) -> None:
        """Set up.

        Args:
            console: where to show it.
            steps: of the whole run.
            start: steps already taken.
            n_codes: size of the codebook, None for a method without one.
        """
        self.console, self.steps, self.start, self.n_codes = console, steps, start, n_codes
        self._begun = time.monotonic()
        self._progress = Progress(
            TextColumn("meta-training"),
            BarColumn(bar_width=30),
            TaskProgressColumn(),
            TextColumn("{task.fields[rate]:.0f} steps/s"),
            TimeRemainingColumn(),
            console=console,
        )
        self._bar = self._progress.add_task("", total=steps, completed=start, rate=0.0)
        self._live = Live(self._progress, console=console) if console.is_terminal else None
        self._return: float | None = None

    def __enter__(self) -> TrainingDisplay:
        """Start the live table, on a terminal."""
        if self._live:
            self._live.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Stop the live table."""
        if self._live:
            self._live.stop()

    def show(self, metrics: Mapping[str, float | None]) -> None:
        """Show a row of metrics."""
        step = int(metrics["step"] or 0)
        measured = metrics["return/training_tasks"]
        self._return = self._return if measured is None else measured
        elapsed = max(time.monotonic() - self._begun, 1e-6)
        rate = (step - self.start) / elapsed
        if self._live:
            self._progress.update(self._bar, completed=step, rate=rate)
            grid = Table.grid()
            grid.add_row(self._progress)
            grid.add_row(self._table(metrics))
            self._live.update(grid)
        elif measured is not None:
            left = (self.steps - step) / max(rate, 1e-6)
            self.console.print(
                f"step {step}/{self.steps}: {self._losses(metrics)}; {self._usage(metrics)}"
                f"return on training tasks {measured:.2f}; "
                f"{elapsed:.0f} s, about {left:.0f} s left",
                soft_wrap=True,
                highlight=False,
            )

    @staticmethod
    def _losses(metrics: Mapping[str, float | None]) -> str:
        shown = {
            key.removeprefix("loss/").replace("encoder/", ""): value
            for key, value in metrics.items()
            if key.startswith("loss/")
        }
        return ", ".join(f"{key} {value:.3g}" for key, value in shown.items())

    def _usage(self, metrics: Mapping[str, float | None]) -> str:
        if self.n_codes is None:
            return ""
        return f"codes in use {metrics['codes/perplexity']:.1f} of {self.n_codes}; "

    def _table(self, metrics: Mapping[str, float | None]) -> Table:
        """A row for each kind of metric, a few characters for each metric."""
        known = {key: value for key, value in metrics.items() if value is not None}
        if self._return is not None:
            known["return/training_tasks"] = self._return
        kinds: dict[str, list[str]] = {kind: [] for kind in KINDS}
        for key, value in known.items():
            kind, _, name = key.rpartition("/")
            if kind in kinds:
                kinds[kind].append(f"{name.replace('_', ' ')} {value:.3g}")
        shares = [f"{100 * v:.0f}" for k, v in known.items() if k.startswith("codes/share/")]
        if shares:
            kinds["codes"].append(f"shares {' '.join(shares)} %")
        table = Table(box=None, show_header=False, padding=(0, 2, 0, 0))
        for kind, said in kinds.items():
            if said:
                table.add_row(KINDS[kind], Columns(said, padding=(0, 3)))
        return table
