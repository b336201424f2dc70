"""CTMRL as released: each term against loops, what it trains, its codebook over a schedule."""

from __future__ import annotations

import copy
import dataclasses
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.nn import functional

from ctmrl.codebook import perplexity, usage
from ctmrl.config import check_settings
from ctmrl.data import OfflineData
from ctmrl.errors import UsageError
from ctmrl.meta_train import Learner
from ctmrl.methods.ctmrl_released import (
    CTMRLReleased,
    CTMRLReleasedConfig,
    bilinear_contrast_loss,
    commitment_loss,
    cycle_loss,
)
from ctmrl.networks import mean_encoding
from ctmrl.presets import preset
from ctmrl.schedule import COLLECTIONS
from tests.ctmrl.examples import (
    ACT,
    BATCH,
    CODES,
    LENGTH,
    OBS,
    TASKS,
    Z,
    contexts,
    dimensions,
    generator,
    normal,
    statistics,
)

WEIGHTS = ("metric", "club", "commitment", "cycle", "contrast")
GROUPS = torch.tensor([3, 0, 3, 1, 0, 3, 0, 4, 3, 0, 1])
"""A batch's codes: code 2 has no task, code 4 a single one."""


def released(seed: int = 0, steps: int = 100, **changes: Any) -> CTMRLReleased:
    """An untrained method of small networks; the weights depend on the seed alone."""
    small = CTMRLReleasedConfig(z_dim=Z, encoder_hidden=(23,), predictor_hidden=(29,), codes=CODES)
    config = dataclasses.replace(small, **changes)
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        return CTMRLReleased(config, statistics(config.next_obs_in_context), dimensions(steps))


def placed(**changes: Any) -> CTMRLReleased:
    """The same in double precision with the warm-up behind it, each code with some history."""
    method = released(**changes).double()
    book = method.codebook
    book.placed.fill_(True)
    book.sizes.fill_(2.0)
    book.sums.copy_(normal(CODES, Z, seed=8))
    book.codes.copy_(book.sums / 2)
    return method


def loss_and_gradients(method: CTMRLReleased) -> tuple[float, dict[str, Tensor], dict[str, Tensor]]:
    """The loss of a copy of the method, each parameter's gradient, and the metrics."""
    twin, h = copy.deepcopy(method), contexts().double()
    loss, metrics = twin.context_loss(h, twin.encoder(h), generator())
    loss.backward()  # type: ignore[no-untyped-call]
    found = {
        name: torch.zeros_like(p) if p.grad is None else p.grad
        for name, p in twin.named_parameters()
    }
    return loss.item(), found, metrics


def only(term: str | None = None, **changes: Any) -> CTMRLReleased:
    """A method where this term alone of those with a weight has one, its usual."""
    usual = CTMRLReleasedConfig()
    off = {f"{name}_weight": 0.0 for name in WEIGHTS}
    if term is not None:
        off[f"{term}_weight"] = getattr(usual, f"{term}_weight")
    return placed(**(off | changes))


def assert_gradients(method: CTMRLReleased, found: dict[str, Tensor], wanted: Tensor) -> None:
    """Compare gradients with those of a loss that was put together here."""
    named = dict(method.named_parameters())
    gradients = torch.autograd.grad(wanted, list(named.values()), allow_unused=True)
    for name, gradient in zip(named, gradients, strict=True):
        expected = torch.zeros_like(found[name]) if gradient is None else gradient
        torch.testing.assert_close(found[name], expected, rtol=1e-6, atol=1e-10, msg=name)


def trained(gradients: dict[str, Tensor]) -> set[str]:
    """The parts of a method that a gradient reaches."""
    reached = (name for name, gradient in gradients.items() if gradient.abs().max() > 1e-10)
    return {name.partition(".")[0] for name in reached}


def unweighted(method: CTMRLReleased) -> Tensor:
    """What has no weight, by loops over tasks: the fit of q and the predictors' squared errors."""
    h = contexts().double()[0]
    total = torch.zeros(())
    for i in range(BATCH):
        obs, action, reward, after = torch.split(h[i], [OBS, ACT, 1, OBS], dim=-1)
        encodings = method.encoder(h[i]).detach()
        mean, variance = method.behavior_model(torch.cat([obs, action], dim=-1))
        fit = (encodings - mean) ** 2 / (2 * variance) + variance.sqrt().log()
        z = encodings.mean(dim=0).expand(LENGTH, Z)
        wanted_reward, wanted_change = method.predictors.targets(reward, obs, after)
        found_reward, found_change = method.predictors(obs, action, z)
        errors = ((found_reward - wanted_reward) ** 2).sum() / LENGTH
        errors = errors + ((found_change - wanted_change) ** 2).sum() / (LENGTH * OBS)
        total = total + fit.mean() + errors
    return total / BATCH


