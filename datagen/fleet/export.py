"""A fleet's policies as files that `stable_baselines3.SAC.load` opens."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path

import torch
from stable_baselines3 import SAC
from torch import Tensor

from datagen.behavior import new_sac
from datagen.budgets import Budget
from datagen.files import write_whole


def sac_of(env: str, task: int, budget: Budget, tensors: dict[str, Tensor]) -> SAC:
    """Stable-Baselines3's SAC with one task's networks.

    Args:
        env: any of the environment's names.
        task: row of its task set.
        budget: how the fleet learned.
        tensors: the task's part of `FleetPolicy.state_dict()`, without the leading axis, and its
            `log_temperature`.
    """
    model = new_sac(env, task, budget)
    model.policy.load_state_dict(_state(tensors, len(budget.sac.hidden)))
    assert model.log_ent_coef is not None
    with torch.no_grad():
        model.log_ent_coef.copy_(tensors["log_temperature"].reshape(1))
    return model


def _state(tensors: dict[str, Tensor], hidden: int) -> dict[str, Tensor]:
    """Stable-Baselines3's names and shapes."""
    state = {}
    acts = tensors[f"actor.biases.{hidden}"].shape[-1] // 2
    halves = {"mu": slice(0, acts), "log_std": slice(acts, 2 * acts)}
    for name, part in halves.items():
        state[f"actor.{name}.weight"] = tensors[f"actor.weights.{hidden}"][:, part].T
        state[f"actor.{name}.bias"] = tensors[f"actor.biases.{hidden}"][0, part]
    sources = {"actor": "actor.latent_pi"}
    for number in range(2):
        sources[f"critic_{number}"] = f"critic.qf{number}"
        sources[f"target_{number}"] = f"critic_target.qf{number}"
    for ours, theirs in sources.items():
        for layer in range(hidden if ours == "actor" else hidden + 1):
            # Between the linear layers are the ReLUs.
            state[f"{theirs}.{2 * layer}.weight"] = tensors[f"{ours}.weights.{layer}"].T
            state[f"{theirs}.{2 * layer}.bias"] = tensors[f"{ours}.biases.{layer}"][0]
    return state


def export_policy(path: Path, model: SAC) -> None:
    """Write Stable-Baselines3's file, whole or not at all.

    Raises:
        OSError: the disk is full or the folder is not there.
    """
    content = BytesIO()
    model.save(content)
    write_whole(path, content.getvalue())
