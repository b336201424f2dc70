"""CTMRL: which term trains what, its switches, and its schedule."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import pytest
import torch
from torch import Tensor

from ctmrl import cqvae
from ctmrl.codebook import Codebook, kmeans
from ctmrl.errors import UsageError
from ctmrl.methods.ctmrl import COLLECTIONS, CTMRL, CTMRLConfig
from ctmrl.metric import focal_metric_loss
from ctmrl.networks import mean_encoding
from tests.ctmrl.examples import (
    ACT,
    BATCH,
    CODES,
    LENGTH,
    OBS,
    TASKS,
    Z,
    contexts,
    ctmrl,
    generator,
    normal,
    with_switches,
)

OFF: dict[str, Any] = {"code_contrast": False, "cross_prediction": False, "contrast": False}
WEIGHTS: dict[str, Any] = {
    "code_contrast_weight": 0.7,
    "cross_prediction_weight": 1.3,
    "contrast_weight": 0.4,
}


def placed(**changes: Any) -> CTMRL:
    """A method in double precision with the warm-up behind it."""
    method = ctmrl(**(WEIGHTS | changes))
    method.double()
    method.codebook.placed.fill_(True)
    return method


def loss_and_gradients(method: CTMRL, seed: int = 3) -> tuple[float, dict[str, Tensor]]:
    """The loss of a copy of the method, and the gradient of each of its parameters."""
    method = with_switches(method)
    h = contexts().double()
    loss, _ = method.context_loss(h, method.encoder(h), generator(seed))
    loss.backward()  # type: ignore[no-untyped-call]
    return loss.item(), {
        name: torch.zeros_like(p) if p.grad is None else p.grad
        for name, p in method.named_parameters()
    }


def of_a_term(method: CTMRL, switch: str) -> tuple[float, dict[str, Tensor]]:
    """What the switch alone adds to the loss and to the gradients, all else off."""
    value, gradients = loss_and_gradients(with_switches(method, **(OFF | {switch: True})))
    rest, others = loss_and_gradients(with_switches(method, **OFF))
    return value - rest, {name: gradients[name] - others[name] for name in gradients}


def trained(gradients: dict[str, Tensor]) -> set[str]:
    """The parts of a method that a gradient reaches."""
    reached = (name for name, gradient in gradients.items() if gradient.abs().max() > 1e-10)
    return {name.partition(".")[0] for name in reached}


def parts(method: CTMRL) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Contexts, anchors, positives, and the codes as they are when the losses are taken."""
    h = contexts().double()
    anchors, positives = mean_encoding(method.encoder(h))
    codes = method.codebook.codes
    matched = cqvae.match(anchors, codes)
    moved = cqvae.moving_update(codes, anchors, matched, method.config.eta)
    return h, anchors, positives, moved.detach().requires_grad_()


def predictions(method: CTMRL, h: Tensor, z: Tensor) -> Tensor:
    """L_pre of equations (4) to (9), averaged over tasks and transitions, by a loop over tasks."""
    total = torch.zeros(())
    obs, action, reward, next_obs = torch.split(h[0], [OBS, ACT, 1, OBS], dim=-1)
    wanted_reward, wanted_change = method.predictors.targets(reward, obs, next_obs)
    for i in range(BATCH):
        got_reward, got_change = method.predictors(obs[i], action[i], z[i].expand(LENGTH, Z))
        for t in range(LENGTH):
            errors = got_reward[t] - wanted_reward[i, t], got_change[t] - wanted_change[i, t]
            for error in errors:
                total = total + error.norm() ** (2 if method.config.squared_errors else 1)
    return total / BATCH / LENGTH


def assert_gradients(
    found: dict[str, Tensor], wanted: Tensor, method: CTMRL, codes: Tensor, scale: float = 1.0
) -> None:
    """Compare gradients with those of a loss that was put together here."""
    named = dict(method.named_parameters())
    named["codebook.codes"] = codes  # type: ignore[assignment] # a leaf, if no Parameter
    inputs = [parameter for parameter in named.values() if parameter.requires_grad]
    gradients = torch.autograd.grad(scale * wanted, inputs, allow_unused=True)
    for name, gradient in zip(named, gradients, strict=True):
        expected = torch.zeros_like(found[name]) if gradient is None else gradient
        torch.testing.assert_close(found[name], expected, rtol=1e-6, atol=1e-9, msg=name)


