"""What renderers that know nothing but perspective make of a camera."""

from __future__ import annotations

import math

import numpy as np

from endotwin.cameras.base import Camera
from endotwin.cameras.pinhole import Pinhole

WIDEST_DEGREES = 100.0
"""Height of the field that a perspective view of a wider lens has."""


def as_pinhole(camera: Camera) -> Pinhole:
    """A pinhole without distortion and with square pixels that sees like ``camera``: with its own focal
    length and centre if it is a pinhole, else with the height of its field, up to WIDEST_DEGREES."""
    if isinstance(camera, Pinhole):
        focal = math.sqrt(camera.fx * camera.fy)
        return Pinhole(camera.width, camera.height, focal, focal, camera.cx, camera.cy)
    focal = camera.height / 2 / math.tan(math.radians(height_degrees(camera)) / 2)
    return Pinhole(camera.width, camera.height, focal, focal, (camera.width - 1) / 2, (camera.height - 1) / 2)


def height_degrees(camera: Camera) -> float:
    """Angle between the top and the bottom of the picture, at most WIDEST_DEGREES."""
    middle = (camera.width - 1) / 2
    top, bottom = camera.directions(np.array([[middle, 0.0], [middle, camera.height - 1.0]]))
    angle = math.degrees(math.acos(float(np.clip(top @ bottom, -1, 1))))
    return min(angle, WIDEST_DEGREES) if math.isfinite(angle) else WIDEST_DEGREES
