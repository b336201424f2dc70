"""Where metrics go beside metrics.csv: TensorBoard, trackio, W&B, each imported when asked for."""

from __future__ import annotations

import difflib
import importlib.util
import os
import secrets
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from ctmrl import runs
from ctmrl.errors import UsageError
from datagen.dataset import write_whole

PROJECT = "ctmrl"
"""What trackio and W&B keep the runs under."""


class MetricLogger(Protocol):
    """Something that shows metrics."""

    def log(self, step: int, row: Mapping[str, float]) -> None:
        """Take the metrics of a step."""

    def close(self) -> None:
        """Finish."""


@dataclass(frozen=True)
class LoggedRun:
    """What a logger is told of a run.

    Attributes:
        folder: the run's.
        name: for people, such as point_robot_wind/ctmrl/seed-0.
        settings: all that is in its config.json.
        step: up to which its metrics have been logged before.
        id: the same when the run goes on, another when it is thrown away and trained anew.
    """

    folder: Path
    name: str
    settings: dict[str, Any]
    step: int
    id: str


class TensorBoard:
    """Event files in the run's folder."""

    def __init__(self, run: LoggedRun) -> None:
        """Open the events; what an earlier process wrote of later steps does not count."""
        from torch.utils.tensorboard import SummaryWriter

        folder = str(run.folder / "tensorboard")
        self._writer: Any = SummaryWriter(folder, purge_step=run.step + 1)

    def log(self, step: int, row: Mapping[str, float]) -> None:
        """Write a scalar for each."""
        for key, value in row.items():
            self._writer.add_scalar(key, value, step)

    def close(self) -> None:
        """Write what is left."""
        self._writer.close()


class Trackio:
    """trackio: on this machine and without an account, unless its own variables say otherwise."""

    def __init__(self, run: LoggedRun) -> None:
        """Begin the run there, or go on with it."""
        import trackio

        self._run: Any = trackio.init(
            project=PROJECT,
            name=f"{run.name}-{run.id}",
            config=run.settings,
            resume="allow",
            embed=False,
            auto_log_cpu=False,
            auto_log_gpu=False,
        )

    def log(self, step: int, row: Mapping[str, float]) -> None:
        """Send a row."""
        self._run.log(dict(row), step=step)

    def close(self) -> None:
        """Send what is left."""
        self._run.finish()


class Wandb:
    """Weights & Biases: into the run's folder, and to the site too for those who are logged in."""

    def __init__(self, run: LoggedRun) -> None:
        """Begin the run there, or go on with it; without a login offline, and nothing is asked."""
        import wandb

        mode = os.environ.get("WANDB_MODE")
        if mode is None:
            mode = "online" if wandb.login(prompt=False, verify=False) else "offline"
        self._run: Any = wandb.init(
            project=PROJECT,
            id=run.id,
            name=run.name,
            config=run.settings,
            dir=str(run.folder),
            mode=mode,
            resume="allow",
            settings=wandb.Settings(silent=True, console="off"),
        )

    def log(self, step: int, row: Mapping[str, float]) -> None:
        """Send a row."""
        self._run.log(dict(row), step=step)

    def close(self) -> None:
        """Send what is left."""
        self._run.finish()


LOGGERS: dict[str, Callable[[LoggedRun], MetricLogger]] = {
    "tensorboard": TensorBoard,
    "trackio": Trackio,
    "wandb": Wandb,
}
"""The loggers by name, which is that of the package they need and of the extra that installs it."""


def check_loggers(names: Sequence[str]) -> None:
    """Check that the loggers are known and installed.

    Raises:
        UsageError: the first one that is not.
    """
    for name in names:
        if name not in LOGGERS:
            near = difflib.get_close_matches(name, LOGGERS, n=1)
            hint = f"; did you mean '{near[0]}'?" if near else ""
            raise UsageError(f"no logger '{name}'{hint} (known: {', '.join(LOGGERS)})")
        if importlib.util.find_spec(name) is None:
            raise UsageError(
                f"--loggers {name} needs a package that is not installed: "
                f"pip install 'ctmrl[{name}]'"
            )


class Loggers:
    """The loggers of a run, which get a row once at most, however often the run is interrupted.

    A run that goes on takes the steps after its last checkpoint again. So a row waits until the
    checkpoint behind it is written; one killed between the two is in metrics.csv alone, as the last
    row of a run that diverges.
    """

    def __init__(self, loggers: Sequence[MetricLogger]) -> None:
        """Take open loggers."""
        self._loggers = loggers
        self._waiting: list[tuple[int, dict[str, float]]] = []

    def log(self, step: int, row: Mapping[str, float | None]) -> None:
        """Keep a row, but for what was not measured, until the next checkpoint."""
        measured = {key: value for key, value in row.items() if value is not None}
        self._waiting.append((step, {k: v for k, v in measured.items() if k != "step"}))

    def pass_on(self) -> None:
        """Give the loggers the rows that wait: a checkpoint of the last one's step is written."""
        for step, row in self._waiting:
            for logger in self._loggers:
                logger.log(step, row)
        self._waiting.clear()


@contextmanager
def open_loggers(names: Sequence[str], folder: Path, name: str, step: int) -> Iterator[Loggers]:
    """Open loggers of a run, and close them at the end.

    Args:
        names: of `LOGGERS`.
        folder: the run's, with its config.json.
        name: of the run, for people.
        step: of the checkpoint it goes on from, 0 at the start.
    """
    with ExitStack() as stack:
        loggers: list[MetricLogger] = []
        if names:
            settings = runs.read_json(folder / runs.CONFIG)
            run = LoggedRun(folder, name, settings, step, _run_id(folder / runs.LOGGERS))
            for one in dict.fromkeys(names):
                loggers.append(stack.enter_context(closing(LOGGERS[one](run))))
        yield Loggers(loggers)


def _run_id(path: Path) -> str:
    """The id in a run's file, drawn and written there the first time."""
    if not path.exists():
        write_whole(path, runs.to_json({"id": secrets.token_hex(4)}))
    with runs.fitting(path):
        found = str(runs.read_json(path)["id"])
    return found
