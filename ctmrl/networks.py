"""The networks of every method: plain multi-layer perceptrons with ReLU."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from ctmrl.bounds import bounded
from ctmrl.numbers import Source, normal
from ctmrl.precision import lowered

LOG_STD_RANGE = (-20.0, 0.0)
"""Bounds of the policy's log standard deviation, as in the field's code since FOCAL."""

LARGEST_ACTION = 0.9999
"""Of the data's, where their density is asked for: before the tanh, 1 is infinitely far out."""

BLOCK = 1024
"""Rows a critic evaluates at once on a processor in float32, and differentiates at once: what they
need stays in the second cache."""
MLP_BLOCK = 4096
"""The same of the other networks, and of critics in bfloat16: docs/speed.md has what both gain."""

RUNNING_RATE = 0.01
"""A batch's share in running statistics, from the hundredth on."""
LARGEST_CONTEXT = 10.0
"""Of standardised ones, where a task's is far from those of training."""

Layers = list[tuple[Tensor, Tensor]]
"""Weight and bias of each layer: of a critic [heads, in, out] and [heads, 1, out], else as
PyTorch's linear layer has them."""


class MLP(nn.Sequential):
    """Linear layers with ReLU between them, in the precision that is set and in blocks of rows."""

    def forward(self, x: Tensor) -> Tensor:
        """[*, in] -> [*, out], of the same type."""
        linear = [layer for layer in self if isinstance(layer, nn.Linear)]
        layers = [(lowered(layer.weight), lowered(layer.bias)) for layer in linear]
        rows = lowered(x).reshape(-1, x.shape[-1])
        size = MLP_BLOCK if x.device.type == "cpu" else len(rows)
        blocks = [_through(block, layers) for block in torch.split(rows, size)]
        out = torch.cat(blocks) if len(blocks) > 1 else blocks[0]
        return out.reshape(*x.shape[:-1], out.shape[-1]).to(x.dtype)


def _through(h: Tensor, layers: Layers) -> Tensor:
    """Outputs [n, out] of inputs [n, in]."""
    *hidden, last = layers
    for weight, bias in hidden:
        h = torch.relu_(functional.linear(h, weight, bias))
    return functional.linear(h, *last)


def mlp(in_dim: int, hidden: tuple[int, ...], out_dim: int) -> MLP:
    """ReLU network [*, in_dim] -> [*, out_dim]."""
    layers: list[nn.Module] = []
    for width in hidden:
        layers += [nn.Linear(in_dim, width), nn.ReLU(inplace=True)]
        in_dim = width
    return MLP(*layers, nn.Linear(in_dim, out_dim))


class Standardize(nn.Module):
    """(x - mean) / std with fixed statistics of the training data; constant columns pass as 0."""

    mean: Tensor
    scale: Tensor

    def __init__(self, mean: Tensor, std: Tensor) -> None:
        """Keep the statistics, each [D], as buffers, so that a checkpoint carries them."""
        super().__init__()
        self.register_buffer("mean", mean.clone())
        self.register_buffer("scale", torch.where(std > 1e-6, 1.0 / std.clamp_min(1e-6), 0.0))

    def forward(self, x: Tensor) -> Tensor:
        """Standardised x, [*, D]."""
        return (x - self.mean) * self.scale

    def inverse(self, standardized: Tensor) -> Tensor:
        """The x, [*, D], that `forward` standardises to this; the mean in constant columns."""
        std = torch.where(self.scale > 0, self.scale.reciprocal(), 0.0)
        return self.mean + standardized * std


