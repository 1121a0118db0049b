"""Bloom: highlights brighter than the sensor's range glare into their surroundings."""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt
from typing import ClassVar

import cv2
import numpy as np
import torch
from torch import Tensor

from endotwin.cameras import Camera
from endotwin.effects.effect import Effect, parameter
from endotwin.sequence import Sequence

SATURATION = 1.0
"""Linear radiance at which the display value is 1."""

BOXES = 3


@dataclass(frozen=True)
class Bloom(Effect):
    """A share of what exceeds saturation is spread by a glare kernel: L' = L − a·E + a·(P ∗ E).

    E = max(L − 1, 0), and P is a kernel of sum 1 (the glare filter of Spencer et al. 1995, with one lobe), so
    light is moved and none is made or lost; from beyond the border as much glares in as leaves the image. P
    is three boxes in a row: nearly a Gaussian, 12% lower at its peak, and as fast at any width.

    Attributes:
        share: a, of the light beyond saturation. radius: standard deviation of P, in image heights.
    """

    name: ClassVar[str] = "bloom"
    share: float = parameter(0.2, 0.0, 1.0)
    radius: float = parameter(0.01, 0.0, 0.2)

    def through(self, radiance: Tensor, depth_mm: np.ndarray | Tensor, camera: Camera) -> Tensor:
        """Radiance float32 [H, W, 3] with its glare."""
        if not radiance.numel() or radiance.max() <= SATURATION:
            return radiance
        glare = self.share * (radiance.numpy() - SATURATION).clip(min=0)
        spread = glare
        width = box_width(self.radius * radiance.shape[0])
        for _ in range(BOXES):
            spread = cv2.boxFilter(spread, -1, (width, width), borderType=cv2.BORDER_REFLECT)
        return radiance + torch.from_numpy(spread - glare)

    @classmethod
    def evidence(cls, sequence: Sequence) -> tuple[Bloom | None, str]:
        """Never by photos alone: how far a clipped highlight exceeds the range is not in them. A fit, which
        knows by the others of its photos how bright it was, tells."""
        return None, "rendered on request: a clipped highlight does not tell how bright it was"


def box_width(sigma_px: float) -> int:
    """Odd width of the boxes, BOXES of which in a row have the variance of ``sigma_px``, or nearly."""
    return 2 * round((sqrt(12 * sigma_px**2 / BOXES + 1) - 1) / 2) + 1
