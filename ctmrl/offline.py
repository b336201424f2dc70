"""A run's dataset, and contexts of its tasks' own data for a meta-test without exploration."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ctmrl.config import RunConfig
from ctmrl.data import OfflineData
from ctmrl.errors import UsageError
from datagen.dataset import Dataset, open_dataset


def open_data(config: RunConfig) -> Dataset:
    """Open the run's slice of its dataset.

    Raises:
        UsageError: it is of another environment or has no training tasks.
        DatasetError: it is missing or damaged.
    """
    path = config.data or Path("datasets") / config.env
    dataset = open_dataset(path, verify=False)
    if dataset.env != config.env:
        raise UsageError(
            f"{path} is of {dataset.env}, not of {config.env}: "
            f"give --env {dataset.env} or another --data"
        )
    if len(dataset.train_tasks) < 2:
        raise UsageError(
            f"{path} has {len(dataset.train_tasks)} training tasks, at least 2 are needed: "
            f"python -m datagen.collect --env {config.env} collects them"
        )
    return dataset.select(config.quality, config.data_episodes)


def offline_contexts(
    config: RunConfig,
    groups: Mapping[str, NDArray[np.int64]],
    seed: int,
    learned_from: str,
) -> dict[str, Tensor]:
    """Contexts of the tasks' own data, drawn as in meta-training.

    Args:
        config: of the run; its dataset, slice and sizes of contexts are in it.
        groups: tasks by the groups' names.
        seed: of the draws, in each group anew.
        learned_from: hash of the dataset that it must be.

    Returns:
        Transitions [R * n, T, O + A + 1 + O] by group, repetition by repetition.

    Raises:
        UsageError: it is another dataset, lacks a task or has too few episodes.
        DatasetError: it is missing or damaged.
    """
    dataset, found = open_data(config), {}
    if learned_from != dataset.hash:
        raise UsageError(
            f"{dataset.path} does not hold the data that the run learned from: "
            "give --data with the folder that does"
        )
    training = config.training
    for name, rows in groups.items():
        if missing := sorted({*rows.tolist()} - {*dataset.tasks.tolist()}):
            raise UsageError(
                f"--protocols offline needs data of the {name} tasks, and {dataset.path} has "
                f"none of {', '.join(map(str, missing))}: python -m datagen.collect "
                f"--env {config.env} --out {dataset.path}, with its --budget and --seed, collects "
                "all tasks, for a new run to learn from"
            )
        data = OfflineData(dataset, rows, dense_context=config.context.dense_reward_in_context)
        draws = torch.Generator().manual_seed(seed)
        sizes = (1, training.context_episodes, training.context_size)
        repetitions = [
            data.contexts(torch.arange(len(rows)), *sizes, draws)[0]
            for _ in range(config.meta_test.repetitions)
        ]
        found[name] = torch.cat(repetitions)
    return found
