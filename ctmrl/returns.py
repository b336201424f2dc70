"""Returns on training tasks, measured beside training where a core is free for it."""

from __future__ import annotations

import copy
import dataclasses
import threading
from collections.abc import Callable, Mapping
from types import TracebackType
from typing import Self

from torch import Tensor

from ctmrl.config import RunConfig
from ctmrl.errors import Diverged
from ctmrl.meta_test import Group, MetaTest
from ctmrl.meta_train import Learner
from ctmrl.seeds import own_cores
from ctmrl.threads import settle_threads
from meta_envs import task_set

Row = dict[str, float | None]
State = dict[str, Tensor]
Measure = Callable[[Callable[[], None] | None], float]
"""Measures a return; calls what it is given before each step, whose exceptions end it."""
RETURN = "return/training_tasks"


def spare_cores(config: RunConfig) -> int:
    """Cores left by a run's threads and by the seeds beside it; below 1 if there are none."""
    return own_cores(config) - config.threads


def measured_beside(config: RunConfig) -> bool:
    """Whether the returns are to be measured while training goes on."""
    if config.beside == "auto":
        return spare_cores(config) > 0
    return config.beside == "always"


def measure_of(config: RunConfig, learner: Learner) -> Measure:
    """What measures the mean return on the training tasks, one repetition, of the agent as it is.

    Beside training that is a copy of the agent, on the cores that are spare. An agent that
    exploration cannot change is measured without it.
    """
    meta_test = dataclasses.replace(config.meta_test, repetitions=1)
    if not learner.method.explores:
        meta_test = dataclasses.replace(meta_test, random_episodes=0, policy_episodes=0)
    beside = measured_beside(config)
    agent = copy.deepcopy(learner.agent) if beside else learner.agent
    test = MetaTest(
        agent.method.encoder,
        agent.actor,
        task_set(config.env),
        meta_test,
        config.seed,
        max(spare_cores(config), 1) if beside else own_cores(config),
    )
    tasks = learner.data.tasks

    def measure(each_step: Callable[[], None] | None) -> float:
        return float(test.run({"": Group(tasks)}, each_step)[""].returns.mean())

    return measure


class _Stopped(Exception):
    """The measurement is not wanted any more."""


class Measurement:
    """A return that is measured in a thread of its own, to the bits it has in the caller's.

    A thread and not a process: nothing to start, nothing that could outlive the run, and the
    simulation lets other threads work.
    """

    def __init__(self, measure: Measure, threads: int) -> None:
        """Begin.

        Args:
            measure: what to do.
            threads: of the numerical libraries, as for the caller.
        """
        self._measure, self._threads = measure, threads
        self._stopped = threading.Event()
        self._value: float | None = None
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name="returns")
        self._thread.start()

    def _run(self) -> None:
        # Denormal numbers and the like are a thread's own matter.
        settle_threads(self._threads)
        try:
            self._value = self._measure(self._check)
        except BaseException as error:
            self._error = error

    def _check(self) -> None:
        if self._stopped.is_set():
            raise _Stopped

    @property
    def done(self) -> bool:
        """Whether the value need not be waited for."""
        return not self._thread.is_alive()

    def value(self) -> float:
        """The return; waits for it, and raises what went wrong."""
        self._thread.join()
        if self._value is None:
            raise self._error or _Stopped
        return self._value

    def stop(self) -> None:
        """End it within a step, if it is not over."""
        self._stopped.set()
        self._thread.join()


class Rows:
    """Rows of metrics and checkpoints on their way to the disk, in the order they come in.

    A row whose return is still being measured holds up all that comes behind it, so that what is
    on the disk is at each moment what a run that waits for its returns leaves there too. Of
    checkpoints that wait only the last is kept. A run that ends otherwise than by `Diverged`
    leaves out what waits: as after any interruption, it is made again.
    """

    def __init__(
        self,
        write: Callable[[Row], None],
        save: Callable[[State], None],
        beside: bool,
        threads: int,
    ) -> None:
        """Set up.

        Args:
            write: takes a row that is complete.
            save: takes a checkpoint's state, after all rows that it covers.
            beside: measure returns while training goes on.
            threads: of the numerical libraries.
        """
        self._write, self._save = write, save
        self._beside, self._threads = beside, threads
        self._measurement: Measurement | None = None
        self._waiting: list[Row] = []
        self._state: State | None = None
        self._covered = 0

    def __enter__(self) -> Self:
        """Itself."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Write what waits if training came to its end or diverged; no thread is left."""
        try:
            if kind is None or issubclass(kind, Diverged):
                self._finish()
        finally:
            if self._measurement is not None:
                self._measurement.stop()

    def add(self, metrics: Mapping[str, float | None], measure: Measure | None) -> None:
        """Take a row of metrics, and what measures its return if it has one."""
        if measure is not None:
            # One at a time, so that training cannot run away from its measurements.
            self._finish()
        elif self._measurement is not None and self._measurement.done:
            self._finish()
        row: Row = {**metrics, RETURN: None}
        if measure is None and self._measurement is None:
            self._write(row)
        elif measure is None:
            self._waiting.append(row)
        elif self._beside:
            self._waiting.append(row)
            self._measurement = Measurement(measure, self._threads)
        else:
            self._write(row | {RETURN: measure(None)})

    def save(self, state: Mapping[str, Tensor]) -> None:
        """Take a checkpoint's state, which may change afterwards."""
        if self._measurement is not None and self._measurement.done:
            self._finish()
        if self._measurement is None:
            self._save(dict(state))
        else:
            self._state = {key: value.clone() for key, value in state.items()}
            self._covered = len(self._waiting)

    def _finish(self) -> None:
        """Write what waits, once the return is known."""
        if self._measurement is None:
            return
        self._waiting[0][RETURN] = self._measurement.value()
        self._measurement = None
        for number, row in enumerate(self._waiting, start=1):
            self._write(row)
            if self._state is not None and number == self._covered:
                self._save(self._state)
        self._waiting, self._state = [], None
