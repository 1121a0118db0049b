"""Embree ray casting: which surface point each pixel of a new pose sees."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from copy import copy
from dataclasses import dataclass, fields
from functools import cached_property
from itertools import pairwise

import numpy as np
import torch
from embreex import rtcore, rtcore_scene
from torch.nn.functional import embedding_bag

from endotwin.cameras.base import Camera
from endotwin.run.threads import THREADS
from endotwin.surface import embree
from endotwin.surface.packets import Packets
from endotwin.surface.refit import Refit
from endotwin.surface.surface import Surface

RAYS_PER_TASK = 1 << 14
"""Rays of one task; with more, BLAS would rotate them on threads of its own, in each other's way."""

RUN_PX = 64
"""Pixels in a row that are sooner copied at once than one by one."""

NUDGE = 1e-6 * np.array([0.36, 0.48, -0.8], np.float32)
"""A ray exactly through a shared vertex can slip between its triangles; one that misses is tried again this
much aside."""


@dataclass(frozen=True, eq=False)
class Correspondences:
    """Pixel → surface correspondences of one view; only pixels whose ray hits are listed.

    Attributes:
        pixel: int32 [N], row-major index into the image.
        triangle: int32 [N].
        barycentric: float32 [N, 3], weights of the triangle's vertices, non-negative, summing to 1.
        distance_mm: float32 [N], along the ray from the camera centre.
    """

    pixel: np.ndarray
    triangle: np.ndarray
    barycentric: np.ndarray
    distance_mm: np.ndarray

    def __len__(self) -> int:
        return len(self.pixel)

    def __getitem__(self, index: np.ndarray) -> Correspondences:
        rows = np.flatnonzero(index) if index.dtype == bool else index
        return Correspondences(*(getattr(self, each.name).take(rows, axis=0) for each in fields(self)))

    def laid_out(self, values: np.ndarray, shape: tuple[int, int], empty: float = 0.0) -> np.ndarray:
        """Values of the hits, [N, ...], as an image [H, W, ...] of ``shape``, with ``empty`` elsewhere."""
        image = np.full((shape[0] * shape[1], *values.shape[1:]), empty, values.dtype)
        if self._runs is None:
            image[self.pixel] = values
        else:
            for there, here in self._runs:
                image[there] = values[here]
        return image.reshape(*shape, *values.shape[1:])

    @cached_property
    def _runs(self) -> list[tuple[slice, slice]] | None:
        """Pixels that follow each other, and which of the hits they are; None where most of them do not."""
        gaps = np.flatnonzero(self.pixel[1:] != self.pixel[:-1] + 1) + 1
        if (len(gaps) + 1) * RUN_PX > len(self):
            return None
        starts = (0, *gaps.tolist())
        shifts = (self.pixel[list(starts)] - starts).tolist()
        hits = pairwise((*starts, len(self)))
        return [(slice(a + by, b + by), slice(a, b)) for (a, b), by in zip(hits, shifts, strict=True)]

    def interpolate(self, surface: Surface, per_vertex: np.ndarray) -> np.ndarray:
        """Barycentric interpolation of ``per_vertex`` [V, ...] at the hit points, [N, ...]."""
        values = np.ascontiguousarray(per_vertex, np.result_type(per_vertex, np.float32))
        table = torch.from_numpy(values).reshape(len(values), -1)
        weights = torch.from_numpy(self.barycentric).to(table.dtype)
        mixed = embedding_bag(self._corners(surface.triangles), table, mode="sum", per_sample_weights=weights)
        return mixed.numpy().reshape(len(self), *per_vertex.shape[1:])

    def _corners(self, triangles: np.ndarray) -> torch.Tensor:
        """Vertices of the triangles that are hit, [N, 3]; those of the latest ``triangles`` are kept."""
        kept = vars(self).get("_kept")
        if kept is None or kept[0] is not triangles:
            kept = (triangles, torch.from_numpy(triangles.take(self.triangle, axis=0)))
            vars(self)["_kept"] = kept
        return kept[1]


def surface_points(surface: Surface, hits: Correspondences) -> np.ndarray:
    """World points of hits, float64 [N, 3], mm."""
    return hits.interpolate(surface, surface.vertices_mm.astype(np.float64)) + surface.origin_mm


