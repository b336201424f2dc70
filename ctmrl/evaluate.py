"""`python -m ctmrl.evaluate RUN`: meta-test a stored run, on its own tasks or on fresh ones."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from ctmrl.protocols import NP_ONLINE, Protocol

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray
    from torch import Tensor

    from ctmrl.agent import Agent
    from ctmrl.config import RunConfig
    from ctmrl.meta_test import MetaTestResult
    from meta_envs import TaskSet


@dataclass(frozen=True)
class EvaluateConfig:
    """Repeat the meta-test of a stored run, or run it on tasks nobody could have trained on."""

    run: Annotated[Path, tyro.conf.Positional]
    """Run folder, such as runs/point_robot_wind/ctmrl/seed-0."""
    fresh: int = 0
    """Instead of the dataset's tasks, this many fresh ones from the same distribution."""
    protocols: tuple[Protocol, ...] = ("np_online",)
    """Which meta-tests, one or more, all in one pass. np_online, training's own: random episodes,
    then the stochastic policy's. online: as many episodes of the deterministic policy. offline: no
    exploration, contexts are of the tasks' own data, so the dataset must have the test tasks.
    codes: the first episodes act on the codes instead of at random, and what returns most counts,
    for rewards that random actions never see; of methods with a codebook."""
    data: Path | None = None
    """Dataset folder for offline contexts, of the data that the run learned from; default
    datasets/<environment>."""
    seed: int | None = None
    """Of exploration and of the offline contexts, and of the fresh tasks; the run's own seed by
    default."""
    out: Path | None = None
    """Also write the result as JSON, its pictures and the run's settings into this folder; with
    several protocols, into a sub-folder for each, named after it."""
    repetitions: int | None = field(default=None)
    """Independent adaptations of each task; the run's own number by default."""
    unfinished: bool = False
    """Also score the last checkpoint of a run that has not come to its end, such as one that
    diverged."""


def evaluate_agent(  # noqa: PLR0913 - each decides what is measured
    agent: Agent,
    config: RunConfig,
    tasks: TaskSet,
    groups: dict[str, NDArray[np.int64]],
    best_behavior: dict[int, float],
    seed: int,
    protocols: Mapping[Protocol, dict[str, Tensor] | None] = NP_ONLINE,
) -> dict[Protocol, dict[str, Any]]:
    """Meta-test an agent by one or more protocols, all in one vector environment.

    Args:
        agent: encoder and actor.
        config: of its run; how much it explores is in it.
        tasks: the task set.
        groups: rows of it by name, such as `unseen` and `seen`.
        best_behavior: return of each task's best behaviour policy, where known.
        seed: of the exploration, in each protocol anew.
        protocols: by which, np_online by default; for `offline` with contexts of each group, as
            `offline_contexts` gives them.

    Returns:
        What evaluation.json holds, by protocol; returns are undiscounted sums, means where not said
        otherwise.
    """
    from ctmrl.meta_test import Group, MetaTest
    from ctmrl.seeds import own_cores
    from meta_envs import reference_returns

    threads = own_cores(config)
    references = reference_returns(tasks, threads=threads)
    anchors: dict[str, dict[str, float]] = {}
    for name, rows in groups.items():
        anchors[name] = {key: float(values[rows].mean()) for key, values in references.items()}
        if best_behavior and all(int(row) in best_behavior for row in rows):
            best = [best_behavior[int(row)] for row in rows]
            anchors[name]["best_behavior"] = sum(best) / len(best)
    test = MetaTest(agent.method.encoder, agent.actor, tasks, config.meta_test, seed, threads)
    asked = {
        f"{protocol}/{name}": Group(
            rows,
            protocol,
            None if data is None else data[name],
            agent.method.codes if protocol == "codes" else None,
        )
        for protocol, data in protocols.items()
        for name, rows in groups.items()
    }
    results = test.run(asked)
    records: dict[Protocol, dict[str, Any]] = {}
    for protocol in protocols:
        records[protocol] = {
            "env": config.env,
            "method": config.label if protocol == "np_online" else f"{config.label}, {protocol}",
            "seed": config.seed,
            "evaluation_seed": seed,
            "protocol": _described(protocol, config),
            "param_names": list(tasks.param_names),
            "groups": {
                name: {
                    "tasks": rows.tolist(),
                    "params": tasks.params[rows].tolist(),
                    **_scored(agent, results[f"{protocol}/{name}"], anchors[name]),
                }
                for name, rows in groups.items()
            },
        }
        if agent.method.note:
            records[protocol]["note"] = agent.method.note
    return records