class RunningStandardize(nn.Module):
    """(x - mean) / std, within bounds, with statistics that follow what it is shown in training.

    They are means over all batches until a batch's share is RUNNING_RATE, then exponential ones.
    The variance is that within a batch, so what moves all rows leaves it alone.
    """

    shown: Tensor
    mean: Tensor
    variance: Tensor

    def __init__(self, size: int) -> None:
        """Begin with statistics [size] that change nothing, as buffers."""
        super().__init__()
        self.register_buffer("shown", torch.zeros(()))
        self.register_buffer("mean", torch.zeros(size))
        self.register_buffer("variance", torch.ones(size))

    @torch.no_grad()
    def show(self, x: Tensor) -> None:
        """Let the statistics follow a batch x, [n, size]."""
        self.shown.add_(1.0)
        rate = self.shown.reciprocal().clamp_min(RUNNING_RATE)
        mean = x.mean(dim=0)
        self.mean.lerp_(mean, rate)
        self.variance.lerp_((x - mean).square().mean(dim=0), rate)

    def forward(self, x: Tensor) -> Tensor:
        """Standardised x, [*, size], within LARGEST_CONTEXT; constant columns pass as 0."""
        scale = torch.where(self.variance > 1e-12, self.variance.clamp_min(1e-12).rsqrt(), 0.0)
        return ((x - self.mean) * scale).clamp(-LARGEST_CONTEXT, LARGEST_CONTEXT)


class Statistics(NamedTuple):
    """Mean and standard deviation of the training tasks' data.

    Attributes:
        obs: two tensors [O].
        context: two tensors [O + A + 1 (+ O)], of (s, a, r) and, where contexts have it, s' - s.
        target: two tensors [1 + O], of (r, s' - s), what the predictors predict.
        params: two tensors [P], of the tasks' parameters.
    """

    obs: tuple[Tensor, Tensor]
    context: tuple[Tensor, Tensor]
    target: tuple[Tensor, Tensor]
    params: tuple[Tensor, Tensor]


class Encoder(nn.Module, ABC):
    """Context transitions -> encodings of size Z; a context is their mean.

    Attributes:
        z_dim: Z.
        sees_dense_reward: whether r is the dense reward of a sparse environment.
    """

    def __init__(self, z_dim: int, sees_dense_reward: bool = False) -> None:
        """Note the size."""
        super().__init__()
        self.z_dim, self.sees_dense_reward = z_dim, sees_dense_reward

    @abstractmethod
    def forward(self, context: Tensor) -> Tensor:
        """Encodings e(h), [*, n, Z], of transitions (s, a, r, s'), [*, n, O + A + 1 + O]."""

    def told(self, z: Tensor, params: Tensor) -> Tensor:
        """What the policy is told, [*, Z]: the contexts, unless this is a reference's encoder.

        Args:
            z: contexts, 0 where there is no transition yet, [*, Z].
            params: true parameters of their tasks, [*, P], which only a reference may look at.
        """
        return z

    def show(self, contexts: Tensor) -> None:
        """Let what `scaled` does follow a training batch's contexts, [*, Z]."""

    def scaled(self, told: Tensor) -> Tensor:
        """What the networks of the actor-critic get for what the policy is told, [*, Z]."""
        return told


def mean_encoding(encodings: Tensor) -> Tensor:
    """Task-specific contexts c^spe = mean_t e(h^t), [*, n, Z] -> [*, Z]."""
    return encodings.mean(dim=-2)


class BlindEncoder(Encoder):
    """Sees nothing: contexts are 0."""

    def forward(self, context: Tensor) -> Tensor:
        """Zeros [*, n, Z]."""
        return context.new_zeros(*context.shape[:-1], self.z_dim)


