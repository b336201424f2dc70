"""The codebook: its moving update, K-means, dead codes."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from sklearn.cluster import KMeans
from threadpoolctl import threadpool_info, threadpool_limits
from torch import Tensor
from torch.nn import functional

from ctmrl.codebook import Codebook, kmeans, perplexity, usage
from tests.ctmrl.examples import CODES, Z, generator, normal

SIZES = (13, 29, 7, 17, 23)
"""Contexts of each of five blobs."""


def blobs(spread: float = 0.02) -> tuple[Tensor, Tensor]:
    """Contexts around five nearly orthogonal directions, and the blob of each, shuffled."""
    centres = functional.normalize(torch.eye(CODES, Z) + 0.1 * normal(CODES, Z).float(), dim=1)
    centres = centres * torch.tensor([[0.3], [0.9], [0.5], [0.7], [0.4]])
    label = torch.repeat_interleave(torch.arange(CODES), torch.tensor(SIZES))
    points = centres[label] + spread * normal(len(label), Z, seed=1).float()
    order = torch.randperm(len(label), generator=generator())
    return points[order], label[order]


@pytest.mark.parametrize("seed", range(5))
def test_kmeans_recovers_well_separated_blobs(seed: int) -> None:
    points, label = blobs()
    wanted = np.stack([points[label == n].mean(dim=0).numpy() for n in range(CODES)])
    found = kmeans(points, CODES, seed).numpy()
    order = np.linalg.norm(found[:, None] - wanted, axis=2).argmin(axis=1)
    assert sorted(order) == list(range(CODES))
    np.testing.assert_allclose(found, wanted[order], atol=1e-6)


def test_kmeans_clusters_by_direction_and_not_by_length() -> None:
    # Two directions, each at two very different lengths: by distance the lengths would group.
    a, b = torch.tensor([1.0, 0.0, 0.02]), torch.tensor([0.9, 0.3, 0.0])
    points = torch.cat([scale * row[None] for row in (a, b) for scale in (1.0, 1.02, 9.0, 9.02)])
    found = kmeans(points, 2, 0)
    order = found[:, 1].argsort()
    np.testing.assert_allclose(found[order], torch.stack([5.01 * a, 5.01 * b]), atol=1e-4)


def test_kmeans_takes_one_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    fit_predict = KMeans.fit_predict
    seen: list[int] = []

    def watched(model: KMeans, points: NDArray[np.float64]) -> NDArray[np.int32]:
        seen.extend(pool["num_threads"] for pool in threadpool_info())
        found: NDArray[np.int32] = fit_predict(model, points)
        return found

    monkeypatch.setattr(KMeans, "fit_predict", watched)
    with threadpool_limits(3):
        before = threadpool_info()
        kmeans(normal(89, Z).float(), CODES, 0)
        assert threadpool_info() == before
    assert {*seen} == {1}


def test_kmeans_is_repeatable() -> None:
    points = normal(89, Z).float()
    first, again, other = (kmeans(points, CODES, seed) for seed in (3, 3, 4))
    assert first.equal(again)
    assert not first.equal(other)


@pytest.mark.parametrize("distinct", [1, 2, 3])
def test_fewer_distinct_contexts_than_codes_are_no_fault(distinct: int) -> None:
    points = normal(distinct, Z).float().repeat(11, 1)
    found = kmeans(points, CODES, 0)
    assert found.shape == (CODES, Z)
    nearest = torch.cdist(found, points[:distinct])
    np.testing.assert_allclose(nearest.min(dim=1).values, 0.0, atol=1e-5)
    assert set(nearest.argmin(dim=1).tolist()) == set(range(distinct))


def test_kmeans_of_zeros_is_finite() -> None:
    assert kmeans(torch.zeros(11, Z), CODES, 0).isfinite().all()


def test_codes_start_as_random_unit_vectors() -> None:
    first, again, other = (Codebook(CODES, Z, generator(seed)) for seed in (0, 0, 1))
    np.testing.assert_allclose(first.codes.detach().norm(dim=1), 1.0, atol=1e-6)
    assert not first.placed
    assert first.codes.equal(again.codes)
    assert not first.codes.equal(other.codes)


def test_matching_sends_no_gradient() -> None:
    book, contexts = Codebook(CODES, Z, generator()), normal(11, Z).float().requires_grad_()
    assert not book.match(contexts).requires_grad
    book.update(contexts, book.match(contexts), 0.1)
    assert book.codes.requires_grad
    assert book.codes.is_leaf
    assert contexts.grad is None


def test_placing_puts_the_codes_at_the_centres() -> None:
    points, _ = blobs()
    book = Codebook(CODES, Z, generator())
    book.place(points, seed=2)
    assert book.placed
    assert book.codes.equal(kmeans(points, CODES, 2))


def test_a_dead_code_survives_5000_updates_without_nan() -> None:
    book = Codebook(CODES, Z, generator())
    with torch.no_grad():
        book.codes[0] = torch.tensor([1.0] + [0.0] * (Z - 1))
    alive = normal(11, Z).float()
    alive[:, 0] = -3.0
    before = book.codes[0].clone()
    draw = generator(1)
    for _ in range(5000):
        contexts = alive + 0.1 * torch.randn(11, Z, generator=draw)
        matched = book.match(contexts)
        assert (matched != 0).all()
        book.update(contexts, matched, 0.1)
    assert book.codes.isfinite().all()
    assert book.codes[0].equal(before)
    assert (book.codes[1:].norm(dim=1) > 0.1).all()


@pytest.mark.parametrize("eta", [0.1, 1.0])
def test_a_refresh_moves_each_code_towards_its_centre(eta: float) -> None:
    points, label = blobs()
    means = torch.stack([points[label == n].mean(dim=0) for n in range(CODES)])
    book = Codebook(CODES, Z, generator())
    start = means + 0.05 * normal(CODES, Z, seed=2).float()
    with torch.no_grad():
        book.codes.copy_(start)
    book.refresh(points, eta, seed=0)
    np.testing.assert_allclose(book.codes.detach(), (1 - eta) * start + eta * means, atol=1e-6)


def test_a_refresh_revives_dead_codes_where_contexts_are_far_from_theirs() -> None:
    points, label = blobs()
    means = torch.stack([points[label == n].mean(dim=0) for n in range(CODES)])
    book = Codebook(CODES, Z, generator())
    # One code serves the blobs 0, 1 and 2; two lie where no context is.
    shared = functional.normalize(means[:3], dim=1).sum(dim=0)
    start = torch.stack([shared, means[3], means[4], -shared, -2 * shared - means[3]])
    with torch.no_grad():
        book.codes.copy_(start)
    used = torch.bincount(book.match(points), minlength=CODES) > 0
    assert used.tolist() == [True, True, True, False, False]
    book.refresh(points, 0.1, seed=0)
    assert (torch.bincount(book.match(points), minlength=CODES) > 0).all()
    revived = torch.cdist(book.codes.detach()[3:], means)
    np.testing.assert_allclose(revived.min(dim=1).values, 0.0, atol=1e-5)
    assert set(revived.argmin(dim=1).tolist()) < {0, 1, 2}


def test_a_refresh_with_more_dead_codes_than_centres_to_spare_is_finite() -> None:
    book = Codebook(CODES, Z, generator())
    book.refresh(normal(1, Z).float().repeat(13, 1), 0.1, seed=0)
    assert book.codes.isfinite().all()


def test_the_same_seed_refreshes_alike() -> None:
    points = normal(89, Z).float()
    books = [Codebook(CODES, Z, generator()) for _ in range(2)]
    for book in books:
        book.refresh(points, 0.3, seed=7)
    assert books[0].codes.equal(books[1].codes)


def test_the_codebook_is_in_its_state() -> None:
    book, other = Codebook(CODES, Z, generator()), Codebook(CODES, Z, generator(1))
    book.place(blobs()[0], seed=0)
    other.load_state_dict(book.state_dict())
    assert other.placed
    assert other.codes.equal(book.codes)


@pytest.mark.parametrize(
    ("matched", "n_codes", "wanted"),
    [
        ([2] * 11, 5, 1.0),
        ([0, 1, 2, 3, 4] * 3, 5, 5.0),
        ([0, 0, 4, 4], 7, 2.0),
        ([0, 0, 0, 1], 3, math.exp(-0.75 * math.log(0.75) - 0.25 * math.log(0.25))),
    ],
)
def test_perplexity(matched: list[int], n_codes: int, wanted: float) -> None:
    assert perplexity(torch.tensor(matched), n_codes).item() == pytest.approx(wanted, rel=1e-5)


def test_the_use_of_the_codes() -> None:
    found = usage(torch.tensor([3, 0, 3, 3]), 5)
    shares = [float(found[f"codes/share/{index}"]) for index in range(5)]
    assert shares == [0.25, 0.0, 0.0, 0.75, 0.0]
    assert found["codes/perplexity"] == perplexity(torch.tensor([3, 0, 3, 3]), 5)
    assert len(found) == 6
