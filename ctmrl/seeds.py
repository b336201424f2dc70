"""`python -m ctmrl.train --seeds`: runs side by side, each in a process of its own.

A process trains one run and ends, so that nothing of a run can reach another: what it leaves is
what the command leaves that trains its seed alone.
"""

from __future__ import annotations

import dataclasses
import multiprocessing
import os
import signal
import sys
import threading
from collections import Counter
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from itertools import islice
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from ctmrl.config import RunConfig
from ctmrl.console import MISTAKES
from ctmrl.errors import UsageError
from ctmrl.report import print_report
from ctmrl.runs import CONFIG, begun_with
from ctmrl.summary import find_records
from ctmrl.table import SHARE, available_memory
from datagen.accelerator import best_precision

Watch = Callable[[Mapping[str, float | None]], None]
"""Is shown each row of metrics."""
Train = Callable[[RunConfig, Console, Watch], object]


class News(NamedTuple):
    """What is heard of a run.

    Attributes:
        seed: the run's.
        kind: "row" of metrics, "finished" or "failed".
        value: step and return on training tasks of a row, or why the run failed, a sentence.
    """

    seed: int
    kind: str
    value: Any = None


def check_seeds(seed: int | None, seeds: tuple[int, ...] | None, workers: int | None) -> None:
    """Check that the options given (None for those that are not) tell which seeds are meant.

    Raises:
        UsageError: they do not.
    """
    if seeds is None:
        if workers is not None:
            raise UsageError("--workers is for --seeds, which is not given")
        return
    if seed is not None:
        raise UsageError("--seed and --seeds exclude each other: give one of them")
    if not seeds:
        raise UsageError("--seeds needs seeds, such as --seeds 0 1 2")
    for one, times in Counter(seeds).items():
        if times > 1:
            raise UsageError(f"--seeds has {one} {times} times: give each seed once")