@pytest.mark.parametrize("squared", [False, True])
def test_l_pre_spe_trains_encoder_and_predictors_but_not_the_codes(squared: bool) -> None:
    method = with_switches(placed(), squared_errors=squared)
    value, gradients = loss_and_gradients(with_switches(method, **OFF))
    assert trained(gradients) == {"encoder", "predictors"}
    h, anchors, _, codes = parts(method)
    wanted = predictions(method, h, anchors)
    assert value == pytest.approx(wanted.item(), rel=1e-6)
    assert_gradients(gradients, wanted, method, codes)


def test_l_c_trains_encoder_and_codes() -> None:
    method = placed()
    value, gradients = of_a_term(method, "code_contrast")
    assert trained(gradients) == {"encoder", "codebook"}
    _, anchors, _, codes = parts(method)
    matched = cqvae.match(anchors, method.codebook.codes)
    wanted = cqvae.code_contrast_loss(anchors, codes, matched, method.config.tau) / BATCH
    assert value == pytest.approx(0.7 * wanted.item(), rel=1e-6)
    assert_gradients(gradients, wanted, method, codes, 0.7)


def test_l_pre_cro_trains_codes_and_predictors_and_the_encoder_straight_through() -> None:
    method = placed()
    value, gradients = of_a_term(method, "cross_prediction")
    assert trained(gradients) == {"encoder", "codebook", "predictors"}
    h, anchors, _, codes = parts(method)
    matched = cqvae.match(anchors, method.codebook.codes)
    # The loss of codes alone gives the gradients of codes and predictors ...
    wanted = predictions(method, h, codes[matched])
    assert value == pytest.approx(1.3 * wanted.item(), rel=1e-6)
    given = codes[matched].detach().requires_grad_()
    (at_codes,) = torch.autograd.grad(predictions(method, h, given), given)
    assert_gradients(
        # ... and the encoder's are as if each task's context stood in its code's place.
        gradients,
        wanted + (anchors * at_codes).sum() - (anchors * at_codes).sum().detach(),
        method,
        codes,
        1.3,
    )


def test_l_contra_trains_the_encoder_alone() -> None:
    method = placed()
    value, gradients = of_a_term(method, "contrast")
    assert trained(gradients) == {"encoder"}
    _, anchors, positives, codes = parts(method)
    matched = cqvae.match(anchors, method.codebook.codes)
    negatives = cqvae.hard_negatives(matched, method.config.extra_negatives, generator(3))
    wanted = cqvae.hard_contrast_loss(
        anchors, positives, matched, negatives, method.config.tau, CODES
    )
    assert value == pytest.approx(0.4 * wanted.item(), rel=1e-6)
    assert_gradients(gradients, wanted, method, codes, 0.4)


def test_the_metric_term_trains_the_encoder_alone_and_is_off_by_default() -> None:
    assert CTMRLConfig().metric_weight == 0.0
    method = placed()
    plain, without = loss_and_gradients(with_switches(method, **OFF))
    value, gradients = loss_and_gradients(with_switches(method, **OFF, metric_weight=5.0))
    added = {name: gradients[name] - without[name] for name in gradients}
    assert trained(added) == {"encoder"}
    wanted = focal_metric_loss(parts(method)[1])
    assert value - plain == pytest.approx(5 * wanted.item(), rel=1e-6)


@pytest.mark.parametrize("switch", list(OFF))
def test_a_switch_removes_exactly_its_term(switch: str) -> None:
    method = placed()
    whole, gradients = loss_and_gradients(method)
    value, others = loss_and_gradients(with_switches(method, **{switch: False}))
    term, of_term = of_a_term(method, switch)
    assert abs(term) > 1e-3
    assert whole - value == pytest.approx(term, rel=1e-8)
    for name, gradient in gradients.items():
        torch.testing.assert_close(gradient - others[name], of_term[name], rtol=1e-6, atol=1e-11)


