"""The codebook of moving averages against loops, and that a dead code harms nothing."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor
from torch.nn import functional

from ctmrl.codebook import kmeans
from ctmrl.ema_codebook import EMACodebook
from tests.ctmrl.examples import BATCH, CODES, Z, generator, normal


def build() -> EMACodebook:
    """A codebook in use, in double precision, each code with sizes and sums of its own."""
    book = EMACodebook(CODES, Z, generator()).double()
    book.placed.fill_(True)
    book.sizes.copy_(torch.arange(1, CODES + 1))
    book.sums.copy_(normal(CODES, Z, seed=5))
    book.codes.copy_(book.sums / book.sizes[:, None])
    return book


def expected(book: EMACodebook, contexts: Tensor, matched: Tensor, decay: float) -> list[Tensor]:
    """Sizes, sums and codes after an update, one code at a time."""
    sizes, sums = [], []
    for n in range(CODES):
        own = [contexts[i] for i in range(len(contexts)) if matched[i] == n]
        sizes.append(decay * book.sizes[n].item() + (1 - decay) * len(own))
        sums.append(decay * book.sums[n] + (1 - decay) * sum(own, torch.zeros(Z)))
    total = math.fsum(sizes)
    smooth = [(size + 1e-5) / (total + CODES * 1e-5) * total for size in sizes]
    codes = [one / size for one, size in zip(sums, smooth, strict=True)]
    return [torch.tensor(sizes, dtype=torch.float64), torch.stack(sums), torch.stack(codes)]


@pytest.mark.parametrize("decay", [0.9, 0.6561, 0.0, 1.0])
def test_an_update(decay: float) -> None:
    book, contexts = build(), normal(BATCH, Z)
    matched = torch.tensor([0, 0, 0, 1, 1, 3, 0, 1, 3, 3, 0])
    wanted = expected(book, contexts, matched, decay)
    book.update(contexts, matched, decay)
    for found, one in zip((book.sizes, book.sums, book.codes), wanted, strict=True):
        torch.testing.assert_close(found, one)


def test_matching_is_by_cosine() -> None:
    book, contexts = build(), normal(BATCH, Z, seed=2)
    book.codes[1] *= 1000
    for context, code in zip(contexts, book.match(contexts), strict=True):
        cosines = [float(functional.cosine_similarity(context, one, dim=0)) for one in book.codes]
        assert cosines.index(max(cosines)) == code


def test_a_codebook_that_always_sees_the_same_goes_to_its_means() -> None:
    book, contexts = build(), normal(BATCH, Z)
    matched = torch.arange(BATCH) % CODES
    for _ in range(300):
        book.update(contexts, matched, 0.9)
    means = torch.stack([contexts[matched == n].mean(dim=0) for n in range(CODES)])
    torch.testing.assert_close(book.codes, means, rtol=1e-4, atol=1e-4)


def test_a_code_that_dies_stays_finite_and_attracts_nothing() -> None:
    book = EMACodebook(3, Z, generator())
    draw = generator(1)
    ahead = functional.normalize(torch.ones(Z), dim=0)
    ways = torch.stack([ahead, functional.normalize(torch.arange(float(Z)), dim=0), -ahead])
    book.place(ways.repeat(11, 1) + 0.01 * torch.randn(33, Z, generator=draw), seed=0)
    living = ways[:2].repeat(5, 1)
    dead = book.match(ways[2:])
    counts = torch.zeros(3)
    for _ in range(5000):
        contexts = living + 0.1 * torch.randn(living.shape, generator=draw)
        matched = book.match(contexts)
        counts += torch.bincount(matched, minlength=3)
        book.update(contexts, matched, 0.9)
    assert counts[dead] == 0
    for state in (book.codes, book.sizes, book.sums):
        assert state.isfinite().all()
    assert book.codes[dead].norm() == 0
    assert set(book.match(ways[:2]).tolist()) == {0, 1, 2} - set(dead.tolist())
    # Contexts that point away from all living codes still revive it.
    assert book.match(ways[2:]) == dead
    book.update(ways[2:], book.match(ways[2:]), 0.9)
    # A unit vector over a size of 0.1, smoothed by 1e-5.
    torch.testing.assert_close(book.codes[dead], ways[2:], rtol=2e-4, atol=1e-6)


def test_placing_is_kmeans_of_unit_length_with_the_sizes_of_the_clusters() -> None:
    book, contexts = EMACodebook(CODES, Z, generator()), normal(89, Z).float()
    assert not book.placed
    book.place(contexts, seed=3)
    assert book.placed
    wanted = functional.normalize(kmeans(contexts, CODES, 3), dim=1)
    torch.testing.assert_close(book.codes, wanted)
    assert book.sums.equal(book.codes)
    nearest = [max(range(CODES), key=lambda n: float(c @ wanted[n])) for c in contexts]
    assert book.sizes.tolist() == [nearest.count(n) for n in range(CODES)]


def test_after_placing_codes_are_short_and_grow_as_released() -> None:
    book, contexts = EMACodebook(CODES, Z, generator()), normal(2 * BATCH, Z).float()
    contexts = functional.normalize(contexts, dim=1)
    book.place(contexts.repeat(20, 1), seed=0)
    lengths = []
    for _ in range(200):
        book.update(contexts, book.match(contexts), 0.9)
        lengths.append(float(book.codes.norm(dim=1).mean()))
    assert lengths[0] < 0.2
    assert lengths[50] > 0.9 * lengths[-1] > 0.3


@pytest.mark.parametrize("distinct", [1, 2, 3])
def test_fewer_distinct_contexts_than_codes_stay_finite(distinct: int) -> None:
    book = EMACodebook(CODES, Z, generator())
    contexts = normal(distinct, Z).float().repeat(11, 1)
    book.place(contexts, seed=0)
    assert (book.sizes >= 1).all()
    for step in range(50):
        book.update(contexts, book.match(contexts), 0.9)
        book.refresh(contexts, 0.9, seed=step)
        assert book.codes.isfinite().all()
        assert book.codes.norm(dim=1).max() < 2 * contexts.norm(dim=1).max() + 1


def test_a_refresh_is_one_update_by_the_centres() -> None:
    book, contexts = build(), normal(89, Z)
    centres = functional.normalize(kmeans(contexts.float(), CODES, 7), dim=1).double()
    wanted = expected(book, centres, book.match(centres), 0.9)
    single = EMACodebook(CODES, Z, generator())
    single.load_state_dict(book.state_dict())
    single.refresh(contexts.float(), 0.9, seed=7)
    for found, one in zip((single.sizes, single.sums, single.codes), wanted, strict=True):
        torch.testing.assert_close(found, one.float())


def test_a_checkpoint_holds_all_of_it_and_nothing_is_trained() -> None:
    book = build()
    assert list(book.parameters()) == []
    assert set(book.state_dict()) == {"codes", "sizes", "sums", "placed"}
    torch.testing.assert_close(
        EMACodebook(CODES, Z, generator()).codes.norm(dim=1), torch.ones(CODES)
    )
