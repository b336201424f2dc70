"""`python -m ctmrl.evaluate RUN`: meta-test a stored run, on its own tasks or on fresh ones."""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray
    from torch import Tensor

    from ctmrl.agent import Agent
    from ctmrl.config import RunConfig
    from meta_envs import TaskSet


@dataclass(frozen=True)
class EvaluateConfig:
    """Repeat the meta-test of a stored run, or run it on tasks nobody could have trained on."""

    run: Annotated[Path, tyro.conf.Positional]
    """Run folder, such as runs/point_robot_wind/ctmrl/seed-0."""
    fresh: int = 0
    """Instead of the dataset's tasks, this many fresh ones from the same distribution."""
    offline: bool = False
    """Contexts of the tasks' own offline data in place of exploration: what the field calls the
    offline protocol. The dataset must have the test tasks."""
    data: Path | None = None
    """Dataset folder for --offline, of the data that the run learned from; default
    datasets/<environment>."""
    seed: int | None = None
    """Of exploration or of the offline contexts, and of the fresh tasks; the run's own seed by
    default."""
    out: Path | None = None
    """Also write the result as JSON and its pictures into this folder."""
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
    given: dict[str, Tensor] | None = None,
) -> dict[str, Any]:
    """Meta-test an agent.

    Args:
        agent: encoder and actor.
        config: of its run; the protocol is in it.
        tasks: the task set.
        groups: rows of it by name, such as `unseen` and `seen`.
        best_behavior: return of each task's best behaviour policy, where known.
        seed: of the exploration.
        given: contexts of each group in place of exploration, as `offline_contexts` gives them.

    Returns:
        What evaluation.json holds; returns are undiscounted sums, means where not said otherwise.
    """
    import torch

    from ctmrl.meta_test import MetaTest
    from ctmrl.report import score
    from ctmrl.seeds import own_cores
    from meta_envs import reference_returns

    threads = own_cores(config)
    references = reference_returns(tasks, threads=threads)
    record: dict[str, Any] = {
        "env": config.env,
        "method": config.label if given is None else f"{config.label}, offline contexts",
        "seed": config.seed,
        "evaluation_seed": seed,
        "protocol": {
            "random_episodes": 0 if given is not None else config.meta_test.random_episodes,
            "policy_episodes": 0 if given is not None else config.meta_test.policy_episodes,
            "scored_episodes": config.meta_test.scored_episodes,
            "repetitions": config.meta_test.repetitions,
        },
        "param_names": list(tasks.param_names),
        "groups": {},
    }
    if agent.method.note:
        record["note"] = agent.method.note
    test = MetaTest(agent.method.encoder, agent.actor, tasks, config.meta_test, seed, threads)
    results = test.run(groups, given=given)
    for name, rows in groups.items():
        result = results[name]
        anchors = {key: float(values[rows].mean()) for key, values in references.items()}
        if best_behavior and all(int(row) in best_behavior for row in rows):
            best = [best_behavior[int(row)] for row in rows]
            anchors["best_behavior"] = sum(best) / len(best)
        value = float(result.returns.mean())
        contexts = torch.from_numpy(result.contexts.mean(axis=0))
        codes = agent.method.code_of(contexts)
        record["groups"][name] = {
            "tasks": rows.tolist(),
            "params": tasks.params[rows].tolist(),
            "return": value,
            "score": score(value, anchors),
            "task_returns": result.returns.mean(axis=0).tolist(),
            "repetition_returns": result.returns.mean(axis=1).tolist(),
            "curve": result.curve.tolist(),
            "references": anchors,
            "contexts": contexts.tolist(),
            "codes": None if codes is None else codes.tolist(),
        }
    return record


def _check_out(config: EvaluateConfig) -> None:
    """Refuse an output folder that holds a run, whose evaluation would be written over."""
    from ctmrl import runs
    from ctmrl.errors import UsageError

    if config.out is not None and (config.out / runs.CONFIG).exists():
        whose = "the run itself" if config.out.resolve() == config.run.resolve() else "another run"
        raise UsageError(f"--out {config.out} is {whose}: choose another folder")


def _make_out(out: Path) -> None:
    """Make the output folder, and be sure that files can be written there.

    Raises:
        UsageError: they cannot.
    """
    import tempfile

    from ctmrl.errors import UsageError

    try:
        out.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=out).close()
    except OSError as error:
        raise UsageError(
            f"--out {out} cannot be written to ({error.strerror}): choose another folder"
        ) from None


def _settings(config: EvaluateConfig, run: RunConfig) -> RunConfig:
    """The run's settings, with what the evaluation has of its own.

    Raises:
        UsageError: options that cannot be used.
    """
    import dataclasses

    from ctmrl.errors import UsageError

    _check_out(config)
    if config.fresh < 0:
        raise UsageError(f"--fresh must be at least 0, got {config.fresh}")
    if config.fresh and config.offline:
        raise UsageError("--offline is for tasks with data, and --fresh tasks have none")
    if config.data is not None and not config.offline:
        raise UsageError("--data is for --offline: no other evaluation reads a dataset")
    if config.repetitions is not None:
        protocol = dataclasses.replace(run.meta_test, repetitions=config.repetitions)
        run = dataclasses.replace(run, meta_test=protocol)
    return dataclasses.replace(run, data=config.data)


def _groups(stored: dict[str, Any], tasks: TaskSet) -> dict[str, NDArray[np.int64]]:
    """The groups of a run's config.json; an error that `fitting` knows if they cannot be."""
    import numpy as np

    for name, rows in stored["groups"].items():
        if name not in ("unseen", "seen"):
            raise ValueError(f"groups.{name} is neither of unseen nor of seen tasks")
        if not rows or not all(isinstance(row, int) and 0 <= row < len(tasks) for row in rows):
            raise ValueError(f"groups.{name} is not of tasks from 0 to {len(tasks) - 1}")
    return {name: np.array(rows) for name, rows in stored["groups"].items()}


def main(config: EvaluateConfig) -> None:
    """Evaluate and print."""
    import dataclasses

    import numpy as np
    from rich.console import Console

    from ctmrl import runs
    from ctmrl.agent import load_agent
    from ctmrl.config import check_settings
    from ctmrl.methods.base import Dimensions
    from ctmrl.offline import offline_contexts
    from ctmrl.presets import config_from_settings
    from ctmrl.report import result_table, write_pictures
    from ctmrl.threads import settle_threads
    from datagen.dataset import write_whole
    from meta_envs import task_set

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
    if config.fresh:
        tasks = tasks.sample(seed, config.fresh)
        groups, best = {"fresh": np.arange(config.fresh)}, {}
    given = offline_contexts(run_config, groups, seed, learned_from) if config.offline else None
    if config.out is not None:
        _make_out(config.out)
    record = evaluate_agent(agent, run_config, tasks, groups, best, seed, given)
    console = Console()
    if step < dims.steps:
        record["step"] = step
        console.print(f"The checkpoint of step {step} of {dims.steps}.")
    console.print(result_table(record))
    if config.out is not None:
        write_whole(config.out / runs.EVALUATION, runs.to_json(record))
        write_pictures(record, config.out)


if __name__ == "__main__":
    from ctmrl.console import run_command

    sys.exit(run_command(lambda: main(tyro.cli(EvaluateConfig)), stopped="Stopped."))