class Caster:
    """An Embree scene of one surface; ``cast`` may be called from several threads."""

    def __init__(self, surface: Surface, threads: int = THREADS):
        self.surface = surface
        self._threads = threads
        self._device = rtcore.EmbreeDevice()
        self._scene = rtcore_scene.EmbreeScene(self._device, robust=True)
        self._mesh = embree.mesh(self._scene, self._device, surface.vertices_mm, surface.triangles)
        self._refit: Refit | None = None

    def threaded(self, threads: int) -> Caster:
        """The same scene, cast into by so many threads."""
        other = copy(self)
        other._threads = threads
        vars(other).pop("_packets", None)
        return other

    def moved(self, surface: Surface) -> Caster:
        """A caster of ``surface``, which has the same triangles; it takes the place of this one, which is
        not to be used any more."""
        self._refit = self._refit or Refit.of(self._scene, self._device, len(surface.vertices_mm))
        if self._refit is None:
            return Caster(surface, self._threads)
        self._refit.move(surface.vertices_mm)
        other = copy(self)
        other.surface = surface
        return other

    def cast_rays(
        self, origins: np.ndarray, directions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """First hits of rays in the surface's local frame.

        Args:
            origins: float32 [N, 3]; directions: float32 [N, 3], unit. Rays that are not finite are not cast
                (Embree would walk its whole tree for them).

        Returns:
            triangle int32 [N] (-1 where nothing is hit), barycentric float32 [N, 3], distance_mm float32
            [N] (inf where nothing is hit).
        """
        return self._first_hits(lambda part: (origins[part], directions[part]), len(directions))

    def unobstructed(self, origins: np.ndarray, directions: np.ndarray, length_mm: np.ndarray) -> np.ndarray:
        """Bool [N]: rays as of ``cast_rays`` that meet nothing nearer than ``length_mm`` [N]. That takes a
        third of the time of finding what they meet."""
        clear = np.zeros(len(directions), bool)

        def run(part: slice) -> None:
            start, towards, rows = _finite(origins[part], directions[part], part)
            start, towards, reach = (
                np.ascontiguousarray(x, np.float32) for x in (start, towards, length_mm[rows])
            )
            clear[rows] = self._scene.run(start, towards, dists=reach, query="OCCLUDED") < 0

        self._in_parts(run, len(directions))
        return clear

    def cast(
        self, camera: Camera, T_world_camera: np.ndarray, mask: np.ndarray | None = None
    ) -> Correspondences:
        """Correspondences of the view from ``T_world_camera`` [4, 4], of the pixels in ``mask`` [H, W] if
        given."""
        if mask is None and self._packets is not None and self._packets.native:
            return self._picture(camera, T_world_camera)
        T_local_camera = self.surface.to_local(T_world_camera).astype(np.float32)
        directions = camera.pixel_directions.reshape(-1, 3)
        centre = np.tile(T_local_camera[:3, 3], (RAYS_PER_TASK, 1))
        chosen = np.arange(len(directions)) if mask is None else np.flatnonzero(mask)

        def rays(part: slice) -> tuple[np.ndarray, np.ndarray]:
            seen = directions[part] if mask is None else directions.take(chosen[part], axis=0)
            return centre[: len(seen)], seen @ T_local_camera[:3, :3].T

        found = Correspondences(chosen.astype(np.int32), *self._first_hits(rays, len(chosen)))
        hit = np.flatnonzero(found.triangle >= 0)
        return found if len(hit) == len(found) else found[hit]

    def hides(
        self,
        camera: Camera,
        T_world_camera: np.ndarray,
        hits: Correspondences,
        gap_mm: float,
        reach_mm: float,
    ) -> np.ndarray:
        """Bool [N]: hits of the view from ``T_world_camera`` [4, 4] with more surface on the same ray, more
        than ``gap_mm`` behind them and within ``reach_mm`` of the camera."""
        from_mm = hits.distance_mm + np.float32(gap_mm)
        if self._packets is None:
            T_local_camera = self.surface.to_local(T_world_camera).astype(np.float32)
            rays = camera.pixel_directions.reshape(-1, 3).take(hits.pixel, axis=0) @ T_local_camera[:3, :3].T
            origins = T_local_camera[:3, 3] + from_mm[:, None] * rays
            return ~self.unobstructed(origins, rays, np.maximum(reach_mm - from_mm, 0))
        centre, rays, valid = self._rays(camera, T_world_camera)
        near_mm = np.full(valid.shape, np.inf, np.float32)
        near_mm.reshape(-1)[hits.pixel] = from_mm
        valid &= near_mm < reach_mm
        met = valid & ~self._packets.clear(centre, rays, near_mm, reach_mm, valid)
        return met.reshape(-1).take(hits.pixel)

    @cached_property
    def _packets(self) -> Packets | None:
        """Those of its scene; None where they cannot be had, and for several threads, in whose way their many
        short calls would be."""
        if self._threads > 1 or not len(self.surface.triangles):
            return None
        return Packets.of(self._scene, self._device)

    def _rays(self, camera: Camera, T_world_camera: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Of a camera's pixels, in the surface's frame: their origin float32 [3], directions float32 [H, W,
        3], and which are finite, bool [H, W]."""
        T_local_camera = self.surface.to_local(T_world_camera).astype(np.float32)
        rays = camera.pixel_directions @ T_local_camera[:3, :3].T
        return T_local_camera[:3, 3], rays, np.isfinite(rays[..., 0] + rays[..., 1] + rays[..., 2])

    def _picture(self, camera: Camera, T_world_camera: np.ndarray) -> Correspondences:
        """What ``cast`` returns, of all pixels."""
        centre, rays, valid = self._rays(camera, T_world_camera)
        found = [image.reshape(-1) for image in self._packets.first_hits(centre, rays, valid)]
        missed = np.flatnonzero(valid.reshape(-1) & (found[0] < 0))
        nudged = rays.reshape(-1, 3)[missed] + NUDGE
        again = self._scene.run(np.tile(centre, (len(missed), 1)), nudged, output=True)
        for image, name in zip(found, ("primID", "u", "v", "tfar"), strict=True):
            image[missed] = again[name]
        hit = np.flatnonzero(found[0] >= 0).astype(np.int32)
        triangle, u, v, distance_mm = (image.take(hit) for image in found)
        return Correspondences(hit, triangle, _barycentric(u, v), distance_mm)

    def _first_hits(
        self, rays: Callable[[slice], tuple[np.ndarray, np.ndarray]], count: int
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """What ``cast_rays`` returns, of ``count`` rays; ``rays`` gives origins and directions of a part."""
        triangle = np.full(count, -1, np.int32)
        barycentric = np.zeros((count, 3), np.float32)
        distance_mm = np.full(count, np.inf, np.float32)

        def run(part: slice) -> None:
            origins, directions, rows = _finite(*rays(part), part)
            triangle[rows], barycentric[rows], distance_mm[rows] = self._trace(origins, directions)

        if len(self.surface.triangles):
            self._in_parts(run, count)
        return triangle, barycentric, distance_mm

    def _in_parts(self, run: Callable[[slice], None], count: int) -> None:
        """Call ``run`` with parts of ``count`` rays, on the caster's threads."""
        parts = [slice(start, start + RAYS_PER_TASK) for start in range(0, count, RAYS_PER_TASK)]
        if min(self._threads, len(parts)) > 1:
            with ThreadPoolExecutor(self._threads) as pool:
                list(pool.map(run, parts))
        else:
            for part in parts:
                run(part)

    def _trace(
        self, origins: np.ndarray, directions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """What ``cast_rays`` returns, of finite rays."""
        origins, directions = (np.ascontiguousarray(array, np.float32) for array in (origins, directions))
        found = self._scene.run(origins, directions, output=True)
        missed = np.flatnonzero(found["primID"] < 0)
        if len(missed):
            again = self._scene.run(origins[missed], directions[missed] + NUDGE, output=True)
            for name in ("primID", "u", "v", "tfar"):
                found[name][missed] = again[name]
            missed = missed[again["primID"] < 0]
        barycentric = _barycentric(found["u"], found["v"])
        barycentric[missed], found["tfar"][missed] = 0, np.inf
        return found["primID"], barycentric, found["tfar"]


def _barycentric(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Weights float32 [N, 3] of a triangle's vertices, of Embree's u and v."""
    u = np.clip(u, 0, 1)
    v = np.clip(v, 0, 1 - u)
    return np.stack([1 - u - v, u, v], axis=1)


def _finite(
    origins: np.ndarray, directions: np.ndarray, part: slice
) -> tuple[np.ndarray, np.ndarray, slice | np.ndarray]:
    """Those of the ``part``'s rays that are finite, and which of all rays they are."""
    if np.isfinite(directions).all() and np.isfinite(origins).all():
        return origins, directions, part
    finite = np.flatnonzero(np.isfinite(directions).all(axis=1) & np.isfinite(origins).all(axis=1))
    return origins[finite], directions[finite], part.start + finite
