"""Image metrics: closed forms, an independent SSIM, and pixels outside the mask that must not matter."""

import sys
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter

from endotwin.evaluation import metrics


@pytest.fixture
def images() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A smooth photo, a noisy render of it, and a round mask."""
    rng = np.random.default_rng(3)
    photo = gaussian_filter(rng.uniform(0, 1, (60, 80, 3)), (3, 3, 0))
    photo = (photo - photo.min()) / np.ptp(photo)
    render = np.clip(photo + rng.normal(0, 0.03, photo.shape), 0, 1)
    y, x = np.mgrid[:60, :80]
    return photo, render, (x - 40) ** 2 + (y - 30) ** 2 < 25**2


def test_psnr_of_a_constant_error_is_its_closed_form(images):
    photo, _, mask = images
    assert metrics.psnr(photo, photo + 0.1, mask) == pytest.approx(20, abs=1e-6)


def test_psnr_pools_the_squared_error_of_all_masked_pixels(images):
    photo, render, mask = images
    error = (photo - render)[mask]
    assert metrics.psnr(photo, render, mask) == pytest.approx(-10 * np.log10(np.mean(error**2)))


def test_nothing_outside_the_mask_changes_a_score(images):
    photo, render, mask = images
    spoiled = np.where(mask[..., None], render, 1 - render)
    assert metrics.psnr(photo, spoiled, mask) == metrics.psnr(photo, render, mask)
    before, after = metrics.ssim_map(photo, render, mask), metrics.ssim_map(photo, spoiled, mask)
    np.testing.assert_array_equal(before[mask], after[mask])


def test_ssim_agrees_with_the_formula_of_wang_2004(images):
    photo, render, mask = images

    def blur(channel: np.ndarray) -> np.ndarray:
        return gaussian_filter(channel, 1.5, truncate=3.5)

    maps = []
    for channel in range(3):
        x, y = (np.where(mask, image[..., channel], 0) for image in (photo, render))
        mx, my = blur(x), blur(y)
        vx, vy, vxy = blur(x * x) - mx * mx, blur(y * y) - my * my, blur(x * y) - mx * my
        c1, c2 = 0.01**2, 0.03**2
        maps.append((2 * mx * my + c1) * (2 * vxy + c2) / ((mx**2 + my**2 + c1) * (vx + vy + c2)))
    expected = np.mean(maps, axis=0)[mask].mean()
    assert metrics.masked_mean(metrics.ssim_map(photo, render, mask), mask) == pytest.approx(
        expected, abs=1e-6
    )


def test_ssim_of_an_image_with_itself_is_one(images):
    photo, _, mask = images
    assert metrics.masked_mean(metrics.ssim_map(photo, photo, mask), mask) == pytest.approx(1)


def test_an_empty_mask_has_no_score(images):
    photo, render, mask = images
    empty = np.zeros_like(mask)
    assert np.isnan(metrics.psnr(photo, render, empty))
    assert np.isnan(metrics.masked_mean(photo[..., 0], empty))


@pytest.mark.parametrize("network", metrics.LPIPS_NETWORKS)
def test_lpips_gives_the_network_asked_for_pictures_between_minus_one_and_one_black_off_the_mask(
    images, monkeypatch, network
):
    photo, render, mask = images
    asked, given = [], []

    class Network(torch.nn.Module):
        def __init__(self, net, spatial, verbose):
            super().__init__()
            asked.append(net)

        def forward(self, reference, image):
            given.extend((reference, image))
            return (reference - image).abs().mean(dim=1, keepdim=True)

    monkeypatch.setitem(sys.modules, "lpips", SimpleNamespace(LPIPS=Network))
    metrics._lpips_network.cache_clear()
    try:
        distance = metrics.lpips_map(photo, render, mask, network)
    finally:
        metrics._lpips_network.cache_clear()
    assert asked == [network]
    for picture, tensor in zip((photo, render), given, strict=True):
        shown = (tensor[0].permute(1, 2, 0).numpy() + 1) / 2
        np.testing.assert_allclose(shown[mask], picture[mask], atol=1e-6)
        assert (tensor[0][:, ~torch.from_numpy(mask)] == -1).all()
    assert distance[~mask].max() == 0 and distance[mask].max() > 0


def test_lpips_is_absent_where_the_extra_is_not_installed(monkeypatch):
    monkeypatch.setitem(sys.modules, "lpips", None)
    metrics._lpips_network.cache_clear()
    try:
        assert not metrics.lpips_installed()
    finally:
        metrics._lpips_network.cache_clear()
