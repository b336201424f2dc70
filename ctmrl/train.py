"""`python -m ctmrl.train`: meta-train a method on an offline dataset and meta-test it."""

from __future__ import annotations

import dataclasses
import sys
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray
    from rich.console import Console
    from torch import Tensor

    from ctmrl.config import RunConfig
    from ctmrl.meta_train import Learner
    from ctmrl.runs import RunFolder
    from ctmrl.seeds import Watch
    from datagen.dataset import Dataset

LOGS, CHECKPOINTS, RETURNS = 100, 50, 10
"""Rows of metrics, checkpoints, and measured returns on training tasks in a run."""
NOT_SETTINGS = {"data", "out", "restart", "loggers", "memory", "seeds", "workers", "beside"}
"""Fields of RunConfig that do not change a run's results."""
PACKAGES = ("ctmrl", "numpy", "torch", "gymnasium", "scikit-learn")
"""What a run's bytes depend on; those of MuJoCo's robots also on mujoco."""


@dataclass(frozen=True)
class Split:
    """Tasks of a run: trained on, and scored as unseen."""

    train: NDArray[np.int64]
    unseen: NDArray[np.int64]


def split_tasks(dataset: Dataset, validate: bool) -> Split:
    """The dataset's split, or with `validate` one inside its training tasks.

    Raises:
        UsageError: too few training tasks to hold one out.
    """
    import numpy as np

    from ctmrl.errors import UsageError
    from meta_envs import task_set

    if not validate:
        return Split(dataset.train_tasks, task_set(dataset.env).test_tasks)
    held_out = dataset.train_tasks[2::5]
    if not len(held_out):
        raise UsageError(
            f"--validate needs at least 3 training tasks, {dataset.path} has "
            f"{len(dataset.train_tasks)}: collect more"
        )
    return Split(np.setdiff1d(dataset.train_tasks, held_out), held_out)


def best_behavior(dataset: Dataset) -> dict[int, float]:
    """Deterministic return of each task's best behaviour policy."""
    return {
        int(task): max(dataset.entry(int(task))["returns"]["deterministic"].values())
        for task in dataset.tasks
    }


def known_settings(config: RunConfig, dataset: Dataset, split: Split) -> dict[str, Any]:
    """All that decides the run's results and is known before the data are read."""
    from ctmrl.settings import without_later_settings
    from meta_envs.mujoco_robot import MujocoRobot
    from meta_envs.registry import definition

    packages = (
        (*PACKAGES, "mujoco") if isinstance(definition(dataset.env), MujocoRobot) else PACKAGES
    )
    # Of a device such as cuda:1, what decides the bytes.
    every = {**dataclasses.asdict(config), "device": config.device.partition(":")[0]}.items()
    return {
        "settings": without_later_settings({k: v for k, v in every if k not in NOT_SETTINGS}),
        "dataset": dataset.hash,
        "groups": {"unseen": split.unseen.tolist(), "seen": split.train.tolist()},
        "best_behavior": {str(task): value for task, value in best_behavior(dataset).items()},
        "versions": {name: metadata.version(name) for name in packages},
    }


def check(config: RunConfig) -> Dataset:
    """Check all that can be told before the data are read, and open them.

    Raises:
        UsageError: settings or a dataset that cannot be used.
    """
    from ctmrl.config import check_settings
    from ctmrl.loggers import check_loggers
    from ctmrl.meta_train import usable_precision
    from ctmrl.offline import open_data

    check_settings(config)
    check_loggers(config.loggers)
    usable_precision(config)
    return open_data(config)


