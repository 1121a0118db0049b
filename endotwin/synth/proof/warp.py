"""Frames of a dataset as geometry: the point of each pixel, and what another frame has where it lands."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from endotwin.surface.silhouettes import discontinuities
from endotwin.synth.proof.written import Written

FLOAT_STEP = 4e-7
"""Relative step of depth that was kept as float32, with the float32 ray that it was taken along."""

DEPTHS = ("depth_exr", "depth")
"""Images of depth, the most precise first."""


class Frame:
    """One frame of a dataset; images are read when they are used, and kept."""

    def __init__(self, written: Written, index: int):
        self.written, self.index = written, index
        self.T_world_camera = written.trajectory.T_world_camera[index]
        self._images: dict[str, np.ndarray] = {}

    def image(self, name: str) -> np.ndarray:
        """The image ``name``."""
        if name not in self._images:
            self._images[name] = self.written.image(self.index, name)
        return self._images[name]

    def first(self, *names: str) -> np.ndarray | None:
        """The first of the images ``names`` that the dataset has; None where it has none."""
        return next((self.image(name) for name in names if self.written.has(name)), None)

    @cached_property
    def distance_mm(self) -> np.ndarray | None:
        """Float64 [H, W], along the ray; NaN where depth tells nothing. None: there is no depth."""
        depth_mm = self.first(*DEPTHS)
        if depth_mm is None:
            return None
        with np.errstate(all="ignore"):
            distance_mm = depth_mm / self.written.rays[..., 2]
        return np.where(np.isfinite(distance_mm) & (distance_mm > 0), distance_mm, np.nan)

    @cached_property
    def smooth(self) -> np.ndarray:
        """Bool [H, W]: pixels with depth on all sides, and no rim beside them."""
        return np.isfinite(self.distance_mm) & ~discontinuities(self.distance_mm.astype(np.float32))

    def half_step_mm(self, chosen: np.ndarray) -> np.ndarray:
        """How far the distance of the ``chosen`` pixels, int [N], may be from what was rendered, [N]."""
        step = next(self.written.step(name) for name in DEPTHS if self.written.has(name))
        with np.errstate(divide="ignore"):
            along = step / 2 / np.abs(self.written.rays.reshape(-1, 3)[chosen, 2])
        return along + FLOAT_STEP * self.distance_mm.ravel()[chosen]


@dataclass(frozen=True)
class Landing:
    """Pixels of one frame in another.

    Attributes:
        chosen: int [N], row-major. uv: float64 [N, 2], where their points lie there. slack_px: [N], by which
            that may be off since depth is kept in steps. distance_mm: [N], of the points from that camera.
            slack_mm: [N], by which the points themselves may be.
    """

    chosen: np.ndarray
    uv: np.ndarray
    slack_px: np.ndarray
    distance_mm: np.ndarray
    slack_mm: np.ndarray

    def flow(self, width: int) -> np.ndarray:
        """From the pixels to ``uv``, px, [N, 2]."""
        return self.uv - np.stack([self.chosen % width, self.chosen // width], axis=1)


def landing(one: Frame, other: Frame, motion_mm: np.ndarray | None) -> Landing:
    """Where the points of ``one`` lie in ``other``; ``motion_mm`` [H, W, 3]: the tissue's own."""
    camera = one.written.camera
    chosen = np.flatnonzero(np.isfinite(one.distance_mm))
    rays = one.written.rays.reshape(-1, 3)[chosen] @ one.T_world_camera[:3, :3].T
    distance_mm = one.distance_mm.ravel()[chosen]
    slack_mm = one.half_step_mm(chosen)
    moved = 0 if motion_mm is None else motion_mm.reshape(-1, 3)[chosen]

    def seen(distance_mm: np.ndarray) -> np.ndarray:
        points = one.T_world_camera[:3, 3] + rays * distance_mm[:, None] + moved
        return (points - other.T_world_camera[:3, 3]) @ other.T_world_camera[:3, :3]

    with np.errstate(all="ignore"):
        points = seen(distance_mm)
        uv = camera.project(points)
        slack_px = np.linalg.norm(camera.project(seen(distance_mm + slack_mm)) - uv, axis=1)
    return Landing(chosen, uv, slack_px, np.linalg.norm(points, axis=1), slack_mm)


@dataclass(frozen=True)
class Sampled:
    """What an image has about places in it.

    Attributes:
        chosen: int [M], those of the places that have four pixels about them. four: int [M, 4], those pixels,
            row-major. weights: float64 [M, 4], of bilinear interpolation.
    """

    chosen: np.ndarray
    four: np.ndarray
    weights: np.ndarray

    def where(self, kept: np.ndarray) -> Sampled:
        """Those of the places that are ``kept``, bool [M]."""
        return Sampled(self.chosen[kept], self.four[kept], self.weights[kept])

    def values(self, image: np.ndarray) -> np.ndarray:
        """``image`` [H, W, ...] at the four pixels, [M, 4, ...]."""
        return image.reshape(-1, *image.shape[2:])[self.four]

    def mean(self, image: np.ndarray) -> np.ndarray:
        """``image`` [H, W, ...] interpolated, [M, ...]."""
        return np.einsum("mk,mk...->m...", self.weights, self.values(image))


def sampled(frame: Frame, uv: np.ndarray) -> Sampled:
    """The pixels of ``frame`` about places ``uv`` [N, 2]."""
    camera = frame.written.camera
    with np.errstate(invalid="ignore"):
        inside = ((uv >= 0) & (uv <= (camera.width - 1, camera.height - 1))).all(axis=1)
    chosen = np.flatnonzero(inside)
    corner = np.minimum(uv[chosen].astype(np.int64), (camera.width - 2, camera.height - 2))
    u, v = (uv[chosen] - corner).T
    first = corner[:, 1] * camera.width + corner[:, 0]
    four = first[:, None] + np.array([0, 1, camera.width, camera.width + 1])
    return Sampled(chosen, four, np.stack([(1 - u) * (1 - v), u * (1 - v), (1 - u) * v, u * v], axis=1))
