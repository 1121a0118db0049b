"""Which ray each pixel sees along: a pinhole, or C3VD's omnidirectional lens."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

C3VD = {"cx": 678.544839263292, "cy": 542.975887548343, "a0": 769.243600037458, "a2": -8.12770624150226e-4}
C3VD |= {"a3": 6.25674244578925e-7, "a4": -1.1966218214428e-9}
C3VD |= {"c": 0.99998688224999, "d": 0.00288273829525059, "e": -0.00296316513429569}
C3VD_WIDTH, C3VD_HEIGHT = 1350, 1080

CIRCLE = 0.53
"""Radius of the omnidirectional lens's picture, as a share of the image's width."""


@dataclass(frozen=True)
class Lens:
    """A camera without distortion's surprises: the content of its ``camera.json``."""

    model: str
    width: int
    height: int
    parameters: dict[str, float] = field(default_factory=dict)

    @classmethod
    def pinhole(cls, width: int, height: int, across_deg: float) -> Lens:
        """Square pixels, the axis in the image's middle."""
        focal = width / 2 / np.tan(np.radians(across_deg) / 2)
        values = {"fx": focal, "fy": focal, "cx": (width - 1) / 2, "cy": (height - 1) / 2}
        return cls("pinhole", width, height, values)

    @classmethod
    def omni(cls, height: int) -> Lens:
        """C3VD's lens (Bobrow et al. 2023) with images ``height`` pixels high."""
        scale = height / C3VD_HEIGHT
        powers = {"a0": 1, "a2": -1, "a3": -2, "a4": -3, "c": 0, "d": 0, "e": 0}
        values = {name: C3VD[name] * scale**power for name, power in powers.items()}
        centre = {name: (C3VD[name] + 0.5) * scale - 0.5 for name in ("cx", "cy")}
        return cls("omni", round(C3VD_WIDTH * scale), height, centre | values)

    def rays(self, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Unit directions [..., 3] in the camera frame of pixel coordinates; omni: Scaramuzza et al. 2006,
        ray ∝ (A⁻¹(u − centre), a0 + a2 ρ² + a3 ρ³ + a4 ρ⁴)."""
        p = self.parameters
        if self.model == "pinhole":
            x, y, z = (u - p["cx"]) / p["fx"], (v - p["cy"]) / p["fy"], np.ones_like(u)
        else:
            sensor = np.array([[p["c"], p["d"]], [p["e"], 1.0]])
            x, y = np.moveaxis(np.stack([u - p["cx"], v - p["cy"]], -1) @ np.linalg.inv(sensor).T, -1, 0)
            rho = np.hypot(x, y)
            z = p["a0"] + p["a2"] * rho**2 + p["a3"] * rho**3 + p["a4"] * rho**4
        ray = np.stack([x, y, z], axis=-1)
        return ray / np.linalg.norm(ray, axis=-1, keepdims=True)

    def lit(self, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Bool [...]: inside the lens's picture."""
        if self.model == "pinhole":
            return np.ones(np.shape(u), bool)
        return np.hypot(u - self.parameters["cx"], v - self.parameters["cy"]) < CIRCLE * self.width

    def squared_radius(self, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """r² from the image's middle, 1 at half its longer side: what vignetting depends on."""
        x, y = u - (self.width - 1) / 2, v - (self.height - 1) / 2
        return (x * x + y * y) / (max(self.width, self.height) / 2) ** 2

    def to_dict(self) -> dict:
        """The content of ``camera.json``."""
        return {"model": self.model, "width": self.width, "height": self.height, **self.parameters}
