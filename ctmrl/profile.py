"""`python -m ctmrl.profile`: where a gradient step's time goes, and how near it is to the machine.

A step's parts are functions of the learner; each is wrapped for as long as it is measured, so that
training itself holds no clock. A part's time is without that of the parts inside it.
"""

from __future__ import annotations

import dataclasses
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import tyro

if TYPE_CHECKING:
    import torch
    from rich.console import Console
    from rich.table import Table

    from ctmrl.config import RunConfig
    from ctmrl.data import OfflineData
    from ctmrl.meta_train import Learner
    from ctmrl.precision import Precision
    from datagen.dataset import Dataset

REST = "everything else"
WARM_UP = 3
"""Steps before the first that counts."""
TRACED = 3
"""Steps in a trace."""
PEAK_SIZE, PEAK_TIMES = 2048, 6
"""Side and number of the matrix products that measure the machine."""
LEAST_FLOPS = 1_000_000
"""Fewer are not shown: a part of fewer does something else."""
SYNTHETIC_STEPS = 4_000
"""Transitions a task where there is no dataset, or as many as its contexts need."""


@dataclass(frozen=True)
class ProfileConfig:
    """Measure the parts of a gradient step: time, share, and GFLOP/s beside the machine's peak.

    The settings are those python -m ctmrl.train would use. The codebook is in use, as it is for
    most of a run; K-means, which runs once in hundreds of steps, is not measured. Without a dataset
    random numbers of its shape are used, which takes the same time. The peak is that of a large
    matrix product, measured with the same threads in the same precision; only the FLOPs of matrix
    products are counted.
    """

    env: str = "point_robot_wind"
    """Environment: short name, id or hyphenated name."""
    method: str = "ctmrl"
    """Context-learning method, as of python -m ctmrl.train."""
    preset: str = "standard"
    """standard, paper or smoke."""
    steps: int = 50
    """Gradient steps to measure; the table has the mean of the faster half of them."""
    threads: int = 1
    """Threads of the numerical libraries."""
    precision: Literal["auto", "float32", "bfloat16"] | None = None
    """Of the networks' matrix products; default that of python -m ctmrl.train."""
    device: str = "cpu"
    """cpu or cuda, such as cuda:1. On a GPU the table has a step's parts one after the other, and
    below it is how fast the step is as training takes it, as one CUDA graph."""
    data: Path | None = None
    """Dataset folder; default datasets/<environment>."""
    trace: Path | None = None
    """Also write a trace of three steps, for chrome://tracing or ui.perfetto.dev."""


class Part(NamedTuple):
    """What a step spends in one of its parts."""

    seconds: float
    flops: int


class Stopwatch:
    """Time and FLOPs between the edges of nested parts; each edge ends what was before it.

    Attributes:
        seconds: of each part by name, without the parts inside it.
        flops: the same, while `counted` says how many there were so far.
    """

    def __init__(
        self, counted: Callable[[], int] = lambda: 0, settle: Callable[[], None] = lambda: None
    ) -> None:
        """Start it in what is no part.

        Args:
            counted: FLOPs so far.
            settle: waits until all that was begun is done.
        """
        self._counted, self._settle = counted, settle
        self._open = [REST]
        self.restart()

    def restart(self) -> None:
        """Begin anew with all parts at 0."""
        self.seconds: dict[str, float] = defaultdict(float)
        self.flops: dict[str, int] = defaultdict(int)
        self._since = (time.perf_counter(), self._counted())

    def edge(self) -> None:
        """Give what passed since the last edge to the innermost part that is open."""
        self._settle()
        now = (time.perf_counter(), self._counted())
        self.seconds[self._open[-1]] += now[0] - self._since[0]
        self.flops[self._open[-1]] += now[1] - self._since[1]
        self._since = now

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        """What is done inside belongs to `name`, but for parts inside of it."""
        from torch.profiler import record_function

        self.edge()
        self._open.append(name)
        try:
            with record_function(name):
                yield
        finally:
            self.edge()
            self._open.pop()


def parts_of(learner: Learner) -> list[tuple[Any, str, str]]:
    """Which functions are parts: owner, attribute and the part's name."""
    import torch

    method, actor_critic = learner.method, learner.actor_critic
    found: list[tuple[Any, str, str]] = [
        (learner, "_draw", "sampling"),
        (learner.data, "transitions", "sampling"),
        (method, "context_loss", "context losses"),
        (actor_critic, "loss", "actor-critic losses"),
        (actor_critic, "_train_dual", "dual critic's losses"),
        (actor_critic, "follow_value", "target value's step"),
        (torch.Tensor, "backward", "backward"),
    ]
    for owner in (method, actor_critic):
        for name, child in owner.named_children():
            if name != "codebook":
                found.append((child, "forward", name.replace("_", " ") + ", forward"))
    if hasattr(method, "codebook"):
        found += [(method.codebook, name, "codebook") for name in ("match", "update")]
    for optimizer in learner.optimizers.values():
        found += [(optimizer, name, "optimisers") for name in ("step", "zero_grad")]
    return found


