"""Returns measured beside training: the bytes of a run that waits for them, whatever ends it."""

from __future__ import annotations

import dataclasses
import io
import signal
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from rich.console import Console

from ctmrl.config import RunConfig
from ctmrl.data import OfflineData
from ctmrl.errors import Diverged
from ctmrl.meta_test import meta_test
from ctmrl.meta_train import Learner
from ctmrl.methods import METHODS
from ctmrl.presets import preset
from ctmrl.returns import (
    RETURN,
    Measurement,
    Row,
    Rows,
    State,
    measure_of,
    measured_beside,
    spare_cores,
)
from ctmrl.runs import load_checkpoint
from ctmrl.seeds import plan
from ctmrl.synthetic import synthetic_dataset
from ctmrl.threads import settle_threads
from ctmrl.train import train
from meta_envs import MetaVectorEnv, task_set
from tests.ctmrl.commands import FILES, Commands, contents, rows, wait_until
from tests.ctmrl.conftest import FinishedRun
from tests.ctmrl.examples import smoke


class Slow:
    """A measurement that ends when it is let go."""

    def __init__(self, value: float = 7.0) -> None:
        self.go, self.begun, self.ended = threading.Event(), threading.Event(), threading.Event()
        self.answer = value

    def __call__(self, each_step: Callable[[], None] | None) -> float:
        self.begun.set()
        try:
            while not self.go.wait(0.001):
                assert each_step is not None
                each_step()
        finally:
            self.ended.set()
        return self.answer


class Disk:
    """What came, in its order: a row's step and return, or a checkpoint's step."""

    def __init__(self) -> None:
        self.content: list[tuple[Any, ...]] = []

    def write(self, row: Row) -> None:
        assert [*row] == ["step", "loss", RETURN]
        self.content.append((row["step"], row[RETURN]))

    def save(self, state: State) -> None:
        self.content.append((int(state["step"]),))

    def rows(self, beside: bool = True) -> Rows:
        return Rows(self.write, self.save, beside, 1)


@pytest.fixture
def disk() -> Disk:
    return Disk()


@pytest.fixture(autouse=True)
def no_thread_is_left() -> Iterator[None]:
    yield
    assert not [thread for thread in threading.enumerate() if thread.name == "returns"]


def row(step: int) -> dict[str, float | None]:
    return {"step": step, "loss": 0.5}


def saved(step: int) -> State:
    return {"step": torch.tensor(step)}


def test_all_that_comes_after_a_row_waits_for_its_return(disk: Disk) -> None:
    slow = Slow()
    with disk.rows() as waiting:
        waiting.add(row(1), None)
        waiting.save(saved(1))
        waiting.add(row(2), slow)
        state = saved(2)
        waiting.save(state)
        waiting.add(row(3), None)
        waiting.add(row(4), None)
        assert slow.begun.wait(60)
        assert disk.content == [(1, None), (1,)]
        # A checkpoint is of the moment at which it was taken.
        state["step"].add_(100)
        slow.go.set()
        wait_until(slow.ended.is_set)
        wait_until(lambda: not [one for one in threading.enumerate() if one.name == "returns"])
        waiting.add(row(5), None)
        found = [(1, None), (1,), (2, 7.0), (2,), (3, None), (4, None), (5, None)]
        assert disk.content == found
        waiting.save(saved(5))
    assert disk.content == [*found, (5,)]


def test_of_checkpoints_that_wait_the_last_is_kept_behind_its_rows(disk: Disk) -> None:
    slow = Slow()
    with disk.rows() as waiting:
        waiting.add(row(1), slow)
        waiting.save(saved(1))
        waiting.add(row(2), None)
        waiting.save(saved(2))
        waiting.add(row(3), None)
        assert disk.content == []
        slow.go.set()
    assert disk.content == [(1, 7.0), (2, None), (2,), (3, None)]


def test_a_second_return_is_measured_after_the_first(disk: Disk) -> None:
    first, second = Slow(1.0), Slow(2.0)
    threading.Timer(0.05, first.go.set).start()
    with disk.rows() as waiting:
        waiting.add(row(1), first)
        waiting.add(row(2), second)
        # The first was waited for.
        assert disk.content == [(1, 1.0)]
        second.go.set()
    assert disk.content == [(1, 1.0), (2, 2.0)]


