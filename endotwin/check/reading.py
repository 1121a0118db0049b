"""A reading: what the numbers in a sequence's files are taken to mean.

The sequence as it is written is one reading; each usual mistake is another, under which the same numbers
would be right. All of them end in the same place: camera poses, rays of pixels, and z-depths.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import permutations, product

import numpy as np
from scipy.spatial.transform import Rotation

from endotwin.cameras import Camera

OPENGL = ((1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, -1.0))
IDENTITY = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
BASES = ("camera to world", "world to camera", "rotation transposed", "translation of the inverse")
ORDERS = ("listed", "reversed", "alphabetic")


@dataclass(frozen=True)
class Lens:
    """The pixel of the calibration that each image pixel is: ``calibrated = scale · pixel + offset``.

    Attributes:
        scale, offset: of the axes (u, v); the offset in pixels.
    """

    scale: tuple[float, float] = (1.0, 1.0)
    offset: tuple[float, float] = (0.0, 0.0)

    @classmethod
    def of_resized(cls, ratio_u: float, ratio_v: float) -> Lens:
        """Images that are ``ratio`` times the size of the calibrated ones; images begin at −½."""
        return cls((1 / ratio_u, 1 / ratio_v), (0.5 / ratio_u - 0.5, 0.5 / ratio_v - 0.5))

    @classmethod
    def of_mirrored(cls, camera: Camera, across: str) -> Lens:
        """Images mirrored left to right (``across`` is "u") or top to bottom ("v")."""
        if across == "u":
            return cls((-1.0, 1.0), (camera.width - 1.0, 0.0))
        return cls((1.0, -1.0), (0.0, camera.height - 1.0))

    def then(self, outer: Lens) -> Lens:
        """This map of the image's pixels, followed by ``outer``."""
        scale = np.multiply(outer.scale, self.scale)
        offset = np.multiply(outer.scale, self.offset) + outer.offset
        return Lens(tuple(scale.tolist()), tuple(offset.tolist()))

    def adjusted(self, camera: Camera, focal: np.ndarray, shift: np.ndarray) -> Lens:
        """The lens whose focal lengths are ``focal`` [2] times as long and whose centre lies ``shift`` [2] px
        further."""
        centre = principal_point(camera)
        return self.then(
            Lens(tuple((1 / focal).tolist()), tuple((centre - (centre + shift) / focal).tolist()))
        )

    def calibrated(self, uv: np.ndarray) -> np.ndarray:
        """Pixels [..., 2] of the calibration."""
        return uv * self.scale + self.offset

    def image(self, uv: np.ndarray) -> np.ndarray:
        """Pixels [..., 2] of the image; the inverse of ``calibrated``."""
        return (uv - self.offset) / self.scale


@dataclass(frozen=True)
class Reading:
    """How poses, intrinsics and depth are taken. The defaults are the sequence as written.

    Attributes:
        base: what a pose is, one of ``BASES``.
        axes: turns the camera's axes as written into the layout's, a signed permutation [3][3];
            determinant −1 is left-handed.
        layout: turns the layout's axes of the camera into OpenCV's, [3][3].
        scale: factor on the translations, relative to depth.
        lens: where image pixels lie in the calibration.
        ray: 1 where depth is the distance along the ray, 0 where it is z-depth.
        shift: frame i has the pose of frame i + shift; fractions interpolate.
        order: the order in which the poses are written, one of ``ORDERS``.
    """

    base: str = BASES[0]
    axes: tuple[tuple[float, ...], ...] = IDENTITY
    layout: tuple[tuple[float, ...], ...] = IDENTITY
    scale: float = 1.0
    lens: Lens = Lens()
    ray: float = 0.0
    shift: float = 0.0
    order: str = ORDERS[0]

    def poses(self, written: np.ndarray, frames: np.ndarray) -> np.ndarray:
        """``T_world_camera`` [F, 4, 4] of ``frames`` [F] from the poses as ``written`` [N, 4, 4].

        NaN where the shift leaves the sequence.
        """
        T = _interpolated(written[_places(self.order, len(written))], frames + self.shift)
        R, t = T[:, :3, :3].copy(), T[:, :3, 3].copy()
        R_inverse = R.transpose(0, 2, 1)
        if self.base == "world to camera":
            T[:, :3, :3], T[:, :3, 3] = R_inverse, -np.einsum("nij,nj->ni", R_inverse, t)
        elif self.base == "rotation transposed":
            T[:, :3, :3] = R_inverse
        elif self.base == "translation of the inverse":
            T[:, :3, 3] = -np.einsum("nij,nj->ni", R, t)
        T[:, :3, :3] = T[:, :3, :3] @ np.array(self.axes) @ np.array(self.layout)
        T[:, :3, 3] *= self.scale
        return T

    def adjusted(self, camera: Camera, step: np.ndarray) -> Reading:
        """This reading moved by ``step`` [7]: log scale, log focal u and v, centre u and v (px), ray,
        shift."""
        return replace(
            self,
            scale=self.scale * float(np.exp(step[0])),
            lens=self.lens.adjusted(camera, np.exp(step[1:3]), step[3:5]),
            ray=self.ray + float(step[5]),
            shift=self.shift + float(step[6]),
        )


def principal_point(camera: Camera) -> np.ndarray:
    """Where the optical axis meets the image, float64 [2], in pixels."""
    return camera.project(np.array([0.0, 0.0, 1.0]))


def signed_permutations() -> list[tuple[tuple[float, ...], ...]]:
    """All 48 ways to name and point three axes; the first is the identity."""
    ways = []
    for order, signs in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
        axes = np.zeros((3, 3))
        axes[list(order), range(3)] = signs
        ways.append(tuple(map(tuple, axes.tolist())))
    return ways


def _places(order: str, count: int) -> np.ndarray:
    """The row of the pose file [N] that belongs to each frame."""
    if order == "reversed":
        return np.arange(count)[::-1]
    if order == "alphabetic":
        return np.argsort(np.argsort([str(index) for index in range(count)]))
    return np.arange(count)


def _interpolated(T: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Poses [F, 4, 4] at places ``at`` [F] between those of ``T`` [N, 4, 4]; NaN outside."""
    count = len(T)
    inside = (at >= 0) & (at <= count - 1)
    low = np.clip(np.floor(at).astype(int), 0, count - 1)
    part = np.clip(at - low, 0, 1)
    found = T[low].copy()
    between = inside & (part > 0)
    if between.any():
        start, stop = T[low[between]], T[low[between] + 1]
        turn = start[:, :3, :3].transpose(0, 2, 1) @ stop[:, :3, :3]
        vectors = Rotation.from_matrix(turn).as_rotvec() * part[between, None]
        found[between, :3, :3] = start[:, :3, :3] @ Rotation.from_rotvec(vectors).as_matrix()
        found[between, :3, 3] += part[between, None] * (stop - start)[:, :3, 3]
    found[~inside] = np.nan
    return found
