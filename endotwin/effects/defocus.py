"""Defocus: tissue nearer or farther than the lens is focused at is seen through a disc."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import cv2
import numpy as np
import torch
from torch import Tensor

from endotwin.cameras import Camera, Pinhole
from endotwin.effects.axis import focal_px
from endotwin.effects.effect import Effect, parameter
from endotwin.sequence import Sequence

MAX_RADIUS_PX = 32.0
SHARP_PX = 0.1
"""Discs of a smaller radius are points."""

RATIO = 1.5
"""Radius of each of DISCS over that of the one before."""

SUBPIXELS = 16

EMPTY = 1e-6
"""Coverage below which a pixel has nothing to divide by."""


@dataclass(frozen=True)
class Defocus(Effect):
    """Circle of confusion of a thin lens (Potmesil & Chakravarty 1982), by slabs of depth.

    Its diameter in pixels is c = f·A·|1/s − 1/z|: A the aperture's diameter, s the focused and z the seen
    depth, f the focal length in pixels at the axis. This is c = A·v·|1/s − 1/z| on a sensor at the image
    distance v, exactly. Behind a wide-angle lens (any model but the pinhole) the surface in focus is a sphere
    about the lens, so z is the distance there.

    Pixels are sorted into slabs of similar discs, and each slab, spread by them, is laid over those behind
    it: far tissue never bleeds over nearer, and near tissue out of focus is seen through at its rim. Where
    there is no surface, black lies infinitely far.

    Attributes:
        aperture_mm: diameter of the entrance pupil. focus_mm: depth in focus.
    """

    name: ClassVar[str] = "defocus"
    aperture_mm: float = parameter(0.1, 0.0, 5.0)
    focus_mm: float = parameter(15.0, 0.5, 1000.0)

    def blur_radius_px(self, depth_mm: np.ndarray | Tensor, camera: Camera) -> np.ndarray:
        """Radius of each pixel's disc, float32 [H, W]: positive beyond the focus, negative before it."""
        depth_mm = np.asarray(depth_mm, np.float32)
        with np.errstate(divide="ignore", invalid="ignore"):
            if not isinstance(camera, Pinhole):
                depth_mm = depth_mm / camera.pixel_directions[..., 2]
            nearness = np.where(depth_mm > 0, 1 / depth_mm, 0).astype(np.float32)
        radius = np.float32(focal_px(camera) * self.aperture_mm / 2) * (1 / self.focus_mm - nearness)
        return np.clip(radius, -MAX_RADIUS_PX, MAX_RADIUS_PX).astype(np.float32)

    def through(self, radiance: Tensor, depth_mm: np.ndarray | Tensor, camera: Camera) -> Tensor:
        """Radiance float32 [H, W, 3] as the lens images it."""
        if not radiance.numel():
            return radiance
        radius = self.blur_radius_px(depth_mm, camera)
        if np.abs(radius).max() < SHARP_PX:
            return radiance
        slab, share = _slabs(radius)
        premultiplied = np.ones((*radius.shape, 4), np.float32)
        premultiplied[..., :3] = radiance.numpy()
        image = np.zeros_like(premultiplied)
        for number in np.unique(slab):
            _lay_over(image, premultiplied, slab, share, int(number))
        return torch.from_numpy((image[..., :3] / np.maximum(image[..., 3:], EMPTY)).clip(min=0))

    @classmethod
    def evidence(cls, sequence: Sequence) -> tuple[Defocus | None, str]:
        """Never by itself: in photos, tissue out of focus and tissue without detail look alike."""
        return None, "rendered on request: photos alone do not tell defocus from smooth tissue"


def disc(radius_px: float) -> np.ndarray:
    """A disc as a kernel float32 [k, k] of sum 1: the share of each pixel that it covers."""
    reach = max(int(np.ceil(radius_px - 0.5)), 0)
    inside = (np.arange((2 * reach + 1) * SUBPIXELS) + 0.5) / SUBPIXELS - reach - 0.5
    covered = (inside[:, None] ** 2 + inside**2 <= radius_px**2).astype(np.float64)
    pixels = covered.reshape(2 * reach + 1, SUBPIXELS, 2 * reach + 1, SUBPIXELS).sum(axis=(1, 3))
    return (pixels / pixels.sum()).astype(np.float32)


def variance(kernel: np.ndarray) -> float:
    """Variance of a kernel along x, px²: R²/4 for a disc."""
    along = kernel.sum(axis=0, dtype=np.float64)
    return float(along @ (np.arange(len(along)) - len(along) // 2) ** 2)


STEPS = int(np.ceil(np.log(MAX_RADIUS_PX) / np.log(RATIO)))
DISCS = [disc(radius) for radius in (0.5, *(RATIO**step for step in range(STEPS + 1)))]
"""A point and discs of growing radius."""

RADII = np.array([2 * np.sqrt(variance(kernel)) for kernel in DISCS], np.float32)
"""Radii of the ideal discs that have the variances of DISCS."""


def _slabs(radius: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The slab of each pixel, int8 [H, W], and the share of its larger disc, float32 [H, W].

    A slab holds the pixels on one side of the focus whose disc is between two neighbours in DISCS, i and
    i + 1. Its number grows towards the lens: i before the focus, −1 − i beyond it. With the ``share`` of the
    larger disc, the mixture of both has the variance of the pixel's own, R²/4.
    """
    size = np.abs(radius)
    smaller = np.zeros(radius.shape, np.int8)
    for larger in RADII[1:-1]:
        smaller += size >= larger
    low, high = RADII[smaller] ** 2, RADII[smaller + 1] ** 2
    return np.where(radius < 0, smaller, -1 - smaller), (size**2 - low) / (high - low)


def _lay_over(
    image: np.ndarray, premultiplied: np.ndarray, slab: np.ndarray, share: np.ndarray, number: int
) -> None:
    """Spread the pixels of one slab by their discs, and lay them over ``image`` [H, W, 4], in place.

    The slab goes on below the next nearer one for as far as that lets it shine through, so that a surface
    which slants from one to the other has no rim there. Through the rim of tissue before the focus one sees
    what no ray of the sharp image reached: there, what lies behind is continued from its surroundings.
    """
    smaller = max(number, -1 - number)
    reach = len(DISCS[smaller + 1]) // 2
    x, y, width, height = cv2.boundingRect((slab == number).view(np.uint8))
    onward = 3 * reach
    margin = onward + reach
    box = np.s_[max(y - margin, 0) : y + height + margin, max(x - margin, 0) : x + width + margin]
    slab, share, behind = slab[box], share[box], image[box]
    members = slab == number
    below = cv2.dilate(members.view(np.uint8), np.ones((2 * onward + 1, 2 * onward + 1))).view(bool)
    below &= slab == number + 1
    large = np.where(members, share, np.float32(number >= 0))
    own = premultiplied[box] * (members | below)[..., None]
    wide = own * large[..., None]
    spread = _spread(own - wide, DISCS[smaller]) + _spread(wide, DISCS[smaller + 1])
    if number > 0:
        around = cv2.boxFilter(behind, -1, (4 * reach + 1, 4 * reach + 1), borderType=cv2.BORDER_CONSTANT)
        behind += around * ((1 - behind[..., 3:]) / np.maximum(around[..., 3:], EMPTY))
    behind *= 1 - spread[..., 3:]
    behind += spread


def _spread(image: np.ndarray, kernel: np.ndarray) -> np.ndarray:
    """The image [H, W, 4] with each pixel spread by a kernel; what touches the border goes on beyond it."""
    return image if len(kernel) == 1 else cv2.filter2D(image, -1, kernel, borderType=cv2.BORDER_REPLICATE)
