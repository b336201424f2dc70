"""Equations (1) to (10) against plain loops that were written from the paper."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import Tensor

from ctmrl import cqvae
from tests.ctmrl.examples import BATCH, CODES, LENGTH, OBS, Z, generator, normal

TAU = 0.3
GROUPS = [0, 3, 0, 0, 1, 3, 1, 6, 0, 3, 4]
"""Codes of 11 tasks: one of four tasks, one of three, one of two, and the singletons 4 and 6."""
N = 7
"""Codes 2 and 5 are empty."""


def cosine(a: list[float], b: list[float]) -> float:
    """The cosine of the angle between two vectors."""
    dot = sum(x * y for x, y in zip(a, b, strict=True))
    return dot / math.sqrt(sum(x * x for x in a)) / math.sqrt(sum(y * y for y in b))


def nearest(context: list[float], codes: list[list[float]]) -> int:
    """Equation (1)."""
    best = 0
    for n in range(len(codes)):
        if cosine(context, codes[n]) > cosine(context, codes[best]):
            best = n
    return best


def test_cosine_of_all_pairs() -> None:
    a, b = normal(CODES, Z), normal(BATCH, Z, seed=1)
    found = cqvae.cosine(a, b)
    wanted = [[cosine(x, y) for y in b.tolist()] for x in a.tolist()]
    np.testing.assert_allclose(found.numpy(), wanted, atol=1e-12)
    assert found.abs().max() <= 1.0 + 1e-12


def test_equation_1_is_the_code_of_largest_cosine() -> None:
    contexts, codes = normal(BATCH, Z), normal(CODES, Z, seed=1)
    wanted = [nearest(context, codes.tolist()) for context in contexts.tolist()]
    found = cqvae.match(contexts, codes)
    assert found.dtype == torch.int64
    assert found.tolist() == wanted
    assert len(set(wanted)) > 2


def test_equation_1_is_blind_to_length() -> None:
    contexts, codes = normal(BATCH, Z), normal(CODES, Z, seed=1)
    longer = codes * torch.tensor([[0.01], [1.0], [100.0], [3.0], [0.5]])
    assert cqvae.match(contexts, codes).equal(cqvae.match(contexts, longer))
    assert not torch.cdist(contexts, codes).argmin(1).equal(torch.cdist(contexts, longer).argmin(1))


@pytest.mark.parametrize("eta", [0.0, 0.1, 0.7, 1.0])
def test_equation_2_moves_a_matched_code_towards_its_context(eta: float) -> None:
    codes, contexts = normal(CODES, Z), normal(2, Z, seed=1)
    found = cqvae.moving_update(codes, contexts, torch.tensor([3, 1]), eta)
    for code, context in ((3, 0), (1, 1)):
        for k in range(Z):
            old, new = codes[code, k].item(), contexts[context, k].item()
            assert found[code, k].item() == pytest.approx((1 - eta) * old + eta * new, abs=1e-12)


def test_equation_2_leaves_unmatched_codes_unchanged() -> None:
    codes, contexts = normal(CODES, Z), normal(3, Z, seed=1)
    before = codes.clone()
    found = cqvae.moving_update(codes, contexts, torch.tensor([2, 2, 4]), 0.1)
    assert found[[0, 1, 3]].equal(codes[[0, 1, 3]])
    assert (found[[2, 4]] != codes[[2, 4]]).all()
    assert codes.equal(before)


def test_equation_2_takes_the_mean_of_a_codes_contexts_in_any_order() -> None:
    codes, contexts, eta = normal(CODES, Z), normal(BATCH, Z, seed=1), 0.2
    matched = cqvae.match(contexts, codes)
    wanted = codes.numpy().copy()
    for n in range(CODES):
        own = [contexts[i].numpy() for i in range(BATCH) if matched[i] == n]
        if own:
            wanted[n] = (1 - eta) * wanted[n] + eta * sum(own) / len(own)
    found = cqvae.moving_update(codes, contexts, matched, eta)
    np.testing.assert_allclose(found.numpy(), wanted, atol=1e-12)
    order = torch.randperm(BATCH, generator=generator())
    again = cqvae.moving_update(codes, contexts[order], matched[order], eta)
    np.testing.assert_allclose(again.numpy(), wanted, atol=1e-12)


def test_equation_3_against_a_loop() -> None:
    contexts, codes = normal(BATCH, Z), normal(CODES, Z, seed=1)
    matched = cqvae.match(contexts, codes)
    total = 0.0
    for context in contexts.tolist():
        terms = [math.exp(cosine(context, code) / TAU) for code in codes.tolist()]
        total -= math.log(terms[nearest(context, codes.tolist())] / sum(terms))
    loss = cqvae.code_contrast_loss(contexts, codes, matched, TAU)
    assert loss.item() == pytest.approx(total, rel=1e-10)


def test_equation_3_keeps_the_match_it_is_given() -> None:
    contexts, codes = normal(BATCH, Z), normal(CODES, Z, seed=1)
    other = (cqvae.match(contexts, codes) + 1) % CODES
    total = 0.0
    for context, code in zip(contexts.tolist(), other.tolist(), strict=True):
        terms = [math.exp(cosine(context, one) / TAU) for one in codes.tolist()]
        total -= math.log(terms[code] / sum(terms))
    loss = cqvae.code_contrast_loss(contexts, codes, other, TAU)
    assert loss.item() == pytest.approx(total, rel=1e-10)


def test_equation_3_with_a_single_code_is_0() -> None:
    matched = torch.zeros(BATCH, dtype=torch.int64)
    assert cqvae.code_contrast_loss(normal(BATCH, Z), normal(1, Z), matched, TAU).item() == 0.0


@pytest.mark.parametrize("squared", [False, True])
@pytest.mark.parametrize(
    ("loss", "width"),
    [(cqvae.reward_prediction_loss, 1), (cqvae.state_prediction_loss, OBS)],
    ids=["4 and 7", "5 and 8"],
)
def test_prediction_equations_sum_norms_over_time(
    loss: Callable[[Tensor, Tensor, bool], Tensor], width: int, squared: bool
) -> None:
    predicted, target = normal(BATCH, LENGTH, width), normal(BATCH, LENGTH, width, seed=1)
    found = loss(predicted, target, squared)
    assert found.shape == (BATCH,)
    for i in range(BATCH):
        total = 0.0
        for t in range(LENGTH):
            squares = [(predicted[i, t, k] - target[i, t, k]).item() ** 2 for k in range(width)]
            total += sum(squares) if squared else math.sqrt(sum(squares))
        assert found[i].item() == pytest.approx(total, rel=1e-9)


def test_equations_6_and_9_weigh_reward_and_state_equally() -> None:
    found = cqvae.prediction_loss(torch.tensor([1.0, 2.0, 3.0]), torch.tensor([10.0, 20.0, 40.0]))
    assert found.tolist() == [11.0, 22.0, 43.0]


@pytest.mark.parametrize("squared", [False, True])
def test_a_perfect_prediction_has_no_loss_and_a_gradient(squared: bool) -> None:
    target = normal(BATCH, LENGTH, OBS)
    predicted = target.clone().requires_grad_()
    loss = cqvae.state_prediction_loss(predicted, target, squared).sum()
    (gradient,) = torch.autograd.grad(loss, predicted)
    assert loss.item() == pytest.approx(0.0, abs=1e-3)
    assert gradient.isfinite().all()


def contrast_by_a_loop(
    anchors: Tensor, positives: Tensor, groups: list[int], negatives: Tensor, n_codes: int
) -> float:
    """Equation (10); the tasks in a denominator are the group's, or the extra ones of a single."""
    total = 0.0
    for code in range(n_codes):
        members = [k for k in range(len(groups)) if groups[k] == code]
        inner = 0.0
        for k in members:
            others = [j for j in members if j != k]
            if len(members) == 1:
                others = [j for j in range(len(groups)) if negatives[k, j]]
            anchor = anchors[k].tolist()
            own = math.exp(cosine(anchor, positives[k].tolist()) / TAU)
            rest = (math.exp(cosine(anchor, positives[j].tolist()) / TAU) for j in others)
            inner += math.log(own / (own + sum(rest)))
        if members:
            total += inner / len(members)
    return -total / n_codes


