"""The surface as the alignment sees it: some of its vertices, rays into it, what a pixel is worth in 3D."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from endotwin.cameras import Camera
from endotwin.surface import Surface
from endotwin.surface.casting import Caster, Correspondences

SHADING = 6
"""Columns of ``shading_columns``."""

SHADING_MEAN = np.array([0.9, 0.9, 0.45, 0.0, 0.2, 0.0])
SHADING_SPREAD = np.array([0.3, 0.2, 0.1, 0.2, 0.3, 0.2])
"""What the coefficients usually are: γn, γq and γ of a bare fibre, vignetting, Burley's diffuse lobe and a
rough highlight, whose logarithms are nearly linear in these columns."""

LEAST_COSINE = 0.02


@dataclass(frozen=True, eq=False)
class Scene:
    """A surface before one camera.

    Attributes:
        pixels_by_direction: float32 [H·W, 2, 3], slopes of a pixel's coordinates by the unit ray to it.
        vertices: int [V], the vertices that are looked at. points_mm, normals: float64 [V, 3], local.
    """

    surface: Surface
    camera: Camera
    caster: Caster
    pixels_by_direction: np.ndarray
    vertices: np.ndarray
    points_mm: np.ndarray
    normals: np.ndarray

    @classmethod
    def of(cls, caster: Caster, camera: Camera, count: int, seed: int = 0) -> Scene:
        """The surface of ``caster``, at most ``count`` vertices drawn from those that two photos see."""
        surface = caster.surface
        seen = np.flatnonzero(surface.seen_by >= 2)
        if len(seen) > count:
            seen = np.sort(np.random.default_rng(seed).choice(seen, count, replace=False))
        points, normals = (x[seen].astype(np.float64) for x in (surface.vertices_mm, surface.normals))
        return cls(surface, camera, caster, _by_direction(camera), seen, points, normals)

    def through(self, camera: Camera) -> Scene:
        """The same surface before another camera."""
        if camera == self.camera:
            return self
        return replace(self, camera=camera, pixels_by_direction=_by_direction(camera))

    @property
    def shape(self) -> tuple[int, int]:
        return self.camera.height, self.camera.width

    @property
    def rays(self) -> np.ndarray:
        """Unit rays of all pixels, float32 [H·W, 3]."""
        return self.camera.pixel_directions.reshape(-1, 3)

    def distances(self, hits: Correspondences) -> np.ndarray:
        """Float32 [H, W]: how far each pixel's ray goes, in mm; 0 where it meets nothing."""
        image = np.zeros(len(self.rays), np.float32)
        image[hits.pixel] = hits.distance_mm
        return image.reshape(self.shape)

    def by_point(self, pixel: np.ndarray, slope_u: np.ndarray, slope_v: np.ndarray, points_mm: np.ndarray):
        """Slopes [N, 3] by points [N, 3] (camera frame, at ``pixel`` [N]) of what has ``slope_u``,
        ``slope_v`` [N] a pixel."""
        distance_mm = np.linalg.norm(points_mm, axis=1, keepdims=True)
        ray = points_mm / distance_mm
        by_u, by_v = self.pixels_by_direction[pixel].astype(np.float64).transpose(1, 0, 2)
        by_ray = slope_u[:, None] * by_u + slope_v[:, None] * by_v
        return (by_ray - (by_ray * ray).sum(axis=1, keepdims=True) * ray) / distance_mm

    def by_intrinsics(self, uv: np.ndarray, slope_u: np.ndarray, slope_v: np.ndarray) -> np.ndarray:
        """Slopes [N, 3] by the camera's intrinsics (see ``Camera.corrected``) of what has ``slope_u``,
        ``slope_v`` [N] a pixel at pixels [N, 2]."""
        longer = slope_u * (uv[:, 0] - self.camera.cx) + slope_v * (uv[:, 1] - self.camera.cy)
        return np.stack([longer, slope_u * self.camera.width, slope_v * self.camera.width], axis=1)

    def squared_radius(self, uv: np.ndarray) -> np.ndarray:
        """r² of pixels [N, 2], r = 1 at half the width from the middle."""
        half = np.array([self.camera.width, self.camera.height]) / 2
        return (((uv - half) / half[0]) ** 2).sum(axis=1)


def by_twist(slopes: np.ndarray, points_mm: np.ndarray) -> np.ndarray:
    """Slopes [N, 6] by the camera's twist of what has ``slopes`` [N, 3] by its points [N, 3] in the camera
    frame, which move as −ω × x − t."""
    return np.concatenate([-np.cross(points_mm, slopes), -slopes], axis=1)


def shading_columns(
    ray_z: np.ndarray, distance_mm: np.ndarray, cos: np.ndarray, r2: np.ndarray
) -> np.ndarray:
    """[N, 6], in which ln C is about linear (see ``start``): ln cosθ, −ln d, ln n·ω, r², and two of n·ω."""
    columns = np.log(np.maximum(ray_z, LEAST_COSINE)), -np.log(distance_mm), np.log(cos), r2
    return np.stack([*columns, (1 - cos) ** 5, cos**8], axis=1)


def shading_slopes(
    points_mm: np.ndarray, normals: np.ndarray, cos: np.ndarray, light: np.ndarray
) -> np.ndarray:
    """Slopes [N, 6] of the columns times ``light`` [6] by the camera's twist; r² stays."""
    distance_mm = np.linalg.norm(points_mm, axis=1, keepdims=True)
    ray, c = points_mm / distance_mm, cos[:, None]
    by_distance = -ray / distance_mm
    by_axis = np.array([0, 0, 1.0]) / points_mm[:, 2:] + by_distance
    by_cos = -(normals + c * ray) / distance_mm
    lobes = light[2] / c - light[4] * 5 * (1 - c) ** 4 + light[5] * 8 * c**7
    turned = by_twist(light[0] * by_axis, points_mm)
    turned[:, 3:] -= light[1] * by_distance + lobes * by_cos
    return turned


def _by_direction(camera: Camera) -> np.ndarray:
    rays = camera.pixel_directions.astype(np.float64)
    along = np.stack([np.gradient(rays, axis=1), np.gradient(rays, axis=0)], axis=-1)
    gram = np.einsum("...ki,...kj->...ij", along, along)
    sound = np.isfinite(gram).all(axis=(2, 3)) & (np.abs(np.linalg.det(np.nan_to_num(gram))) > 0)
    gram[~sound] = np.eye(2)
    inverse = np.einsum("...ij,...kj->...ik", np.linalg.inv(gram), along)
    return np.where(sound[..., None, None], inverse, 0).reshape(-1, 2, 3).astype(np.float32)
