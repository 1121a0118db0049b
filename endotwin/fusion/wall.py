"""The wall beyond what depth maps show, as it may go on: a lumen is closed, and tissue that nobody saw throws
light on what was seen."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from endotwin.cameras import Camera
from endotwin.fusion._open3d import o3d
from endotwin.fusion.views import View
from endotwin.run.ahead import ahead
from endotwin.run.threads import THREADS
from endotwin.surface import Surface
from endotwin.surface.casting import Caster
from endotwin.surface.vectors import dot

EDGE = 0.075
"""Length of the wall's edges as a share of the median depth: half a patch between which light goes back and
forth."""

SPACING = 2 / 3
"""Of the points that Poisson's equation is solved for, in edges."""

GAP = 0.3
"""The wall keeps this far off the surface, in edges, so as not to lie on it."""

LEVELS = (5, 9)
"""Of the octree: with fewer the solver complains on the terminal, one more takes four times the time."""

CUBE = 1.05
"""Edge of the cube that the wall ends at, as a share of the surface's size: there the lumen stays open. In a
larger one its open ends are drawn shut before they come to the cube."""

STRIDE_PX = 8
"""Of the pixels that tell whether a camera is within the wall."""

OUTSIDE = 0.5
"""A camera for which the wall hides more than this share of what it measured is outside of the wall."""


def with_wall(camera: Camera, surface: Surface, views: Iterable[View], median_mm: float) -> Surface:
    """``surface``, seen from ``median_mm`` in the median, with the wall that closes it: the screened Poisson
    surface (Kazhdan & Hoppe 2013) of its vertices and normals, where that is off the surface itself.

    Where one of the ``views`` is outside of it, what would show its back to that view is left out.
    """
    wall_mm, triangles = _closed(surface, EDGE * median_mm)
    if not len(triangles):
        return surface
    caster = Caster(replace(surface, vertices_mm=wall_mm, triangles=triangles))
    middle_mm = wall_mm[triangles].mean(axis=1)
    normal = np.cross(*(wall_mm[triangles[:, k]] - wall_mm[triangles[:, 0]] for k in (1, 2)))

    def amiss(view: View) -> np.ndarray:
        if _share_hidden(camera, caster, view) <= OUTSIDE:
            return np.zeros(len(triangles), bool)
        return dot(normal, middle_mm - surface.to_local(view.T_world_camera)[:3, 3].astype(np.float32)) > 0

    wrong = sum(ahead(amiss, views, threads=THREADS))
    used, numbers = np.unique(triangles[wrong == 0], return_inverse=True)
    return replace(surface, wall_mm=wall_mm[used], wall_triangles=numbers.reshape(-1, 3).astype(np.int32))


def _closed(surface: Surface, edge_mm: float) -> tuple[np.ndarray, np.ndarray]:
    """Vertices float32 [W, 3] and triangles [T, 3] of the Poisson surface, where it is off ``surface``."""
    points = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(surface.vertices_mm.astype(np.float64)))
    points.normals = o3d.utility.Vector3dVector(surface.normals.astype(np.float64))
    points = points.voxel_down_sample(SPACING * edge_mm)
    size_mm = CUBE * float(np.ptp(surface.vertices_mm, axis=0).max())
    depth = int(np.clip(np.ceil(np.log2(size_mm / edge_mm)), *LEVELS))
    mesh, _ = o3d.geometry.TriangleMesh.create_from_point_cloud_poisson(
        points, depth=depth, scale=CUBE, n_threads=1
    )
    wall_mm, triangles = np.asarray(mesh.vertices, np.float32), np.asarray(mesh.triangles)
    gap_mm, _ = cKDTree(surface.vertices_mm).query(wall_mm[triangles].mean(axis=1), workers=-1)
    return wall_mm, triangles[gap_mm > GAP * edge_mm]


def _share_hidden(camera: Camera, wall: Caster, view: View) -> float:
    """Of what a view measured, the share that lies behind the ``wall``."""
    T_local_camera = wall.surface.to_local(view.T_world_camera).astype(np.float32)
    distance_mm = view.distance_mm[::STRIDE_PX, ::STRIDE_PX]
    measured = np.isfinite(distance_mm)
    rays = camera.pixel_directions[::STRIDE_PX, ::STRIDE_PX][measured] @ T_local_camera[:3, :3].T
    _, _, wall_mm = wall.cast_rays(np.broadcast_to(T_local_camera[:3, 3], rays.shape), rays)
    return float((wall_mm < distance_mm[measured]).sum() / max(len(rays), 1))