def _described(protocol: Protocol, config: RunConfig) -> dict[str, Any]:
    """A protocol's name, and how much of everything it has."""
    import dataclasses

    found = dataclasses.asdict(config.meta_test)
    if protocol == "codes":
        found |= {"random_episodes": 0, "code_episodes": config.meta_test.random_episodes}
    elif protocol != "np_online":
        explored = config.meta_test.random_episodes + config.meta_test.policy_episodes
        policy = explored if protocol == "online" else 0
        found |= {"random_episodes": 0, "policy_episodes": policy}
    return {"name": protocol} | found


def _scored(agent: Agent, result: MetaTestResult, anchors: dict[str, float]) -> dict[str, Any]:
    """A group's result, as it is in a record."""
    import torch

    from ctmrl.report import score

    value = float(result.returns.mean())
    contexts = torch.from_numpy(result.contexts.mean(axis=0))
    codes = agent.method.code_of(contexts)
    return {
        "return": value,
        "score": score(value, anchors),
        "task_returns": result.returns.mean(axis=0).tolist(),
        "repetition_returns": result.returns.mean(axis=1).tolist(),
        "curve": result.curve.tolist(),
        "references": anchors,
        "contexts": contexts.tolist(),
        "codes": None if codes is None else codes.tolist(),
    }


def _folders(config: EvaluateConfig) -> dict[Protocol, Path]:
    """Each protocol's folder, if any; one that holds a run is refused, it would be written over.

    Raises:
        UsageError: it does.
    """
    from ctmrl import runs
    from ctmrl.errors import UsageError

    if config.out is None:
        return {}
    several = len(config.protocols) > 1
    folders = {one: config.out / one if several else config.out for one in config.protocols}
    for folder in (config.out, *folders.values()):
        if (folder / runs.CONFIG).exists():
            whose = "the run itself" if folder.resolve() == config.run.resolve() else "another run"
            raise UsageError(f"--out {folder} is {whose}: choose another folder")
    return folders


def _make_folders(folders: Iterable[Path]) -> None:
    """Make folders, and be sure that files can be written there.

    Raises:
        UsageError: they cannot.
    """
    from ctmrl.errors import UsageError
    from ctmrl.runs import check_writable

    for folder in folders:
        try:
            folder.mkdir(parents=True, exist_ok=True)
            check_writable(folder)
        except OSError as error:
            raise UsageError(
                f"--out {folder} cannot be written to ({error.strerror}): choose another folder"
            ) from None


def _settings(config: EvaluateConfig, run: RunConfig) -> RunConfig:
    """The run's settings, with what the evaluation has of its own.

    Raises:
        UsageError: options that cannot be used.
    """
    import dataclasses

    from ctmrl.errors import UsageError

    if config.fresh < 0:
        raise UsageError(f"--fresh must be at least 0, got {config.fresh}")
    if not config.protocols or len({*config.protocols}) != len(config.protocols):
        said = " ".join(config.protocols) or "none"
        raise UsageError(f"--protocols needs one or more, each once, got {said}")
    offline = "offline" in config.protocols
    if config.fresh and offline:
        raise UsageError("--protocols offline is for tasks with data, and --fresh tasks have none")
    if config.data is not None and not offline:
        raise UsageError("--data is for --protocols offline: no other reads a dataset")
    if config.repetitions is not None:
        meta_test = dataclasses.replace(run.meta_test, repetitions=config.repetitions)
        run = dataclasses.replace(run, meta_test=meta_test)
    return dataclasses.replace(run, data=config.data)