def train(config: RunConfig, console: Console, watch: Watch | None = None) -> dict[str, Any]:
    """Train, or go on training, then evaluate; everything goes into the run folder.

    Args:
        config: the run.
        console: where to show it.
        watch: also shown how it goes on.

    Returns:
        The evaluation's record.

    Raises:
        UsageError: settings or a dataset that cannot be used.
        Diverged: a quantity that is not finite, or a Q beyond what rewards explain.
        OutOfMemory: it takes more memory than there is; it leaves no run without a checkpoint.
    """
    from ctmrl import runs
    from ctmrl.data import OfflineData
    from ctmrl.errors import Diverged, OutOfMemory, within_memory
    from ctmrl.meta_train import Learner
    from ctmrl.table import Room
    from ctmrl.threads import settle_threads

    dataset = check(config)
    settle_threads(config.threads)
    split = split_tasks(dataset, config.validate)
    path = config.out or default_folder(config)
    config = with_precision(config, path)
    known = known_settings(config, dataset, split)
    if runs.check_folder(path, known, config.restart):
        return _finished(path, console)
    data = OfflineData(
        dataset,
        split.train,
        config.actor_critic.timeouts_as_terminals,
        config.context.dense_reward_in_context,
        Room(config.memory, path),
    )
    with within_memory():
        learner = Learner(config, data)
    settings = {**known, "dimensions": learner.method.dims._asdict()}
    folder = runs.RunFolder(path, settings, config.restart)
    try:
        if folder.finished:
            return _finished(path, console)
        if data.in_file:
            console.print("The training data are read from a file; more --memory avoids it.")
        try:
            with within_memory():
                _meta_train(config, learner, folder, console, watch)
        except Diverged as error:
            raise Diverged(f"training diverged: {error}; {_way_on(folder)}") from None
        except OutOfMemory:
            folder.abandon()
            raise
        with within_memory():
            return _evaluate(config, learner, folder, split, best_behavior(dataset))
    finally:
        folder.close()


def _finished(path: Path, console: Console) -> dict[str, Any]:
    """The evaluation of a run that is finished."""
    from ctmrl import runs

    done = f"{path} is finished; --restart trains it anew, --seed n another."
    console.print(done, soft_wrap=True)
    return runs.read_json(path / runs.EVALUATION)


def with_precision(config: RunConfig, path: Path) -> RunConfig:
    """A config with a precision in place of "auto": that of the run in its folder, or the best."""
    from ctmrl import runs
    from datagen.accelerator import best_precision

    if config.precision != "auto":
        return config
    begun = None if config.restart else runs.begun_with(path, "precision")
    return dataclasses.replace(config, precision=begun or best_precision(config.device))


def _way_on(folder: RunFolder) -> str:
    """Where a run that diverged stands, and what to do."""
    from ctmrl import runs

    state = folder.checkpoint()
    if state is None:
        kept, again = f"{folder.path} has no checkpoint yet", "starts again"
    else:
        kept = f"{folder.path / runs.CHECKPOINT} is of step {int(state['step'])}, before it"
        again = "goes on from there"
    return (
        f"{kept}; the same command {again} and stops alike: "
        "lower --learning-rate or --encoder-lr, with --restart or another --out"
    )


def default_folder(config: RunConfig) -> Path:
    """runs/<env>/<method>/seed-<n>, beside it for runs that must not be mistaken for those."""
    return Path("runs") / config.env / config.label / f"seed-{config.seed}"


