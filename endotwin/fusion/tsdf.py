"""Truncated signed distance fusion on Open3D's sparse voxel blocks."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from endotwin.cameras import Camera
from endotwin.errors import SequenceError
from endotwin.fusion._open3d import o3c, o3d
from endotwin.fusion.faces import Face
from endotwin.fusion.views import View

BLOCK_VOXELS = 8
TRUNCATION_VOXELS = 3.0
TRUNCATION_SIGMAS = 4.0
FOOTPRINTS_PER_VOXEL = 2.5
"""A voxel spans this many pixels of a VGA image at the sequence's median distance."""

VGA_PIXELS = 640 * 480
LARGER_IMAGES = 0.25
"""Power of the image's size with which a voxel spans more of its pixels: as the mesh is then as large as the
root of the image, C3VD's 1350×1080 takes 1.6 times less time than in proportion, for half a decibel."""

NO_DEPTH = "No frame has any valid depth, so there is nothing to fuse; check the depth maps."
MAX_BLOCKS = 250_000
"""About 2 GB: two float32 in each of 8³ voxels, twice while the table of blocks grows."""
BLOCKS_PER_CELL = 2.5
"""Blocks that the truncation band touches for each block-sized cell with a measured point in it."""
HALF_PIXEL = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])


def footprint_voxel_mm(camera: Camera, views: Iterable[View]) -> tuple[float, float, float]:
    """Voxel edge from the pixel footprint (distance × angle) of a few views, and their median distance; and
    the least edge with which what these views measured needs no more than ``MAX_BLOCKS`` blocks, which the
    first is not below.
    """
    angle = float(np.nanmedian(np.linalg.norm(np.diff(camera.pixel_directions, axis=1), axis=-1)))
    medians_mm, points_mm = [], []
    for view in views:
        medians_mm.append(np.nanmedian(view.distance_mm))
        some = camera.pixel_directions[::4, ::4] * view.distance_mm[::4, ::4, None]
        some = some[np.isfinite(some).all(axis=-1)] @ view.T_world_camera[:3, :3].T
        points_mm.append(some + view.T_world_camera[:3, 3])
    if not medians_mm:
        raise SequenceError(NO_DEPTH)
    median_mm = float(np.median(medians_mm))
    larger = max(1.0, camera.width * camera.height / VGA_PIXELS) ** LARGER_IMAGES
    voxel_mm = FOOTPRINTS_PER_VOXEL * larger * angle * median_mm
    cells = np.unique(
        np.floor(np.concatenate(points_mm) / (BLOCK_VOXELS * voxel_mm)).astype(np.int64), axis=0
    )
    # A surface needs blocks in inverse proportion to the square of their size.
    least_mm = voxel_mm * (BLOCKS_PER_CELL * len(cells) / MAX_BLOCKS) ** 0.5
    return max(voxel_mm, least_mm), median_mm, least_mm


def fuse_tsdf(
    faces: tuple[Face, ...], views: Iterable[View], origin_mm: np.ndarray, voxel_mm: float, noise_mm: float
) -> tuple[np.ndarray, np.ndarray]:
    """Integrate views and extract the zero level set.

    Args:
        faces: of the views' camera, see ``faces.split``.
        origin_mm: float64 [3], the local origin in the world; poses are taken relative to it before they
            become float32.

    Returns:
        vertices float32 [V, 3] relative to ``origin_mm`` and triangles int32 [F, 3], both in an order that
        depends on positions only. Open3D keeps its blocks in a concurrent hash table, whose order changes
        from run to run.

    Raises:
        SequenceError: no view has a surface.
    """
    truncation_voxels = max(TRUNCATION_VOXELS, TRUNCATION_SIGMAS * noise_mm / voxel_mm)
    grid = o3d.t.geometry.VoxelBlockGrid(
        ("tsdf", "weight"), (o3c.float32, o3c.float32), ((1,), (1,)), voxel_mm, BLOCK_VOXELS, 10_000
    )
    for view in views:
        for face in faces:
            _integrate(grid, face, view, origin_mm, truncation_voxels)
    if grid.hashmap().size() == 0:
        raise SequenceError(NO_DEPTH)
    try:
        mesh = grid.extract_triangle_mesh(weight_threshold=0.5)
    except RuntimeError:  # Open3D on a grid whose sign never changes
        mesh = None
    if mesh is None or "indices" not in mesh.triangle or len(mesh.triangle.indices) == 0:
        raise SequenceError(
            f"Depth gives no surface at a voxel size of {voxel_mm:g} mm; check the poses or that size."
        )
    return _ordered(mesh.vertex.positions.numpy(), mesh.triangle.indices.numpy())


def _integrate(
    grid: o3d.t.geometry.VoxelBlockGrid,
    face: Face,
    view: View,
    origin_mm: np.ndarray,
    truncation_voxels: float,
) -> None:
    depth_mm = face.depth_mm(view.distance_mm)
    if not depth_mm.any():
        return
    T_local_face = view.T_world_camera.copy()
    T_local_face[:3, 3] -= origin_mm
    T_local_face[:3, :3] = T_local_face[:3, :3] @ face.R_camera_face
    extrinsic = o3c.Tensor(np.linalg.inv(T_local_face))
    # Open3D looks up the pixel with floor(u), so that its pixel centres lie at halves.
    intrinsic = o3c.Tensor(face.intrinsics + HALF_PIXEL)
    image = o3d.t.geometry.Image(o3c.Tensor(depth_mm))
    reach = (1.0, float(depth_mm.max()) + 1.0, truncation_voxels)
    try:
        blocks = grid.compute_unique_block_coordinates(image, intrinsic, extrinsic, *reach)
    except RuntimeError:  # Open3D where the few pixels with depth touch none
        return
    grid.integrate(blocks, image, intrinsic, extrinsic, *reach)


def _ordered(vertices: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The same mesh with vertices sorted by position and triangles by their vertices; winding kept."""
    order = np.lexsort(vertices.T)
    rank = np.empty(len(order), np.int32)
    rank[order] = np.arange(len(order), dtype=np.int32)
    triangles = rank[triangles]
    first = triangles.argmin(axis=1)[:, None]
    triangles = np.take_along_axis(triangles, (first + np.arange(3)) % 3, axis=1)
    return vertices[order], np.ascontiguousarray(triangles[np.lexsort(triangles.T[::-1])])
