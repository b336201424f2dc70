"""The fleet's policies: Stable-Baselines3's distribution, each task's own noise."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from gymnasium import spaces
from stable_baselines3.common.utils import ConstantSchedule
from torch import Tensor

from datagen.fleet.policy import FleetPolicy
from datagen.fleet.training import actor
from tests.datagen.fleet.fleets import generators

OBS = spaces.Box(-np.inf, np.inf, (4,), np.float32)
ACTION = spaces.Box(-1.0, 1.0, (3,), np.float32)
BATCH = 11


def policy(tasks: int = 2, first: int = 0, wider: float = 0.0) -> FleetPolicy:
    """At its start, but for log standard deviations that are `wider`."""
    made = FleetPolicy(OBS, ACTION, ConstantSchedule(1e-3), generators(tasks, first), (16, 8))
    with torch.no_grad():
        made.actor.biases[-1][:, :, 3:] += wider
    made.refresh()
    return made


def observations(*shape: int) -> Tensor:
    drawn = np.random.default_rng(1).standard_normal((*shape, 4), dtype=np.float32)
    return torch.from_numpy(drawn)


# A standard deviation at its upper bound sends actions to the tanh's ends, where the logarithm of
# its slope makes much of a rounding.
@pytest.mark.parametrize(("wider", "tolerance"), [(0.0, 1e-5), (1.0, 1e-4), (5.0, 2e-2)])
def test_actions_and_their_probabilities_are_stable_baselines3s(
    wider: float, tolerance: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    ours, obs = policy(wider=wider), observations(2, BATCH)
    noise = ours.noise(BATCH)
    action, log_prob = ours.act(obs, noise)
    assert (action.shape, log_prob.shape) == ((2, BATCH, 3), (2, BATCH, 1))
    mean, log_std = ours.distribution(obs)
    for task in range(2):
        theirs = actor(OBS, ACTION, [value[task] for value in ours.actor.state_dict().values()])
        own = noise[task]
        monkeypatch.setattr(
            "torch.distributions.normal._standard_normal", lambda *about, own=own, **more: own
        )
        their_action, their_log_prob = theirs.action_log_prob(obs[task])
        torch.testing.assert_close(action[task], their_action, rtol=1e-5, atol=1e-6)
        torch.testing.assert_close(log_prob[task, :, 0], their_log_prob, rtol=0, atol=tolerance)
        their_mean, their_log_std, _ = theirs.get_action_dist_params(obs[task])
        torch.testing.assert_close(mean[task], their_mean, rtol=1e-5, atol=1e-6)
        torch.testing.assert_close(log_std[task], their_log_std, rtol=1e-5, atol=1e-6)
    assert bool((log_std == 2.0).all()) == (wider == 5.0)


def test_the_narrowest_policy_has_its_probability_too() -> None:
    # Stable-Baselines3's own loses it: mean + std * noise - mean is 0 in float32.
    ours, obs = policy(wider=-30.0), observations(2, BATCH)
    noise = ours.noise(BATCH)
    mean, log_std = ours.distribution(obs)
    assert bool((log_std == -20.0).all())
    action, log_prob = ours.act(obs, noise)
    density = -0.5 * noise.double() ** 2 + 20.0 - 0.5 * np.log(2 * np.pi)
    slope = torch.log(1 - torch.tanh(mean.double()) ** 2)
    wanted = (density - slope).sum(dim=2, keepdim=True)
    torch.testing.assert_close(log_prob.double(), wanted, rtol=0, atol=1e-4)
    torch.testing.assert_close(action, torch.tanh(mean))


def test_noise_is_normal_and_each_tasks_own() -> None:
    three, one = policy(3), policy(1, first=1)
    many, alone = three.noise(4000), one.noise(4000)
    assert torch.equal(many[1], alone[0])
    assert not torch.equal(many[0], many[1])
    assert many.mean().item() == pytest.approx(0.0, abs=0.03)
    assert many.std().item() == pytest.approx(1.0, abs=0.03)
    assert not torch.equal(many, three.noise(4000))


def test_a_prediction_for_each_task() -> None:
    ours, obs = policy(), observations(2)
    mean, log_std = ours.distribution(obs[:, None])
    best, _ = ours.predict(obs.numpy(), deterministic=True)
    np.testing.assert_allclose(best, np.tanh(mean[:, 0].detach().numpy()), atol=1e-6)
    # Its noise is the next of the tasks' generators.
    action = ours(obs)
    wanted = mean + log_std.exp() * _next_noise()
    torch.testing.assert_close(action, torch.tanh(wanted)[:, 0].detach())
    assert not action.requires_grad


def _next_noise() -> Tensor:
    """The first noise a policy like the ones above draws."""
    return policy().noise(1)


def test_the_targets_begin_as_the_critics_and_apart_from_them() -> None:
    ours = policy()
    for one, target in zip(ours.critic_parameters, ours.target_parameters, strict=True):
        assert torch.equal(one, target)
        assert one.data_ptr() != target.data_ptr()
        assert not target.requires_grad
    pairs = torch.cat([observations(2, BATCH), torch.zeros(2, BATCH, 3)], dim=2)
    first, second = (critic(pairs) for critic in ours.critics)
    assert first.shape == (2, BATCH, 1)
    assert not torch.equal(first, second)
    with torch.no_grad():
        for value in ours.critic_parameters:
            value.zero_()
    ours.refresh()
    assert torch.equal(ours.critics[0](pairs), torch.zeros(2, BATCH, 1))
    assert torch.equal(ours.targets[0](pairs), first)


def test_weights_depend_on_the_tasks_own_generator() -> None:
    three, one = policy(3), policy(1, first=1)
    assert set(three.state_dict()) == set(one.state_dict())
    for name, value in one.state_dict().items():
        assert torch.equal(three.state_dict()[name][1], value[0]), name


def test_loaded_weights_are_seen_after_a_refresh() -> None:
    low = [
        FleetPolicy(OBS, ACTION, ConstantSchedule(1e-3), generators(2, first), (8,), "bfloat16")
        for first in (0, 5)
    ]
    obs = observations(2, BATCH)
    wanted = low[0].distribution(obs)[0]
    low[1].load_state_dict(low[0].state_dict())
    assert not torch.equal(low[1].distribution(obs)[0], wanted)
    low[1].refresh()
    assert torch.equal(low[1].distribution(obs)[0], wanted)


def test_what_it_is_not_made_for() -> None:
    with pytest.raises(ValueError, match="state-dependent exploration is not for fleets"):
        FleetPolicy(OBS, ACTION, ConstantSchedule(1e-3), generators(1), use_sde=True)
    with pytest.raises(NotImplementedError, match=r"saved by datagen\.fleet\.state"):
        policy()._get_constructor_parameters()
