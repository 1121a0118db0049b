"""The one interface of all camera models.

Camera frame as in OpenCV: x right, y down, z forward. Pixel centres lie at integer coordinates.
"""

from __future__ import annotations

import dataclasses
import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from functools import cached_property
from typing import ClassVar

import numpy as np
from numpy.polynomial import Polynomial

from endotwin.errors import OptionError
from endotwin.run.arguments import check_positive

INVERSE_TABLE = 4096


@dataclasses.dataclass(frozen=True)
class Camera(ABC):
    """A camera model: which ray each pixel sees, and where each point lands.

    Attributes:
        model: name of the model in a ``camera.json``.
        positive: the parameters that must be greater than 0.
        width, height: image size in pixels.
    """

    model: ClassVar[str]
    positive: ClassVar[tuple[str, ...]] = ()
    width: int
    height: int

    @abstractmethod
    def directions(self, uv: np.ndarray) -> np.ndarray:
        """Unit viewing directions in the camera frame, float64 [..., 3], of pixels ``uv`` [..., 2].

        NaN where the lens model defines no ray. ``z`` may be negative: a field of view can pass 180°.
        """

    @abstractmethod
    def project(self, points: np.ndarray) -> np.ndarray:
        """Pixel coordinates, float64 [..., 2], of points [..., 3] in the camera frame; NaN where none."""

    @abstractmethod
    def scaled(self, scale: float) -> Camera:
        """The camera of the same view at ``round(scale·width)`` × ``round(scale·height)`` pixels."""

    @abstractmethod
    def lengthened(self, factor: float) -> Camera:
        """The camera whose pictures are ``factor`` times as large about its centre, which stays."""

    def corrected(self, intrinsics: np.ndarray) -> Camera:
        """The camera with ``intrinsics`` [3] put right: ln of the factor on its focal length, and where its
        centre goes, to the right and down, as shares of the width."""
        longer, right, down = (float(value) for value in intrinsics)
        moved = {"cx": self.cx + right * self.width, "cy": self.cy + down * self.width}
        return dataclasses.replace(self.lengthened(math.exp(longer)), **moved)

    @cached_property
    def pixel_directions(self) -> np.ndarray:
        """Unit viewing direction of every pixel centre, float32 [height, width, 3]; NaN where none."""
        u, v = np.meshgrid(np.arange(self.width), np.arange(self.height))
        return self.directions(np.stack([u, v], axis=-1).astype(np.float64)).astype(np.float32)

    def to_dict(self) -> dict:
        """The content of a ``camera.json``."""
        return {"model": self.model, **dataclasses.asdict(self)}


def solid_angle(camera: Camera, uv: np.ndarray) -> np.ndarray:
    """Solid angle, sr, of the pixels about ``uv`` [N, 2], [N]: the cross product of the steps that their rays
    take across and down."""
    step = np.array([[-0.5, 0], [0.5, 0], [0, -0.5], [0, 0.5]])
    left, right, above, below = np.moveaxis(camera.directions(uv[:, None] + step), 1, 0)
    return np.linalg.norm(np.cross(right - left, below - above), axis=1)


def scaled_size(camera: Camera, scale: float) -> tuple[int, int, float, float]:
    """Width and height at ``scale``, rounded to pixels, and the ratios per axis that the rounding leaves.

    Raises OptionError unless ``scale`` is positive and leaves at least one pixel.
    """
    check_positive("scale", scale)
    if min(round(camera.width * scale), round(camera.height * scale)) < 1:
        raise OptionError(
            f"A scale of {scale:g} leaves nothing of {camera.width}×{camera.height} pixels; choose 0.5, say"
        )
    width, height = round(camera.width * scale), round(camera.height * scale)
    return width, height, width / camera.width, height / camera.height


def scaled_centre(coordinate: float, ratio: float) -> float:
    """A pixel coordinate after resizing by ``ratio``: the image begins at −½, pixel centres are integers."""
    return (coordinate + 0.5) * ratio - 0.5


def scaled_lengths(camera: Camera, scale: float) -> dict[str, float]:
    """Size, focal lengths and centre, at ``scale``, of a camera that has ``fx`` and ``fy``."""
    width, height, ratio_x, ratio_y = scaled_size(camera, scale)
    return {
        "width": width,
        "height": height,
        "fx": camera.fx * ratio_x,
        "fy": camera.fy * ratio_y,
        "cx": scaled_centre(camera.cx, ratio_x),
        "cy": scaled_centre(camera.cy, ratio_y),
    }


def padded(camera: Camera, by: int) -> Camera:
    """The camera whose picture goes on by so many pixels on each side."""
    size = {"width": camera.width + 2 * by, "height": camera.height + 2 * by}
    return dataclasses.replace(camera, **size, cx=camera.cx + by, cy=camera.cy + by)


def first_positive_root(polynomial: Polynomial) -> float:
    """The least real root greater than 0, inf where there is none."""
    roots = polynomial.trim().roots()
    real = roots[np.abs(roots.imag) < 1e-9 * np.maximum(1, np.abs(roots))].real
    return float(min(real[real > 0], default=np.inf))


def inverse_of_increasing(
    function: Callable[[np.ndarray], np.ndarray], values: np.ndarray, interval: tuple[float, float]
) -> np.ndarray:
    """Arguments in ``interval`` where an increasing function has ``values`` [...], by linear interpolation.

    Good to about 1e-7 of the interval, as a start for Newton; NaN beyond the function's range there.
    """
    arguments = np.linspace(*interval, INVERSE_TABLE)
    return np.interp(values, function(arguments), arguments, left=np.nan, right=np.nan)