@pytest.mark.parametrize("extra", [0, 3, 50])
def test_equation_10_against_a_loop(extra: int) -> None:
    anchors, positives = normal(BATCH, Z), normal(BATCH, Z, seed=1)
    groups = torch.tensor(GROUPS)
    negatives = cqvae.hard_negatives(groups, extra, generator())
    found = cqvae.hard_contrast_loss(anchors, positives, groups, negatives, TAU, N)
    wanted = contrast_by_a_loop(anchors, positives, GROUPS, negatives, N)
    assert found.item() == pytest.approx(wanted, rel=1e-10)


def test_equation_10_counts_empty_codes_in_the_mean_and_nowhere_else() -> None:
    anchors, positives = normal(BATCH, Z), normal(BATCH, Z, seed=1)
    groups = torch.tensor(GROUPS)
    negatives = cqvae.hard_negatives(groups, 3, generator())
    few, many = (
        cqvae.hard_contrast_loss(anchors, positives, groups, negatives, TAU, n).item()
        for n in (N, 3 * N)
    )
    assert few == pytest.approx(3 * many, rel=1e-12)


def test_equation_10_weighs_codes_and_not_tasks() -> None:
    # Two orthogonal pairs under code 0, the same task five times under code 1.
    anchors = torch.eye(7, dtype=torch.float64)
    groups = torch.tensor([0, 0, 1, 1, 1, 1, 1])
    negatives = cqvae.hard_negatives(groups, 3, generator())
    found = cqvae.hard_contrast_loss(anchors, anchors, groups, negatives, TAU, 2).item()
    own = math.exp(1 / TAU)
    assert found == pytest.approx(-0.5 * sum(math.log(own / (own + k)) for k in (1, 4)), rel=1e-10)