@contextmanager
def watched(learner: Learner, stopwatch: Stopwatch) -> Iterator[None]:
    """Let a stopwatch see the parts of a learner's steps."""

    def wrapped(function: Callable[..., Any], name: str) -> Callable[..., Any]:
        def call(*arguments: Any, **options: Any) -> Any:
            with stopwatch.part(name):
                return function(*arguments, **options)

        return call

    with ExitStack() as stack:
        for owner, attribute, name in parts_of(learner):
            function = getattr(owner, attribute)
            if attribute in vars(owner):
                stack.callback(setattr, owner, attribute, function)
            else:
                stack.callback(delattr, owner, attribute)
            setattr(owner, attribute, wrapped(function, name))
        yield


def settling(device: torch.device) -> Callable[[], None]:
    """What waits until a device has done all that was begun; a processor always has."""
    import torch

    if device.type == "cpu":
        return lambda: None
    return lambda: torch.cuda.synchronize(device)


def step_in_parts(learner: Learner) -> None:
    """A step whose parts are called one by one, also where a GPU would replay it as one graph."""
    learner.update(look=None if learner.device.type == "cpu" else lambda made: None)


def count_flops(learner: Learner) -> dict[str, int]:
    """FLOPs of the matrix products of one step, by part."""
    from torch.utils._python_dispatch import TorchDispatchMode
    from torch.utils.flop_counter import flop_registry

    class Counter(TorchDispatchMode):  # type: ignore[no-untyped-call]
        """Adds up what the operators inside of it cost."""

        flops = 0

        def __torch_dispatch__(
            self, operator: Any, types: Any, args: Any = (), kwargs: Any = None
        ) -> Any:
            out = operator(*args, **(kwargs or {}))
            if cost := flop_registry.get(operator.overloadpacket):
                self.flops += cost(*args, **(kwargs or {}), out_val=out)
            return out

    with Counter() as counter:  # type: ignore[no-untyped-call]
        stopwatch = Stopwatch(lambda: counter.flops)
        with watched(learner, stopwatch):
            step_in_parts(learner)
            stopwatch.edge()
    return dict(stopwatch.flops)


