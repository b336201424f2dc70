"""CTMRL as its published code has it: what the code computes, where the paper says otherwise."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from ctmrl.club import BehaviorModel, club_loss, likelihood_loss
from ctmrl.codebook import check_codes, usage
from ctmrl.ema_codebook import EMACodebook
from ctmrl.methods.base import Dimensions, Method, MethodConfig
from ctmrl.metric import focal_metric_loss
from ctmrl.networks import Predictors, Statistics, mean_encoding
from ctmrl.numbers import Source
from ctmrl.schedule import COLLECTIONS, Schedule


@dataclass(frozen=True)
class CTMRLReleasedConfig(MethodConfig):
    """Hyper-parameters of CTMRL's published code, with its values for the point robots."""

    codes: int = 8
    """N, codes in the codebook; fewer than training tasks."""
    code_decay: float = 0.9
    """Share of a code's moving averages that stays at a step; the published code, which updates
    them four times a step, amounts to 0.9 ** 4 = 0.6561."""
    warm_up: float = 0.3
    """Share of the steps before the codebook is used; contexts are collected in its last third."""
    refresh: float = 0.05
    """Share of the steps between two K-means refreshes."""
    metric_weight: float = 10.0
    """Weight of FOCAL's metric loss."""
    club_weight: float = 25.0
    """Weight of CSRO's CLUB term."""
    commitment_weight: float = 0.25
    """Weight of the squared distance between contexts and their codes."""
    cycle_weight: float = 1.0
    """Weight of the latent cycle: codes against the encodings of what they predict."""
    contrast_weight: float = 1.0
    """Weight of the contrast between tasks of the same code."""
    predictor_hidden: tuple[int, ...] = (64, 64)
    """Widths of the predictors' hidden layers."""


def commitment_loss(contexts: Tensor, codes: Tensor) -> Tensor:
    """Mean over coordinates of (C - z)^2.

    Args:
        contexts: z, [B, Z].
        codes: the code C of each context, [B, Z].

    Returns:
        Scalar.
    """
    return (codes - contexts).square().mean()


def cycle_loss(codes: Tensor, encodings: Tensor) -> Tensor:
    """Mean over transitions and coordinates of (C - e(s, a, r^(s, a, C), s^(s, a, C)))^2.

    Args:
        codes: the code C of each task, [B, Z].
        encodings: of the n transitions predicted from it, [B, n, Z].

    Returns:
        Scalar.
    """
    return (codes[:, None] - encodings).square().mean()


def bilinear_contrast_loss(
    anchors: Tensor, positives: Tensor, matched: Tensor, bilinear: Tensor
) -> Tensor:
    """InfoNCE between the tasks of one code, by a bilinear form instead of a cosine.

    With members k, l of a code, the logits z'_k W z_l and l = k the right answer: the cross-entropy
    is averaged over a code's members and summed over the codes. A code's only member adds 0; with
    a single code in the batch all is 0.

    Args:
        anchors: z, [B, Z].
        positives: z' of the same tasks from other episodes, [B, Z].
        matched: int64 [B], code each task matches.
        bilinear: W, [Z, Z].

    Returns:
        Scalar.
    """
    same = matched[:, None] == matched[None, :]
    logits = positives @ bilinear @ anchors.T
    per_task = logits.masked_fill(~same, -torch.inf).logsumexp(dim=1) - logits.diagonal()
    return torch.where(same.all(), 0.0, (per_task / same.sum(dim=1)).sum())


