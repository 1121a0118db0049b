"""What the photos saw of each vertex."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from endotwin.cameras import Camera
from endotwin.fusion.agreement import Tolerance, about
from endotwin.fusion.choice import STRIDE, Glance
from endotwin.fusion.refine import Sighting, sighting
from endotwin.fusion.views import View
from endotwin.run.ahead import ahead
from endotwin.run.threads import THREADS
from endotwin.surface import Surface
from endotwin.surface.casting import Caster

CLEARANCE = 1e-3
"""A ray reaches a vertex when its first hit is no nearer than this part of the distance."""


def covered(
    camera: Camera, surface: Surface, views: Iterable[View], lens_mask: np.ndarray, tolerance: Tolerance
) -> Surface:
    """``surface`` with ``seen_by`` and ``nearest_mm`` over ``views``.

    A view sees a vertex that faces it, projects onto a lit pixel (``lens_mask`` [H, W]) and is not hidden:
    it is no farther than all pixels about it measured, up to the tolerance, or else than some of them, and
    a ray reaches it. Vertices are asked, not triangles that pixels hit, so triangles may be larger or
    smaller than pixels.
    """
    caster = Caster(surface)

    def seen_in(view: View) -> Sighting:
        seen = sighting(camera, surface, view.T_world_camera)
        column, row = np.rint(seen.uv).astype(np.int32).T
        nearest_mm, farthest_mm = about(view.distance_mm, seen.uv)
        clear = seen.distance_mm <= nearest_mm + tolerance.at(nearest_mm)
        unsure = np.flatnonzero(~clear & (seen.distance_mm <= farthest_mm + tolerance.at(farthest_mm)))
        clear[unsure] = _reached(caster, view.T_world_camera, seen[unsure])
        return seen[np.flatnonzero(clear & lens_mask[row, column])]

    count = len(surface.vertices_mm)
    seen_by = np.zeros(count, np.int32)
    nearest_mm = np.full(count, np.inf, np.float32)
    for seen in ahead(seen_in, views, threads=THREADS):
        seen_by[seen.vertex] += 1
        nearest_mm[seen.vertex] = np.minimum(nearest_mm[seen.vertex], seen.distance_mm)
    return surface.with_coverage(seen_by, nearest_mm)


def covered_by_glances(
    camera: Camera, surface: Surface, seen: Iterable[Glance], lens_mask: np.ndarray, tolerance: Tolerance
) -> Surface:
    """``surface`` with ``seen_by`` and ``nearest_mm`` of what only those frames saw at which there was just a
    glance."""
    caster = Caster(surface)
    unseen = np.flatnonzero(surface.seen_by == 0)
    rest = replace(surface, vertices_mm=surface.vertices_mm[unseen], normals=surface.normals[unseen])
    seen_by, nearest_mm = surface.seen_by.copy(), surface.nearest_mm.copy()
    for glance in seen:
        found = sighting(camera, rest, glance.T_world_camera)
        column, row = np.rint(found.uv).astype(np.int32).T
        shape = np.array(glance.distance_mm.shape)[:, None] - 1
        at = np.minimum(np.rint(found.uv.T[::-1] / STRIDE).astype(np.int32), shape)
        measured_mm = glance.distance_mm[at[0], at[1]]
        near = found.distance_mm <= measured_mm + tolerance.at(measured_mm)
        found = found[np.flatnonzero(near & lens_mask[row, column])]
        found = replace(found, vertex=unseen[found.vertex])
        found = found[np.flatnonzero(_reached(caster, glance.T_world_camera, found))]
        seen_by[found.vertex] += 1
        nearest_mm[found.vertex] = np.minimum(nearest_mm[found.vertex], found.distance_mm)
    return surface.with_coverage(seen_by, nearest_mm)


def _reached(caster: Caster, T_world_camera: np.ndarray, seen: Sighting) -> np.ndarray:
    """Bool [N]: vertices of ``seen`` with nothing between them and the lens."""
    centre = caster.surface.to_local(T_world_camera)[:3, 3].astype(np.float32)
    directions = (caster.surface.vertices_mm[seen.vertex] - centre) / seen.distance_mm[:, None]
    length_mm = seen.distance_mm * (1 - CLEARANCE)
    return caster.unobstructed(np.broadcast_to(centre, directions.shape), directions, length_mm)
