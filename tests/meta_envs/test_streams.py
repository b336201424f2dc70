import numpy as np
from gymnasium.utils import seeding

from meta_envs.streams import Streams


def test_a_stream_is_the_one_a_single_environment_has() -> None:
    streams = Streams([4, 7])
    assert len(streams) == 2
    for seed, stream in zip((4, 7), streams, strict=True):
        expected = seeding.np_random(seed)[0].uniform(size=3)
        np.testing.assert_array_equal(stream.uniform(size=3), expected)


def test_only_its_own_draws_move_a_stream_on() -> None:
    streams, alone = Streams([1, 2, 3]), Streams([1, 2, 3])
    some = streams.of([2, 0])
    assert len(some) == 2
    assert some[0].uniform() == alone[2].uniform()
    assert streams[2].uniform() == alone[2].uniform()
    assert streams[1].uniform() == alone[1].uniform()
    assert [one.uniform() for one in streams[:2]] == [alone[0].uniform(), alone[1].uniform()]


def test_reseeding_starts_one_stream_anew() -> None:
    streams, alone = Streams([1, 2]), Streams([1, 9])
    streams[0].uniform()
    streams[1].uniform()
    streams.reseed(1, 9)
    assert streams[1].uniform() == alone[1].uniform()
    alone[0].uniform()
    streams.reseed(0, None)
    assert streams[0].uniform() == alone[0].uniform()


def test_streams_without_seeds_differ() -> None:
    first, second = Streams([None, None])
    assert first.uniform() != second.uniform()