def test_without_a_free_core_a_return_is_measured_at_once(disk: Disk) -> None:
    begun = threading.get_ident()
    where: list[int] = []

    def measure(each_step: Callable[[], None] | None) -> float:
        assert each_step is None
        where.append(threading.get_ident())
        return 3.0

    with disk.rows(beside=False) as waiting:
        waiting.add(row(1), measure)
        assert disk.content == [(1, 3.0)]
        waiting.save(saved(1))
        assert disk.content == [(1, 3.0), (1,)]
    assert where == [begun]


@pytest.mark.parametrize("error", [KeyboardInterrupt, OSError, Diverged])
def test_what_ends_training_ends_the_measurement(error: type[BaseException], disk: Disk) -> None:
    slow = Slow()

    def end() -> None:
        with disk.rows() as waiting:
            waiting.add(row(1), slow)
            waiting.save(saved(1))
            if error is Diverged:
                slow.go.set()
            raise error("this")

    with pytest.raises(error, match="this"):
        end()
    assert slow.ended.is_set()
    # A run that diverged leaves what was sound, and says which checkpoint is the last.
    assert disk.content == ([(1, 7.0), (1,)] if error is Diverged else [])


def test_what_goes_wrong_in_a_measurement_is_raised_where_its_value_is_needed(disk: Disk) -> None:
    def wrong(each_step: Callable[[], None] | None) -> float:
        raise ZeroDivisionError("nothing to measure")

    def use() -> None:
        with disk.rows() as waiting:
            waiting.add(row(1), wrong)

    with pytest.raises(ZeroDivisionError, match="nothing to measure"):
        use()
    assert disk.content == []


def test_a_measurement_computes_as_a_run_does() -> None:
    def tiny() -> float:
        return float(torch.tensor(2.0**-126) * 0.5)

    flushed = tiny() == 0.0
    torch.set_flush_denormal(False)
    try:
        assert tiny() > 0.0
        # A run has no denormal numbers, and whether there are any is a thread's own matter.
        assert Measurement(lambda _: tiny(), 1).value() == 0.0
        assert tiny() > 0.0
    finally:
        torch.set_flush_denormal(flushed)


