"""A fleet's policies as Stable-Baselines3's files: loaded, they are the same networks."""

from __future__ import annotations

import resource
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from stable_baselines3 import SAC
from torch import Tensor

from datagen.budgets import budget
from datagen.fleet.algorithm import FleetSAC
from datagen.fleet.export import export_policy, sac_of
from tests.datagen.fleet.fleets import NEVER, SETTINGS, fleet

ENV, TASKS = "hopper_params", (2, 9)
ROWS = replace(budget(ENV, "smoke"), sac=SETTINGS)


@pytest.fixture(scope="module")
def model() -> FleetSAC:
    """A fleet after some updates, so that critics and targets differ."""
    made = fleet(TASKS, ENV)
    made.learn(60 * 2, log_interval=NEVER)
    return made


def tensors(model: FleetSAC, row: int) -> dict[str, Tensor]:
    held = {name: value[row] for name, value in model.policy.state_dict().items()}
    return {**held, "log_temperature": model.log_temperature[row].detach()}


@pytest.mark.parametrize("row", [0, 1])
def test_what_is_loaded_is_the_tasks_own_networks(
    row: int, model: FleetSAC, tmp_path: Path
) -> None:
    path = tmp_path / "policy.zip"
    export_policy(path, sac_of(ENV, TASKS[row], ROWS, tensors(model, row)))
    assert [one.name for one in tmp_path.iterdir()] == ["policy.zip"]
    loaded = SAC.load(path, device="cpu")
    drawn = np.random.default_rng(0)
    obs = torch.from_numpy(drawn.standard_normal((2, 20, 11), dtype=np.float32))
    action = torch.from_numpy(drawn.uniform(-1, 1, (2, 20, 3)).astype(np.float32))
    pairs = torch.cat([obs, action], dim=2)
    with torch.no_grad():
        mean, log_std, _ = loaded.actor.get_action_dist_params(obs[row])
        both = model.policy.distribution(obs)
        torch.testing.assert_close((mean, log_std), tuple(part[row] for part in both))
        for theirs, ours in (
            (loaded.critic, model.policy.critics),
            (loaded.critic_target, model.policy.targets),
        ):
            for value, net in zip(theirs(obs[row], action[row]), ours, strict=True):
                torch.testing.assert_close(value, net(pairs)[row])
    assert loaded.log_ent_coef is not None
    assert loaded.log_ent_coef.item() == model.log_temperature[row].item()
    best, _ = loaded.predict(obs[row].numpy(), deterministic=True)
    np.testing.assert_allclose(best, np.tanh(mean.numpy()), atol=1e-6)
    assert (loaded.gamma, loaded.tau, loaded.batch_size) == (0.97, 0.02, 16)


def test_a_full_disk_leaves_nothing(model: FleetSAC, tmp_path: Path) -> None:
    exported = sac_of(ENV, 2, ROWS, tensors(model, 0))
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, limits[1]))
    try:
        with pytest.raises(OSError, match="File too large"):
            export_policy(tmp_path / "policy.zip", exported)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert list(tmp_path.iterdir()) == []
