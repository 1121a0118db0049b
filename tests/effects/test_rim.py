"""Sharpening by the edge of the lens circle: what was put in comes out, and soft or plain edges tell none."""

import cv2
import numpy as np
import pytest
from photos import levels, photographed, textured

from endotwin.effects.codec import Codec
from endotwin.effects.overlay import Overlay
from endotwin.effects.processor import Processor
from endotwin.effects.rim import unsharp
from endotwin.sequence import Sequence
from endotwin.sequence.readers import open_sequence

HEIGHT, WIDTH, RADIUS_PX = 360, 480, 165.0


def through_lens(seed: int, blur_px: float = 0.4) -> np.ndarray:
    """Faint texture within a circle whose edge is so wide, with vignetting, float32 [H, W, 3]."""
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    r_px = np.hypot(u - WIDTH / 2 + 3.3, v - HEIGHT / 2 + 1.7)
    passed = np.clip(RADIUS_PX - r_px + 0.5, 0, 1) * np.exp(-0.3 * (r_px / RADIUS_PX) ** 2)
    seen = (0.3 + 0.4 * textured(seed, HEIGHT, WIDTH)) * passed[..., None].astype(np.float32)
    return cv2.GaussianBlur(seen, (0, 0), blur_px)


def recording(folder, *steps: Processor | Codec, blur_px: float = 0.4, noise: float = 1.0) -> Sequence:
    photos = []
    for k in range(16):
        color = through_lens(k, blur_px)
        color = np.where(color > 0.02, levels(color, 1, k) / np.float32(255), color)
        for step in steps:
            color = step.recorded(color)
        photos.append(levels(color))
    return photographed(folder, photos)


@pytest.mark.parametrize(
    "contrast, amount, radius_px", [(0.0, 0.6, 1.2), (0.4, 1.0, 1.2), (0.0, 1.5, 2.5), (0.4, 0.8, 2.0)]
)
def test_the_sharpening_put_in_comes_out(tmp_path, contrast, amount, radius_px):
    found = unsharp(recording(tmp_path, Processor(contrast, amount, radius_px)))
    assert found.amount == pytest.approx(amount, rel=0.25)
    assert found.radius_px == pytest.approx(radius_px, rel=0.25)


def test_what_is_found_undoes_most_of_it(tmp_path):
    for folder in ("sharp", "plain"):
        (tmp_path / folder).mkdir()
    sharp = recording(tmp_path / "sharp", Processor(0.0, 0.8, 1.5))
    plain, inside = recording(tmp_path / "plain"), sharp.well_lit(8)
    found, _ = Processor.evidence(sharp)
    was, left = (
        (photo.astype(float) - plain.color(3))[inside].std()
        for photo in (sharp.color(3), found.unsharpened(sharp.color(3)))
    )
    assert left < was / 3


def test_a_jpeg_codec_leaves_it_told(tmp_path):
    found, _ = Processor.evidence(recording(tmp_path, Processor(0.3, 1.5, 2.0), Codec(85)))
    assert found.sharpening == pytest.approx(1.5, rel=0.25) and found.contrast == 0


@pytest.mark.parametrize("blur_px", [0.2, 1.0])
@pytest.mark.parametrize("steps", [(), (Processor(0.8, 0.0),), (Codec(50),)])
def test_an_edge_that_no_processor_sharpened_tells_none(tmp_path, blur_px, steps):
    assert unsharp(recording(tmp_path, *steps, blur_px=blur_px)) is None


def test_without_a_round_edge_there_is_nothing_to_tell_it(tmp_path):
    sharpened = [Processor(0.3, 1.0).recorded(textured(k)) for k in range(16)]
    for overlay in (Overlay(0.0, 0.0), Overlay(0.3, 0.0)):
        photos = [levels(overlay.recorded(photo)) for photo in sharpened]
        assert unsharp(photographed(tmp_path, photos)) is None


@pytest.mark.parametrize("kind", ["direct", "offset", "fisheye", "bounce", "wet"])
def test_path_traced_colons_without_a_processor_tell_none(data_root, kind):
    assert unsharp(open_sequence(data_root / f"colon_{kind}")) is None


def test_a_path_traced_colon_that_was_sharpened_tells_so(data_root):
    assert unsharp(open_sequence(data_root / "colon_scope")).overshoot > 0.1


def test_what_a_path_traced_colon_is_sharpened_by_comes_out_to_an_eighth(data_root, tmp_path):
    """Its brightness is not even beside the edge, nor a straight line."""
    sequence, processor = open_sequence(data_root / "colon_wet"), Processor(0.0, 0.8, 1.5)
    photos = [sequence.color(index) for index in range(len(sequence))]
    sharp = [levels(processor.recorded(np.float32(photo) / 255)) for photo in photos]
    found = unsharp(photographed(tmp_path, sharp))
    assert found.amount == pytest.approx(0.8, rel=1 / 8)
    assert found.radius_px == pytest.approx(1.5, rel=1 / 8)
