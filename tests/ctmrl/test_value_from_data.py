"""--value-from-data: where critics and value networks begin."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from ctmrl.data import OfflineData
from ctmrl.meta_train import Learner
from ctmrl.presets import preset


@pytest.mark.parametrize("gamma", [0.8, 0.98])
def test_critics_begin_at_the_value_of_the_data_on_request(
    gamma: float, wind_data: OfflineData
) -> None:
    values = []
    for asked in (False, True):
        config = preset("point_robot_wind", "ctmrl", "smoke")
        policy = dataclasses.replace(config.actor_critic, gamma=gamma, value_from_data=asked)
        ac = Learner(dataclasses.replace(config, actor_critic=policy), wind_data).actor_critic
        rows = wind_data.unpack(wind_data.table[:13])
        z = torch.zeros(13, config.context.z_dim)
        found = (ac.critic(rows.obs, rows.action, z), ac.value(rows.obs, z))
        values.append([*found, ac.target_value(rows.obs, z)])
    reward = wind_data.unpack(wind_data.table).reward.mean()
    assert reward < -0.1
    for plain, moved in zip(*values, strict=True):
        # No episode of this robot ends before its time.
        value = torch.full_like(plain, float(reward) / (1 - gamma))
        torch.testing.assert_close(moved - plain, value)