@pytest.mark.parametrize(
    ("switch", "metric"),
    [
        ("code_contrast", "code_contrast"),
        ("cross_prediction", "cro_prediction"),
        ("contrast", "contrast"),
    ],
)
def test_a_switch_shows_in_the_metrics(switch: str, metric: str) -> None:
    h = contexts().double()
    for on in (True, False):
        method = placed(**{switch: on})
        _, metrics = method.context_loss(h, method.encoder(h), generator())
        assert bool(metrics[f"loss/encoder/{metric}"] != 0) == on


def test_before_the_warm_up_is_over_only_l_pre_spe_counts() -> None:
    method = ctmrl()
    method.double()
    codes = method.codebook.codes.detach().clone()
    value, gradients = loss_and_gradients(method)
    h = contexts().double()
    loss, metrics = method.context_loss(h, method.encoder(h), generator())
    assert trained(gradients) == {"encoder", "predictors"}
    assert value == loss.item() == pytest.approx(metrics["loss/encoder/spe_prediction"].item())
    assert method.codebook.codes.equal(codes)


def test_the_codes_move_once_a_step_by_equation_2() -> None:
    method = placed(eta=0.25)
    h = contexts().double()
    encodings = method.encoder(h)
    z = mean_encoding(encodings)
    matched = cqvae.match(z[0], method.codebook.codes)
    wanted = cqvae.moving_update(method.codebook.codes, z[0], matched, 0.25).detach()
    method.context_loss(h, encodings, generator())
    torch.testing.assert_close(method.codebook.codes.detach(), wanted)


def test_the_metrics_before_their_weights() -> None:
    h = contexts().double()
    light, heavy = placed(), placed(**dict.fromkeys(WEIGHTS, 9.0))
    found = [one.context_loss(h, one.encoder(h), generator())[1] for one in (light, heavy)]
    assert found[0] == found[1]


@pytest.mark.parametrize("codes", [-1, 0, TASKS, TASKS + 1])
def test_a_wrong_number_of_codes_is_one_sentence(codes: int) -> None:
    with pytest.raises(UsageError, match=f"--codes .* {TASKS} training tasks, got {codes}$"):
        ctmrl(codes=codes)


@pytest.mark.parametrize("codes", [1, TASKS - 1])
def test_any_number_of_codes_below_that_of_tasks_works(codes: int) -> None:
    value, gradients = loss_and_gradients(placed(codes=codes))
    assert math.isfinite(value)
    assert all(gradient.isfinite().all() for gradient in gradients.values())


def test_a_single_code_has_no_code_contrast() -> None:
    value, gradients = of_a_term(placed(codes=1), "code_contrast")
    assert value == pytest.approx(0.0, abs=1e-12)
    assert trained(gradients) == set()


class Spied(Codebook):
    """A codebook that notes what it is given to cluster."""

    def __init__(self) -> None:
        super().__init__(CODES, Z, generator())
        self.clustered: list[tuple[str, Tensor]] = []

    def place(self, contexts: Tensor, seed: int) -> None:
        self.clustered.append(("place", contexts.clone()))
        super().place(contexts, seed)

    def refresh(self, contexts: Tensor, eta: float, seed: int) -> None:
        self.clustered.append(("refresh", contexts.clone()))
        super().refresh(contexts, eta, seed)


class Run:
    """A method's schedule from its first to its last step, and what it did at which step."""

    def __init__(self, steps: int, **changes: Any) -> None:
        self.method = ctmrl(steps=steps, **changes)
        self.book = self.method.codebook = Spied()
        self.placed_at: list[int] = []
        self.refreshed_at: list[int] = []
        self.drawn_at: list[int] = []
        for self.step in range(steps):
            done = len(self.book.clustered)
            self.method.before_step(self.step, self.draw)
            for kind, given in self.book.clustered[done:]:
                self.check(given)
                (self.placed_at if kind == "place" else self.refreshed_at).append(self.step)

    def draw(self) -> Tensor:
        """Contexts of all tasks whose first number counts the draws."""
        self.drawn_at.append(self.step)
        drawn = normal(TASKS, Z, seed=len(self.drawn_at)).float()
        drawn[:, 0] = len(self.drawn_at)
        return drawn

    def check(self, clustered: Tensor) -> None:
        """K-means gets the latest draws, each of them whole."""
        latest = range(len(self.drawn_at) - COLLECTIONS + 1, len(self.drawn_at) + 1)
        assert clustered.shape == (COLLECTIONS * TASKS, Z)
        assert sorted(clustered[:, 0].tolist()) == sorted([float(n) for n in latest] * TASKS)