def _meta_train(
    config: RunConfig,
    learner: Learner,
    folder: RunFolder,
    console: Console,
    watch: Watch | None,
) -> None:
    from ctmrl import runs
    from ctmrl.console import TrainingDisplay
    from ctmrl.loggers import open_loggers
    from ctmrl.meta_train import meta_train
    from ctmrl.returns import Rows, measure_of, measured_beside

    state = folder.checkpoint()
    if state is not None:
        with runs.fitting(folder.path / runs.CHECKPOINT):
            learner.load(state)
        console.print(f"Going on at step {learner.step} of {config.training.steps}.")
    folder.rewind_metrics(learner.step)
    steps = config.training.steps
    log_every = max(steps // LOGS, 1)
    save_every = log_every * max(LOGS // CHECKPOINTS, 1)
    measure_every = log_every * max(LOGS // RETURNS, 1)
    n_codes = getattr(config.context, "codes", None)
    name = default_folder(config).relative_to("runs").as_posix()
    with (
        open_loggers(config.loggers, folder.path, name, learner.step) as loggers,
        TrainingDisplay(console, steps, learner.step, n_codes) as display,
    ):

        def write(row: dict[str, float | None]) -> None:
            folder.append_metrics(row)
            loggers.log(int(row["step"] or 0), row)
            display.show(row)
            if watch:
                watch(row)

        def save(state: dict[str, Tensor]) -> None:
            folder.save_checkpoint(state)
            loggers.pass_on()

        with Rows(write, save, measured_beside(config), config.threads) as rows:

            def pass_state() -> None:
                rows.save(learner.state())

            for metrics in meta_train(learner, log_every, pass_state, save_every):
                measure = learner.step % measure_every == 0 or learner.step == steps
                rows.add(metrics, measure_of(config, learner) if measure else None)


def _evaluate(
    config: RunConfig,
    learner: Learner,
    folder: RunFolder,
    split: Split,
    best: dict[int, float],
) -> dict[str, Any]:
    from ctmrl import runs
    from ctmrl.evaluate import evaluate_agent
    from ctmrl.report import write_pictures
    from meta_envs import task_set

    groups = {"unseen": split.unseen, "seen": split.train}
    tasks = task_set(config.env)
    found = evaluate_agent(learner.agent, config, tasks, groups, best, config.seed)
    record = found["np_online"]
    write_pictures(record, folder.path)
    folder.write_json(runs.EVALUATION, record)
    return record


@dataclass(frozen=True)
class Choice:
    """The options that decide the defaults of all others."""

    env: str = "point_robot_wind"
    method: str = "ctmrl"
    preset: str = "standard"
    seed: int | None = None
    seeds: tuple[int, ...] | None = None
    workers: int | None = None


def parse(arguments: list[str]) -> RunConfig:
    """Read the command line: which environment, method and preset decides all other defaults.

    Raises:
        UsageError: an unknown environment or method, or no telling which seeds are meant.
    """
    import difflib

    from ctmrl.config import RunConfig
    from ctmrl.errors import UsageError
    from ctmrl.methods import METHODS
    from ctmrl.presets import known_preset, preset
    from ctmrl.seeds import check_seeds
    from meta_envs import resolve

    plain = [word for word in arguments if word not in ("-h", "--help")]
    choice, _ = tyro.cli(Choice, args=plain, return_unknown_args=True, prog="python -m ctmrl.train")
    check_seeds(choice.seed, choice.seeds, choice.workers)
    try:
        env = resolve(choice.env).name
    except ValueError as error:
        raise UsageError(str(error)) from None
    if choice.method not in METHODS:
        near = difflib.get_close_matches(choice.method, METHODS, n=1)
        hint = f"; did you mean '{near[0]}'?" if near else ""
        raise UsageError(f"no method '{choice.method}'{hint} (known: {', '.join(METHODS)})")
    default = preset(env, choice.method, known_preset(choice.preset))
    # tyro narrows `context` to the class of its default, so the method's own options appear.
    parsed = tyro.cli(
        tyro.conf.OmitArgPrefixes[RunConfig],
        default=default,
        args=arguments,
        prog="python -m ctmrl.train",
    )
    return dataclasses.replace(parsed, env=env)


def main() -> None:
    """Train and print the result."""
    from rich.console import Console

    from ctmrl import runs
    from ctmrl.report import result_table
    from ctmrl.seeds import train_seeds

    config = parse(sys.argv[1:])
    console = Console()
    if config.seeds:
        check(config)
        folder = config.out or default_folder(config).parent
        sys.exit(train_seeds(train, config, folder, console))
    record = train(config, console)
    path = config.out or default_folder(config)
    with runs.fitting(path / runs.EVALUATION):
        table = result_table(record)
    console.print(table)
    console.print(f"Pictures, metrics and checkpoint: {path}", soft_wrap=True)


if __name__ == "__main__":
    from ctmrl.console import run_command

    sys.exit(run_command(main))
