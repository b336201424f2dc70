"""FOCAL: its loss is the weighted metric loss of the first contexts, and nothing else."""

from __future__ import annotations

import pytest

from ctmrl.methods.focal import FOCAL, FOCALConfig
from ctmrl.metric import focal_metric_loss
from tests.ctmrl.examples import BATCH, Z, contexts, dimensions, generator, normal, statistics


def focal(weight: float = 10.0) -> FOCAL:
    config = FOCALConfig(z_dim=Z, encoder_hidden=(23,), metric_weight=weight)
    return FOCAL(config, statistics(), dimensions())


@pytest.mark.parametrize("weight", [10.0, 3.0])
def test_the_loss(weight: float) -> None:
    method, h = focal(weight), contexts(1)
    encodings = method.encoder(h)
    loss, metrics = method.context_loss(h, encodings, generator())
    wanted = focal_metric_loss(encodings[0].mean(dim=1)).item()
    assert loss.item() == pytest.approx(weight * wanted, rel=1e-6)
    assert metrics == {"loss/encoder/metric": pytest.approx(wanted, rel=1e-6)}


def test_it_has_an_encoder_and_no_codes() -> None:
    method = focal()
    assert {name.partition(".")[0] for name, _ in method.named_parameters()} == {"encoder"}
    assert method.code_of(normal(BATCH, Z).float()) is None
    assert method.context_sets == 1
