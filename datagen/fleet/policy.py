"""The networks of a fleet: tanh-Gaussian actors, pairs of critics and their targets."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from torch import Tensor

from datagen.budgets import Precision
from datagen.fleet.networks import BatchedMLP

LOG_STD_MIN, LOG_STD_MAX = -20.0, 2.0
"""Stable-Baselines3's bounds of the log standard deviation."""
TINY = 1e-6
"""Keeps the logarithm of the tanh's slope finite, as in Stable-Baselines3."""
_LOG_SQRT_2PI = 0.5 * float(np.log(2.0 * np.pi))


class FleetPolicy(BasePolicy):
    """Actor, two critics and two target critics of every task, drawn task by task.

    An observation [task, O] is one of each task.
    """

    def __init__(  # noqa: PLR0913 - the arguments Stable-Baselines3 gives a policy, and ours
        self,
        observation_space: spaces.Box,
        action_space: spaces.Box,
        lr_schedule: Schedule,
        generators: Sequence[np.random.Generator],
        net_arch: Sequence[int] = (256, 256),
        precision: Precision = "float32",
        use_sde: bool = False,
    ) -> None:
        """Draw all networks.

        Args:
            observation_space: of one task.
            action_space: of one task, a Box of [-1, 1].
            lr_schedule: Adam's rate, from the part of the training that is left.
            generators: one a task; of the weights and of the noise in actions.
            net_arch: width of each hidden layer.
            precision: of the matrix products.
            use_sde: must be False.
        """
        if use_sde:
            raise ValueError("state-dependent exploration is not for fleets")
        super().__init__(observation_space, action_space, squash_output=True)
        self.generators = generators
        obs, acts = observation_space.shape[0], action_space.shape[0]
        self.action_dim = acts
        actor, critic = (obs, *net_arch, 2 * acts), (obs + acts, *net_arch, 1)
        self.actor = BatchedMLP(actor, generators, precision)
        self.critics = [BatchedMLP(critic, generators, precision) for _ in range(2)]
        self.targets = copy.deepcopy(self.critics)
        self.critic_parameters = [p for one in self.critics for p in one.parameters()]
        self.target_parameters = [p for one in self.targets for p in one.parameters()]
        # Lists, not modules: only so are the networks' types known where they are called.
        for number, (one, target) in enumerate(zip(self.critics, self.targets, strict=True)):
            self.add_module(f"critic_{number}", one)
            self.add_module(f"target_{number}", target.requires_grad_(False))
        rate = lr_schedule(1.0)
        self.actor_optimizer = torch.optim.Adam(self.actor.parameters(), lr=rate, fused=True)
        self.critic_optimizer = torch.optim.Adam(self.critic_parameters, lr=rate, fused=True)

    def distribution(self, obs: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and log standard deviation [task, batch, A] of what goes into the tanh."""
        mean, log_std = self.actor(obs).chunk(2, dim=-1)
        return mean, log_std.clamp(LOG_STD_MIN, LOG_STD_MAX)

    def act(self, obs: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
        """Actions [task, batch, A] and their log probabilities [task, batch, 1].

        Args:
            obs: [task, batch, O].
            noise: standard normal, [task, batch, A].
        """
        mean, log_std = self.distribution(obs)
        action = torch.tanh(mean + log_std.exp() * noise)
        normal = -0.5 * noise.square() - log_std - _LOG_SQRT_2PI
        slope = torch.log(1.0 - action.square() + TINY)
        return action, (normal - slope).sum(dim=-1, keepdim=True)

    def noise(self, batch_size: int) -> Tensor:
        """Standard normal numbers [task, batch, A], each task's from its own generator."""
        drawn = np.empty((len(self.generators), batch_size, self.action_dim), dtype=np.float32)
        self.draw_noise(drawn)
        return torch.from_numpy(drawn).to(self.device)

    def draw_noise(self, into: NDArray[np.float32]) -> None:
        """Write such numbers to an array [task, batch, A]."""
        for row, generator in zip(into, self.generators, strict=True):
            generator.standard_normal(dtype=np.float32, out=row)

    def refresh(self) -> None:
        """Make every network see its parameters, after they were loaded."""
        for net in (self.actor, *self.critics, *self.targets):
            net.refresh()

    @torch.no_grad()
    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> Tensor:
        assert isinstance(observation, Tensor)
        mean, log_std = self.distribution(observation[:, None])
        if not deterministic:
            mean = mean + log_std.exp() * self.noise(1)
        return torch.tanh(mean)[:, 0]

    def forward(self, observation: PyTorchObs, deterministic: bool = False) -> Tensor:
        """Actions [task, A] for observations [task, O]."""
        return self._predict(observation, deterministic)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        raise NotImplementedError("a fleet's state is saved by datagen.fleet.state")