def test_which_runs_have_a_free_core(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def spare(cores: int, **changes: Any) -> int:
        monkeypatch.setattr("ctmrl.seeds.cores", lambda: cores)
        config = dataclasses.replace(smoke(), **changes)
        if config.seeds:
            config = plan(dataclasses.replace(config, memory=1.0), tmp_path)[0][0]
        assert measured_beside(dataclasses.replace(config, beside="always"))
        assert not measured_beside(dataclasses.replace(config, beside="never"))
        assert measured_beside(config) == (spare_cores(config) > 0)
        return spare_cores(config)

    assert [spare(cores) for cores in (1, 2, 16)] == [0, 1, 15]
    assert [spare(2, threads=threads) for threads in (2, 3)] == [0, -1]
    assert [spare(cores, seeds=(0, 1)) for cores in (2, 3, 4, 16)] == [0, 0, 1, 7]
    assert spare(4, seeds=(0, 1, 2, 3, 4)) == 0
    assert spare(4, seeds=(0, 1, 2, 3, 4), workers=2) == 1
    assert spare(8, seeds=(0, 1), threads=3) == 1


@pytest.mark.parametrize(
    ("beside", "workers", "wanted"),
    # The 16 cores are shared by the seeds, and beside training it keeps its own.
    [("never", 5, {3}), ("always", 5, {2, 3}), ("never", None, {16}), ("never", 40, {1})],
)
def test_seeds_share_the_cores_that_step_their_environments(
    beside: Any,
    workers: int | None,
    wanted: set[int],
    wind_path: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    found: list[int | None] = []

    def spied(*arguments: Any, **options: Any) -> MetaVectorEnv:
        found.append(options["threads"])
        return MetaVectorEnv(*arguments, **options)

    monkeypatch.setattr("ctmrl.seeds.cores", lambda: 16)
    for module in ("ctmrl.meta_test", "meta_envs.scores"):
        monkeypatch.setattr(f"{module}.MetaVectorEnv", spied)
    run(smoke(2, data=wind_path), out=tmp_path / "run", beside=beside, workers=workers)
    # A return on training tasks, the evaluation, and the references of the wind.
    assert len(found) == 2 + 3
    assert set(found) == wanted


def run(config: RunConfig, **changes: Any) -> None:
    train(dataclasses.replace(config, **changes), Console(file=io.StringIO(), width=200))


def check_value(config: RunConfig, data: OfflineData) -> None:
    """The value is that of the agent at the beginning, whatever training does meanwhile."""
    protocol = dataclasses.replace(config.meta_test, random_episodes=1, policy_episodes=1)
    waits = dataclasses.replace(config, meta_test=protocol, beside="never")
    settle_threads(1)
    learner = Learner(waits, data)
    learner.update()
    before = measure_of(waits, learner)(None)
    measurement = Measurement(
        measure_of(dataclasses.replace(waits, beside="always"), learner), config.threads
    )
    while learner.step < 4 or not measurement.done:
        learner.update()
    assert measurement.value() == before
    assert measure_of(waits, learner)(None) != before


@pytest.mark.parametrize("method", METHODS)
def test_every_method_is_measured_as_it_was(method: str, wind_data: OfflineData) -> None:
    check_value(preset("point_robot_wind", method, "smoke"), wind_data)


@pytest.mark.parametrize("method", METHODS)
def test_what_exploration_cannot_change_is_measured_without_it(
    method: str, wind_data: OfflineData
) -> None:
    config = preset("point_robot_wind", method, "smoke")
    learner, steps = Learner(config, wind_data), []
    learner.update()
    found = measure_of(config, learner)(lambda: steps.append(1))
    # Two random episodes and two of the policy, each with one beside it that is scored.
    episodes = 1 if method in ("oracle_task", "no_context") else 2 * (2 + 2) + 1
    assert len(steps) == 25 * episodes
    agent, tasks = learner.agent, task_set(config.env)
    whole = (agent.method.encoder, agent.actor, tasks, wind_data.tasks, config.meta_test)
    assert found == meta_test(*whole, config.seed).returns.mean()


def test_a_mujoco_robot_is_measured_as_it_was() -> None:
    dataset = synthetic_dataset("hopper_params", 3)
    data = OfflineData(dataset, dataset.train_tasks[:5])
    check_value(preset("hopper_params", "focal", "smoke"), data)


def test_a_run_makes_the_same_bytes_beside(
    wind_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    busy: list[int] = []
    update = Learner.update

    def watched(learner: Learner, *look: Any) -> dict[str, torch.Tensor]:
        if any(one.name == "returns" for one in threading.enumerate()):
            busy.append(learner.step)
        return update(learner, *look)

    monkeypatch.setattr(Learner, "update", watched)
    found = []
    for beside in ("never", "always"):
        config = smoke(21, data=wind_path, out=tmp_path / beside, beside=beside)
        train(config, Console(file=io.StringIO(), width=200))
        found.append(contents(tmp_path / beside))
        assert tuple(found[-1]) == FILES
        # Only beside were steps taken while a return was measured.
        assert bool(busy) == (beside == "always")
    assert found[0] == found[1]


def test_runs_ended_while_a_return_is_measured_end_in_the_same_bytes(
    finished_run: FinishedRun, commands: Commands, tmp_path: Path
) -> None:
    # Long adaptations, so that the moments below are inside them.
    common = (*finished_run.words, "--random-episodes", "60", "--steps", "31")
    whole, path = tmp_path / "whole", tmp_path / "run"
    assert commands.run(*common, "--beside", "never", "--out", str(whole)) == 0, commands.output()
    words = (*common, "--beside", "always", "--out", str(path))
    reached = []
    for lines, pause, sent in (
        (10, 0.1, signal.SIGKILL),
        (10, 0.4, signal.SIGINT),
        (20, 0.0, signal.SIGKILL),
        (20, 0.7, signal.SIGKILL),
    ):
        commands.start(*words)
        wait_until(lambda lines=lines: rows(path / "metrics.csv") >= lines)  # type: ignore[misc]
        time.sleep(pause)
        commands.send(sent)
        begun = time.monotonic()
        assert commands.wait() == (130 if sent is signal.SIGINT else -signal.SIGKILL)
        # Nothing waits for the adaptation.
        assert time.monotonic() - begun < 20
        assert "Traceback" not in commands.output()
        reached.append(int(load_checkpoint(path / "checkpoint.pt")["step"]))
        # Every row on the disk is whole, and the checkpoint covers no row that is not there.
        complete = (path / "metrics.csv").read_bytes()
        assert (whole / "metrics.csv").read_bytes().startswith(complete)
        assert rows(path / "metrics.csv") > reached[-1]
    assert reached == sorted(reached)
    # The first one was ended while the return of step 10 was measured.
    assert reached[0] == 8
    assert commands.run(*words) == 0, commands.output()
    assert contents(path) == contents(whole)
