"""Datasets, finished runs and a runner of commands, each made once."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
import torch

from ctmrl.data import OfflineData
from ctmrl.threads import settle_threads
from datagen.dataset import open_dataset
from tests.ctmrl.commands import Commands
from tests.ctmrl.examples import write_good_dataset
from tests.datagen.examples import write_dataset
from tests.meta_envs.conftest import noisy_robot

__all__ = ["noisy_robot"]

WIND_TASKS = (0, 1, 2, 3, 4, 5, 6, 7, 8)
"""Tasks of the dataset in the wind: 2 and 7 are for meta-testing, the other seven for training."""


@pytest.fixture(scope="package", autouse=True)
def settled() -> Iterator[None]:
    """The numerical settings of a run, for all tests here."""
    threads = torch.get_num_threads()
    settle_threads(1)
    yield
    torch.set_num_threads(threads)
    torch.use_deterministic_algorithms(False)
    torch.set_flush_denormal(False)


@pytest.fixture(autouse=True)
def seeded_weights() -> Iterator[None]:
    """Networks' initial weights come from torch's global generator: the same in every test."""
    with torch.random.fork_rng():
        torch.manual_seed(0)
        yield


@pytest.fixture(scope="session")
def wind_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Random behaviour on PointRobotWind, six episodes a task."""
    folder = tmp_path_factory.mktemp("datasets") / "wind"
    return write_dataset(folder, WIND_TASKS, episodes=6)


@pytest.fixture(scope="session")
def sparse_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Random behaviour on SparsePointRobot, four episodes a task."""
    folder = tmp_path_factory.mktemp("datasets") / "sparse"
    return write_dataset(folder, (0, 1, 3, 4, 5, 6), "sparse_point_robot")


@pytest.fixture(scope="session")
def good_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Good behaviour on thirteen training tasks of PointRobotWind, sixteen episodes a task."""
    folder = tmp_path_factory.mktemp("datasets") / "good"
    return write_good_dataset(folder, [task for task in range(16) if task % 5 != 2], 16)


@pytest.fixture(scope="session")
def wind_data(wind_path: Path) -> OfflineData:
    """The training tasks of `wind_path`."""
    dataset = open_dataset(wind_path)
    return OfflineData(dataset, dataset.train_tasks)


@pytest.fixture(scope="session")
def commands(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Commands]:
    """A runner of commands."""
    with Commands(tmp_path_factory.mktemp("commands")) as runner:
        yield runner


@dataclass(frozen=True)
class FinishedRun:
    """A run that an uninterrupted command made.

    Attributes:
        path: its folder.
        words: the command, but for the run's folder.
        output: what it wrote.
    """

    path: Path
    words: tuple[str, ...]
    output: str


@pytest.fixture(scope="session")
def finished_run(
    commands: Commands, wind_path: Path, tmp_path_factory: pytest.TempPathFactory
) -> FinishedRun:
    """CTMRL with the smoke preset on PointRobotWind; tests must not change it."""
    path = tmp_path_factory.mktemp("runs") / "whole"
    words = ("ctmrl.train", "--preset", "smoke", "--steps", "40", "--data", str(wind_path))
    assert commands.run(*words, "--out", str(path)) == 0, commands.output()
    return FinishedRun(path, words, commands.output())