def plan(config: RunConfig, folder: Path) -> tuple[list[RunConfig], int]:
    """The run of each of the config's seeds, in a folder below `folder`; how many at a time.

    Each run's `workers` is that number, for the cores that it leaves to the others.

    Raises:
        UsageError: the folder is a run's own, or the seeds in it cannot go on together.
    """
    if (folder / CONFIG).exists():
        raise UsageError(
            f"{folder} is the folder of one run, and --seeds makes a folder for each below it: "
            "choose another --out"
        )
    workers = min(config.workers or max(cores() // config.threads, 1), len(config.seeds))
    memory = config.memory
    if memory is None:
        memory = SHARE * available_memory() / 1e9 / workers
    runs = [
        dataclasses.replace(
            config, seed=seed, out=folder / f"seed-{seed}", memory=memory, workers=workers
        )
        for seed in config.seeds
    ]
    return _in_one_precision(runs), workers


def _in_one_precision(runs: list[RunConfig]) -> list[RunConfig]:
    """The runs with one precision in place of "auto": that of those that have begun, or the best.

    The processor is timed for it here, once and before the seeds keep it busy.

    Raises:
        UsageError: those that have begun have different ones.
    """
    first = runs[0]
    if first.precision != "auto":
        return runs
    folders = [run.out for run in runs if run.out and not first.restart]
    begun = sorted({found for folder in folders if (found := begun_with(folder, "precision"))})
    if len(begun) > 1:
        raise UsageError(
            f"some seeds in {folders[0].parent} have begun in {begun[0]}, some in {begun[1]}, and "
            "no report mixes them: choose another --out, or one --precision and --restart"
        )
    precision = begun[0] if begun else best_precision(first.device)
    return [dataclasses.replace(run, precision=precision) for run in runs]


def cores() -> int:
    """Cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def own_cores(config: RunConfig) -> int:
    """A run's share of the cores, beside the seeds that are trained with it; at least 1."""
    return max(cores() // (config.workers or 1), 1)


def train_seeds(train: Train, config: RunConfig, folder: Path, console: Console) -> int:
    """Train a run of each seed, show how they get on, and print the report of the finished ones.

    Args:
        train: a function of a module: trains a run, and lets its last argument watch.
        config: with the seeds.
        folder: of the runs' folders.
        console: where to show it; why a run failed goes to stderr, once where others say the same.

    Returns:
        The exit code: 1 if a run has failed.
    """
    runs, workers = plan(config, folder)
    failures: dict[int, str] = {}
    with (
        SeedsDisplay(console, runs) as display,
        closing(each_in_a_process(train, runs, workers)) as told,
    ):
        for news in told:
            display.show(news)
            if news.kind == "failed":
                if news.value not in failures.values():
                    sys.stderr.write(f"error: seed {news.seed}: {news.value}\n")
                failures[news.seed] = news.value
    finished = [run.out for run in runs if run.out and run.seed not in failures]
    if finished:
        print_report(find_records(finished), console)
        names = ", ".join(path.name for path in finished)
        console.print(f"Pictures, metrics and checkpoints: {names} in {folder}", soft_wrap=True)
    return 1 if failures else 0


def each_in_a_process(
    train: Train, runs: Sequence[RunConfig], workers: int
) -> Generator[News, None, None]:
    """Train every run, and yield news as they come; however this ends, no process is left."""
    waiting = iter(runs)
    crew: dict[Connection, tuple[int, SpawnProcess]] = {}
    try:
        while True:
            for run in islice(waiting, workers - len(crew)):
                connection, process = _start(train, run)
                crew[connection] = (run.seed, process)
            if not crew:
                return
            # A pipe whose other end is closed is ready too, so that a death is seen at once.
            ready = wait([*crew])
            for connection in [one for one in crew if one in ready]:
                seed, process = crew[connection]
                news = _receive(connection, seed, process)
                if news.kind != "row":
                    process.join()
                    del crew[connection]
                yield news
    finally:
        # A run that is killed goes on like any other.
        for _, process in crew.values():
            process.kill()
        for _, process in crew.values():
            process.join()


def _start(train: Train, run: RunConfig) -> tuple[Connection, SpawnProcess]:
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe(duplex=False)
    process = context.Process(target=_serve, args=(train, run, theirs), daemon=True)
    with _interrupts_ignored():
        process.start()
    theirs.close()
    return ours, process


@contextmanager
def _interrupts_ignored() -> Iterator[None]:
    """A process started meanwhile ignores Ctrl-C from its first moment; it inherits that."""
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _receive(connection: Connection, seed: int, process: SpawnProcess) -> News:
    try:
        return News(seed, *connection.recv())
    except (EOFError, OSError):
        process.join()
        code = process.exitcode or 0
        how = f"was killed by signal {-code}" if code < 0 else f"ended with exit code {code}"
        return News(seed, "failed", f"its process {how}; the same command goes on with it")


def _serve(train: Train, run: RunConfig, connection: Connection) -> None:
    """A process's life: train, and say how it went."""
    threading.Thread(target=_die_with_parent, daemon=True).start()
    said: tuple[str, str | None] = ("finished", None)
    try:
        train(
            run,
            Console(quiet=True, force_terminal=False),
            lambda row: connection.send(("row", (row["step"], row["return/training_tasks"]))),
        )
    except MISTAKES as error:
        said = ("failed", str(error))
    # Nobody may be there to hear it any more.
    with suppress(BrokenPipeError):
        connection.send(said)


def _die_with_parent() -> None:
    """End this process at once when its parent ends, in whatever way it does."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)


class SeedsDisplay:
    """A bar for each run on a terminal; elsewhere a line for each return measured."""

    def __init__(self, console: Console, runs: Sequence[RunConfig]) -> None:
        """Set up.

        Args:
            console: where to show it.
            runs: all of them.
        """
        self._console, self._steps = console, runs[0].training.steps
        self._progress = Progress(
            TextColumn("seed {task.description}"),
            BarColumn(bar_width=12),
            MofNCompleteColumn(),
            TextColumn("{task.fields[said]}"),
            TimeRemainingColumn(),
            console=console,
            # Where it is a file, sentences belong there.
            redirect_stderr=sys.stderr.isatty(),
        )
        self._bars = {
            run.seed: self._progress.add_task(f"{run.seed}", total=self._steps, said="")
            for run in runs
        }

    def __enter__(self) -> SeedsDisplay:
        """Start the bars, on a terminal."""
        if self._console.is_terminal:
            self._progress.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Leave the bars as they are."""
        if self._console.is_terminal:
            self._progress.stop()

    def show(self, news: News) -> None:
        """Show the news of a run."""
        bar = self._bars[news.seed]
        if news.kind == "row":
            step, value = news.value
            said = None if value is None else f"return on training tasks {value:.2f}"
            self._progress.update(bar, completed=step)
            line = f"step {step:.0f}/{self._steps}, {said}"
        else:
            said = line = news.kind
        if said is not None:
            self._progress.update(bar, said=said)
            if not self._console.is_terminal:
                self._console.print(f"seed {news.seed}: {line}", soft_wrap=True, highlight=False)