def test_hard_negatives_are_the_tasks_of_the_same_code() -> None:
    negatives = cqvae.hard_negatives(torch.tensor(GROUPS), 3, generator())
    assert negatives.dtype == torch.bool
    for k, code in enumerate(GROUPS):
        if GROUPS.count(code) > 1:
            wanted = [j for j in range(BATCH) if GROUPS[j] == code and j != k]
            assert negatives[k].nonzero()[:, 0].tolist() == wanted


@pytest.mark.parametrize(("extra", "drawn"), [(0, 0), (1, 1), (3, 3), (10, 10), (50, 10)])
def test_a_single_task_has_m_extra_negatives(extra: int, drawn: int) -> None:
    negatives = cqvae.hard_negatives(torch.tensor(GROUPS), extra, generator())
    for k in (7, 10):
        assert negatives[k].sum() == drawn
        assert not negatives[k, k]


def test_the_extra_negatives_are_uniform_over_the_other_tasks() -> None:
    draw, groups, counts = generator(), torch.tensor(GROUPS), torch.zeros(BATCH)
    for _ in range(600):
        counts += cqvae.hard_negatives(groups, 3, draw)[7]
    assert counts[7] == 0
    others = torch.cat([counts[:7], counts[8:]])
    # Binomial of 600 draws with share 3/10: mean 180, deviation 11.
    assert (others - 180).abs().max() < 45
    first, again = (cqvae.hard_negatives(groups, 3, generator(5)) for _ in range(2))
    assert first.equal(again)


def test_a_batch_of_one_task_has_no_negatives_and_no_loss() -> None:
    groups = torch.tensor([2])
    negatives = cqvae.hard_negatives(groups, 8, generator())
    assert negatives.tolist() == [[False]]
    loss = cqvae.hard_contrast_loss(normal(1, Z), normal(1, Z, seed=1), groups, negatives, TAU, N)
    assert loss.item() == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("zero", ["contexts", "codes", "both"])
def test_zero_vectors_give_no_nan(zero: str) -> None:
    contexts, codes, positives = normal(BATCH, Z), normal(CODES, Z, seed=1), normal(BATCH, Z)
    if zero != "codes":
        contexts[4], positives[2] = 0.0, 0.0
    if zero != "contexts":
        codes[3] = 0.0
    for tensor in (contexts, codes, positives):
        tensor.requires_grad_()
    matched = cqvae.match(contexts.detach(), codes.detach())
    negatives = cqvae.hard_negatives(matched, 3, generator())
    loss = cqvae.code_contrast_loss(contexts, codes, matched, TAU) + cqvae.hard_contrast_loss(
        contexts, positives, matched, negatives, TAU, CODES
    )
    gradients = torch.autograd.grad(loss, (contexts, codes, positives))
    assert loss.isfinite()
    assert all(gradient.isfinite().all() for gradient in gradients)
    assert cqvae.moving_update(codes, contexts, matched, 0.1).isfinite().all()


def test_a_zero_code_is_matched_by_nobody_with_a_nearer_code() -> None:
    contexts, codes = normal(BATCH, Z), normal(CODES, Z, seed=1)
    codes[1] = 0.0
    best = cqvae.cosine(contexts, codes).max(dim=1).values
    assert (cqvae.match(contexts, codes) != 1)[best > 0].all()
    assert (best > 0).sum() > BATCH // 2
