"""Command line: collect a dataset, one behaviour policy a task, rolled out at its checkpoints.

python -m datagen.collect --env point_robot_wind --budget paper --workers 2
"""

from __future__ import annotations

import os
import shlex
import sys
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from rich.console import Console

from datagen.budgets import Budget, budget
from datagen.dataset import DatasetError, task_file
from datagen.estimate import seconds_of, state_bytes
from datagen.finished import (
    check_origin,
    remove_stale,
    remove_states,
    scan,
    without_versions,
    write_summary,
)
from datagen.groups import rows_text
from datagen.job import Job, group_file, origin, policy_file
from datagen.plan import Plan, parse_shard, parse_tasks
from datagen.progress import CollectionDisplay, duration
from datagen.stages import collect_tasks, train_groups
from datagen.workers import WorkerError
from meta_envs import resolve, task_set

MOST_WORKERS = 8
"""Default number of workers on a machine with more cores than that; each needs 0.4 GB."""


LONG = 400_000
"""Updates of all missing tasks from which on a collection first measures how long it will take."""


@dataclass(frozen=True)
class CollectConfig:
    """Collect an offline dataset: train a behaviour policy on every task and roll it out.

    Interrupted and run again, the same command does only what is missing, and ends in the same
    bytes. Exit code: 0 done, 1 failed on the way, 2 wrong usage, 130 interrupted.
    """

    env: str
    """Environment: its short name, its id or the field's hyphenated name."""
    budget: Annotated[str, tyro.conf.arg(metavar="paper|standard|quick|smoke")] = "standard"
    """How much to collect: as in the papers, to suit a small machine, no more of a MuJoCo robot
    than that learns in an hour or so, or just enough to test."""
    tasks: Annotated[str | None, tyro.conf.arg(metavar="0-9,12")] = None
    """Tasks to collect; all by default."""
    shard: Annotated[str | None, tyro.conf.arg(metavar="I/N")] = None
    """Collect every N-th group of these tasks from the I-th on, I from 0, to share them with
    machines that see the same folder; --dry-run says how many groups there are. Without a fleet
    each task is a group."""
    seed: int = 0
    """Seed of everything random."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER")] = None
    """The dataset's folder; datasets/ENV by default."""
    workers: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """Processes, one thread each; by default one a core, 8 at most, and with --ray as many as the
    cluster has free cores."""
    ray: Annotated[str | None, tyro.conf.arg(metavar="ADDRESS")] = None
    """Train and roll out on a Ray cluster instead of on this machine: auto for the one that runs
    here, HOST:PORT, or local to start one. Its machines must see the dataset's folder under the
    same path, and have the same versions of the packages. Needs pip install 'ctmrl[ray]'."""
    engine: Annotated[Literal["fleet", "sb3"] | None, tyro.conf.arg(metavar="fleet|sb3")] = None
    """What trains the behaviour policies: a fleet learns many tasks side by side in one process,
    sb3 is Stable-Baselines3's SAC, a process a task. A fleet by default."""
    fleet_size: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """Tasks a fleet learns side by side, at most; by default a setting of the budget, and on a GPU
    all of the environment's."""
    precision: Annotated[
        Literal["auto", "float32", "bfloat16"], tyro.conf.arg(metavar="auto|float32|bfloat16")
    ] = "auto"
    """Of a fleet's matrix products; by default bfloat16 where the hardware multiplies it faster."""
    device: str = "cpu"
    """Where a fleet learns, such as cpu or cuda."""
    policies: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER")] = None
    """Also write the last policy of every task that a fleet collects now to this folder, as a file
    that stable_baselines3.SAC.load opens."""
    episodes: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """Episodes of each checkpoint, instead of the budget's, for a smaller dataset."""
    dry_run: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Say what would be done and how long it would take, and touch nothing."""


class CollectionError(RuntimeError):
    """A collection failed on the way; the message is one sentence."""


class InterruptedCollectionError(RuntimeError):
    """A collection was stopped by Ctrl-C; the message is one sentence."""

    def __init__(self, done: int, total: int) -> None:
        """Say how far it got."""
        super().__init__(f"stopped with {done} of {total} tasks done; the same command continues")


def plan_of(config: CollectConfig) -> Plan:
    """The plan of a command line.

    Raises:
        ValueError: an option is wrong; the message says which and how to do better.
    """
    env = resolve(config.env).name
    tasks = parse_tasks(config.tasks, task_set(env))
    if config.seed < 0:
        raise ValueError(f"--seed must not be negative, got {config.seed}")
    workers = config.workers
    if workers is None:
        workers = len(tasks) if config.ray else min(_cores(), MOST_WORKERS)
    if workers < 1:
        raise ValueError(f"--workers must be at least 1, got {workers}")
    wanted = with_engine(budget(env, config.budget, config.episodes), config)
    groups = parse_shard(config.shard, wanted.groups(tasks))
    folder, policies = config.out or Path("datasets") / env, config.policies
    if config.ray:
        # Processes elsewhere have working folders of their own.
        folder, policies = folder.absolute(), policies and policies.absolute()
    return Plan(
        env, groups, wanted, config.seed, folder, workers, config.device, policies, config.ray
    )


def _cores() -> int:
    """Cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def with_engine(budget: Budget, config: CollectConfig) -> Budget:
    """A budget with the engine a command line asks for.

    Raises:
        ValueError: an option is wrong, or of the other engine.
    """
    fleet = budget.fleet
    if config.engine == "fleet" and fleet is None:
        raise ValueError(f"the budget {budget.name} has no fleet: leave --engine fleet out")
    if config.engine == "sb3" or fleet is None:
        for name, value, default in (
            ("fleet-size", config.fleet_size, None),
            ("precision", config.precision, "auto"),
            ("device", config.device, "cpu"),
            ("policies", config.policies, None),
        ):
            if value != default:
                raise ValueError(f"--{name} is for fleets, not for --engine sb3")
        return replace(budget, fleet=None)
    if config.fleet_size is not None:
        if config.fleet_size < 1:
            raise ValueError(f"--fleet-size must be at least 1, got {config.fleet_size}")
        fleet = replace(fleet, size=config.fleet_size)
    elif config.device.startswith("cuda"):
        fleet = replace(fleet, size=len(task_set(config.env)))
    # Loads torch, which --help and mistakes need not wait for.
    from datagen.accelerator import check_precision

    precision = check_precision(config.precision, config.device)
    # Of a device such as cuda:1, what decides the bytes.
    kind = config.device.partition(":")[0]
    return replace(budget, fleet=replace(fleet, precision=precision, device=kind))


