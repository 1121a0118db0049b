"""A gain for each frame, also for those in which none was measured."""

import numpy as np
import pytest

from endotwin.effects.gain import Gain

GAIN = Gain((2, 6, 7), (-0.3, 0.1, 0.2))


def test_a_frame_that_was_not_measured_has_the_gain_between_its_neighbours():
    frames = np.array([0, 2, 3, 4, 6, 7, 30])
    expected = np.exp([-0.3, -0.3, -0.2, -0.1, 0.1, 0.2, 0.2])
    np.testing.assert_allclose(GAIN.of(frames), expected, rtol=1e-6)


def test_held_for_more_frames_it_is_the_same_up_to_one_factor():
    frames = np.arange(1, 9)
    gain = GAIN.at(frames)
    assert gain.frames == tuple(range(1, 9)) and np.mean(gain.log_gain) == pytest.approx(0)
    np.testing.assert_allclose(np.ptp(np.log(gain.of(frames) / GAIN.of(frames))), 0, atol=1e-6)


def test_without_a_measured_frame_every_gain_is_one():
    assert (Gain().of(np.arange(3)) == 1).all()