class ContextEncoder(Encoder):
    """e(h): encodings in (-1, 1)."""

    def __init__(
        self,
        statistics: tuple[Tensor, Tensor],
        obs_dim: int,
        hidden: tuple[int, ...],
        z_dim: int,
        sees_dense_reward: bool = False,
        standardize_contexts: bool = False,
    ) -> None:
        """Build the network; whether it sees s' follows from the statistics' size."""
        super().__init__(z_dim, sees_dense_reward)
        self.obs_dim = obs_dim
        self.standardize = Standardize(*statistics)
        self.in_dim = len(statistics[0])
        self.net = mlp(self.in_dim, hidden, z_dim)
        self.running = RunningStandardize(z_dim) if standardize_contexts else None

    def show(self, contexts: Tensor) -> None:
        """Let the statistics follow contexts [*, Z], if there are any."""
        if self.running is not None:
            self.running.show(contexts.flatten(0, -2))

    def scaled(self, told: Tensor) -> Tensor:
        """Standardised contexts [*, Z], 0 where there is no transition yet; or the contexts."""
        if self.running is None:
            return told
        nothing = (told == 0).all(dim=-1, keepdim=True)
        return torch.where(nothing, 0.0, self.running(told))

    def forward(self, context: Tensor) -> Tensor:
        """Encodings e(h), [*, n, Z], of transitions (s, a, r, s'), [*, n, O + A + 1 + O]."""
        features = context[..., : self.in_dim]
        if self.in_dim == context.shape[-1]:
            # s' - s instead of s': what the dynamics did, on a scale of its own.
            change = context[..., -self.obs_dim :] - context[..., : self.obs_dim]
            features = torch.cat([context[..., : -self.obs_dim], change], dim=-1)
        encoded: Tensor = torch.tanh(self.net(self.standardize(features)))
        return encoded


class ActionSample(NamedTuple):
    """A reparameterised action with what its loss needs; A is the action's size.

    Attributes:
        action: tanh(mean + std * noise), [*, A].
        log_prob: log density of the action, [*].
        mean: before the tanh, [*, A].
        log_std: within LOG_STD_RANGE, [*, A].
    """

    action: Tensor
    log_prob: Tensor
    mean: Tensor
    log_std: Tensor

    def log_prob_of(self, action: Tensor) -> Tensor:
        """Log density, [*], that the policy gives to other actions [*, A] for the same inputs."""
        inside = action.clamp(-LARGEST_ACTION, LARGEST_ACTION)
        noise = (torch.atanh(inside) - self.mean) / self.log_std.exp()
        return _log_prob(noise, self.log_std, inside)


def _log_prob(noise: Tensor, log_std: Tensor, action: Tensor) -> Tensor:
    """Log density, [*], of actions [*, A] that are the tanh of mean + std * noise."""
    gaussian = -0.5 * noise.square() - log_std - 0.5 * math.log(2 * math.pi)
    return (gaussian - torch.log(1 - action.square() + 1e-6)).sum(dim=-1)


class Actor(nn.Module):
    """Tanh-Gaussian policy pi(a | s, z)."""

    def __init__(
        self,
        statistics: tuple[Tensor, Tensor],
        z_dim: int,
        hidden: tuple[int, ...],
        act_dim: int,
    ) -> None:
        """Build the network; `statistics` are of the observations."""
        super().__init__()
        self.standardize = Standardize(*statistics)
        self.net = mlp(len(statistics[0]) + z_dim, hidden, 2 * act_dim)

    def forward(self, obs: Tensor, z: Tensor) -> tuple[Tensor, Tensor]:
        """Mean before the tanh and bounded log standard deviation, each [*, A]."""
        out = self.net(torch.cat([self.standardize(obs), z], dim=-1))
        mean, log_std = out.chunk(2, dim=-1)
        return mean, bounded(log_std, *LOG_STD_RANGE)

    def sample(self, obs: Tensor, z: Tensor, generator: Source) -> ActionSample:
        """Draw actions [*, A] for observations [*, O] and contexts [*, Z]."""
        mean, log_std = self(obs, z)
        noise = normal(generator, *mean.shape)
        pre_tanh = mean + log_std.exp() * noise
        action = torch.tanh(pre_tanh)
        return ActionSample(action, _log_prob(noise, log_std, action), mean, log_std)

    @torch.no_grad()
    def act(self, obs: Tensor, z: Tensor) -> Tensor:
        """Deterministic actions tanh(mean), [*, A]."""
        return torch.tanh(self(obs, z)[0])


def frozen(layers: Layers) -> Layers:
    """The same layers, but gradients reach the inputs alone."""
    return [(weight.detach(), bias.detach()) for weight, bias in layers]


