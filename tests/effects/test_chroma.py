"""Colour at half the size: brightness stays, libjpeg does the same, and fine detail tells of it."""

import cv2
import numpy as np
import pytest
from photos import levels, photographed, textured
from recording import change_of_rgb_alone

from endotwin.effects.chroma import YCBCR, Chroma
from endotwin.effects.codec import Codec
from endotwin.effects.processor import Processor
from endotwin.effects.video import Clip, Video
from endotwin.sequence.readers import open_sequence


def noisy(seed: int, noise_levels: float = 2.0) -> np.ndarray:
    return levels(textured(seed), noise_levels, seed) / np.float32(255)


@pytest.mark.parametrize("size", [(240, 320), (241, 319), (1, 1)])
def test_luminance_stays_and_colour_keeps_its_mean(size):
    color = 0.2 + 0.5 * noisy(0)[: size[0], : size[1]]
    shown = Chroma().recorded(color)
    before, after = color @ YCBCR.T, shown @ YCBCR.T
    np.testing.assert_allclose(after[..., 0], before[..., 0], atol=1e-5)
    np.testing.assert_allclose(after[..., 1:].mean(axis=(0, 1)), before[..., 1:].mean(axis=(0, 1)), atol=1e-3)


def test_it_is_what_libjpeg_does_to_colour():
    color = noisy(1)
    shown = 255 * Chroma().recorded(color)
    apart = np.abs(255 * Codec(100).recorded(color) - shown).mean()
    assert apart < 0.8 < np.abs(255 * color - shown).mean()


@pytest.mark.parametrize("noise_levels", [2, 6])
@pytest.mark.parametrize("sharpened", [False, True])
def test_noise_without_its_colour_tells_so(tmp_path, noise_levels, sharpened):
    photos = [noisy(k, noise_levels) for k in range(8)]
    if sharpened:
        photos = [Processor(0.2, 1.0).recorded(photo) for photo in photos]
    assert Chroma.evidence(photographed(tmp_path, [levels(photo) for photo in photos]))[0] is None
    halved = photographed(tmp_path, [levels(Chroma().recorded(photo)) for photo in photos])
    assert Chroma.evidence(halved)[0] == Chroma()


def test_a_video_codec_leaves_it_told(tmp_path):
    pytest.importorskip("av")
    clip = Clip()
    photos = [levels(clip.recorded(noisy(k), Video(bitrate=100))) for k in range(8)]
    assert Chroma.evidence(photographed(tmp_path, photos))[0] == Chroma()


@pytest.mark.parametrize("blur_px", [0, 1, 3])
def test_photos_without_fine_detail_tell_nothing(tmp_path, blur_px):
    photos = [cv2.GaussianBlur(textured(k), (0, 0), blur_px or 0.1) for k in range(8)]
    assert Chroma.evidence(photographed(tmp_path, [levels(photo) for photo in photos]))[0] is None


def test_of_a_jpeg_picture_the_codec_is_told_instead(tmp_path):
    photos = photographed(tmp_path, [levels(Codec(92).recorded(noisy(k))) for k in range(8)])
    assert Codec.evidence(photos)[0] == Codec(92)
    assert Chroma.evidence(photos)[0] is None


@pytest.mark.parametrize("kind", ["direct", "gi", "offset", "fisheye", "bounce", "wet"])
def test_path_traced_colons_have_all_their_colour(data_root, kind):
    assert Chroma.evidence(open_sequence(data_root / f"colon_{kind}"))[0] is None


def test_it_changes_rgb_alone(tmp_path):
    assert change_of_rgb_alone(tmp_path, [Chroma()]) > 0.01
