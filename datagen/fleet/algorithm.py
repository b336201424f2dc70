"""Soft actor-critic of many tasks side by side, as an algorithm of Stable-Baselines3."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from io import BufferedIOBase
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from torch import Tensor
from torch.optim import Optimizer

from datagen.accelerator import Inlet, recorded
from datagen.budgets import Precision, SACSettings
from datagen.fleet.memory import FleetMemory
from datagen.fleet.policy import FleetPolicy
from datagen.fleet.vec_env import FleetVecEnv


class FleetSAC(OffPolicyAlgorithm):
    """Stable-Baselines3's SAC, one a task, all updated by one set of batched operations.

    Soft actor-critic is of Haarnoja et al. 2018 (arXiv 1801.01290), with two critics and a
    temperature that is learnt as in their second paper (arXiv 1812.05905).
    The tasks share no parameter, transition, statistic or random number. As in Stable-Baselines3,
    steps are counted over all sub-environments: `learn(n * len(tasks))` is n steps of each task.
    """

    policy: FleetPolicy
    replay_buffer: FleetMemory  # type: ignore[assignment] # a buffer of the same use

    def __init__(  # noqa: PLR0913 - Stable-Baselines3 spells its algorithms' arguments out
        self,
        env: FleetVecEnv,
        settings: SACSettings,
        seeds: Sequence[int | np.random.SeedSequence],
        steps: int,
        random_steps: int,
        precision: Precision = "float32",
        device: torch.device | str = "cpu",
    ) -> None:
        """Draw the networks.

        Args:
            env: the tasks.
            settings: hyper-parameters of every task's SAC.
            seeds: one a task; a task's weights, noise and samples depend on its own alone.
            steps: of each task, at most, random ones among them: what the memory holds.
            random_steps: steps of each task before its first update, with uniform actions.
            precision: of the matrix products.
            device: torch's.

        Raises:
            ValueError: not one seed a task.
        """
        if len(seeds) != env.num_envs:
            raise ValueError(f"{env.num_envs} tasks need as many seeds, got {len(seeds)}")
        self.generators = [np.random.default_rng(seed) for seed in seeds]
        self._first_temperature = settings.initial_temperature
        super().__init__(
            FleetPolicy,
            env,
            settings.learning_rate,
            buffer_size=steps * env.num_envs,
            learning_starts=random_steps * env.num_envs,
            batch_size=settings.batch_size,
            tau=settings.tau,
            gamma=settings.gamma,
            train_freq=settings.update_every,
            gradient_steps=settings.update_every,
            replay_buffer_class=FleetMemory,  # type: ignore[arg-type] # a buffer of the same use
            replay_buffer_kwargs={"generators": self.generators},
            policy_kwargs={
                "generators": self.generators,
                "net_arch": settings.hidden,
                "precision": precision,
            },
            device=device,
            support_multi_env=True,
            supported_action_spaces=(spaces.Box,),
        )
        self._setup_model()

    def _setup_model(self) -> None:
        super()._setup_model()
        self.actor = self.policy.actor
        start = float(np.log(self._first_temperature))
        self.log_temperature = torch.full(
            (self.n_envs, 1, 1), start, device=self.device, requires_grad=True
        )
        self.temperature_optimizer = torch.optim.Adam(
            [self.log_temperature], lr=self.lr_schedule(1.0), fused=True
        )
        self.log_temperature.grad = torch.zeros_like(self.log_temperature)
        self._losses = torch.zeros(3, device=self.device)
        tasks, acts = self.n_envs, self.policy.action_dim
        self._rows, *self._noises = (
            Inlet((tasks, self.batch_size, size), self.device)
            for size in (self.replay_buffer.rows.shape[2], acts, acts)
        )
        for optimizer in self.optimizers.values():
            for group in optimizer.param_groups:
                group["capturable"] = self.device.type == "cuda"
        self.record()

    @property
    def optimizers(self) -> dict[str, Optimizer]:
        """All of them, by name."""
        return {
            "actor_optimizer": self.policy.actor_optimizer,
            "critic_optimizer": self.policy.critic_optimizer,
            "temperature_optimizer": self.temperature_optimizer,
        }

    def record(self) -> None:
        """Have the updates recorded anew, because tensors were replaced, as optimisers' are."""
        self._recorded = recorded(self._update, self.device)

    def save(
        self,
        path: str | Path | BufferedIOBase,
        exclude: Iterable[str] | None = None,
        include: Iterable[str] | None = None,
    ) -> None:
        """Refused: Stable-Baselines3's file of a fleet could not be loaded.

        Raises:
            NotImplementedError: always, before anything is written.
        """
        raise NotImplementedError(
            "a fleet's state is saved by datagen.fleet.state, its policies by --policies of "
            "datagen.collect"
        )

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Uniform actions [task, A] at first, the policies' afterwards."""
        if self.num_timesteps < learning_starts:
            size = self.policy.action_dim
            drawn = [one.random(size, dtype=np.float32) for one in self.generators]
            actions = 2 * np.stack(drawn) - 1
        else:
            assert isinstance(self._last_obs, np.ndarray)
            obs = torch.from_numpy(self._last_obs).to(self.device)
            actions = self.policy(obs).cpu().numpy()
        return actions, actions

    def train(self, gradient_steps: int, batch_size: int) -> None:
        """Updates of every task; the mean losses over tasks go to the logger.

        Raises:
            ValueError: a batch size other than the settings'.
        """
        if batch_size != self.batch_size:
            raise ValueError(f"batches are of {self.batch_size} transitions, not {batch_size}")
        self._losses.zero_()
        for _ in range(gradient_steps):
            self._rows.fill(self.replay_buffer.draw)
            for noise in self._noises:
                noise.fill(self.policy.draw_noise)
            self._recorded()
        self._n_updates += gradient_steps
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        names = ("train/actor_loss", "train/critic_loss", "train/ent_coef_loss")
        means = (self._losses / gradient_steps / self.n_envs).tolist()
        for name, mean in zip(names, means, strict=True):
            self.logger.record(name, mean)
        self.logger.record("train/ent_coef", float(self.log_temperature.detach().exp().mean()))

    def _update(self) -> None:
        """One update of temperature, critics and actor, in Stable-Baselines3's order.

        Every loss is the sum over tasks of a task's mean, so that no task weighs on another.
        Reads the inlets, adds to the losses of the actors, the critics and the temperatures, and
        is recorded on a GPU: nothing here may wait for a value or keep a tensor it has made.
        """
        policy = self.policy
        batch = self.replay_buffer.split(self._rows.tensor)
        noise, next_noise = (one.tensor for one in self._noises)
        action, log_prob = policy.act(batch.observations, noise)

        temperature = self.log_temperature.detach().exp()
        short = (log_prob - policy.action_dim).detach()
        temperature_loss = -(self.log_temperature * short).mean(dim=1).sum()
        (gradient,) = torch.autograd.grad(temperature_loss, self.log_temperature)
        assert self.log_temperature.grad is not None
        self.log_temperature.grad.copy_(gradient)
        self.temperature_optimizer.step()

        target = self._target(batch, temperature, next_noise)
        pairs = torch.cat([batch.observations, batch.actions], dim=2)
        critic_loss = torch.zeros((), device=self.device)
        for critic in policy.critics:
            critic_loss = critic_loss + 0.5 * (critic(pairs) - target).square().mean(dim=1).sum()
        critic_loss.backward()  # type: ignore[no-untyped-call] # torch's own
        policy.critic_optimizer.step()

        acted = torch.cat([batch.observations, action], dim=2)
        for critic in policy.critics:
            critic.refresh()
        value = torch.minimum(*(critic(acted, learn=False) for critic in policy.critics))
        actor_loss = (temperature * log_prob - value).mean(dim=1).sum()
        actor_loss.backward()  # type: ignore[no-untyped-call] # torch's own
        policy.actor_optimizer.step()
        policy.actor.refresh()

        self._follow()
        self._losses += torch.stack([actor_loss, critic_loss, temperature_loss]).detach()

    @torch.no_grad()
    def _target(self, batch: Any, temperature: Tensor, noise: Tensor) -> Tensor:
        """What the critics should say, [task, batch, 1]."""
        action, log_prob = self.policy.act(batch.next_observations, noise)
        acted = torch.cat([batch.next_observations, action], dim=2)
        value = torch.minimum(*(target(acted, learn=False) for target in self.policy.targets))
        value -= temperature * log_prob
        goes_on = 1.0 - batch.dones
        found: Tensor = batch.rewards + self.gamma * goes_on * value
        return found

    @torch.no_grad()
    def _follow(self) -> None:
        """The target critics take a step towards the critics."""
        policy = self.policy
        for target, one in zip(policy.target_parameters, policy.critic_parameters, strict=True):
            target.lerp_(one, self.tau)
        for net in policy.targets:
            net.refresh()
