"""The processor's overlay: an octagon and text, and a label that tells what they hide."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import tube_twin
from photos import levels, photographed, textured

import endotwin
import endotwin.synth
from endotwin.effects import Effects
from endotwin.effects.codec import Codec
from endotwin.effects.lens import Lens
from endotwin.effects.overlay import Overlay
from endotwin.sequence.readers import open_sequence


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


@pytest.mark.parametrize("size", [(240, 320), (301, 301), (480, 400)])
@pytest.mark.parametrize("corner, quality", [(0.1, None), (0.25, None), (0.4, None), (0.2, 60), (0.4, 60)])
def test_the_corners_of_photos_are_told_to_a_pixel(tmp_path, size, corner, quality):
    drawn = Overlay(corner, letters=0.03)
    photos = [drawn.recorded(levels(textured(k, *size), 2, k) / np.float32(255)) for k in range(8)]
    coded = photos if quality is None else [Codec(quality).recorded(photo) for photo in photos]
    sequence = photographed(tmp_path, [levels(photo) for photo in coded])
    found, _ = Overlay.evidence(sequence)
    assert found.corner == pytest.approx(corner, abs=1 / size[0]) and found.letters == 0
    assert Lens.evidence(sequence)[0] is None


def test_other_black_than_four_equal_corners_tells_no_octagon(tmp_path):
    height, width = 240, 320
    x, y = np.meshgrid(np.arange(width), np.arange(height))
    one_corner = x + y < 80
    unequal = one_corner | (width - x + y < 40) | (x + height - y < 80) | (width - x + height - y < 40)
    circle = np.hypot(x - 159.5, y - 119.5) > 130
    bars = (x < 40) | (x >= width - 40)
    for black in (one_corner, unequal, circle, bars, np.zeros((height, width), bool)):
        photos = [levels(np.where(black[..., None], 0, textured(k)), 0, k) for k in range(8)]
        assert Overlay.evidence(photographed(tmp_path, photos))[0] is None


@pytest.mark.parametrize("kind", ["direct", "offset", "fisheye", "bounce", "wet", "scope"])
def test_path_traced_colons_have_no_octagon(data_root, kind):
    assert Overlay.evidence(open_sequence(data_root / f"colon_{kind}"))[0] is None
