"""CTMRL: contexts shaped by a codebook of cross-task contexts, the CQ-VAE of the source paper."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from ctmrl import cqvae
from ctmrl.codebook import Codebook, check_codes, usage
from ctmrl.methods.base import Dimensions, Method, MethodConfig
from ctmrl.metric import focal_metric_loss
from ctmrl.networks import Predictors, Statistics, mean_encoding
from ctmrl.numbers import Source
from ctmrl.schedule import COLLECTIONS, Schedule

__all__ = ["COLLECTIONS", "CTMRL", "CTMRLConfig"]


@dataclass(frozen=True)
class CTMRLConfig(MethodConfig):
    """Hyper-parameters of CTMRL; the four switches are the ablations of the paper's Table 2."""

    codes: int = 8
    """N, codes in the codebook; fewer than training tasks."""
    code_contrast: bool = True
    """Use L_C, equation (3)."""
    cross_prediction: bool = True
    """Use L_pre^cro, equations (7) to (9)."""
    kmeans: bool = True
    """Place and refresh the codes by K-means; off: random unit vectors, no refresh."""
    contrast: bool = True
    """Use L_contra, equation (10)."""
    tau: float = 0.1
    """Temperature of equations (3) and (10)."""
    eta: float = 0.1
    """Learning rate of the codes, equation (2)."""
    extra_negatives: int = 8
    """M, negatives of a task that is alone with its code."""
    warm_up: float = 0.1
    """Share of the steps before the codebook is used; contexts are collected in its last third."""
    refresh: float = 0.05
    """Share of the steps between two K-means refreshes."""
    code_contrast_weight: float = 0.1
    """Weight of L_C, averaged over tasks."""
    cross_prediction_weight: float = 0.1
    """Weight of L_pre^cro, averaged over tasks and transitions."""
    contrast_weight: float = 0.1
    """Weight of L_contra."""
    metric_weight: float = 0.0
    """Weight of FOCAL's metric loss, which the released code adds (10) and the paper lacks."""
    squared_errors: bool = False
    """Square the norms of equations (4), (5), (7) and (8), as the released code does. The norm of a
    reward's error is least at its median, which is 0 where rewards are rare."""
    predictor_hidden: tuple[int, ...] = (64, 64)
    """Widths of the predictors' hidden layers."""


class CTMRL(Method):
    """CTMRL: encoder, codebook, and reward and state predictors, trained end to end."""

    context_sets = 2

    def __init__(self, config: CTMRLConfig, statistics: Statistics, dims: Dimensions) -> None:
        """Build the CQ-VAE.

        Raises:
            UsageError: not fewer codes than training tasks, or none.
        """
        super().__init__(config, statistics, dims)
        check_codes(config.codes, dims.tasks)
        self.config = config
        self.predictors = Predictors(statistics, dims.act, config.z_dim, config.predictor_hidden)
        start = torch.Generator().manual_seed(int(torch.randint(2**31, ())))
        self.codebook = Codebook(config.codes, config.z_dim, start)
        self.collected: Tensor
        empty = torch.zeros(COLLECTIONS, dims.tasks, config.z_dim)
        self.register_buffer("collected", empty)
        self._schedule = Schedule(config.warm_up, config.refresh, dims.steps)

    def before_step(self, step: int, all_contexts: Callable[[], Tensor]) -> None:
        """Collect contexts, place the codebook after the warm-up, refresh it at its interval."""
        if not self.config.kmeans:
            if step == self._schedule.start:
                self.codebook.placed.fill_(True)
            return
        for slot in self._schedule.slots(step):
            self.collected[slot] = all_contexts()
        if self._schedule.ends_interval(step):
            contexts = self.collected.flatten(0, 1)
            if self.codebook.placed:
                self.codebook.refresh(contexts, self.config.eta, seed=step)
            else:
                self.codebook.place(contexts, seed=step)

    @property
    def phase(self) -> bool:
        """Whether the codebook is in use."""
        return bool(self.codebook.placed)

    def context_loss(
        self, contexts: Tensor, encodings: Tensor, generator: Source
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Equations (3) to (10); the codebook's terms are 0 until the warm-up is over."""
        config, zero = self.config, torch.zeros((), device=contexts.device)
        anchors, positives = mean_encoding(encodings)
        tasks, n = contexts.shape[1:3]
        losses = {"spe_prediction": zero, "metric": zero}
        losses |= {"code_contrast": zero, "cro_prediction": zero, "contrast": zero}
        matched = self.codebook.match(anchors)
        if self.codebook.placed:
            self.codebook.update(anchors.detach(), matched, config.eta)
            codes = self.codebook.codes
            if config.contrast:
                negatives = cqvae.hard_negatives(matched, config.extra_negatives, generator)
                losses["contrast"] = cqvae.hard_contrast_loss(
                    anchors, positives, matched, negatives, config.tau, len(codes)
                )
            if config.code_contrast:
                losses["code_contrast"] = (
                    cqvae.code_contrast_loss(anchors, codes, matched, config.tau) / tasks
                )
        spe, cro = self._prediction(contexts[0], anchors, matched)
        losses["spe_prediction"] = spe / n
        losses["cro_prediction"] = cro / n
        if config.metric_weight:
            losses["metric"] = focal_metric_loss(anchors)
        total = (
            losses["spe_prediction"]
            + config.cross_prediction_weight * losses["cro_prediction"]
            + config.code_contrast_weight * losses["code_contrast"]
            + config.contrast_weight * losses["contrast"]
            + config.metric_weight * losses["metric"]
        )
        metrics = {f"loss/encoder/{name}": value.detach() for name, value in losses.items()}
        return total, metrics | usage(matched, config.codes)

    def _prediction(self, context: Tensor, z: Tensor, matched: Tensor) -> tuple[Tensor, Tensor]:
        """L_pre^spe and L_pre^cro, equations (6) and (9), each a mean over tasks."""
        o, a = self.dims.obs, self.dims.act
        obs, action, reward, next_obs = torch.split(context, [o, a, 1, o], dim=-1)
        targets = self.predictors.targets(reward, obs, next_obs)
        used = [z]
        if self.codebook.placed and self.config.cross_prediction:
            # The value is the code's; the gradient reaches both the code and the context, whose
            # matching to the code has none of its own.
            used.append(self.codebook.codes[matched] + z - z.detach())
        n, squared = context.shape[1], self.config.squared_errors
        conditions = torch.stack(used)[:, :, None].expand(-1, -1, n, -1)
        many = len(used)
        predicted = self.predictors(
            obs.expand(many, *obs.shape), action.expand(many, *action.shape), conditions
        )
        per_task = cqvae.prediction_loss(
            cqvae.reward_prediction_loss(predicted[0], targets[0], squared),
            cqvae.state_prediction_loss(predicted[1], targets[1], squared),
        )
        means = per_task.mean(dim=1)
        return means[0], means[1] if many == 2 else torch.zeros((), device=z.device)

    @property
    def codes(self) -> Tensor | None:
        """The codebook's, [N, Z]; None before the warm-up is over."""
        return self.codebook.codes.detach() if self.codebook.placed else None

    def code_of(self, z: Tensor) -> Tensor | None:
        """Equation (1); None before the warm-up is over."""
        return self.codebook.match(z) if self.codebook.placed else None