@pytest.mark.parametrize("steps", [5, 7, 13, 31, 101, 499, 1000])
def test_the_schedule(steps: int) -> None:
    warm_up, refresh = 0.3, 0.05
    run = Run(steps, warm_up=warm_up, refresh=refresh)
    start = max(round(warm_up * steps), 1)
    period = max(round(refresh * steps), 1)
    assert run.placed_at == [start]
    assert run.refreshed_at == list(range(start + period, steps, period))
    # Nothing is collected before the warm-up's last third, and nothing in vain before K-means.
    assert min(run.drawn_at) > start - max(round(warm_up * steps / 3), 1)
    first = [step for step in run.drawn_at if step <= start]
    assert len(first) == COLLECTIONS
    for begin in range(start, steps - period, period):
        inside = [step for step in run.drawn_at if begin < step <= begin + period]
        assert len(inside) == COLLECTIONS
        if period >= COLLECTIONS:
            gaps = {b - a for a, b in pairwise(inside)}
            assert gaps <= {period // COLLECTIONS, period // COLLECTIONS + 1}
    assert run.method.codebook.placed


def test_placing_is_kmeans_of_what_was_collected() -> None:
    run = Run(31, warm_up=1 / 3, refresh=1.0)
    ((_, collected),) = run.book.clustered
    assert run.book.codes.equal(kmeans(collected, CODES, seed=run.placed_at[0]))


@pytest.mark.parametrize(("warm_up", "wanted"), [(0.0, [1]), (0.5, [10]), (1.0, [])])
def test_the_warm_ups_ends(warm_up: float, wanted: list[int]) -> None:
    assert Run(20, warm_up=warm_up).placed_at == wanted


@pytest.mark.parametrize("steps", [1, 2, 3])
def test_runs_of_a_few_steps_end(steps: int) -> None:
    run = Run(steps)
    assert run.placed_at == ([1] if steps > 1 else [])


def test_a_run_interrupted_while_it_collects_goes_on_alike() -> None:
    draws = [normal(TASKS, Z, seed=n).float() for n in range(100)]
    whole, first_half, second_half = (
        ctmrl(seed, steps=101, warm_up=0.3, refresh=0.2) for seed in (0, 0, 1)
    )
    source = iter(draws)
    for step in range(60):
        whole.before_step(step, lambda: next(source))
    again = iter(draws)
    for step in range(40):
        first_half.before_step(step, lambda: next(again))
    second_half.load_state_dict(first_half.state_dict())
    for step in range(40, 60):
        second_half.before_step(step, lambda: next(again))
    assert second_half.codebook.placed
    assert second_half.codebook.codes.equal(whole.codebook.codes)
    assert not second_half.codebook.codes.equal(first_half.codebook.codes)


def test_without_kmeans_codes_stay_random_unit_vectors_and_nothing_is_collected() -> None:
    run = Run(101, kmeans=False)
    assert run.drawn_at == run.placed_at == run.refreshed_at == []
    assert run.method.codebook.placed
    codes = ctmrl(kmeans=False).codebook.codes.detach()
    torch.testing.assert_close(codes.norm(dim=1), torch.ones(CODES))
    assert run.method.codebook.codes.equal(Spied().codes)
    early = ctmrl(steps=101, kmeans=False, warm_up=0.3)
    for step in range(30):
        early.before_step(step, lambda: torch.zeros(()))
        assert not early.codebook.placed


def test_code_of_is_equation_1() -> None:
    method, z = ctmrl(), normal(BATCH, Z).float()
    assert method.code_of(z) is None
    method.codebook.placed.fill_(True)
    found = method.code_of(z)
    assert found is not None
    assert found.equal(cqvae.match(z, method.codebook.codes))