def missing_tasks(plan: Plan) -> tuple[int, ...]:
    """The tasks that have no finished file yet.

    Raises:
        DatasetError: a file in the folder is damaged or was collected in another way. Other
            versions of packages are no difference as long as no task is missing.
    """
    asked = origin(plan.env, plan.budget, plan.seed)
    found = scan(plan.folder, without_versions(asked))
    missing = tuple(task for task in plan.tasks if task not in found)
    if missing:
        for one in found.values():
            check_origin(one, asked)
    return missing


def collect(plan: Plan, console: Console) -> dict[str, Any]:
    """Collect what is missing, then write the index and the card.

    Args:
        plan: what to do; its folder is made if it is not there.
        console: where progress is shown.

    Returns:
        The index.

    Raises:
        ValueError: the folder cannot be made or written to, or there is no Ray.
        DatasetError: a file in the folder is damaged or was collected in another way, or the folder
            cannot be read.
        CollectionError: a worker failed or a file could not be written.
        InterruptedCollectionError: Ctrl-C.
    """
    with _cluster(plan):
        return _collect(plan, console)


def _collect(plan: Plan, console: Console) -> dict[str, Any]:
    _prepare(plan.folder)
    missing = missing_tasks(plan)
    if plan.policies is not None and missing:
        _prepare(plan.policies, "--policies")
    finished = len(plan.tasks) - len(missing)
    if finished:
        console.print(f"{finished} of {len(plan.tasks)} tasks are already finished.")
    lost = _lost_policies(plan, missing)
    if lost:
        _say(
            console,
            f"The policies of finished tasks are not kept: {plan.policies} will have none of "
            f"{rows_text(lost)}, collect to another --out to have them.",
        )
    if plan.ray is None and len(missing) * plan.budget.updates >= LONG:
        _say(console, _estimate(plan, missing))
    jobs = [
        Job(plan.env, task, plan.budget, plan.seed, plan.folder, group, plan.policies)
        for group in plan.groups
        for task in group
    ]
    wanted = [job for job in jobs if job.task in missing]
    with CollectionDisplay(console, len(plan.tasks), len(wanted), plan.budget) as display:
        try:
            if plan.budget.fleet:
                train_groups(jobs, wanted, plan, display)
            collect_tasks(wanted, plan, display)
        except KeyboardInterrupt:
            raise InterruptedCollectionError(_done(plan), len(plan.tasks)) from None
        except WorkerError as error:
            raise CollectionError(
                f"{error}; {_done(plan)} of {len(plan.tasks)} tasks are done, and the same "
                "command continues"
            ) from None
        finally:
            remove_stale(plan.folder)
    try:
        index = write_summary(plan.folder, origin(plan.env, plan.budget, plan.seed))
    except OSError as error:
        raise CollectionError(
            f"all tasks are done, but not the index ({error}); the same command continues"
        ) from error
    states = {group_file(plan.folder, group).name for group in plan.groups}
    try:
        remove_stale(plan.folder, states | {task_file(task) for task in plan.tasks})
        remove_states(plan.folder)
    except (DatasetError, OSError) as error:
        raise CollectionError(
            f"the dataset is complete, but what its making left cannot be removed ({error})"
        ) from error
    return index