def _groups(stored: dict[str, Any], tasks: TaskSet) -> dict[str, NDArray[np.int64]]:
    """The groups of a run's config.json; an error that `fitting` knows if they cannot be."""
    import numpy as np

    for name, rows in stored["groups"].items():
        if name not in ("unseen", "seen"):
            raise ValueError(f"groups.{name} is neither of unseen nor of seen tasks")
        if not rows or not all(type(row) is int and 0 <= row < len(tasks) for row in rows):
            raise ValueError(f"groups.{name} is not of tasks from 0 to {len(tasks) - 1}")
    if not stored["groups"]:
        raise ValueError("groups has none")
    return {name: np.array(rows) for name, rows in stored["groups"].items()}


def _write(record: dict[str, Any], stored: dict[str, Any], folder: Path) -> None:
    """Write an evaluation, last, so that where it is, all that stands beside it is of it."""
    from ctmrl.report import write_pictures
    from ctmrl.runs import EVALUATION, to_json
    from ctmrl.settings import SETTINGS_FILE
    from datagen.dataset import write_whole

    (folder / EVALUATION).unlink(missing_ok=True)
    of_run = {name: stored[name] for name in ("dataset", "settings")}
    write_whole(folder / SETTINGS_FILE, to_json(of_run))
    write_pictures(record, folder)
    write_whole(folder / EVALUATION, to_json(record))


def main(config: EvaluateConfig) -> None:
    """Evaluate and print."""
    import dataclasses

    import numpy as np
    from rich.console import Console

    from ctmrl import runs
    from ctmrl.agent import load_agent
    from ctmrl.config import check_settings
    from ctmrl.errors import UsageError
    from ctmrl.methods.base import Dimensions
    from ctmrl.offline import offline_contexts
    from ctmrl.presets import config_from_settings
    from ctmrl.report import result_table
    from ctmrl.threads import settle_threads
    from meta_envs import task_set

    folders = _folders(config)
    stored = runs.read_json(config.run / runs.CONFIG)
    run_config = _settings(config, config_from_settings(stored, config.run / runs.CONFIG))
    seed = run_config.seed if config.seed is None else config.seed
    tasks = task_set(run_config.env)
    with runs.fitting(config.run / runs.CONFIG):
        check_settings(dataclasses.replace(run_config, seed=seed))
        dims = Dimensions(*(int(stored["dimensions"][name]) for name in Dimensions._fields))
        groups = _groups(stored, tasks)
        best = {int(task): float(value) for task, value in stored["best_behavior"].items()}
        learned_from = str(stored["dataset"])
    settle_threads(run_config.threads)
    state = runs.load_checkpoint(config.run / runs.CHECKPOINT)
    with runs.fitting(config.run / runs.CHECKPOINT):
        agent = load_agent(run_config, dims, state)
        step = int(state["step"])
    if step < dims.steps and not config.unfinished:
        raise runs.RunError(
            f"{config.run} stopped at step {step} of {dims.steps}: "
            "give its training command again to finish it, or --unfinished to score it as it is"
        )
    if "codes" in config.protocols and agent.method.codes is None:
        raise UsageError(
            f"--protocols codes acts on a codebook, and {config.run} has none in use: "
            "it is for runs of ctmrl and ctmrl_released that are past their warm-up"
        )
    if config.fresh:
        tasks = tasks.sample(seed, config.fresh)
        groups, best = {"fresh": np.arange(config.fresh)}, {}
    protocols = {
        one: offline_contexts(run_config, groups, seed, learned_from) if one == "offline" else None
        for one in config.protocols
    }
    _make_folders(folders.values())
    records = evaluate_agent(agent, run_config, tasks, groups, best, seed, protocols)
    console = Console()
    if step < dims.steps:
        console.print(f"The checkpoint of step {step} of {dims.steps}.")
    for protocol, record in records.items():
        if step < dims.steps:
            record["step"] = step
            record["method"] += f", step {step} of {dims.steps}"
        console.print(result_table(record))
        if folder := folders.get(protocol):
            _write(record, stored, folder)


if __name__ == "__main__":
    from ctmrl.console import run_command

    parse = partial(tyro.cli, EvaluateConfig, prog="python -m ctmrl.evaluate")
    sys.exit(run_command(lambda: main(parse()), stopped="Stopped."))
