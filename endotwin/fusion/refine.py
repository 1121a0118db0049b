"""Vertices meet the depth maps: each moves along its normal to where the views that see it measured the
surface."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from endotwin.cameras import Camera
from endotwin.fusion.mesh import vertex_normals
from endotwin.fusion.views import View
from endotwin.run.ahead import ahead
from endotwin.run.threads import THREADS
from endotwin.surface import Surface

LEAST_COSINE = 0.2
"""Views more grazing than 78° do not move a vertex: along the normal their pixels say little."""
INTERPOLATED_STEP = 0.05
"""Relative step between neighbouring distances above which nothing is interpolated."""


@dataclass(frozen=True)
class Sighting:
    """Vertices that face a view and project into its image.

    Attributes:
        vertex: int [N], no number twice.
        uv: float64 [N, 2], pixel coordinates.
        distance_mm: float32 [N], from the camera's centre.
        cosine: float32 [N], between normal and viewing direction.
    """

    vertex: np.ndarray
    uv: np.ndarray
    distance_mm: np.ndarray
    cosine: np.ndarray

    def __getitem__(self, chosen: np.ndarray) -> Sighting:
        return Sighting(
            self.vertex[chosen], self.uv.take(chosen, axis=0), self.distance_mm[chosen], self.cosine[chosen]
        )


def sighting(camera: Camera, surface: Surface, T_world_camera: np.ndarray) -> Sighting:
    """Vertices of ``surface`` that face the pose [4, 4] and project between pixel centres of its image."""
    T_local_camera = surface.to_local(T_world_camera)
    ray_mm = surface.vertices_mm - T_local_camera[:3, 3].astype(np.float32)
    along_mm = np.einsum("va,va->v", ray_mm, surface.normals)
    vertex = np.flatnonzero(along_mm < 0)
    ray_mm, along_mm = ray_mm.take(vertex, axis=0), along_mm[vertex]
    # einsum, because BLAS starts threads for a product this thin and takes six times as long.
    uv = camera.project(np.einsum("va,ab->vb", ray_mm, T_local_camera[:3, :3].astype(np.float32)))
    u, v = uv.T
    inside = np.flatnonzero((u >= 0) & (u <= camera.width - 1) & (v >= 0) & (v <= camera.height - 1))
    ray_mm, along_mm = ray_mm.take(inside, axis=0), along_mm[inside]
    distance_mm = np.sqrt(np.einsum("va,va->v", ray_mm, ray_mm))
    return Sighting(vertex[inside], uv.take(inside, axis=0), distance_mm, -along_mm / distance_mm)


def refined(camera: Camera, surface: Surface, views: Iterable[View], reach_mm: float) -> Surface:
    """``surface`` with each vertex moved along its normal by the weighted mean offset of the views that see
    it.

    The offset from one view is (vertex − measured distance) · cosine, with the measured distance
    interpolated between pixels; views whose offset is beyond ``reach_mm`` see something else. Weights are
    cosine² / distance², the inverse variance of a depth error that grows with the distance.
    """

    def offsets(view: View) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        seen = sighting(camera, surface, view.T_world_camera)
        seen = seen[np.flatnonzero(seen.cosine > LEAST_COSINE)]
        offset_mm = (seen.distance_mm - interpolated(view.distance_mm, seen.uv)) * seen.cosine
        near = np.flatnonzero(np.abs(offset_mm) <= reach_mm)
        return seen.vertex[near], offset_mm[near], (seen.cosine[near] / seen.distance_mm[near]) ** 2

    weight_sum = np.zeros(len(surface.vertices_mm))
    offset_sum = np.zeros_like(weight_sum)
    for vertex, offset_mm, weight in ahead(offsets, views, threads=THREADS):
        weight_sum[vertex] += weight
        offset_sum[vertex] += weight * offset_mm
    move_mm = (offset_sum / np.where(weight_sum > 0, weight_sum, 1)).astype(np.float32)
    vertices_mm = surface.vertices_mm + move_mm[:, None] * surface.normals
    return replace(surface, vertices_mm=vertices_mm, normals=vertex_normals(vertices_mm, surface.triangles))


def interpolated(distance_mm: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Bilinear distances at ``uv`` [N, 2] in ``distance_mm`` [H, W]: float32 [N], NaN at a jump and beside
    a gap."""
    height, width = distance_mm.shape
    low = np.minimum(uv.astype(np.int32), (width - 2, height - 2))
    a, b = (uv - low).astype(np.float32).T
    first = low[:, 1] * width + low[:, 0]
    flat = distance_mm.reshape(-1)
    d00, d01, d10, d11 = flat[first], flat[first + 1], flat[first + width], flat[first + width + 1]
    value = (1 - b) * ((1 - a) * d00 + a * d01) + b * ((1 - a) * d10 + a * d11)
    step = np.maximum(np.maximum(np.abs(d00 - d11), np.abs(d01 - d10)), np.abs(d00 - d01))
    with np.errstate(invalid="ignore"):
        value[~(step <= INTERPOLATED_STEP * value)] = np.nan
    return value
