"""How alike two images are over the pixels that count."""

from __future__ import annotations

import logging
from functools import cache

import numpy as np
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

logger = logging.getLogger("endotwin")


def psnr(reference: np.ndarray, image: np.ndarray, mask: np.ndarray) -> float:
    """Peak signal-to-noise ratio in dB over ``mask`` [H, W], of display-encoded images [H, W, 3] in [0, 1].

    From the mean squared error of all channels of the masked pixels; NaN where the mask is empty.
    """
    if not mask.any():
        return float("nan")
    if np.array_equal(reference[mask], image[mask]):
        return float("inf")
    return float(peak_signal_noise_ratio(reference[mask], image[mask], data_range=1))


def ssim_map(reference: np.ndarray, image: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Structural similarity (Wang et al. 2004) of each pixel, [H, W], of images [H, W, 3] in [0, 1].

    Gaussian window of σ 1.5, population covariance, mean over the channels. Outside ``mask`` [H, W] both
    images are 0.
    """
    _, similarity = structural_similarity(
        np.where(mask[..., None], reference, 0),
        np.where(mask[..., None], image, 0),
        channel_axis=-1,
        data_range=1,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        full=True,
    )
    return similarity.mean(axis=-1)


def masked_mean(values: np.ndarray, mask: np.ndarray) -> float:
    """Mean of ``values`` [H, W] over ``mask`` [H, W]; NaN where the mask is empty."""
    return float(values[mask].mean()) if mask.any() else float("nan")


LPIPS_NETWORKS = ("alex", "vgg")
"""What LPIPS can be of: AlexNet or VGG-16."""


@cache
def _lpips_network(name: str):
    """The LPIPS network of that name, or None where the optional extra ``lpips`` is not installed or does not
    work."""
    try:
        import lpips

        return lpips.LPIPS(net=name, spatial=True, verbose=False).eval()
    except ImportError:
        return None
    except (OSError, RuntimeError) as error:  # weights out of reach, or a torchvision made for another torch
        logger.warning("LPIPS is left out, because its network %s cannot be loaded: %s", name, error)
        return None


def lpips_installed(network: str = "alex") -> bool:
    """Whether the optional extra ``lpips`` is there and works with that one of LPIPS_NETWORKS."""
    return _lpips_network(network) is not None


def lpips_map(
    reference: np.ndarray, image: np.ndarray, mask: np.ndarray, network: str = "alex"
) -> np.ndarray:
    """Learned perceptual distance of each pixel, [H, W] (Zhang et al. 2018), of one of LPIPS_NETWORKS.

    Needs the extra ``lpips``. Images [H, W, 3] in [0, 1], which the network sees in [−1, 1]; outside ``mask``
    [H, W] both are 0.
    """
    import torch

    def prepared(picture: np.ndarray) -> torch.Tensor:
        masked = np.where(mask[..., None], picture, 0).astype(np.float32)
        return torch.from_numpy(masked).permute(2, 0, 1)[None] * 2 - 1

    with torch.inference_mode():
        return _lpips_network(network)(prepared(reference), prepared(image))[0, 0].numpy()
