"""Each random choice of a dataset has numbers of its own."""

from itertools import product

from endotwin.run.streams import Stream


def test_no_two_streams_frames_or_seeds_share_their_numbers():
    keys = list(product(Stream, (0, 1, 7, 1 << 32, (1 << 32) + 1), (0, 1, 2)))
    drawn = {tuple(stream.generator(seed, index).random(2)) for stream, seed, index in keys}
    assert len(drawn) == len(keys)


def test_a_stream_is_the_same_for_the_same_seed():
    assert Stream.JITTER.generator(5, 3).random() == Stream.JITTER.generator(5, 3).random()