class CTMRLReleased(Method):
    """The published code: FOCAL and CLUB throughout, after the warm-up the codebook's terms."""

    context_sets = 2
    bilinear: Tensor
    collected: Tensor

    def __init__(
        self, config: CTMRLReleasedConfig, statistics: Statistics, dims: Dimensions
    ) -> None:
        """Build encoder, predictors, behaviour model, codebook and the frozen bilinear form.

        Raises:
            UsageError: not fewer codes than training tasks, or none.
        """
        super().__init__(config, statistics, dims)
        check_codes(config.codes, dims.tasks)
        self.config = config
        self.predictors = Predictors(statistics, dims.act, config.z_dim, config.predictor_hidden)
        mean, std = (part[: dims.obs + dims.act] for part in statistics.context)
        self.behavior_model = BehaviorModel((mean, std), config.encoder_hidden, config.z_dim)
        start = torch.Generator().manual_seed(int(torch.randint(2**31, ())))
        self.codebook = EMACodebook(config.codes, config.z_dim, start)
        # No optimiser of the published code holds it, so it keeps its random values.
        self.register_buffer("bilinear", torch.rand(config.z_dim, config.z_dim, generator=start))
        self.register_buffer("collected", torch.zeros(COLLECTIONS, dims.tasks, config.z_dim))
        self._schedule = Schedule(config.warm_up, config.refresh, dims.steps)

    def before_step(self, step: int, all_contexts: Callable[[], Tensor]) -> None:
        """Collect contexts, place the codebook after the warm-up; then collect codes, refresh it.

        Once the codebook is in use it is each task's code that is collected, not its context.
        """
        book = self.codebook
        for slot in self._schedule.slots(step):
            z = all_contexts()
            self.collected[slot] = book.codes[book.match(z)] if book.placed else z
        if self._schedule.ends_interval(step):
            collected = self.collected.flatten(0, 1)
            if book.placed:
                book.refresh(collected, self.config.code_decay, seed=step)
            else:
                book.place(collected, seed=step)

    @property
    def phase(self) -> bool:
        """Whether the codebook is in use."""
        return bool(self.codebook.placed)

    def context_loss(
        self, contexts: Tensor, encodings: Tensor, generator: Source
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """The sum of all terms; the codebook's are 0 until the warm-up is over.

        Objectives that the published code gives to separate optimisers share this sum: what must
        not train a network enters its term detached.
        """
        config, zero = self.config, torch.zeros((), device=contexts.device)
        anchors, positives = mean_encoding(encodings)
        mean, variance = self.behavior_model(contexts[0][..., : self.dims.obs + self.dims.act])
        losses = {
            "metric": focal_metric_loss(anchors),
            "club": club_loss(encodings[0], mean.detach(), variance.detach()),
            "club_fit": likelihood_loss(encodings[0].detach(), mean, variance),
            "prediction": self._prediction_loss(contexts[0], anchors.detach()),
        }
        losses |= {"commitment": zero, "cycle": zero, "contrast": zero}
        matched = self.codebook.match(anchors)
        if self.codebook.placed:
            codes = self.codebook.codes[matched]
            self.codebook.update(anchors.detach(), matched, config.code_decay)
            losses["commitment"] = commitment_loss(anchors, codes)
            losses["cycle"] = cycle_loss(codes, self._predicted_encodings(contexts[0], codes))
            losses["contrast"] = bilinear_contrast_loss(anchors, positives, matched, self.bilinear)
        total = (
            config.metric_weight * losses["metric"]
            + config.club_weight * losses["club"]
            + losses["club_fit"]
            + losses["prediction"]
            + config.commitment_weight * losses["commitment"]
            + config.cycle_weight * losses["cycle"]
            + config.contrast_weight * losses["contrast"]
        )
        metrics = {f"loss/encoder/{name}": value.detach() for name, value in losses.items()}
        return total, metrics | usage(matched, config.codes)

    def _prediction_loss(self, context: Tensor, z: Tensor) -> Tensor:
        """Mean squared error of rewards plus that of next states, in the targets' units."""
        o, a = self.dims.obs, self.dims.act
        obs, action, reward, next_obs = torch.split(context, [o, a, 1, o], dim=-1)
        wanted = self.predictors.targets(reward, obs, next_obs)
        found = self.predictors(obs, action, z[:, None].expand(-1, context.shape[1], -1))
        return functional.mse_loss(found[0], wanted[0]) + functional.mse_loss(found[1], wanted[1])

    def _predicted_encodings(self, context: Tensor, codes: Tensor) -> Tensor:
        """Encodings [B, n, Z] of (s, a) with the reward and next state predicted from the codes."""
        o, a = self.dims.obs, self.dims.act
        obs, action = context[..., :o], context[..., o : o + a]
        standardized = self.predictors(obs, action, codes[:, None].expand(-1, context.shape[1], -1))
        outcome = self.predictors.standardize_target.inverse(torch.cat(standardized, dim=-1))
        predicted = torch.cat([obs, action, outcome[..., :1], obs + outcome[..., 1:]], dim=-1)
        encodings: Tensor = self.encoder(predicted)
        return encodings

    @property
    def codes(self) -> Tensor | None:
        """The codebook's, [N, Z]; None before the warm-up is over."""
        return self.codebook.codes.detach() if self.codebook.placed else None

    def code_of(self, z: Tensor) -> Tensor | None:
        """The code nearest by cosine; None before the warm-up is over."""
        return self.codebook.match(z) if self.codebook.placed else None
