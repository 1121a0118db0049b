"""The wall beyond what depth maps show, as it may go on: a lumen is closed, and tissue that nobody saw throws
light on what was seen.

Beside and behind the cameras, where no depth map says how, it goes on as the tube that the measured normals
tell of.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from endotwin.cameras import Camera
from endotwin.fusion._open3d import o3d
from endotwin.fusion.tube import Tube, tube_of
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

CLEAR = 3.0
"""Points of the tube keep so many edges off the surface: there it goes on as it is."""

REACH = 2.0
"""Radii by which the tube goes on beyond surface and cameras, before its round ends."""

FINEST = 1 / 12
"""Of the tube's radius: its points lie no closer."""

STRIDE_PX = 8
"""Of the pixels that tell whether a camera is within the wall."""

OUTSIDE = 0.5
"""A camera for which the wall hides more than this share of what it shows of the surface is outside of the
wall."""


def with_wall(camera: Camera, surface: Surface, T_world_camera: np.ndarray, median_mm: float) -> Surface:
    """``surface``, seen from poses ``T_world_camera`` [F, 4, 4] and ``median_mm`` in the median, with the
    wall that closes it: the screened Poisson surface (Kazhdan & Hoppe 2013) of its vertices and normals, and
    of its tube where nobody looked, where that is off the surface itself.

    Where one of the poses is outside of it, what would show its back to that one is left out.
    """
    T_local_camera = surface.to_local(T_world_camera)
    own = Caster(surface)
    wall_mm, triangles = _closed(camera, own, T_local_camera, EDGE * median_mm)
    if not len(triangles):
        return surface
    wall = Caster(replace(surface, vertices_mm=wall_mm, triangles=triangles))
    middle_mm = wall_mm[triangles].mean(axis=1)
    normal = np.cross(*(wall_mm[triangles[:, k]] - wall_mm[triangles[:, 0]] for k in (1, 2)))

    def amiss(pose: np.ndarray) -> np.ndarray:
        if _share_hidden(camera, own, wall, pose) <= OUTSIDE:
            return np.zeros(len(triangles), bool)
        return dot(normal, middle_mm - pose[:3, 3].astype(np.float32)) > 0

    wrong = sum(ahead(amiss, T_local_camera, threads=THREADS))
    used, numbers = np.unique(triangles[wrong == 0], return_inverse=True)
    return replace(surface, wall_mm=wall_mm[used], wall_triangles=numbers.reshape(-1, 3).astype(np.int32))


def _closed(
    camera: Camera, own: Caster, T_local_camera: np.ndarray, edge_mm: float
) -> tuple[np.ndarray, np.ndarray]:
    """Vertices float32 [W, 3] and triangles [T, 3] of the Poisson surface, where it is off the surface."""
    surface = own.surface
    places_mm, normals, tube = surface.vertices_mm, surface.normals, tube_of(surface)
    if tube is not None and tube.holds(T_local_camera[:, :3, 3]):
        more = _unlooked(camera, own, tube, T_local_camera, edge_mm)
        places_mm, normals = (np.concatenate(pair) for pair in zip((places_mm, normals), more, strict=True))
    points = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(places_mm.astype(np.float64)))
    points.normals = o3d.utility.Vector3dVector(normals.astype(np.float64))
    points = points.voxel_down_sample(SPACING * edge_mm)
    size_mm = CUBE * float(np.ptp(places_mm, axis=0).max())
    depth = int(np.clip(np.ceil(np.log2(size_mm / edge_mm)), *LEVELS))
    mesh, _ = o3d.geometry.TriangleMesh.create_from_point_cloud_poisson(
        points, depth=depth, scale=CUBE, n_threads=1
    )
    wall_mm, triangles = np.asarray(mesh.vertices, np.float32), np.asarray(mesh.triangles)
    gap_mm, _ = cKDTree(surface.vertices_mm).query(wall_mm[triangles].mean(axis=1), workers=-1)
    return wall_mm, triangles[gap_mm > GAP * edge_mm]


def _unlooked(
    camera: Camera, own: Caster, tube: Tube, T_local_camera: np.ndarray, edge_mm: float
) -> tuple[np.ndarray, np.ndarray]:
    """Points float32 [N, 3] of the ``tube``, off the surface, that lie in no picture, and that the surface
    would not hide from all cameras; and normals."""
    ends_mm = np.concatenate([own.surface.vertices_mm, T_local_camera[:, :3, 3]])
    spacing_mm = max(edge_mm, FINEST * tube.radius_mm)
    points_mm, normals = tube.points(ends_mm, REACH * tube.radius_mm, spacing_mm)
    gap_mm, _ = cKDTree(own.surface.vertices_mm).query(points_mm, workers=-1)
    off, open_ = gap_mm > CLEAR * edge_mm, np.zeros(len(points_mm), bool)
    for pose in T_local_camera:
        ray_mm = points_mm - pose[:3, 3]
        uv = camera.project(ray_mm @ pose[:3, :3])
        with np.errstate(invalid="ignore"):
            off &= ~((uv > 0) & (uv < (camera.width - 1, camera.height - 1))).all(axis=1)
        length_mm = np.linalg.norm(ray_mm, axis=1, keepdims=True)
        start_mm, towards = np.broadcast_to(pose[:3, 3], ray_mm.shape), ray_mm / length_mm
        open_ |= own.unobstructed(*(each.astype(np.float32) for each in (start_mm, towards, length_mm[:, 0])))
    return points_mm[off & open_], normals[off & open_]


def _share_hidden(camera: Camera, surface: Caster, wall: Caster, T_local_camera: np.ndarray) -> float:
    """Of what a camera shows of the ``surface``, the share that lies behind the ``wall``."""
    pose = T_local_camera.astype(np.float32)
    rays = camera.pixel_directions[::STRIDE_PX, ::STRIDE_PX].reshape(-1, 3) @ pose[:3, :3].T
    origin = np.broadcast_to(pose[:3, 3], rays.shape)
    triangle, _, distance_mm = surface.cast_rays(origin, rays)
    shown = triangle >= 0
    _, _, wall_mm = wall.cast_rays(origin[shown], rays[shown])
    return float((wall_mm < distance_mm[shown]).sum() / max(shown.sum(), 1))
