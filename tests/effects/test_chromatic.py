"""Chromatic aberration against exact magnification, and measured where it was put in."""

import shutil

import cv2
import numpy as np
import pytest
import torch

from endotwin.cameras import CALIBRATIONS, Fisheye, Pinhole
from endotwin.effects.chromatic import Chromatic
from endotwin.sequence.images import read_color
from endotwin.sequence.readers import open_sequence

CAMERAS = {
    "pinhole": Pinhole(120, 90, 80.0, 80.0, 55.0, 47.0, k1=-0.1),
    "fisheye": Fisheye(120, 90, 50.0, 50.0, 55.0, 47.0, k1=0.01),
    "omni": CALIBRATIONS["c3vd-v1"].scaled(0.1),
}


def coordinates(camera) -> np.ndarray:
    """Pixel coordinates float32 [H, W, 2]."""
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    return np.stack([u, v], axis=-1).astype(np.float32)


@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS)
def test_red_and_blue_are_magnified_about_the_principal_point_and_green_is_not(camera):
    uv = coordinates(camera)
    for axis, centre in ((0, camera.cx), (1, camera.cy)):
        image = torch.from_numpy(np.repeat(uv[..., axis : axis + 1], 3, axis=2))
        found = Chromatic(red=-0.01, blue=0.004).through(image, None, camera).numpy()
        assert np.array_equal(found[..., 1], uv[..., axis])
        for channel, magnification in ((0, 0.99), (2, 1.004)):
            exact = centre + (uv[..., axis] - centre) / magnification
            inside = (exact >= 0) & (exact <= uv[..., axis].max())
            np.testing.assert_allclose(found[..., channel][inside], exact[inside], atol=1e-3)


def test_a_dot_moves_outward_by_its_distance_from_the_centre_times_the_magnification():
    camera = Pinhole(200, 200, 100.0, 100.0, 99.0, 101.0)
    uv = coordinates(camera)
    for dot in ([160.0, 101.0], [99.0, 30.0], [40.0, 150.0]):
        blob = np.exp(-((uv - dot) ** 2).sum(-1) / (2 * 3.0**2))
        image = torch.from_numpy(np.repeat(blob[..., None], 3, axis=2))
        found = Chromatic(red=0.02, blue=-0.01).through(image, None, camera).numpy()
        for channel, beyond in ((0, 0.02), (1, 0.0), (2, -0.01)):
            weight = found[..., channel, None]
            middle = (uv * weight).sum((0, 1)) / weight.sum()
            exact = np.array([99.0, 101.0]) + (1 + beyond) * (np.array(dot) - [99.0, 101.0])
            np.testing.assert_allclose(middle, exact, atol=0.02)


def test_no_magnification_changes_nothing_and_the_image_given_is_kept():
    camera = CAMERAS["pinhole"]
    image = torch.rand(camera.height, camera.width, 3, generator=torch.Generator().manual_seed(0))
    kept = image.clone()
    assert torch.equal(Chromatic(0.0, 0.0).through(image, None, camera), image)
    Chromatic(0.01, 0.01).through(image, None, camera)
    assert torch.equal(image, kept)
    assert Chromatic().through(torch.zeros(0, 4, 3), None, camera).shape == (0, 4, 3)


def test_the_example_has_none(example):
    effect, reason = Chromatic.evidence(open_sequence(example))
    assert effect is None and "standard errors" in reason


def test_what_was_put_into_photos_is_measured(example, tmp_path):
    truth = Chromatic(red=0.006, blue=-0.004)
    folder = shutil.copytree(example, tmp_path / "colored", ignore=shutil.ignore_patterns("truth"))
    camera = open_sequence(folder).camera
    for file in folder.glob("*_color.png"):
        photo = torch.from_numpy(read_color(file).astype(np.float32))
        colored = np.rint(truth.through(photo, None, camera).numpy()).astype(np.uint8)
        cv2.imwrite(str(file), colored[..., ::-1])
    found, _ = Chromatic.evidence(open_sequence(folder))
    assert found.red == pytest.approx(truth.red, rel=0.25)
    assert found.blue == pytest.approx(truth.blue, rel=0.25)


@pytest.mark.parametrize("name", ["colon_direct", "colon_gi", "colon_offset", "colon_fisheye"])
def test_path_traced_colons_have_none(data_root, name):
    assert Chromatic.evidence(open_sequence(data_root / name))[0] is None
