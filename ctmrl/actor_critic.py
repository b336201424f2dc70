"""The context-conditioned actor-critic that every method shares: SAC with a value network.

Contexts come in detached: no gradient of anything here reaches an encoder.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor, nn

from ctmrl import brac
from ctmrl.data import Transitions
from ctmrl.networks import Actor, Critic, Statistics, frozen
from ctmrl.numbers import Source, uniform


@dataclass(frozen=True)
class ActorCriticConfig:
    """Hyper-parameters of the actor-critic."""

    hidden: tuple[int, ...] = (128, 128)
    """Widths of the hidden layers of actor, critics and value network."""
    gamma: float = 0.8
    """Discount factor."""
    reward_scale: float = 500.0
    """R: rewards count R times the entropy; the networks see rewards / entropy as 1 / (1/R)."""
    learning_rate: float = 1e-3
    """Learning rate of actor, critics and value network at the start."""
    target_rate: float = 0.01
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
    dual_steps: int = 1
    """Steps of the dual critic in each gradient step: the first on its batch, each further one on
    another batch of the same tasks. The field's code takes 3. Of no use without
    behavior_regularization."""
    behavior_cloning: float = 0.0
    """Weight of minus the log likelihood of the data's actions in the policy's loss, in units of
    the spread of Q: what TD3+BC is for a deterministic policy. 0 is without it."""
    cloning_advantage: float = 0.0
    """How much more actions count in cloning that are better than the value network's: by e to this
    many times their advantage, in units of its spread. 0 clones all alike. Of no use without
    behavior_cloning."""
    cloning_rank: float = 0.0
    """How much more actions count in cloning that are of better episodes: by e to this many times
    the share of the task's data that are of episodes with lower returns, of the dense reward where
    there are two. 0 clones all alike. Of no use without behavior_cloning."""
    value_expectile: float = 0.0
    """Above 0, the value network learns this expectile of Q at the data's own actions, as in IQL:
    above 0.5 what the better of them are worth; 0 lets it learn the value of the policy."""
    value_from_data: bool = False
    """Let critics and value network begin at the value that the data's mean reward comes to, and
    not at 0, from where they take thousands of steps."""

    @property
    def batches(self) -> int:
        """Batches of a gradient step: one for each step of the dual critic where there is one."""
        return self.dual_steps if self.behavior_regularization else 1


class ActorCritic(nn.Module):
    """Actor, twin critics, value network and, for BRAC, a dual critic.

    Losses are divided by the reward scale R: the optimum is the same as with rewards times R and
    entropy weight 1, and the networks' outputs stay of the size of a discounted return.

    Actor, critics and value network share no parameter, so the sum of their losses trains all of
    them in one backward pass; the dual critic has an optimiser of its own and takes all its steps
    first.
    """

    def __init__(
        self,
        config: ActorCriticConfig,
        statistics: Statistics,
        act_dim: int,
        z_dim: int,
        first_value: float = 0.0,
    ) -> None:
        """Build the networks; initial weights come from torch's global generator.

        Args:
            config: hyper-parameters.
            statistics: of the training data.
            act_dim: A.
            z_dim: Z.
            first_value: about what critics and value network answer at first.
        """
        super().__init__()
        self.config = config
        self.entropy_coef = 1.0 / config.reward_scale
        obs = statistics.obs
        self.actor = Actor(obs, z_dim, config.hidden, act_dim)
        self.critic = Critic(obs, act_dim + z_dim, config.hidden, heads=2)
        self.value = Critic(obs, z_dim, config.hidden, heads=1)
        self.target_value = Critic(obs, z_dim, config.hidden, heads=1)
        for network in (self.critic, self.value):
            network.shift(first_value)
        self.target_value.load_state_dict(self.value.state_dict())
        self.target_value.requires_grad_(False)
        self.multiplier: brac.Multiplier | None = None
        self.dual_optimizer: torch.optim.Optimizer | None = None
        if config.behavior_regularization:
            self.dual_critic = Critic(obs, act_dim + z_dim, config.hidden, heads=1)
            self.dual_optimizer = torch.optim.Adam(
                self.dual_critic.parameters(), lr=config.dual_lr, fused=True
            )
            self.multiplier = brac.Multiplier(
                config.divergence_initial,
                config.divergence_maximum,
                config.divergence_target,
                config.divergence_wind_up,
            )

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        super()._apply(fn, recurse)  # type: ignore[no-untyped-call] # torch's own
        if self.multiplier is not None:
            # Its precision is its own.
            self.multiplier.value = fn(self.multiplier.value).float()
        return self

    def main_parameters(self) -> list[nn.Parameter]:
        """What the sum of the losses trains: actor, critics and value network."""
        modules = (self.actor, self.critic, self.value)
        return [parameter for module in modules for parameter in module.parameters()]

    def loss(
        self,
        batch: Transitions,
        z: Tensor,
        generator: Source,
        further: Sequence[Transitions] = (),
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Losses of critics, value network and actor; with BRAC, also updates the dual critic.

        Args:
            batch: n transitions.
            z: context of each transition's task, [n, Z], detached.
            generator: of the policy's noise.
            further: batches of the same tasks in the same order, for the dual critic alone.

        Returns:
            Scalar sum of the losses, and scalars by metric name.
        """
        target = self.critic_target(batch, z)
        layers = self.critic.layers()
        at_data = self.critic(batch.obs, batch.action, z, layers=layers)
        critic = (at_data - target).square().mean(dim=1).sum()
        sample = self.actor.sample(batch.obs, z, generator)
        q = self.critic(batch.obs, sample.action, z, layers=frozen(layers)).amin(dim=0)
        entropy_cost = self.entropy_coef * sample.log_prob
        expected = self.value(batch.obs, z)[0]
        if expectile := self.config.value_expectile:
            behind = at_data.amin(dim=0).detach() - expected
            value = (torch.where(behind > 0, expectile, 1 - expectile) * behind.square()).mean()
        else:
            value = (expected - (q - entropy_cost).detach()).square().mean()
        regularizer = sample.mean.square().mean() + sample.log_std.square().mean()
        actor = (entropy_cost - q).mean()
        actor = actor + self.entropy_coef * self.config.regularizer * regularizer
        cloning = self.config.behavior_cloning
        if cloning:
            advantage = (at_data.amin(dim=0) - expected).detach()
            weights = self.cloning_weights(advantage, batch.rank)
            unlikely = -(weights * sample.log_prob_of(batch.action)).mean()
            actor = actor + cloning * q.detach().std() * unlikely
        metrics = {
            "policy/q": q.detach().mean(),
            "policy/q_largest": torch.maximum(at_data.abs().amax(), q.abs().amax()).detach(),
            "loss/critic": critic.detach(),
            "loss/value": value.detach(),
            "loss/actor": actor.detach(),
            "policy/entropy": -sample.log_prob.detach().mean(),
        }
        if cloning:
            metrics["loss/behavior_cloning"] = unlikely.detach()
        if self.multiplier is not None:
            batches, action = (batch, *further), sample.action.detach()
            metrics["loss/dual_critic"] = self._train_dual(batches, z, action, generator)
            divergence = self._divergence(batch, z, sample.action)
            coefficient = self.multiplier.coefficient()
            actor = actor + self.entropy_coef * coefficient * divergence.mean()
            self.multiplier.update(divergence)
            metrics["loss/actor"] = actor.detach()
            metrics["divergence/mean"] = divergence.detach().mean()
            metrics["divergence/coefficient"] = coefficient
        return critic + value + actor, metrics

    def cloning_weights(self, advantage: Tensor, rank: Tensor) -> Tensor:
        """Weights of a batch's actions in cloning, 1 on the mean; all [n].

        By advantage they are advantage-weighted regression's (AWR and AWAC, where the spread is a
        temperature), by rank those of reward-weighted regression, with an episode's place among
        the task's in place of its return, which has other units in every task. They are normalised
        over the batch, so that they hold the policy as firmly when all advantages fall.
        """
        better, returned = self.config.cloning_advantage, self.config.cloning_rank
        if not better and not returned:
            return torch.ones_like(advantage)
        spread = advantage.std().clamp(min=1e-6)
        return torch.softmax(better * advantage / spread + returned * rank, dim=0) * len(advantage)

    def critic_target(self, batch: Transitions, z: Tensor) -> Tensor:
        """Targets y = r + gamma V_target(s', z), no value behind a terminal transition; [n]."""
        with torch.no_grad():
            future = self.target_value(batch.next_obs, z)[0]
            target: Tensor = batch.reward + self.config.gamma * (1 - batch.terminal) * future
            return target

    @torch.no_grad()
    def follow_value(self) -> None:
        """Move the target value network towards the value network, after a gradient step."""
        torch._foreach_lerp_(
            list(self.target_value.parameters()),
            list(self.value.parameters()),
            self.config.target_rate,
        )

    def _divergence(self, batch: Transitions, z: Tensor, action: Tensor) -> Tensor:
        layers = frozen(self.dual_critic.layers())
        at_policy = self.dual_critic(batch.obs, action, z, layers=layers)[0]
        at_data = self.dual_critic(batch.obs, batch.action, z, layers=layers)[0]
        return brac.dual_divergence(at_policy, at_data)

    def _train_dual(
        self, batches: Sequence[Transitions], z: Tensor, action: Tensor, generator: Source
    ) -> Tensor:
        """A step of the dual critic on each batch; mean of its losses.

        Args:
            batches: of n transitions each.
            z: context of each transition's task in all of them, [n, Z].
            action: the policy's at the first batch, [n, A].
            generator: of what is drawn, first the policy's noise at all further batches.
        """
        actions = [action]
        if further := batches[1:]:
            with torch.no_grad():
                obs, repeated = torch.cat([one.obs for one in further]), z.repeat(len(further), 1)
                actions += self.actor.sample(obs, repeated, generator).action.chunk(len(further))
        pairs = zip(batches, actions, strict=True)
        return torch.stack([self._update_dual(one, z, at, generator) for one, at in pairs]).mean()

    def _update_dual(
        self, batch: Transitions, z: Tensor, action: Tensor, generator: Source
    ) -> Tensor:
        share = uniform(generator, len(action), 1)
        between_action = action + share * (batch.action - action)
        use_gradient = self.config.dual_penalty == "gradient"
        between_action.requires_grad_(use_gradient)
        layers = self.dual_critic.layers()
        between = self.dual_critic(batch.obs, between_action, z, layers=layers)[0]
        penalty = (
            brac.gradient_penalty(between, between_action)
            if use_gradient
            else brac.value_penalty(between)
        )
        divergence = brac.dual_divergence(
            self.dual_critic(batch.obs, action, z, layers=layers)[0],
            self.dual_critic(batch.obs, batch.action, z, layers=layers)[0],
        )
        loss = brac.dual_critic_loss(divergence, penalty)
        assert self.dual_optimizer is not None
        self.dual_optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        self.dual_optimizer.step()
        detached: Tensor = loss.detach()
        return detached
