"""FOCAL: contexts trained by a distance metric alone."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from ctmrl.methods.base import Dimensions, Method, MethodConfig
from ctmrl.metric import focal_metric_loss
from ctmrl.networks import Statistics, mean_encoding
from ctmrl.numbers import Source


@dataclass(frozen=True)
class FOCALConfig(MethodConfig):
    """Hyper-parameters of FOCAL."""

    metric_weight: float = 10.0
    """Weight of the metric loss."""


class FOCAL(Method):
    """[FOCAL] Li, Yang and Luo 2021: push the contexts of different tasks apart."""

    def __init__(self, config: FOCALConfig, statistics: Statistics, dims: Dimensions) -> None:
        """Nothing but the encoder."""
        super().__init__(config, statistics, dims)
        self.config = config

    def context_loss(
        self, contexts: Tensor, encodings: Tensor, generator: Source
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """The weighted metric loss."""
        metric = focal_metric_loss(mean_encoding(encodings[0]))
        return self.config.metric_weight * metric, {"loss/encoder/metric": metric.detach()}