def by_hand(method: CTMRLReleased, term: str) -> Tensor:
    """A term times its weight, by loops over tasks."""
    h = contexts().double()
    z, other = mean_encoding(method.encoder(h))
    matched = method.codebook.match(z)
    codes = method.codebook.codes
    total = torch.zeros(())
    if term == "metric":
        pairs = [(i, j) for i in range(BATCH) for j in range(i)]
        for i, j in pairs:
            total = total + 1 / (((z[i] - z[j]) ** 2).mean() + 0.1)
        return 10 * total / (len(pairs) + 1e-3)
    if term == "club":
        for i in range(BATCH):
            encodings = method.encoder(h[0, i])
            mean, variance = (x.detach() for x in method.behavior_model(h[0, i, :, : OBS + ACT]))
            pairs_error = (encodings[None] - mean[:, None]) ** 2 / variance[:, None]
            total = total + pairs_error.mean() - ((encodings - mean) ** 2 / variance).mean()
        return 25 * total / BATCH
    if term == "commitment":
        for i in range(BATCH):
            total = total + ((codes[matched[i]] - z[i]) ** 2).mean()
        return 0.25 * total / BATCH
    if term == "cycle":
        return by_hand_cycle(method, h[0], codes[matched])
    for n in set(matched.tolist()):
        members = [i for i in range(BATCH) if matched[i] == n]
        of_code = torch.zeros(())
        for k in members:
            logits = torch.stack([other[k] @ method.bilinear @ z[m] for m in members])
            of_code = of_code + torch.log(logits.exp().sum()) - logits[members.index(k)]
        total = total + of_code / len(members)
    return total


def by_hand_cycle(method: CTMRLReleased, h: Tensor, codes: Tensor) -> Tensor:
    """The latent cycle, with predictions brought back to the data's units here."""
    total = torch.zeros(())
    mean, std = (x.double() for x in statistics(method.config.next_obs_in_context).target)
    for i in range(BATCH):
        obs, action, _, _ = torch.split(h[i], [OBS, ACT, 1, OBS], dim=-1)
        reward, change = method.predictors(obs, action, codes[i].expand(LENGTH, Z))
        reward = mean[0] + std[0] * reward
        after = obs + mean[1:] + std[1:] * change
        predicted = torch.cat([obs, action, reward, after], dim=-1)
        total = total + ((codes[i] - method.encoder(predicted)) ** 2).mean()
    return total / BATCH


def test_what_has_no_weight_trains_predictors_and_q_alone() -> None:
    method = only()
    value, gradients, metrics = loss_and_gradients(method)
    assert trained(gradients) == {"behavior_model", "predictors"}
    wanted = unweighted(method)
    assert value == pytest.approx(wanted.item(), rel=1e-6)
    parts = metrics["loss/encoder/club_fit"] + metrics["loss/encoder/prediction"]
    assert parts.item() == pytest.approx(value, rel=1e-9)
    assert_gradients(method, gradients, wanted)


@pytest.mark.parametrize("term", WEIGHTS)
def test_a_term(term: str) -> None:
    method = only(term)
    value, gradients, metrics = loss_and_gradients(method)
    rest, others, _ = loss_and_gradients(only())
    added = {name: gradients[name] - others[name] for name in gradients}
    assert trained(added) == {"encoder", "predictors"} if term == "cycle" else {"encoder"}
    wanted = by_hand(method, term)
    assert abs(wanted.item()) > 1e-3
    assert value - rest == pytest.approx(wanted.item(), rel=1e-5)
    weight = getattr(method.config, f"{term}_weight")
    assert metrics[f"loss/encoder/{term}"] == pytest.approx(wanted.item() / weight, rel=1e-5)
    assert_gradients(method, added, wanted)


def test_the_loss_is_the_sum_of_all_terms() -> None:
    whole, gradients, metrics = loss_and_gradients(placed())
    wanted = unweighted(placed()) + sum(by_hand(placed(), term) for term in WEIGHTS)
    assert whole == pytest.approx(wanted.item(), rel=1e-6)
    assert trained(gradients) == {"encoder", "predictors", "behavior_model"}
    assert set(metrics) == {
        *(f"loss/encoder/{term}" for term in (*WEIGHTS, "club_fit", "prediction")),
        *usage(torch.zeros(1, dtype=torch.int64), CODES),
    }
    method = placed()
    matched = method.codebook.match(mean_encoding(method.encoder(contexts().double())[0]))
    assert metrics["codes/perplexity"] == perplexity(matched, CODES)


