"""CTMRL's gradient step as one writes it down first: what `meta_train_steps.py` compares with.

Networks, batches and losses are those of `ctmrl`; the means are plain: a Linear module a layer,
each critic a network of its own, contexts repeated for every transition, numpy columns sampled task
by task and copied, a backward pass and an Adam for each network. As in the field's code, the
actor's loss also differentiates the critics' weights, which nobody needs. It knows the settings of
the source paper alone: `dual_penalty` is "value", `metric_weight` is 0, and there are
neither cloning nor an expectile nor standardised contexts.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from ctmrl.config import RunConfig
from ctmrl.methods.ctmrl import CTMRLConfig
from ctmrl.networks import Statistics
from datagen.dataset import TaskData

Batch = tuple[Tensor, Tensor, Tensor, Tensor, Tensor]
"""Observations, actions, rewards, next observations and terminals of n transitions."""
Sampled = tuple[Tensor, Tensor, Tensor, Tensor]
"""Actions of the policy, their log densities, and the means and log deviations behind them."""


class Network(nn.Module):
    """Standardises its first inputs and passes all of them through ReLU layers."""

    def __init__(
        self, statistics: tuple[Tensor, Tensor], more: int, hidden: Sequence[int], out: int
    ) -> None:
        """Build it; `more` inputs come after those that are standardised."""
        super().__init__()
        self.mean, self.std = statistics
        sizes = [len(self.mean) + more, *hidden]
        layers: list[nn.Module] = []
        for fan_in, fan_out in pairwise(sizes):
            layers += [nn.Linear(fan_in, fan_out), nn.ReLU()]
        self.net = nn.Sequential(*layers, nn.Linear(sizes[-1], out))

    def forward(self, x: Tensor, *more: Tensor) -> Tensor:
        """Outputs [*, out]."""
        out: Tensor = self.net(torch.cat([(x - self.mean) / self.std, *more], dim=-1))
        return out


class PlainLearner:
    """Everything a gradient step needs, and the step.

    Attributes:
        networks: by name.
        optimizers: one Adam for each network that is trained, by the same names.
        codes: the codebook, [N, Z].
        with_codebook: whether the codebook's losses are used; they are after the warm-up.
    """

    def __init__(
        self, config: RunConfig, tasks: Sequence[TaskData], statistics: Statistics
    ) -> None:
        """Build the networks; initial weights come from torch's global generator."""
        assert isinstance(config.context, CTMRLConfig)
        self.training, self.context = config.training, config.context
        self.actor_critic = config.actor_critic
        self.tasks = tasks
        self.starts = [np.cumsum([0, *np.bincount(task.episode)]) for task in tasks]
        self.rng = np.random.default_rng(config.seed)
        self.generator = torch.Generator().manual_seed(config.seed)
        self.statistics = statistics
        obs = len(statistics.obs[0])
        act, z = tasks[0].actions.shape[1], self.context.z_dim
        encoder, predictor = self.context.encoder_hidden, self.context.predictor_hidden
        hidden = self.actor_critic.hidden
        self.networks = {
            "encoder": Network(statistics.context, 0, encoder, z),
            "reward": Network(statistics.obs, act + z, predictor, 1),
            "state": Network(statistics.obs, act + z, predictor, obs),
            "actor": Network(statistics.obs, z, hidden, 2 * act),
            "critic_1": Network(statistics.obs, act + z, hidden, 1),
            "critic_2": Network(statistics.obs, act + z, hidden, 1),
            "value": Network(statistics.obs, z, hidden, 1),
        }
        if self.actor_critic.behavior_regularization:
            self.networks["dual"] = Network(statistics.obs, act + z, hidden, 1)
        self.codes = functional.normalize(torch.randn(self.context.codes, z), dim=1)
        self.codes.requires_grad_()
        self.with_codebook = False
        self.multiplier = torch.tensor(self.actor_critic.divergence_initial)
        slow = dict.fromkeys(("encoder", "reward", "state"), self.context.encoder_lr)
        rates = {"dual": self.actor_critic.dual_lr, **slow}
        self.optimizers = {
            name: torch.optim.Adam(
                network.parameters(), lr=rates.get(name, self.actor_critic.learning_rate)
            )
            for name, network in self.networks.items()
        }
        self.optimizers["codes"] = torch.optim.Adam([self.codes], lr=self.context.encoder_lr)
        self.target_value = copy.deepcopy(self.networks["value"])

    def sample_contexts(self, chosen: NDArray[np.int64]) -> Tensor:
        """Two contexts a task from different episodes, [2, B, n, O + A + 1 + O]."""
        episodes, n = self.training.context_episodes, self.training.context_size
        sets: list[list[NDArray[Any]]] = [[], []]
        for index in chosen:
            data, starts = self.tasks[index], self.starts[index]
            order = self.rng.permutation(len(starts) - 1)
            for k, drawn in enumerate(sets):
                own = order[k * episodes : (k + 1) * episodes]
                pool = np.concatenate([np.arange(starts[e], starts[e + 1]) for e in own])
                rows = self.rng.choice(pool, n)
                before = [data.observations, data.actions, data.rewards[:, None]]
                columns = [*before, data.next_observations]
                drawn.append(np.concatenate([column[rows] for column in columns], axis=1))
        return torch.from_numpy(np.stack([np.stack(drawn) for drawn in sets]))

    def sample_batch(self, chosen: NDArray[np.int64]) -> Batch:
        """Transitions of each task for the actor-critic, task by task."""
        names = ("observations", "actions", "rewards", "next_observations", "terminals")
        parts: dict[str, list[NDArray[Any]]] = {name: [] for name in names}
        for index in chosen:
            data = self.tasks[index]
            rows = self.rng.integers(len(data), size=self.training.batch_size)
            for name, part in parts.items():
                part.append(data.columns[name][rows].astype(np.float32))
        obs, action, reward, next_obs, terminal = (
            torch.from_numpy(np.concatenate(part)) for part in parts.values()
        )
        return obs, action, reward, next_obs, terminal

    def update(self) -> dict[str, Tensor]:
        """One gradient step; losses by name."""
        chosen = self.rng.permutation(len(self.tasks))[: self.training.meta_batch]
        contexts, batch = self.sample_contexts(chosen), self.sample_batch(chosen)
        further = [self.sample_batch(chosen) for _ in range(1, self.actor_critic.batches)]
        return self.step(contexts, batch, further)

    def step(
        self, contexts: Tensor, batch: Batch, further: Sequence[Batch] = ()
    ) -> dict[str, Tensor]:
        """One gradient step on these data; losses by name.

        Args:
            contexts: two of each task.
            batch: for the actor-critic.
            further: batches for the dual critic's steps behind its first.
        """
        z = self.encode(contexts)
        losses = self.context_losses(contexts, z[0], z[1])
        given = z[0].detach().repeat_interleave(self.training.batch_size, dim=0)
        losses |= self.actor_critic_losses(batch, given, further)
        weights = {
            "spe_prediction": 1.0,
            "cro_prediction": self.context.cross_prediction_weight,
            "code_contrast": self.context.code_contrast_weight,
            "contrast": self.context.contrast_weight,
        }
        context_loss = sum(weight * losses[name] for name, weight in weights.items())
        assert isinstance(context_loss, Tensor)
        # The actor's first: it leaves gradients in the critics, which must not be stepped on.
        trained = {
            ("actor",): losses["actor"],
            ("critic_1", "critic_2"): losses["critic"],
            ("value",): losses["value"],
            ("encoder", "reward", "state", "codes"): context_loss,
        }
        for names, loss in trained.items():
            for name in names:
                self.optimizers[name].zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
        for names in trained:
            for name in names:
                self.optimizers[name].step()
        value, rate = self.networks["value"], self.actor_critic.target_rate
        for target, source in zip(self.target_value.parameters(), value.parameters(), strict=True):
            target.data.copy_((1 - rate) * target.data + rate * source.data)
        return losses

    def encode(self, contexts: Tensor) -> Tensor:
        """Contexts z, [2, B, Z]; where the encoder is to see s', it sees s' - s."""
        obs, size = len(self.statistics.obs[0]), len(self.statistics.context[0])
        changed = torch.cat(
            [contexts[..., :-obs], contexts[..., -obs:] - contexts[..., :obs]], dim=-1
        )
        return torch.tanh(self.networks["encoder"](changed[..., :size])).mean(dim=2)

    def context_losses(self, contexts: Tensor, z: Tensor, other: Tensor) -> dict[str, Tensor]:
        """Equations (2) to (10) for the two contexts of each task."""
        obs_dim, tau, n = len(self.statistics.obs[0]), self.context.tau, contexts.shape[2]
        obs, action, reward, next_obs = torch.split(
            contexts[0], [obs_dim, contexts.shape[3] - 2 * obs_dim - 1, 1, obs_dim], dim=-1
        )
        losses = {"spe_prediction": self.prediction_loss(obs, action, reward, next_obs, z) / n}
        losses |= dict.fromkeys(("cro_prediction", "code_contrast", "contrast"), torch.zeros(()))
        if not self.with_codebook:
            return losses
        matched = functional.cosine_similarity(z[:, None], self.codes[None], dim=-1).argmax(dim=1)
        with torch.no_grad():
            for code in set(matched.tolist()):
                mean = z[matched == code].mean(dim=0)
                eta = self.context.eta
                self.codes[code] = (1 - eta) * self.codes[code] + eta * mean
        straight_through = self.codes[matched] + z - z.detach()
        cross = self.prediction_loss(obs, action, reward, next_obs, straight_through)
        losses["cro_prediction"] = cross / n
        to_codes = functional.cosine_similarity(z[:, None], self.codes[None], dim=-1) / tau
        losses["code_contrast"] = functional.cross_entropy(to_codes, matched)
        losses["contrast"] = self.contrast_loss(z, other, matched)
        return losses

    def prediction_loss(
        self, obs: Tensor, action: Tensor, reward: Tensor, next_obs: Tensor, z: Tensor
    ) -> Tensor:
        """Equations (4) to (9): norms of both predictors' errors, a sum over transitions."""
        repeated = z[:, None].expand(-1, obs.shape[1], -1)
        mean, std = self.statistics.target
        reward_error = self.networks["reward"](obs, action, repeated) - (reward - mean[0]) / std[0]
        change = (next_obs - obs - mean[1:]) / std[1:]
        state_error = self.networks["state"](obs, action, repeated) - change
        norms = [(e.square().sum(-1) + 1e-12).sqrt().sum(-1) for e in (reward_error, state_error)]
        loss: Tensor = (norms[0] + norms[1]).mean()
        return loss

    def contrast_loss(self, z: Tensor, other: Tensor, matched: Tensor) -> Tensor:
        """Equation (10), task by task."""
        tasks = len(z)
        keys = torch.rand(tasks, tasks, generator=self.generator).fill_diagonal_(2.0)
        logits = functional.cosine_similarity(z[:, None], other[None], dim=-1) / self.context.tau
        total = torch.zeros(())
        for k in range(tasks):
            group = matched == matched[k]
            size = int(group.sum())
            if size == 1:
                drawn = keys[k].argsort()[: min(self.context.extra_negatives, tasks - 1)]
                group[drawn] = True
            total = total + (logits[k, group].logsumexp(dim=0) - logits[k, k]) / size
        return total / self.context.codes

    def sample_actions(self, obs: Tensor, z: Tensor) -> Sampled:
        """Actions that the policy draws."""
        mean, free = self.networks["actor"](obs, z).chunk(2, dim=-1)
        log_std = free + (free.clamp(-20.0, 0.0) - free).detach()
        if free.requires_grad:  # outside the bounds, only gradients that lead back inside
            above, below = free > 0, free < -20
            free.register_hook(lambda g: torch.where(above, g.clamp(min=0), g))
            free.register_hook(lambda g: torch.where(below, g.clamp(max=0), g))
        noise = torch.randn(mean.shape, generator=self.generator)
        drawn = torch.tanh(mean + log_std.exp() * noise)
        density = -0.5 * noise.square() - log_std - 0.5 * math.log(2 * math.pi)
        return drawn, (density - torch.log(1 - drawn.square() + 1e-6)).sum(dim=1), mean, log_std

    def actor_critic_losses(
        self, batch: Batch, z: Tensor, further: Sequence[Batch]
    ) -> dict[str, Tensor]:
        """Losses of critics, value network and actor, in units of the scaled rewards."""
        config, networks = self.actor_critic, self.networks
        obs, action, reward, next_obs, terminal = batch
        with torch.no_grad():
            future = self.target_value(next_obs, z)[:, 0]
            target = reward + config.gamma * (1 - terminal) * future
        q_data = [networks[name](obs, action, z)[:, 0] for name in ("critic_1", "critic_2")]
        critic = functional.mse_loss(q_data[0], target) + functional.mse_loss(q_data[1], target)
        drawn, log_prob, mean, log_std = self.sample_actions(obs, z)
        q_drawn = [networks[name](obs, drawn, z)[:, 0] for name in ("critic_1", "critic_2")]
        q = torch.min(q_drawn[0], q_drawn[1])
        entropy = 1 / config.reward_scale
        value_target = (q - entropy * log_prob).detach()
        value = functional.mse_loss(networks["value"](obs, z)[:, 0], value_target)
        actor = (entropy * log_prob - q).mean()
        small = mean.square().mean() + log_std.square().mean()
        actor = actor + entropy * config.regularizer * small
        losses = {"critic": critic, "value": value}
        if config.behavior_regularization:
            losses["dual_critic"] = self.train_dual([batch, *further], drawn.detach(), z)
            divergence = self.divergence(obs, action, drawn, z)
            actor = actor + entropy * self.multiplier * divergence.mean()
            moved = self.multiplier + divergence.mean().detach() - config.divergence_target
            self.multiplier = moved.clamp(0.0, config.divergence_maximum)
        return losses | {"actor": actor}

    def divergence(self, obs: Tensor, action: Tensor, drawn: Tensor, z: Tensor) -> Tensor:
        """BRAC's dual estimate of the divergence of each transition."""
        at_policy = functional.softplus(self.networks["dual"](obs, drawn, z)[:, 0])
        at_data = functional.softplus(self.networks["dual"](obs, action, z)[:, 0])
        return torch.log(at_policy + 1e-8) - at_data + 1

    def train_dual(self, batches: Sequence[Batch], drawn: Tensor, z: Tensor) -> Tensor:
        """A step of the dual critic on each batch; mean of its losses."""
        all_drawn = [drawn]
        if count := len(batches) - 1:
            obs = torch.cat([batch[0] for batch in batches[1:]])
            with torch.no_grad():
                all_drawn += self.sample_actions(obs, z.repeat(count, 1))[0].chunk(count)
        losses = [
            self.step_dual(obs, action, drawn, z)
            for (obs, action, *_), drawn in zip(batches, all_drawn, strict=True)
        ]
        return torch.stack(losses).mean()

    def step_dual(self, obs: Tensor, action: Tensor, drawn: Tensor, z: Tensor) -> Tensor:
        """A step of the dual critic; its loss."""
        share = torch.rand(len(action), 1, generator=self.generator)
        between = self.networks["dual"](obs, drawn + share * (action - drawn), z)[:, 0]
        penalty = 5 * ((1e-8 + between.square()).sqrt() - 1).clamp_min(0).square().mean()
        loss = penalty - self.divergence(obs, action, drawn, z).mean()
        self.optimizers["dual"].zero_grad()
        loss.backward()
        self.optimizers["dual"].step()
        detached: Tensor = loss.detach()
        return detached