def _lost_policies(plan: Plan, missing: Sequence[int]) -> list[int]:
    """Finished tasks whose policies are asked for and were not written when they were trained."""
    folder = plan.policies
    if folder is None:
        return []
    finished = [task for task in plan.tasks if task not in missing]
    return [task for task in finished if not policy_file(folder, task).exists()]


def _cluster(plan: Plan) -> AbstractContextManager[None]:
    """The connection to Ray, where it is asked for."""
    if plan.ray is None:
        return nullcontext()
    from datagen.ray_jobs import connected

    return connected(plan.ray)


def _done(plan: Plan) -> int:
    """Tasks with a file, also of a worker that was stopped before it could say so."""
    return sum((plan.folder / task_file(task)).exists() for task in plan.tasks)


def _prepare(folder: Path, option: str = "--out") -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ValueError(
            f"{option} {folder} cannot be made ({error.strerror}), choose another"
        ) from None
    if not os.access(folder, os.W_OK | os.X_OK):
        raise ValueError(f"{option} {folder} cannot be written to, choose another")
    remove_stale(folder)


def describe(plan: Plan, console: Console) -> None:
    """Print what a plan would do and about how long it would take; touches nothing.

    Raises:
        DatasetError: as `collect` would.
    """
    missing = missing_tasks(plan)
    budget, rows = plan.budget, plan.rows * len(plan.tasks)
    marks = budget.checkpoints
    lines = {
        "dataset": f"{plan.folder}, budget {budget.name}, seed {plan.seed}",
        "tasks": f"{rows_text(plan.tasks)} ({len(plan.tasks)} tasks, {len(missing)} to collect)",
        **({"groups": _groups_text(plan.groups)} if budget.fleet else {}),
        "training": f"{marks[-1]:,} steps a task, the first {budget.random_steps:,} random",
        "checkpoints": f"{len(marks)}, from {marks[0]:,} to {marks[-1]:,} steps",
        "episodes": f"{budget.episodes} each checkpoint, {budget.total_episodes:,} a task",
        "size": f"at most {rows:,} rows, {rows * plan.row_bytes / 1e6:.1f} MB",
    }
    beside = state_bytes(plan, missing)
    if beside:
        lines["meanwhile"] = f"up to {beside / 1e6:,.1f} MB beside it, until all tasks are done"
    for name, text in lines.items():
        _say(console, f"{name + ':':13}{text}")
    if missing:
        _say(console, f"{'time:':13}{_estimate(plan, missing)}")


def _estimate(plan: Plan, missing: Sequence[int]) -> str:
    time = duration(seconds_of(plan, missing))
    return f"about {time} with {_count(plan.workers, 'worker')}"


def _groups_text(groups: Sequence[tuple[int, ...]]) -> str:
    """How many groups of how many tasks; their sizes differ by one at most."""
    sizes = sorted({len(group) for group in groups})
    return f"{len(groups)} of {' or '.join(map(str, sizes))} {'task' if sizes == [1] else 'tasks'}"


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def _say(console: Console, text: str, style: str | None = None) -> None:
    console.print(text, style=style, soft_wrap=True, markup=False, highlight=False)


def _conclude(plan: Plan, index: dict[str, Any], console: Console) -> None:
    size = sum(record["bytes"] for record in index["tasks"])
    rows = sum(record["transitions"] for record in index["tasks"])
    folder = shlex.quote(str(plan.folder))
    _say(
        console,
        f"{plan.folder}: {_count(len(index['tasks']), 'task')}, {rows:,} transitions, "
        f"{size / 1e6:.1f} MB",
    )
    _say(console, f"look at it: python -m datagen.inspect {folder}")
    if sum(record["split"] == "train" for record in index["tasks"]) > 1:
        _say(console, f"learn from it: python -m ctmrl.train --env {plan.env} --data {folder}")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command.

    Returns:
        Exit code: 0 done, 1 failed on the way, 2 wrong usage, 130 interrupted.
    """
    config = tyro.cli(CollectConfig, prog="python -m datagen.collect", args=arguments)
    out, err = Console(), Console(stderr=True)
    try:
        plan = plan_of(config)
        if config.dry_run:
            describe(plan, out)
        else:
            _conclude(plan, collect(plan, out), out)
    except CollectionError as error:
        _say(err, str(error), "red")
        return 1
    except ValueError as error:
        _say(err, str(error), "red")
        return 2
    except InterruptedCollectionError as error:
        _say(err, str(error))
        return 130
    except KeyboardInterrupt:
        _say(err, "stopped; the same command continues")
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
