"""The processor's overlay: an octagon and text, and a label that tells what they hide."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import tube_twin

import endotwin
import endotwin.synth
from endotwin.effects import Effects
from endotwin.effects.overlay import Overlay


@pytest.mark.parametrize("corner", [0.1, 0.25, 0.4])
def test_the_corners_are_right_angled_triangles_of_the_legs_asked_for(corner):
    hidden = Overlay(corner, letters=0.0).hides(200, 300)
    assert hidden[0].sum() == pytest.approx(2 * corner * 200, abs=2)
    assert hidden[:, -1].sum() == pytest.approx(2 * corner * 200, abs=2)
    assert hidden.sum() == pytest.approx(4 * (corner * 200) ** 2 / 2, rel=0.06)
    np.testing.assert_array_equal(hidden, hidden[::-1, ::-1])


def test_the_text_lies_at_the_lower_right_as_high_as_asked_for():
    rows, columns = np.nonzero(Overlay(0.0, letters=0.05).hides(400, 600))
    assert np.ptp(rows) + 1 == pytest.approx(0.05 * 400, abs=3)
    assert rows.min() > 300 and columns.min() > 300 and columns.max() < 599
    assert not Overlay(0.0, letters=0.0).hides(400, 600).any()


def test_what_it_does_not_hide_stays_and_what_it_hides_does_not_matter():
    rng = np.random.default_rng(0)
    overlay = Overlay()
    one, other = (rng.random((120, 160, 3), np.float32) for _ in range(2))
    hidden = overlay.hides(120, 160)
    np.testing.assert_array_equal(overlay.recorded(one)[~hidden], one[~hidden])
    corners = Overlay(letters=0.0).hides(120, 160)
    assert not overlay.recorded(one)[corners & ~Overlay(0.0).hides(120, 160)].any()
    assert np.abs(overlay.recorded(one) - overlay.recorded(other))[corners].max() < 1e-6


def test_the_label_tells_which_pixels_of_rgb_alone_are_hidden(tmp_path):
    twin = tube_twin.fitted(tube_twin.seen(tube_twin.surface()))
    poses = np.stack([tube_twin.pose(s) for s in (0.5, 0.52)])
    for name, effects in (("plain", []), ("drawn", [Overlay()])):
        equipped = replace(twin, effects=Effects(effects))
        endotwin.synthesize(equipped, poses, tmp_path / name, labels="all")
    for file in (tmp_path / "plain").glob("0001_*"):
        same = file.read_bytes() == (tmp_path / "drawn" / file.name).read_bytes()
        assert same == (file.name not in ("0001_color.png", "0001_overlay.png")), file.name
    one, other = (cv2.imread(str(tmp_path / name / "0001_color.png")) for name in ("plain", "drawn"))
    told = cv2.imread(str(tmp_path / "drawn" / "0001_overlay.png"), cv2.IMREAD_UNCHANGED) > 0
    assert 0.05 < told.mean() < 0.3 and not ((one != other).any(axis=2) & ~told).any()
    assert not cv2.imread(str(tmp_path / "plain" / "0001_overlay.png")).any()
    assert endotwin.synth.prove(tmp_path / "drawn").holds