def test_without_next_observations_the_state_predictor_has_no_cycle() -> None:
    method = only("cycle", next_obs_in_context=False)
    _, gradients, _ = loss_and_gradients(method)
    _, others, _ = loss_and_gradients(only(next_obs_in_context=False))
    for name, gradient in gradients.items():
        reached = bool((gradient - others[name]).abs().max() > 1e-10)
        assert reached == name.startswith(("encoder", "predictors.reward_net")), name
    wanted = by_hand(method, "cycle").item()
    value = loss_and_gradients(method)[0] - loss_and_gradients(only(next_obs_in_context=False))[0]
    assert value == pytest.approx(wanted, rel=1e-5)


def test_before_the_warm_up_is_over_the_codebook_has_no_say() -> None:
    method = released().double()
    before = copy.deepcopy(method.codebook.state_dict())
    h = contexts().double()
    loss, metrics = method.context_loss(h, method.encoder(h), generator())
    for term in ("commitment", "cycle", "contrast"):
        assert metrics[f"loss/encoder/{term}"] == 0
    wanted = unweighted(method) + by_hand(method, "metric") + by_hand(method, "club")
    assert loss.item() == pytest.approx(wanted.item(), rel=1e-6)
    assert all(value.equal(before[key]) for key, value in method.codebook.state_dict().items())


@pytest.mark.parametrize("decay", [0.9, 0.9**4])
def test_the_codes_move_once_a_step_after_the_losses_saw_them(decay: float) -> None:
    method, h = placed(code_decay=decay), contexts().double()
    encodings = method.encoder(h)
    z = mean_encoding(encodings)
    codes, matched = method.codebook.codes.clone(), method.codebook.match(z[0])
    twin = copy.deepcopy(method.codebook)
    _, metrics = method.context_loss(h, encodings, generator())
    twin.update(z[0].detach(), matched, decay)
    assert not twin.codes.equal(codes)
    assert method.codebook.codes.equal(twin.codes)
    seen = commitment_loss(z[0], codes[matched])
    assert metrics["loss/encoder/commitment"].item() == pytest.approx(seen.item())


def test_the_contrast_of_groups() -> None:
    z, other, bilinear = normal(BATCH, Z), normal(BATCH, Z, seed=1), normal(Z, Z, seed=2)
    found = bilinear_contrast_loss(z, other, GROUPS, bilinear)
    total = 0.0
    for n in range(CODES):
        members = [i for i in range(BATCH) if GROUPS[i] == n]
        if members:
            logits = other[members] @ bilinear @ z[members].T
            total += functional.cross_entropy(logits, torch.arange(len(members))).item()
    assert found.item() == pytest.approx(total, rel=1e-10)


def test_the_contrast_of_singletons_and_of_a_single_code_is_zero() -> None:
    z, other = normal(BATCH, Z).requires_grad_(), normal(BATCH, Z, seed=1).requires_grad_()
    bilinear = normal(Z, Z, seed=2)
    alone = bilinear_contrast_loss(z, other, torch.arange(BATCH), bilinear)
    gradients = torch.autograd.grad(alone, [z, other])
    assert alone.item() == pytest.approx(0.0, abs=1e-12)
    assert all(gradient.abs().max() < 1e-12 for gradient in gradients)
    together = bilinear_contrast_loss(z, other, torch.full((BATCH,), 3), bilinear)
    assert together.item() == 0.0
    assert not any(gradient.any() for gradient in torch.autograd.grad(together, [z, other]))


def test_the_contrast_stays_finite_at_the_largest_logits() -> None:
    z = torch.ones(BATCH, 400, requires_grad=True)
    signs = torch.where(torch.arange(BATCH) % 2 == 0, 1.0, -1.0)[:, None]
    loss = bilinear_contrast_loss(z * signs, z, GROUPS, torch.ones(400, 400))
    (gradient,) = torch.autograd.grad(loss, z)
    assert loss.isfinite()
    assert gradient.isfinite().all()


def test_commitment_and_cycle_are_means_over_all_their_numbers() -> None:
    z, codes, encodings = normal(BATCH, Z), normal(BATCH, Z, seed=1), normal(BATCH, LENGTH, Z)
    total = sum(((codes[i] - z[i]) ** 2).sum().item() for i in range(BATCH))
    assert commitment_loss(z, codes).item() == pytest.approx(total / BATCH / Z)
    total = sum(
        ((codes[i] - encodings[i, t]) ** 2).sum().item()
        for i in range(BATCH)
        for t in range(LENGTH)
    )
    assert cycle_loss(codes, encodings).item() == pytest.approx(total / BATCH / LENGTH / Z)


