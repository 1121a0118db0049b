"""The optical axis as each camera model's own parameters name it."""

import numpy as np
import pytest

from endotwin.cameras import CALIBRATIONS, Fisheye, Pinhole
from endotwin.effects.axis import angle_from_axis, focal_px, principal_point_px


@pytest.mark.parametrize("model", [Pinhole, Fisheye])
def test_focal_length_and_principal_point_are_the_parameters(model):
    camera = model(80, 60, 50.0, 54.0, 41.0, 28.0, k1=0.05)
    assert principal_point_px(camera) == pytest.approx((41.0, 28.0))
    assert focal_px(camera) == pytest.approx(52.0, rel=1e-5)


def test_c3vd_s_focal_length_is_a0():
    camera = CALIBRATIONS["c3vd-v1"]
    assert principal_point_px(camera) == pytest.approx((camera.cx, camera.cy))
    assert focal_px(camera) == pytest.approx(camera.a0, rel=1e-4)


def test_angles_are_those_of_the_rays_past_90_degrees_too():
    camera = CALIBRATIONS["c3vd-v1"].scaled(0.1)
    angle = angle_from_axis(camera)
    np.testing.assert_allclose(np.cos(angle), camera.pixel_directions[..., 2], atol=1e-6)
    assert angle.max() > np.pi / 2
