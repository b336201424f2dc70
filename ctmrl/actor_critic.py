"""The context-conditioned actor-critic that every method shares: SAC with a value network.

Contexts come in detached: no gradient of anything here reaches an encoder.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from ctmrl import brac
from ctmrl.data import Transitions
from ctmrl.networks import Actor, Critic, Statistics


@dataclass(frozen=True)
class ActorCriticConfig:
    """Hyper-parameters of the actor-critic."""

    hidden: tuple[int, ...] = (128, 128)
    """Widths of the hidden layers of actor, critics and value network."""
    gamma: float = 0.9
    """Discount factor."""
    reward_scale: float = 100.0
    """R: rewards count R times the entropy; the networks see rewards / entropy as 1 / (1/R)."""
    learning_rate: float = 1e-3
    """Learning rate of actor, critics and value network at the start."""
    target_rate: float = 0.005
    """Share of the value network that goes into its target each step."""
    regularizer: float = 1e-3
    """Weight of mean^2 and log_std^2 of the policy, in units of the entropy."""
    timeouts_as_terminals: bool = False
    """Treat the time limit as a real end, as the field's code does."""
    behavior_regularization: bool = False
    """Stay near the behaviour policies: BRAC with the dual form of the KL divergence."""
    divergence_initial: float = 50.0
    """Multiplier of the divergence at the start, in units of the entropy."""
    divergence_maximum: float = 2000.0
    """Largest multiplier."""
    divergence_target: float = 0.05
    """Divergence the multiplier aims at."""
    divergence_wind_up: bool = False
    """Clip the multiplier on use alone, as the field's code does."""
    dual_penalty: brac.Penalty = "value"
    """What keeps the dual critic smooth: its value (the field's code) or its gradient (BRAC)."""
    dual_lr: float = 1e-4
    """Learning rate of the dual critic."""


