"""Any camera as pinhole faces, because Open3D integrates pinholes only.

A face looks along one axis of a cube about the lens; together they cover every pixel whose ray leaves the
camera. Depth is carried from the native pixels to a face once per frame by a table that is made once per
camera.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from endotwin.cameras import Camera, Pinhole
from endotwin.sequence.sequence import one_surface

SINGLE_FACE_TAN = 1.75
"""A field of view within ±60° about the axis fits one face; a wider one is split along a cube's sides."""


@dataclass(frozen=True)
class Face:
    """One pinhole view out of a camera's centre.

    Attributes:
        intrinsics: float64 [3, 3], pixel centres at integers.
        R_camera_face: float64 [3, 3], face frame to camera frame.
        width, height: size in pixels.
        corners: int32 [4, P], row-major native pixels about each face pixel that has a source; nearest first.
        weights: float32 [4, P], bilinear weights of the corners.
        pixel: int32 [P], row-major face pixels.
        depth_ratio: float32 [P], z-depth in the face over distance along the ray.
    """

    intrinsics: np.ndarray
    R_camera_face: np.ndarray
    width: int
    height: int
    corners: np.ndarray
    weights: np.ndarray
    pixel: np.ndarray
    depth_ratio: np.ndarray

    def depth_mm(self, distance_mm: np.ndarray) -> np.ndarray:
        """Face z-depth float32 [h, w], 0 where there is none, from native distances along the ray [H, W]
        (NaN = none)."""
        near = distance_mm.reshape(-1)[self.corners]
        smooth = one_surface(near.min(axis=0), near.max(axis=0))
        value = np.where(smooth, np.einsum("kp,kp->p", self.weights, near), near[0])
        depth = np.zeros(self.width * self.height, np.float32)
        depth[self.pixel] = np.nan_to_num(value * self.depth_ratio)
        return depth.reshape(self.height, self.width)


def split(camera: Camera) -> tuple[Face, ...]:
    """Faces that cover every pixel of ``camera`` whose ray has z > 0 (z-depth says nothing about the
    others)."""
    if isinstance(camera, Pinhole) and not camera.distortion.any():
        return (_native_face(camera),)
    directions = camera.pixel_directions.astype(np.float64)
    with np.errstate(invalid="ignore"):
        ahead = directions[..., 2] > 0
    focal = _native_focal(directions)
    rays = directions[ahead]
    if np.abs(rays[:, :2] / rays[:, 2:]).max() <= SINGLE_FACE_TAN:
        axes = [np.eye(3)]
    else:
        axes = [np.eye(3), *(_side(angle) for angle in (0, 90, 180, 270))]
    faces = [_face(camera, R, rays, focal, margin=1 if len(axes) > 1 else np.inf) for R in axes]
    return tuple(face for face in faces if face is not None)


def distance_mm(camera: Camera, depth_mm: np.ndarray) -> np.ndarray:
    """Distance along each pixel's ray, float32 [H, W], NaN where z-depth [H, W] is absent or the ray has z
    ≤ 0."""
    z = camera.pixel_directions[..., 2]
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where((z > 0) & (depth_mm > 0), depth_mm / z, np.nan).astype(np.float32)


def _native_face(camera: Pinhole) -> Face:
    """A camera that is a plain pinhole is its own face, pixel by pixel."""
    pixel = np.arange(camera.width * camera.height, dtype=np.int32)
    weights = np.zeros((4, len(pixel)), np.float32)
    weights[0] = 1
    depth_ratio = camera.pixel_directions[..., 2].reshape(-1)
    corners = np.broadcast_to(pixel, (4, len(pixel)))
    return Face(camera.matrix, np.eye(3), camera.width, camera.height, corners, weights, pixel, depth_ratio)


def _side(angle_deg: float) -> np.ndarray:
    """Rotation whose third column, the face's axis, lies in the image plane at ``angle_deg``."""
    a = np.radians(angle_deg)
    axis = np.round([np.cos(a), np.sin(a), 0.0])
    right = np.array([0.0, 0.0, -1.0])
    return np.stack([right, np.cross(axis, right), axis], axis=1)


def _native_focal(directions: np.ndarray) -> float:
    """Pixels per radian at the finest, from the angle between neighbouring rays [H, W, 3]."""
    step = np.linalg.norm(np.diff(directions, axis=1), axis=-1)
    return float(1 / np.nanpercentile(step, 5))


def _face(camera: Camera, R: np.ndarray, rays: np.ndarray, focal: float, margin: float) -> Face | None:
    """The face along ``R``'s third column, cropped to the camera's rays [N, 3]; None where it sees none of
    them."""
    local = rays @ R
    local = local[local[:, 2] > 1e-3]
    slope = local[:, :2] / local[:, 2:]
    slope = slope[(np.abs(slope) <= margin + 2 / focal).all(axis=1)]
    if len(slope) == 0:
        return None
    low = np.floor(slope.min(axis=0) * focal) - 1
    width, height = (np.ceil(slope.max(axis=0) * focal) + 1 - low + 1).astype(int)
    intrinsics = np.array([[focal, 0, -low[0]], [0, focal, -low[1]], [0, 0, 1]], np.float64)

    u, v = np.meshgrid(np.arange(width), np.arange(height))
    grid = np.stack([(u + low[0]) / focal, (v + low[1]) / focal, np.ones(u.shape)], axis=-1).reshape(-1, 3)
    native = camera.project(grid @ R.T)
    with np.errstate(invalid="ignore"):
        inside = (np.round(native) >= 0).all(axis=1) & (
            np.round(native) <= (camera.width - 1, camera.height - 1)
        ).all(axis=1)
    pixel = np.flatnonzero(inside).astype(np.int32)
    corners, weights = _bilinear(native[pixel], camera.width, camera.height)
    depth_ratio = (1 / np.linalg.norm(grid[pixel], axis=1)).astype(np.float32)
    return Face(intrinsics, R, int(width), int(height), corners, weights, pixel, depth_ratio)


def _bilinear(uv: np.ndarray, width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    """Row-major indices and weights [4, P] of the pixels about each uv [P, 2], the nearest one first."""
    nearest = np.round(uv).astype(np.int64)
    side = np.where(uv >= nearest, 1, -1)
    limit = np.array([width - 1, height - 1])
    other = np.clip(nearest + side, 0, limit)
    t = np.abs(uv - nearest)
    columns = (nearest[:, 0], other[:, 0], nearest[:, 0], other[:, 0])
    rows = (nearest[:, 1], nearest[:, 1], other[:, 1], other[:, 1])
    corners = np.stack([row * width + column for row, column in zip(rows, columns, strict=True)])
    a, b = t[:, 0], t[:, 1]
    weights = np.stack([(1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b])
    return corners.astype(np.int32), weights.astype(np.float32)
