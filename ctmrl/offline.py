"""Contexts of the tasks' own data, for a meta-test without exploration."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ctmrl.config import RunConfig
from ctmrl.data import OfflineData
from ctmrl.errors import UsageError
from ctmrl.train import open_data
from datagen.files import collect_command


def offline_contexts(
    config: RunConfig, groups: Mapping[str, NDArray[np.int64]], seed: int
) -> dict[str, Tensor]:
    """Contexts of the tasks' own data, drawn as in meta-training.

    Args:
        config: of the run; its dataset, slice and sizes of contexts are in it.
        groups: tasks by the groups' names.
        seed: of the draws, in each group anew.

    Returns:
        Transitions [R * n, T, O + A + 1 + O] by group, repetition by repetition.

    Raises:
        UsageError: the dataset lacks a task or has too few episodes.
        DatasetError: it is missing or damaged.
    """
    dataset, found = open_data(config), {}
    training = config.training
    for name, rows in groups.items():
        if missing := sorted({*rows.tolist()} - {*dataset.tasks.tolist()}):
            raise UsageError(
                f"--offline needs data of the {name} tasks, and {dataset.path} has none of "
                f"{', '.join(map(str, missing))}: "
                f"`{collect_command(dataset.path, dataset.index)}` collects all tasks"
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
