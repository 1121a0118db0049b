"""Defocus against the thin lens, traced ray by ray, and against what a disc does to light."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from endotwin.cameras import CALIBRATIONS, Fisheye, Pinhole
from endotwin.effects.defocus import MAX_RADIUS_PX, RADII, RATIO, Defocus, disc, variance

CAMERA = Pinhole(96, 72, 60.0, 60.0, 47.5, 35.5)
SHAPE = (CAMERA.height, CAMERA.width)
CENTRE = (36, 48)


def wall(depth_mm: float) -> np.ndarray:
    return np.full(SHAPE, depth_mm, np.float32)


def point_of_light() -> torch.Tensor:
    image = torch.zeros(*SHAPE, 3)
    image[CENTRE] = 1.0
    return image


def depth_of_blur(lens: Defocus, radius_px: float) -> float:
    """Depth before the focus whose disc has a radius."""
    return 1 / (1 / lens.focus_mm + 2 * radius_px / (lens.aperture_mm * 60.0))


@given(
    aperture=st.floats(0.01, 0.5),
    focus=st.floats(5, 60),
    depth=st.floats(3, 150),
    focal=st.floats(0.5, 2.5),
)
def test_the_disc_is_that_of_rays_through_the_rim_of_a_thin_lens(aperture, focus, depth, focal):
    """Rim rays of a point meet at its image distance; where they cross the sensor is the disc's rim."""
    sensor, image = (focal * d / (d - focal) for d in (focus, depth))
    rim = aperture / 2
    crossing = rim + (0 - rim) * sensor / image
    pitch = sensor / CAMERA.fx
    radius = Defocus(aperture, focus).blur_radius_px(wall(depth), CAMERA)[0, 0]
    assert abs(radius) == pytest.approx(min(abs(crossing) / pitch, 32), rel=1e-3, abs=1e-4)
    assert radius * (depth - focus) >= 0


@pytest.mark.parametrize("radius", [0.3, 0.9, 1.4, 2.0, 3.7, 6.0, 10.0])
def test_a_point_is_spread_over_a_disc_of_that_radius_and_keeps_its_energy(radius):
    lens = Defocus(aperture_mm=0.4, focus_mm=20.0)
    depth_mm = wall(depth_of_blur(lens, radius))
    spread = lens.through(point_of_light(), depth_mm, CAMERA)[..., 0].numpy().astype(float)
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]] - np.array(CENTRE)[:, None, None]
    assert spread.sum() == pytest.approx(1, abs=1e-5)
    assert (spread * u**2).sum() == pytest.approx(radius**2 / 4, rel=1e-3)
    assert (spread * v**2).sum() == pytest.approx(radius**2 / 4, rel=1e-3)
    assert spread[np.hypot(u, v) > RATIO * radius + 1.5].max() < 1e-12


def test_far_defocus_keeps_energy_too():
    lens = Defocus(aperture_mm=1.0, focus_mm=5.0)
    spread = lens.through(point_of_light(), wall(30.0), CAMERA).double()
    assert spread.sum(dim=(0, 1)).numpy() == pytest.approx([1, 1, 1], abs=1e-5)


@pytest.mark.parametrize("radius", [3.0, 4.5, 9.0])
def test_a_disc_is_flat_of_sum_one_and_of_its_variance(radius):
    kernel = disc(radius)
    assert kernel.sum() == pytest.approx(1, abs=1e-5)
    assert kernel[len(kernel) // 2, len(kernel) // 2] == pytest.approx(1 / (np.pi * radius**2), rel=0.02)
    assert variance(kernel) == pytest.approx(radius**2 / 4 + 1 / 12, rel=0.02)


def test_discs_grow_from_a_point_to_the_bound():
    assert RADII[0] == 0 and (np.diff(RADII) > 0).all() and RADII[-1] >= MAX_RADIUS_PX


def test_what_is_in_focus_stays_as_it_is():
    image = torch.rand(*SHAPE, 3, generator=torch.Generator().manual_seed(0))
    assert torch.equal(Defocus(0.5, 20.0).through(image, wall(20.0), CAMERA), image)


def test_bright_blurred_background_does_not_bleed_over_a_sharp_foreground():
    depth_mm, image = wall(80.0), torch.full((*SHAPE, 3), 50.0)
    depth_mm[20:50, 30:60], image[20:50, 30:60] = 8.0, 1.0
    found = Defocus(aperture_mm=1.0, focus_mm=8.0).through(image, depth_mm, CAMERA)
    torch.testing.assert_close(found[20:50, 30:60], image[20:50, 30:60])
    torch.testing.assert_close(found[depth_mm == 80], image[depth_mm == 80], rtol=1e-4, atol=0)


def test_a_slanting_wall_has_no_seam_where_its_discs_grow():
    """Ever nearer to the right, and black far below its lower edge, of which nothing shines through above."""
    across = np.linspace(0, 1, CAMERA.width, dtype=np.float32)
    depth_mm, image = wall(200.0), torch.zeros(*SHAPE, 3)
    depth_mm[:50], image[:50] = 40 - 34 * across, 1.0
    lens = Defocus(aperture_mm=1.0, focus_mm=38.0)
    assert lens.blur_radius_px(depth_mm, CAMERA).min() < -4
    found = lens.through(image, depth_mm, CAMERA)
    torch.testing.assert_close(found[:42], image[:42], rtol=0, atol=0.01)


def test_a_near_rim_out_of_focus_is_seen_through():
    lens = Defocus(aperture_mm=0.4, focus_mm=40.0)
    radius = 5.0
    depth_mm, image = wall(40.0), torch.zeros(*SHAPE, 3)
    depth_mm[:, 48:], image[:, 48:] = depth_of_blur(lens, radius), 1.0
    profile = lens.through(image, depth_mm, CAMERA)[36, :, 0].numpy()
    across = np.arange(CAMERA.width) - 47.5
    chord = np.clip(across / radius, -1, 1)
    exact = 0.5 + (chord * np.sqrt(1 - chord**2) + np.arcsin(chord)) / np.pi
    assert np.abs(profile - exact)[10:-10].max() < 0.02


def test_no_surface_is_black_and_far_and_gives_no_nan():
    depth_mm, image = wall(np.nan), torch.zeros(*SHAPE, 3)
    depth_mm[:, :40], image[:, :40] = 10.0, 0.7
    found = Defocus(1.0, 10.0).through(image, depth_mm, CAMERA)
    assert found.isfinite().all() and not found[:, 40:].any()
    torch.testing.assert_close(found[:, :40], image[:, :40])
    assert Defocus(1.0).through(torch.zeros(0, 96, 3), np.zeros((0, 96), np.float32), CAMERA).shape[0] == 0


def test_the_focus_of_a_fisheye_is_a_sphere():
    for camera in (Fisheye(90, 90, 30.0, 30.0, 44.5, 44.5), CALIBRATIONS["c3vd-v1"].scaled(0.1)):
        depth_mm = 12.0 * camera.pixel_directions[..., 2]
        radius = Defocus(0.5, 12.0).blur_radius_px(depth_mm, camera)
        assert np.abs(radius).max() < 1e-4
