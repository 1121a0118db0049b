"""Whether a fit tells that it leaves more of the photos than their noise."""

import numpy as np
import pytest
from c3vd_folder import CAMERA, write_c3vd

from endotwin.effects import Decision
from endotwin.fit.unexplained import residual_warning
from endotwin.sequence.readers import open_sequence

DECISIONS = {
    "gain": Decision("off", "", 0.15),
    "offset": Decision("off", "", 0.02),
    "coat": Decision("on", "", 1.0),
}


@pytest.fixture(scope="module")
def noisy(tmp_path_factory):
    """Flat grey photos with noise of three levels."""
    generator = np.random.default_rng(0)
    photos = np.clip(128 + generator.normal(0, 3, (4, 240, 320, 3)), 0, 255).astype(np.uint8)
    depth = np.full((240, 320), 30000, np.uint16)
    camera = {**CAMERA, "width": 320, "height": 240}
    folder = tmp_path_factory.mktemp("noisy")
    return open_sequence(write_c3vd(folder, list(photos), [depth] * len(photos), camera=camera))


def test_what_the_noise_leaves_is_not_told(noisy):
    assert residual_warning(3.5 / 255, noisy, DECISIONS) is None


def test_what_is_left_beyond_the_noise_is_told_with_its_suspect(noisy):
    said = residual_warning(12 / 255, noisy, DECISIONS)
    assert "12.0 of 255 levels" in said and "4 times" in said and "suspect gain" in said