class Critic(nn.Module):
    """One or two scalar functions of (s, z) or (s, a, z), evaluated as one batched network."""

    def __init__(
        self,
        statistics: tuple[Tensor, Tensor],
        extra_dim: int,
        hidden: tuple[int, ...],
        heads: int,
    ) -> None:
        """Build `heads` independent networks; `extra_dim` is the size of what stands beside s."""
        super().__init__()
        self.standardize = Standardize(*statistics)
        sizes = (len(statistics[0]) + extra_dim, *hidden, 1)
        self.weights = nn.ParameterList()
        self.biases = nn.ParameterList()
        for fan_in, fan_out in pairwise(sizes):
            layers = [nn.Linear(fan_in, fan_out) for _ in range(heads)]
            self.weights.append(torch.stack([layer.weight.detach().T for layer in layers]))
            self.biases.append(torch.stack([layer.bias.detach()[None] for layer in layers]))

    @torch.no_grad()
    def shift(self, value: float) -> None:
        """Add a number to all values."""
        self.biases[-1].add_(value)

    def layers(self) -> Layers:
        """The parameters as the matrix products take them, the last layer's as they are.

        Bfloat16 has 8 bits, and returns of 100 and more differ between actions by less than the
        ninth: the last layer, of width 1, is in float32 always.
        """
        *hidden, last = zip(self.weights, self.biases, strict=True)
        return [*((lowered(weight), lowered(bias)) for weight, bias in hidden), last]

    def forward(self, obs: Tensor, *others: Tensor, layers: Layers | None = None) -> Tensor:
        """Values [heads, n] of observations [n, O] and what stands beside them, each [n, D].

        Args:
            obs: observations.
            *others: actions and contexts.
            layers: this critic's `layers`, which calls may share; perhaps `frozen`.
        """
        layers = layers or self.layers()
        x = torch.cat([self.standardize(obs), *others], dim=-1)
        rows = lowered(x)
        most = MLP_BLOCK if rows.dtype is torch.bfloat16 else BLOCK
        size = most if x.device.type == "cpu" else len(x)
        blocks = [_values(block, layers) for block in torch.split(rows, size)]
        return torch.cat(blocks, dim=1).to(x.dtype)


def _values(x: Tensor, layers: Layers) -> Tensor:
    """Values [heads, n] of inputs [n, in]."""
    h = x.expand(len(layers[0][0]), *x.shape)
    *hidden, (weight, bias) = layers
    for weights, biases in hidden:
        h = torch.relu_(torch.baddbmm(biases, h, weights))
    return torch.baddbmm(bias, h.to(weight.dtype), weight)[..., 0]


class Predictors(nn.Module):
    """Context-based reward and state predictors, r(s, a, c) and s'(s, a, c)."""

    def __init__(
        self,
        statistics: Statistics,
        act_dim: int,
        z_dim: int,
        hidden: tuple[int, ...],
    ) -> None:
        """Build both networks; they predict in units of the targets' standard deviations."""
        super().__init__()
        obs_dim = len(statistics.obs[0])
        self.standardize = Standardize(*statistics.obs)
        self.standardize_target = Standardize(*statistics.target)
        self.reward_net = mlp(obs_dim + act_dim + z_dim, hidden, 1)
        self.state_net = mlp(obs_dim + act_dim + z_dim, hidden, obs_dim)

    def forward(self, obs: Tensor, action: Tensor, z: Tensor) -> tuple[Tensor, Tensor]:
        """Standardised rewards [*, 1] and state changes [*, O]."""
        x = torch.cat([self.standardize(obs), action, z], dim=-1)
        return self.reward_net(x), self.state_net(x)

    def targets(self, reward: Tensor, obs: Tensor, next_obs: Tensor) -> tuple[Tensor, Tensor]:
        """What `forward` should give: rewards [*, 1] and observations [*, O] to both."""
        both = self.standardize_target(torch.cat([reward, next_obs - obs], dim=-1))
        return both[..., :1], both[..., 1:]