class Run:
    """A method's schedule from its first to its last step, and what K-means was given."""

    def __init__(self, steps: int, warm_up: float = 0.3, refresh: float = 0.2) -> None:
        self.method = released(steps=steps, warm_up=warm_up, refresh=refresh)
        self.drawn: list[Tensor] = []
        self.draw_steps: list[int] = []
        self.clustered: dict[int, Tensor] = {}
        for self.step in range(steps):
            before = self.method.codebook.codes.clone()
            self.method.before_step(self.step, self.draw)
            if not self.method.codebook.codes.equal(before):
                self.clustered[self.step] = self.method.collected.clone()

    def draw(self) -> Tensor:
        self.draw_steps.append(self.step)
        self.drawn.append(normal(TASKS, Z, seed=len(self.drawn)).float())
        return self.drawn[-1]


def test_contexts_are_collected_in_the_warm_ups_last_third_and_codes_after_it() -> None:
    run = Run(100)
    assert list(run.clustered) == [30, 50, 70, 90]
    assert run.draw_steps[:COLLECTIONS] == list(range(21, 31))
    assert run.draw_steps[COLLECTIONS : 2 * COLLECTIONS] == list(range(32, 51, 2))
    assert run.clustered[30].equal(torch.stack(run.drawn[:COLLECTIONS]))
    twin = released()
    twin.codebook.place(run.clustered[30].flatten(0, 1), seed=30)
    drawn = torch.stack(run.drawn[COLLECTIONS : 2 * COLLECTIONS])
    codes = twin.codebook.codes[twin.codebook.match(drawn.flatten(0, 1))]
    assert run.clustered[50].flatten(0, 1).equal(codes)
    twin.codebook.refresh(codes, 0.9, seed=50)
    assert twin.codebook.codes.equal(Run(51, 30 / 51, 20 / 51).method.codebook.codes)


def test_a_run_interrupted_while_it_collects_goes_on_alike() -> None:
    draws = [normal(TASKS, Z, seed=n).float() for n in range(40)]
    whole, first_half, second_half = (released(seed, refresh=0.2) for seed in (0, 0, 1))
    source, again = iter(draws), iter(draws)
    for step in range(60):
        whole.before_step(step, lambda: next(source))
    for step in range(40):
        first_half.before_step(step, lambda: next(again))
    second_half.load_state_dict(first_half.state_dict())
    for step in range(40, 60):
        second_half.before_step(step, lambda: next(again))
    assert second_half.codebook.placed
    for key, value in second_half.state_dict().items():
        assert value.equal(whole.state_dict()[key]), key


def test_the_bilinear_form_is_random_frozen_and_in_every_checkpoint() -> None:
    method, other = released(), released(1)
    assert method.bilinear.shape == (Z, Z)
    assert 0 <= method.bilinear.min() < 0.2 < 0.8 < method.bilinear.max() < 1
    assert method.bilinear.equal(released().bilinear)
    assert not method.bilinear.equal(other.bilinear)
    assert not any(
        name.startswith(("bilinear", "codebook")) for name, _ in method.named_parameters()
    )
    other.load_state_dict(method.state_dict())
    assert method.bilinear.equal(other.bilinear)


@pytest.mark.parametrize("codes", [-1, 0, TASKS, TASKS + 1])
def test_a_wrong_number_of_codes_is_one_sentence(codes: int) -> None:
    with pytest.raises(UsageError, match=f"--codes .* {TASKS} training tasks, got {codes}$"):
        released(codes=codes)


@pytest.mark.parametrize("decay", [-0.1, 1.1])
def test_a_decay_out_of_its_range_is_one_sentence(decay: float) -> None:
    with pytest.raises(UsageError, match=rf"^--code-decay must be from 0 to 1, got {decay}$"):
        check_settings(CTMRLReleasedConfig(code_decay=decay))


def test_code_of_is_the_nearest_by_cosine() -> None:
    method, z = placed(), normal(BATCH, Z)
    found = method.code_of(z)
    assert found is not None
    for context, code in zip(z, found, strict=True):
        near = functional.cosine_similarity(context[None], method.codebook.codes)
        assert near.argmax() == code


@pytest.mark.parametrize("codes", [1, 6])
def test_a_learner_stays_finite_to_the_end(codes: int, wind_data: OfflineData) -> None:
    config = preset("point_robot_wind", "ctmrl_released", "smoke")
    assert isinstance(config.context, CTMRLReleasedConfig)
    context = dataclasses.replace(config.context, codes=codes)
    config = dataclasses.replace(config, context=context)
    learner = Learner(config, wind_data)
    names = set()
    for _ in range(config.training.steps):
        metrics = learner.update()
        names.add(frozenset(metrics))
        assert all(value.isfinite() for value in metrics.values())
    assert len(names) == 1
    assert isinstance(learner.method, CTMRLReleased)
    assert learner.method.codebook.placed
    assert all(value.isfinite().all() for value in learner.method.state_dict().values())
    assert metrics["loss/encoder/cycle"] > 0