def measure(learner: Learner, steps: int) -> dict[str, Part]:
    """The parts of a step, those that take longest first."""
    for _ in range(WARM_UP):
        step_in_parts(learner)
    flops, stopwatch = count_flops(learner), Stopwatch(settle=settling(learner.device))
    taken: list[dict[str, float]] = []
    with watched(learner, stopwatch):
        for _ in range(steps):
            stopwatch.restart()
            step_in_parts(learner)
            stopwatch.edge()
            taken.append(stopwatch.seconds)
    # Other programs only ever make a step slower.
    fast = sorted(taken, key=lambda parts: sum(parts.values()))[: (steps + 1) // 2]
    means = {name: sum(parts[name] for parts in fast) / len(fast) for name in flops}
    return {
        name: Part(means[name], flops[name])
        for name in sorted(means, key=lambda name: -means[name])
    }


def whole_rate(learner: Learner, steps: int) -> float:
    """Steps a second as training takes them, one after the other."""
    settle = settling(learner.device)
    # A GPU records the step once it has taken a few.
    for _ in range(2 * WARM_UP):
        learner.update()
    settle()
    start = time.perf_counter()
    for _ in range(steps):
        learner.update()
    settle()
    return steps / (time.perf_counter() - start)


def peak_flops(precision: Precision = "float32", device: torch.device | None = None) -> float:
    """FLOPs a second of a large matrix product on a device, with as many threads as are set."""
    import torch

    device = device or torch.device("cpu")
    settle = settling(device)
    a = torch.randn(PEAK_SIZE, PEAK_SIZE, generator=torch.Generator().manual_seed(0))
    a = a.to(device, getattr(torch, precision))
    out, best = torch.empty_like(a), float("inf")
    for _ in range(PEAK_TIMES):
        settle()
        start = time.perf_counter()
        torch.mm(a, a, out=out)
        settle()
        best = min(best, time.perf_counter() - start)
    return float(2 * PEAK_SIZE**3 / best)


def table_of(parts: dict[str, Part], peak: float) -> Table:
    """The parts, and all together in the last row."""
    from rich.table import Table

    total = Part(*(sum(values) for values in zip(*parts.values(), strict=True)))
    table = Table("part")
    for heading in ("ms a step", "share", "GFLOP", "GFLOP/s", "of peak"):
        table.add_column(heading, justify="right")
    for name, part in [*parts.items(), ("whole step", total)]:
        cells = [f"{1e3 * part.seconds:.2f}", f"{part.seconds / total.seconds:.1%}"]
        if part.flops >= LEAST_FLOPS:
            rate = part.flops / part.seconds
            cells += [f"{part.flops / 1e9:.3f}", f"{rate / 1e9:.1f}", f"{rate / peak:.0%}"]
        table.add_row(name, *cells, end_section=name == list(parts)[-1])
    return table


def open_or_make(config: RunConfig, console: Console) -> OfflineData:
    """The run's training data, or random numbers in its shape where there is no dataset."""
    from ctmrl.data import OfflineData
    from ctmrl.offline import open_data
    from ctmrl.synthetic import synthetic_dataset
    from meta_envs import resolve

    if config.data is None and not (Path("datasets") / config.env).exists():
        console.print(
            f"There is no datasets/{config.env}, so these are random numbers in its shape; "
            f"python -m datagen.collect --env {config.env} collects it.",
            soft_wrap=True,
        )
        enough = SYNTHETIC_STEPS // resolve(config.env).horizon
        # A gradient step draws two contexts of a task.
        episodes = max(enough, 2 * config.training.context_episodes)
        dataset: Dataset = synthetic_dataset(config.env, episodes)
    else:
        dataset = open_data(config)
    return OfflineData(dataset, dataset.train_tasks)


def profile(options: ProfileConfig, console: Console) -> None:
    """Measure and print.

    Raises:
        UsageError: settings that cannot be used.
    """
    import torch
    from torch.profiler import profile as traced

    from ctmrl.config import check_settings
    from ctmrl.errors import UsageError
    from ctmrl.meta_train import Learner
    from ctmrl.threads import settle_threads
    from ctmrl.train import parse

    check_settings(options)
    if options.trace is not None and not options.trace.absolute().parent.is_dir():
        raise UsageError(f"--trace {options.trace}: there is no folder {options.trace.parent}")
    if options.trace is not None and options.trace.is_dir():
        raise UsageError(f"--trace {options.trace} is a folder: give the name of a file")
    words = ["--env", options.env, "--method", options.method, "--preset", options.preset]
    words += ["--device", options.device]
    if options.precision is not None:
        words += ["--precision", options.precision]
    config = dataclasses.replace(parse(words), data=options.data, threads=options.threads)
    # So long a run that neither K-means nor the end of it falls into the steps measured.
    training = dataclasses.replace(config.training, steps=1_000_000 + options.steps)
    settle_threads(config.threads)
    learner = Learner(dataclasses.replace(config, training=training), open_or_make(config, console))
    if isinstance(codebook := getattr(learner.method, "codebook", None), torch.nn.Module):
        codebook.placed.fill_(True)  # type: ignore[operator]
    parts = measure(learner, options.steps)
    peak = peak_flops(learner.precision, learner.device)
    console.print(table_of(parts, peak))
    threads = f"{options.threads} thread" + "s" * (options.threads > 1)
    where = threads if learner.device.type == "cpu" else options.device
    console.print(
        f"{config.env}, {config.method}, {config.preset}: "
        f"{1 / sum(part.seconds for part in parts.values()):.1f} steps/s; "
        f"peak {peak / 1e9:.0f} GFLOP/s in {learner.precision}, {where}.",
        soft_wrap=True,
        highlight=False,
    )
    if learner.device.type != "cpu":
        rate = whole_rate(learner, options.steps)
        console.print(f"As one CUDA graph: {rate:.1f} steps/s.", highlight=False)
    if options.trace is not None:
        with traced() as trace, watched(learner, Stopwatch()):
            for _ in range(TRACED):
                step_in_parts(learner)
        trace.export_chrome_trace(str(options.trace))
        console.print(f"Trace of {TRACED} steps: {options.trace}", soft_wrap=True)


def main() -> None:
    """Read the command line and profile."""
    from rich.console import Console

    profile(tyro.cli(ProfileConfig, prog="python -m ctmrl.profile"), Console())


if __name__ == "__main__":
    from ctmrl.console import run_command

    sys.exit(run_command(main, stopped="Stopped."))
