"""The recorder: what JPEG keeps, what it loses, and that labels know nothing of it."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from recording import change_of_rgb_alone

from endotwin.cameras import Pinhole
from endotwin.effects.codec import Codec
from endotwin.effects.processor import Processor
from endotwin.sequence import Sequence


def picture() -> np.ndarray:
    """Smooth shading with fine texture."""
    v, u = np.meshgrid(np.arange(96.0), np.arange(128.0), indexing="ij")
    shade = 0.5 + 0.3 * np.sin(u / 17) * np.cos(v / 13)
    grain = 0.08 * np.random.default_rng(0).standard_normal((96, 128))
    return np.clip(np.stack([shade + grain, 0.6 * shade + grain, 0.4 * shade + grain], axis=2), 0, 1).astype(
        np.float32
    )


def test_more_quality_is_less_error_and_the_highest_is_near_rounding():
    image = picture()
    errors = [np.sqrt(np.mean((Codec(q).recorded(image) - image) ** 2)) for q in (10, 40, 70, 95)]
    assert np.all(np.diff(errors) < 0) and errors[0] > 3 * errors[3]
    even = np.full((64, 64, 3), (0.6, 0.4, 0.3), np.float32)
    assert np.abs(Codec(100).recorded(even) - even).max() < 2.5 / 255


def test_colour_is_kept_at_half_the_size_and_brightness_at_all_of_it():
    """Columns that alternate in colour alone are averaged; columns that alternate in brightness are not."""
    gray = np.full((64, 64, 3), 0.5, np.float32)
    bright, colored = gray.copy(), gray.copy()
    bright[:, ::2] += 0.2
    colored[:, ::2] += np.array([0.2, -0.2 * 0.299 / 0.587, 0], np.float32)
    kept = [np.ptp(Codec(100).recorded(image)[32, 20:40, 0]) for image in (bright, colored)]
    assert kept[0] > 0.18 and kept[1] < 0.05


def test_blocks_of_8_pixels_show_at_low_quality():
    found = Codec(5).recorded(picture())[..., 1]
    steps = np.abs(np.diff(found, axis=1)).mean(axis=0)
    at_edges = np.arange(127) % 8 == 7
    assert steps[at_edges].mean() > 2 * steps[~at_edges].mean()


@pytest.mark.parametrize("quality", [8, 35, 75, 92, 100])
def test_the_quality_is_read_from_the_files_that_another_library_wrote(tmp_path, quality):
    files = tuple(tmp_path / f"{k}.jpg" for k in range(20))
    for k, file in enumerate(files):
        one = 3 if k == 7 else quality
        cv2.imwrite(str(file), np.uint8(255 * picture()), [cv2.IMWRITE_JPEG_QUALITY, one])
    assert Codec.evidence(recording_of(files))[0] == Codec(quality)


def test_files_that_are_no_jpeg_or_are_shown_smaller_tell_no_quality(tmp_path):
    files = tmp_path / "0.png", tmp_path / "1.jpg"
    for file in files:
        cv2.imwrite(str(file), np.uint8(255 * picture()))
    assert Codec.evidence(recording_of(files))[0] is None
    assert Codec.evidence(recording_of(files[1:]))[0] is not None
    assert Codec.evidence(replace(recording_of(files[1:]), scale=0.5))[0] is None


def recording_of(files: tuple[Path, ...]) -> Sequence:
    """A sequence of these photos, without anything else."""
    camera = Pinhole(128, 96, 100.0, 100.0, 63.5, 47.5)
    poses = np.repeat(np.eye(4)[None], len(files), axis=0)
    times_s = np.arange(len(files)) / 30
    return Sequence(files[0].parent, "c3vd", camera, poses, files, (), lambda file: None, times_s)


def test_rgb_alone_is_recorded(tmp_path):
    assert 1 < change_of_rgb_alone(tmp_path, [Processor(), Codec()]) < 40
