"""Lateral chromatic aberration: red and blue are imaged at other sizes than green."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import ClassVar

import cv2
import numpy as np
import torch
from torch import Tensor

from endotwin.cameras import Camera
from endotwin.effects.axis import principal_point_px
from endotwin.effects.effect import Effect, parameter
from endotwin.sequence import Sequence

FRAMES = 2
FINE_PX, COARSE_PX = 1.5, 4.0
"""Details between these sizes (standard deviations of Gaussians) are compared between channels."""

MARGIN_PX = 17
TILE_PX = 64

CERTAIN = 4.0
"""Standard errors that a measured magnification must differ from 1 by."""

LEAST = 0.002
"""Least magnification taken for one: interreflection reddens one side of folds, which looks like 0.001."""

DARKEST, BRIGHTEST = 12, 243
"""Pixels (of 255 levels) that are compared."""


@dataclass(frozen=True)
class Chromatic(Effect):
    """Each channel is magnified about the principal point: C_c(u) = L_c(u₀ + (u − u₀)/m_c).

    m = 1 + (red, 0, blue); u₀ is where the camera's own model sees along its axis. Radial magnification by
    wavelength is the first term of lateral colour (Mallon & Whelan 2007). Interpolation is bilinear.

    Attributes:
        red, blue: relative magnification of the channel beyond green's.
    """

    name: ClassVar[str] = "chromatic"
    red: float = parameter(-0.001, -0.02, 0.02)
    blue: float = parameter(0.001, -0.02, 0.02)

    def through(self, radiance: Tensor, depth_mm: np.ndarray | Tensor, camera: Camera) -> Tensor:
        """Radiance float32 [H, W, 3] as the lens images it; beyond the image is what its border shows."""
        if not radiance.numel():
            return radiance
        image = radiance.numpy().copy()
        for channel, beyond in ((0, self.red), (2, self.blue)):
            if beyond:
                u, v = _source(camera, 1 + beyond)
                plane = np.ascontiguousarray(image[..., channel])
                image[..., channel] = cv2.remap(
                    plane, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
                )
        return torch.from_numpy(image)

    @classmethod
    def measured(cls, sequence: Sequence, frames: int = FRAMES) -> tuple[Chromatic, Chromatic]:
        """Magnifications in ``frames`` photos spread over the sequence, and their standard errors.

        Details D of the logarithm of red and blue are compared with green's by least squares over all
        pixels: D_c = a·D_g + b·(u − u₀)·∇D_g, with m_c − 1 = −b/a. The errors are a jackknife over tiles.
        Good to about 15%, since noise in D_g makes a too small.
        """
        chosen = sequence.spread(frames)
        sums = [_moments(sequence.color(i), sequence.lens_mask, sequence.camera) for i in chosen]
        red, blue = (_magnification(np.concatenate(channel)) for channel in zip(*sums, strict=True))
        return cls(red[0], blue[0]), cls(red[1], blue[1])

    @classmethod
    def evidence(cls, sequence: Sequence) -> tuple[Chromatic | None, str]:
        """A measured magnification that is certain, and more than colours of the scene can feign."""
        found, error = cls.measured(sequence)
        beyond, sure = np.array([found.red, found.blue]), CERTAIN * np.array([error.red, error.blue])
        real = np.where(np.abs(beyond) > np.maximum(sure, LEAST), beyond, 0.0)
        seen = (
            f"red is {found.red:+.2%} and blue {found.blue:+.2%} larger than green in the photos "
            f"(standard errors {error.red:.2%}, {error.blue:.2%})"
        )
        return (cls(*map(float, real)), seen) if real.any() else (None, seen)


@lru_cache(maxsize=4)
def _source(camera: Camera, magnification: float) -> tuple[np.ndarray, np.ndarray]:
    """Pixel coordinates u, v float32 [H, W] that a magnified channel is seen at."""
    u0, v0 = principal_point_px(camera)
    u = (u0 + (np.arange(camera.width) - u0) / magnification).astype(np.float32)
    v = (v0 + (np.arange(camera.height) - v0) / magnification).astype(np.float32)
    u, v = np.meshgrid(u, v)
    return u, v


def _moments(photo: np.ndarray, mask: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """For red and for blue, sums [tiles, 5] of gg, gr, rr, cg, cr over the usable pixels of each tile.

    g are green's details, r their slope along u − u₀, and c the channel's details.
    """
    color = photo.astype(np.float32)
    usable = mask & (color.min(axis=2) > DARKEST) & (color.max(axis=2) < BRIGHTEST)
    usable = cv2.erode(usable.astype(np.uint8), np.ones((MARGIN_PX, MARGIN_PX)), borderValue=0) > 0
    logarithm = np.log(np.maximum(color, 1))
    fine, coarse = (cv2.GaussianBlur(logarithm, (0, 0), size) for size in (FINE_PX, COARSE_PX))
    details = fine - coarse
    green = np.ascontiguousarray(details[..., 1])
    u0, v0 = principal_point_px(camera)
    u, v = np.arange(camera.width) - u0, np.arange(camera.height) - v0
    slope = u * cv2.Scharr(green, cv2.CV_32F, 1, 0, scale=1 / 32)
    slope += v[:, None] * cv2.Scharr(green, cv2.CV_32F, 0, 1, scale=1 / 32)
    tile = np.add.outer(
        np.arange(camera.height) // TILE_PX * camera.width, np.arange(camera.width) // TILE_PX
    )
    number = np.unique(tile[usable], return_inverse=True)[1]
    g, r = green[usable], slope[usable]

    def sums(channel: int) -> np.ndarray:
        c = details[..., channel][usable]
        return np.stack([np.bincount(number, x) for x in (g * g, g * r, r * r, c * g, c * r)], axis=1)

    return sums(0), sums(2)


def _magnification(moments: np.ndarray) -> tuple[float, float]:
    """m − 1 and its standard error from sums [tiles, 5]; 0 and inf where the photos have no detail."""
    count = len(moments)
    if count < 2:
        return 0.0, float("inf")
    gg, gr, rr, cg, cr = np.concatenate([moments.sum(0)[None], moments.sum(0) - moments]).T
    with np.errstate(divide="ignore", invalid="ignore"):
        beyond = (gr * cg - gg * cr) / (rr * cg - gr * cr)
    error = np.sqrt((count - 1) * beyond[1:].var())
    return (float(beyond[0]), float(error)) if np.isfinite(error) else (0.0, float("inf"))
