"""The lens circle: black beyond the field stop. Distortion is the camera model that renders."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from endotwin.cameras import Camera, Pinhole
from endotwin.effects.axis import angle_from_axis, focal_px
from endotwin.effects.effect import Effect, parameter
from endotwin.effects.overlay import legs_px
from endotwin.sequence import Sequence

FULL = 0.999
"""Share of the image inside the lens circle from which on there is none."""

WHOLE_FIELD_DEG = 180.0


@dataclass(frozen=True)
class Lens(Effect):
    """A round field stop: only rays within ``half_angle_deg`` of the optical axis reach the sensor.

    The stop is an angle, not a radius in pixels, so that it is the same lens through every camera model and
    at every scale: C3VD's fisheye has its circle, and a pinhole of a narrower field sees none of it.

    Attributes:
        half_angle_deg: angle from the axis to the stop; 180 has no stop.
    """

    name: ClassVar[str] = "lens"
    half_angle_deg: float = parameter(WHOLE_FIELD_DEG, 1.0, WHOLE_FIELD_DEG)

    def mask(self, camera: Camera) -> np.ndarray:
        """Bool [H, W]: pixels whose ray passes the stop."""
        return angle_from_axis(camera) <= np.radians(self.half_angle_deg)

    def through(self, radiance: Tensor, depth_mm: np.ndarray | Tensor, camera: Camera) -> Tensor:
        """Radiance float32 [H, W, 3], black outside the circle; its edge is a pixel wide."""
        return radiance * torch.from_numpy(_passed(camera, self.half_angle_deg))[..., None]

    @classmethod
    def measured(cls, camera: Camera, lit: np.ndarray) -> tuple[Lens, float]:
        """The stop as wide as the photos' ``lit`` area [H, W], and the share of pixels it puts on the right
        side."""
        if lit.mean() >= FULL:
            return cls(), float(lit.mean())
        angle = np.nan_to_num(angle_from_axis(camera), nan=np.pi)
        half_angle = float(np.quantile(angle, lit.mean()))
        return cls(float(np.degrees(half_angle))), float(((angle <= half_angle) == lit).mean())

    @classmethod
    def evidence(cls, sequence: Sequence) -> tuple[Lens | None, str]:
        """A black surround in the photos, or a camera model that no plain pinhole is."""
        if legs_px(sequence.lens_mask) is not None:
            return None, "the photos' black corners leave an octagon, which is the effect overlay's"
        return cls.told_by(sequence.camera, sequence.lens_mask)

    @classmethod
    def told_by(cls, camera: Camera, lens_mask: np.ndarray) -> tuple[Lens | None, str]:
        """The evidence of photos that are lit where ``lens_mask`` [H, W] says."""
        lens, agreement = cls.measured(camera, lens_mask)
        if lens.half_angle_deg < WHOLE_FIELD_DEG:
            return lens, (
                f"the photos are black beyond {lens.half_angle_deg:.1f}° from the axis "
                f"({agreement:.1%} of the pixels agree)"
            )
        if isinstance(camera, Pinhole) and not camera.distortion.any():
            return None, "the camera is a pinhole without distortion, and the photos fill the image"
        return lens, f"the distortion is that of the {camera.model} camera; the photos fill the image"


@lru_cache(maxsize=4)
def _passed(camera: Camera, half_angle_deg: float) -> np.ndarray:
    """Share of each pixel within the stop, float32 [H, W]."""
    inside = np.radians(half_angle_deg) - np.nan_to_num(angle_from_axis(camera), nan=np.inf)
    return np.clip(inside * focal_px(camera) + 0.5, 0, 1).astype(np.float32)
