"""Vignetting: the lens passes less light towards the rim of the image."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from endotwin.effects.effect import Effect, parameter

if TYPE_CHECKING:
    from endotwin.cameras import Camera


@dataclass(frozen=True)
class Vignetting(Effect):
    """Transmission V(r) = exp(k2·r² + k4·r⁴), r the distance from the image's middle in half its longer side.

    The usual even polynomial (Goldman 2010, eq. 3), in the exponent, so that it stays positive.
    """

    name: ClassVar[str] = "vignetting"
    k2: float = parameter(0.0, -5.0, 1.0)
    k4: float = parameter(0.0, -5.0, 5.0)

    def transmission(self, camera: Camera, pixel: np.ndarray) -> np.ndarray:
        """V of row-major pixels [N], float32 [N]."""
        r2 = squared_radius(camera, pixel)
        return np.exp(self.k2 * r2 + self.k4 * r2 * r2).astype(np.float32)


def squared_radius(camera: Camera, pixel: np.ndarray) -> np.ndarray:
    """r² of row-major pixels [N], float32 [N]; 1 at the middle of the shorter side of the image's border."""
    half = max(camera.width, camera.height) / 2
    v, u = np.divmod(pixel, camera.width)
    x, y = (u - (camera.width - 1) / 2) / half, (v - (camera.height - 1) / 2) / half
    return (x * x + y * y).astype(np.float32)
