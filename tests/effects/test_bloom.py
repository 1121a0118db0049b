"""Bloom: light that is moved, not made."""

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter

from endotwin.cameras import Pinhole
from endotwin.effects.bloom import Bloom

CAMERA = Pinhole(200, 160, 100.0, 100.0, 99.5, 79.5)


def highlight(peak: float) -> torch.Tensor:
    image = torch.full((160, 200, 3), 0.3)
    image[78:82, 98:102] = torch.tensor([peak, peak / 2, 0.9])
    return image


@pytest.mark.parametrize("radius", [0.005, 0.02, 0.05])
def test_energy_is_conserved_in_each_channel(radius):
    image = highlight(40.0)
    found = Bloom(share=0.3, radius=radius).through(image, None, CAMERA)
    np.testing.assert_allclose(found.double().sum((0, 1)), image.double().sum((0, 1)), rtol=1e-5)
    assert found.min() >= 0.3 - 1e-6


def test_only_what_exceeds_saturation_glares_and_only_the_share_of_it():
    image = highlight(11.0)
    found = Bloom(share=0.25, radius=0.02).through(image, None, CAMERA)
    assert torch.equal(found[..., 2], image[..., 2])
    beyond = (found - image).clamp(min=0).double().sum((0, 1))
    assert 0 < beyond[0] <= 0.25 * 10.0 * 16 + 1e-6


def test_an_image_without_highlights_is_left_alone():
    image = highlight(1.0)
    assert Bloom(1.0, 0.1).through(image, None, CAMERA) is image
    assert Bloom().through(torch.zeros(0, 0, 3), None, CAMERA).shape == (0, 0, 3)


@pytest.mark.parametrize("radius", [0.02, 0.04])
def test_the_glare_is_nearly_a_gaussian_of_its_radius(radius):
    image = torch.zeros(160, 200, 3)
    image[80, 100] = 101.0
    found = Bloom(share=1.0, radius=radius).through(image, None, CAMERA)[..., 0].double().numpy()
    found[80, 100] -= 1.0
    sigma = radius * 160
    v, u = np.mgrid[:160, :200] - np.array([80, 100])[:, None, None]
    assert (found * u**2).sum() / found.sum() == pytest.approx(sigma**2, rel=0.25)
    point = np.zeros((160, 200))
    point[80, 100] = 100.0
    assert (found * v**2).sum() == pytest.approx((found * u**2).sum(), rel=1e-4)
    gauss = gaussian_filter(point, np.sqrt((found * u**2).sum() / found.sum()))
    assert np.abs(found - gauss).max() < 0.15 * gauss.max()


def test_energy_is_conserved_at_the_border_too():
    image = torch.zeros(160, 200, 3)
    image[0, :20] = 11.0
    found = Bloom(share=1.0, radius=0.02).through(image, None, CAMERA)
    assert found.double().sum().item() == pytest.approx(image.double().sum().item(), rel=1e-5)
