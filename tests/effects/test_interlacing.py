"""Interlacing: which rows see which moment, and that a camera that is still shows no comb."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import tube_twin
from photos import levels, textured
from photos import photographed as photos_of

from endotwin.effects import Effects
from endotwin.effects.exposure import Shot
from endotwin.effects.interlacing import FIELDS, Interlacing
from endotwin.effects.processor import Processor
from endotwin.render import Renderer
from endotwin.sequence.readers import open_sequence
from endotwin.synth.photograph import photographed

STEP_MM = np.array([0.0, 0.0, 1.0])


def shot_of(speed: float) -> Shot:
    there, later = np.eye(4), np.eye(4)
    later[:3, 3] = speed * STEP_MM
    camera = tube_twin.CAMERA
    return Shot(camera, there, later, np.full((camera.height, camera.width), 20.0))


def depth_of_pose(shot: Shot) -> torch.Tensor:
    """An image whose value is how far along the way its pose is."""
    return torch.full((shot.camera.height, shot.camera.width, 3), float(shot.T_world_camera[2, 3]))


def test_even_rows_are_a_quarter_of_a_frame_early_and_odd_ones_as_late():
    woven = Interlacing().woven(depth_of_pose, shot_of(1.0)).numpy()
    np.testing.assert_allclose(woven[0::2], FIELDS[0], atol=1e-6)
    np.testing.assert_allclose(woven[1::2], FIELDS[1], atol=1e-6)


def test_the_fields_move_with_the_velocity_of_the_shot():
    """Half a frame lies between them, and from a frame's odd rows to the next frame's even ones as much."""
    velocities = []

    def seen(shot: Shot) -> torch.Tensor:
        velocities.append(shot.T_world_next[2, 3] - shot.T_world_camera[2, 3])
        return depth_of_pose(shot)

    Interlacing().woven(seen, shot_of(3.0))
    np.testing.assert_allclose(velocities, 3.0, atol=1e-6)
    assert FIELDS[1] - FIELDS[0] == 1 + FIELDS[0] - FIELDS[1] == 0.5


def test_a_still_camera_has_no_comb_and_a_moving_one_has():
    twin = tube_twin.fitted(tube_twin.seen(tube_twin.surface(fold_mm=1.5)))
    renderer = Renderer(replace(twin, effects=Effects([Interlacing()])))
    here, later, rng = tube_twin.pose(0.5), tube_twin.pose(0.54), np.random.default_rng(0)
    view = renderer.view(here)
    still = photographed(renderer, view, here, here, rng)[0]
    np.testing.assert_allclose(still, view.color, atol=1e-5)
    moving = photographed(renderer, view, here, later, rng)[0]
    combs = [np.abs(np.diff(image, n=2, axis=0)).mean() for image in (view.color, moving)]
    assert combs[1] > 1.5 * combs[0]


FRAMES = 24


def woven(seed: int, dx_px: float, dy_px: float = 0.0) -> np.ndarray:
    """Texture that moves so far, px, between the two fields."""
    color, (height, width) = textured(seed), textured(seed).shape[:2]

    def moved(share: float) -> np.ndarray:
        shift = np.array([[1, 0, share * dx_px], [0, 1, share * dy_px]])
        options = {"flags": cv2.INTER_CUBIC, "borderMode": cv2.BORDER_REFLECT}
        return cv2.warpAffine(color, shift, (width, height), **options)

    even = moved(-0.5)
    even[1::2] = moved(0.5)[1::2]
    return even


def jpeg(photo: np.ndarray, quality: int) -> np.ndarray:
    return cv2.imdecode(cv2.imencode(".jpg", photo, [cv2.IMWRITE_JPEG_QUALITY, quality])[1], cv2.IMREAD_COLOR)


def told(folder: Path, photos: list[np.ndarray]) -> bool:
    return Interlacing.evidence(photos_of(folder, photos))[0] is not None


@pytest.mark.parametrize("shift_px, noise_levels", [(0.3, 0), (0.3, 1), (1.0, 4), (6.0, 4)])
def test_photos_of_a_moving_camera_tell_their_two_fields(tmp_path, shift_px, noise_levels):
    rng = np.random.default_rng(0)
    angles = rng.uniform(0, 2 * np.pi, FRAMES)
    assert told(
        tmp_path,
        [
            levels(woven(k, shift_px * np.cos(a), shift_px * np.sin(a)), noise_levels, k)
            for k, a in enumerate(angles)
        ],
    )


def test_a_jpeg_codec_leaves_them_told(tmp_path):
    assert told(tmp_path, [jpeg(levels(woven(k, 2.0), 2, k), 75) for k in range(FRAMES)])


@pytest.mark.parametrize("noise_levels", [1, 8])
@pytest.mark.parametrize("sharpened", [None, (0.3, 4.0), (1.2, 1.0)])
@pytest.mark.parametrize("quality", [None, 92])
def test_photos_of_one_moment_tell_none(tmp_path, noise_levels, sharpened, quality):
    photos = []
    for k in range(FRAMES):
        color = levels(textured(k), noise_levels, k) / np.float32(255)
        if sharpened:
            color = Processor(0.0, sharpened[1], sharpened[0]).recorded(color)
        photos.append(levels(color) if quality is None else jpeg(levels(color), quality))
    assert not told(tmp_path, photos)


ODD = (np.arange(240) % 2)[:, None, None]


@pytest.mark.parametrize(
    "change",
    [
        lambda color, k: color * (1 + 0.02 * ODD),
        lambda color, k: color + 0.02 * ODD,
        lambda color, k: color + 0.02 * np.random.default_rng(k).standard_normal((240, 1, 1)),
        lambda color, k: np.repeat(color[::2], 2, axis=0),
        lambda color, k: cv2.resize(color[:160], (320, 240), interpolation=cv2.INTER_CUBIC),
        lambda color, k: np.full_like(color, 0.5),
    ],
    ids=["gain of odd rows", "offset of odd rows", "noise of rows", "doubled rows", "enlarged", "no texture"],
)
def test_rows_that_differ_without_motion_tell_none(tmp_path, change):
    assert not told(tmp_path, [levels(change(textured(k), k), 1, k) for k in range(FRAMES)])


def test_one_photo_and_photos_that_stand_still_tell_none(tmp_path):
    assert not told(tmp_path, [levels(woven(0, 3.0))])
    assert not told(tmp_path, [levels(woven(0, 0.0), 1, k) for k in range(FRAMES)])
    assert not told(tmp_path, [levels(woven(k, 3.0))[:12, :12] for k in range(FRAMES)])


@pytest.mark.parametrize("kind", ["direct", "gi", "offset", "fisheye", "bounce", "wet", "scope"])
def test_path_traced_colons_tell_none(data_root, kind):
    assert Interlacing.evidence(open_sequence(data_root / f"colon_{kind}"))[0] is None


def test_photos_from_the_video_of_c3vd_are_interlaced(data_root):
    """Their combs grow with the speed of the camera, and are gone where it is still."""
    assert Interlacing.evidence(open_sequence(data_root / "c3vd_cecum"))[0] is not None