class ActorCritic(nn.Module):
    """Actor, twin critics, value network and, for BRAC, a dual critic, with their optimisers.

    Losses are divided by the reward scale R: the optimum is the same as with rewards times R and
    entropy weight 1, and the networks' outputs stay of the size of a discounted return.
    """

    def __init__(
        self, config: ActorCriticConfig, statistics: Statistics, act_dim: int, z_dim: int
    ) -> None:
        """Build networks and optimisers; initial weights come from torch's global generator."""
        super().__init__()
        self.config = config
        self.entropy_coef = 1.0 / config.reward_scale
        obs = statistics.obs
        self.actor = Actor(obs, z_dim, config.hidden, act_dim)
        self.critic = Critic(obs, act_dim + z_dim, config.hidden, heads=2)
        self.value = Critic(obs, z_dim, config.hidden, heads=1)
        self.target_value = Critic(obs, z_dim, config.hidden, heads=1)
        self.target_value.load_state_dict(self.value.state_dict())
        self.target_value.requires_grad_(False)
        self.optimizers: dict[str, torch.optim.Optimizer] = {
            "critic": _adam(config.learning_rate, self.critic),
            "actor": _adam(config.learning_rate, self.actor, self.value),
        }
        self.multiplier: brac.Multiplier | None = None
        if config.behavior_regularization:
            self.dual_critic = Critic(obs, act_dim + z_dim, config.hidden, heads=1)
            self.optimizers["dual_critic"] = _adam(config.dual_lr, self.dual_critic)
            self.multiplier = brac.Multiplier(
                config.divergence_initial,
                config.divergence_maximum,
                config.divergence_target,
                config.divergence_wind_up,
            )

    def update(
        self, batch: Transitions, z: Tensor, generator: torch.Generator
    ) -> dict[str, Tensor]:
        """One gradient step of every network, in the order of the field's code.

        Args:
            batch: n transitions.
            z: context of each transition's task, [n, Z], detached.
            generator: of the policy's noise.

        Returns:
            Scalars by metric name.
        """
        metrics = {"loss/critic": self._update_critic(batch, z)}
        sample = self.actor.sample(batch.obs, z, generator)
        divergence = None
        if self.multiplier is not None:
            action = sample.action
            metrics["loss/dual_critic"] = self._update_dual(batch, z, action.detach(), generator)
            divergence = self._divergence(batch, z, action)
            metrics["divergence/mean"] = divergence.detach().mean()
            metrics["divergence/coefficient"] = self.multiplier.coefficient()
        self.critic.requires_grad_(False)
        q = self.critic(batch.obs, sample.action, z).amin(dim=0)
        self.critic.requires_grad_(True)
        entropy_cost = self.entropy_coef * sample.log_prob
        value_error = self.value(batch.obs, z)[0] - (q - entropy_cost).detach()
        value_loss = value_error.square().mean()
        regularizer = sample.mean.square().mean() + sample.log_std.square().mean()
        actor_loss = (entropy_cost - q).mean()
        actor_loss = actor_loss + self.entropy_coef * self.config.regularizer * regularizer
        if divergence is not None and self.multiplier is not None:
            weight = self.entropy_coef * self.multiplier.coefficient()
            actor_loss = actor_loss + weight * divergence.mean()
        # Actor and value network share no parameter, so one backward pass serves both.
        self._step("actor", actor_loss + value_loss)
        self._follow_value()
        if divergence is not None and self.multiplier is not None:
            self.multiplier.update(divergence)
        metrics["loss/value"] = value_loss.detach()
        metrics["loss/actor"] = actor_loss.detach()
        metrics["policy/entropy"] = -sample.log_prob.detach().mean()
        metrics["policy/q"] = q.detach().mean()
        return metrics

    def critic_target(self, batch: Transitions, z: Tensor) -> Tensor:
        """Targets y = r + gamma V_target(s', z), no value behind a terminal transition; [n]."""
        with torch.no_grad():
            future = self.target_value(batch.next_obs, z)[0]
            target: Tensor = batch.reward + self.config.gamma * (1 - batch.terminal) * future
            return target

    def _update_critic(self, batch: Transitions, z: Tensor) -> Tensor:
        target = self.critic_target(batch, z)
        loss = (self.critic(batch.obs, batch.action, z) - target).square().mean(dim=1).sum()
        self._step("critic", loss)
        detached: Tensor = loss.detach()
        return detached

    def _follow_value(self) -> None:
        with torch.no_grad():
            torch._foreach_lerp_(
                list(self.target_value.parameters()),
                list(self.value.parameters()),
                self.config.target_rate,
            )

    def _divergence(self, batch: Transitions, z: Tensor, action: Tensor) -> Tensor:
        self.dual_critic.requires_grad_(False)
        at_policy = self.dual_critic(batch.obs, action, z)[0]
        at_data = self.dual_critic(batch.obs, batch.action, z)[0]
        self.dual_critic.requires_grad_(True)
        return brac.dual_divergence(at_policy, at_data)

    def _update_dual(
        self, batch: Transitions, z: Tensor, action: Tensor, generator: torch.Generator
    ) -> Tensor:
        share = torch.rand(len(action), 1, generator=generator)
        between_action = action + share * (batch.action - action)
        use_gradient = self.config.dual_penalty == "gradient"
        between_action.requires_grad_(use_gradient)
        between = self.dual_critic(batch.obs, between_action, z)[0]
        penalty = (
            brac.gradient_penalty(between, between_action)
            if use_gradient
            else brac.value_penalty(between)
        )
        divergence = brac.dual_divergence(
            self.dual_critic(batch.obs, action, z)[0],
            self.dual_critic(batch.obs, batch.action, z)[0],
        )
        loss = brac.dual_critic_loss(divergence, penalty)
        self._step("dual_critic", loss)
        return loss.detach()

    def _step(self, name: str, loss: Tensor) -> None:
        optimizer = self.optimizers[name]
        optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimizer.step()


def _adam(lr: float, *modules: nn.Module) -> torch.optim.Adam:
    parameters = [parameter for module in modules for parameter in module.parameters()]
    return torch.optim.Adam(parameters, lr=lr, fused=True)
