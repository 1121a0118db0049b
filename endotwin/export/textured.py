"""A lighter mesh with a UV atlas, and the twin's maps as textures on it.

The twin keeps its maps on vertices, about a pixel of its photos apart; other programs want few triangles
and textures. Triangles are collapsed where the surface is flat (Garland & Heckbert 1997), charts come from
xatlas, and each texel takes what the twin has at the nearest point of its own surface, the normal too, so
that folds too fine for the lighter mesh stay in its shading.
"""

from __future__ import annotations

import ctypes
import math
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from scipy.spatial import cKDTree

from endotwin.cameras.perspective import as_pinhole
from endotwin.export.appearance import diffuse_color
from endotwin.fusion._open3d import o3d
from endotwin.surface import Surface
from endotwin.surface.casting import Caster, Correspondences
from endotwin.surface.vectors import dot, unit
from endotwin.twin import Twin

KEPT = 0.25
"""Share of the triangles that the lighter mesh keeps."""

LARGEST = 4096
"""Largest edge of a texture, in texels, about."""

PACKED = 0.6
"""Share of the atlas that charts fill, about: what the largest texture is sized by."""

FINEST = 0.1
"""Share of the surface that a photo shows finer than a texel."""

GUTTER = 2
"""Texels between charts."""

REACH = 0.02
"""How far from the lighter mesh the twin's surface is looked for, as a share of the mesh's size."""

DRY = 1e-6
"""What the surface's own normal counts beside that of a film of weight 1."""

SKEW = np.array([0.1, 0.2, 0.3])
"""Turns any direction into another one."""


@dataclass(frozen=True, eq=False)
class Textured:
    """A mesh with one texture coordinate a vertex, and textures.

    Attributes:
        vertices_mm: float32 [V, 3], relative to the surface's ``origin_mm``. normals: float32 [V, 3], unit.
        uv: float32 [V, 2] in [0, 1], v downwards. triangles: int32 [F, 3].
        base_color: float32 [H, W, 3], linear: that of the diffuse lobe. roughness: float32 [H, W].
        normal: float32 [H, W, 3], unit, in the basis of ``tangents`` (glTF 2.0, 3.7.2.1: x, y, z along
            tangent, bitangent, normal).
        film_weight: float32 [H, W]. film_normal: float32 [H, W, 3], as ``normal``, which it is where no film
            is. None without a film.
    """

    vertices_mm: np.ndarray
    normals: np.ndarray
    uv: np.ndarray
    triangles: np.ndarray
    base_color: np.ndarray
    roughness: np.ndarray
    normal: np.ndarray
    film_weight: np.ndarray | None = None
    film_normal: np.ndarray | None = None

    @cached_property
    def tangents(self) -> np.ndarray:
        """Unit tangents along u and the sign of the bitangent, float32 [V, 4]."""
        return _tangents(self.vertices_mm, self.normals, self.uv, self.triangles)


def textured(twin: Twin) -> Textured:
    """The textured mesh of a fitted twin."""
    surface = twin.surface
    vertices, triangles = _simplified(surface)
    normals = surface.normals[cKDTree(surface.vertices_mm).query(vertices)[1]]
    vertices, normals, uv, triangles, size = _unwrapped(vertices, normals, triangles, texel_mm(twin))
    inside, flat = _texels(uv, triangles, size)
    low = Surface.from_mesh(vertices, triangles, normals)
    points = flat.interpolate(low, vertices)
    facing = unit(flat.interpolate(low, normals))
    maps = [surface.normals, diffuse_color(twin), twin.materials.roughness[:, None], *_film(twin)]
    found = _nearest(surface, points, facing, np.concatenate(maps, axis=1))
    tangents = flat.interpolate(low, _tangents(vertices, normals, uv, triangles))
    for normal in (found[:, :3], found[:, 8:]):
        if normal.size:
            normal[:] = _in_basis(unit(normal), facing, tangents)
    image = np.zeros((size[1] * size[0], found.shape[1]), np.float32)
    image[flat.pixel] = found
    image = _spread(image.reshape(size[1], size[0], -1), inside)
    textures = [unit(image[..., :3])] + ([image[..., 7], unit(image[..., 8:])] if image.shape[2] > 7 else [])
    return Textured(vertices, normals, uv, triangles, image[..., 3:6], image[..., 6], *textures)


def _film(twin: Twin) -> list[np.ndarray]:
    """Weight [V, 1] of the film and normals [V, 3] of no unit length, so that dry vertices count for nothing
    beside wet ones; none without a film."""
    if (film := twin.film) is None:
        return []
    count = len(twin.surface.vertices_mm)
    weight, normal = film.on_all(film.weight, count), film.on_all(film.weight[:, None] * film.normal, count)
    return [weight[:, None], normal + DRY * twin.surface.normals]


def texel_mm(twin: Twin) -> float:
    """Edge of a texel: what a pixel of the nearest photo covers, on all but the FINEST share of the seen
    surface; more where the texture would grow too large."""
    surface = twin.surface
    seen = np.isfinite(surface.nearest_mm)
    nearest_mm = float(np.quantile(surface.nearest_mm[seen], FINEST)) if seen.any() else math.inf
    corners = surface.vertices_mm[surface.triangles]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    smallest = math.sqrt(area.sum() / 2 / PACKED) / LARGEST
    photo = nearest_mm / as_pinhole(twin.camera).fx
    return max(photo, smallest) if math.isfinite(photo) else smallest


def _simplified(surface: Surface) -> tuple[np.ndarray, np.ndarray]:
    """Vertices float32 [V, 3] and triangles int32 [F, 3] of the lighter mesh."""
    vertices = o3d.utility.Vector3dVector(surface.vertices_mm.astype(np.float64))
    mesh = o3d.geometry.TriangleMesh(vertices, o3d.utility.Vector3iVector(surface.triangles))
    mesh = mesh.simplify_quadric_decimation(max(int(KEPT * len(surface.triangles)), 4))
    mesh.remove_degenerate_triangles()
    mesh.remove_unreferenced_vertices()
    return np.asarray(mesh.vertices, np.float32), np.asarray(mesh.triangles, np.int32)


def _unwrapped(
    vertices: np.ndarray, normals: np.ndarray, triangles: np.ndarray, texel: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, tuple[int, int]]:
    """Vertices, normals, uv and triangles of an atlas, split at its seams, and its width and height.

    The atlas is never freed: where xatlas ends its threads, a wake-up can be lost, and it waits for ever.
    """
    import xatlas

    atlas = xatlas.Atlas()
    ctypes.pythonapi.Py_IncRef(ctypes.py_object(atlas))
    atlas.add_mesh(vertices, triangles.astype(np.uint32), normals)
    charts, packing = xatlas.ChartOptions(), xatlas.PackOptions()
    packing.texels_per_unit, packing.padding, packing.bilinear = 1 / texel, GUTTER, True
    atlas.generate(charts, packing, False)
    origin, corners, uv = atlas.get_mesh(0)
    size = (atlas.width, atlas.height)
    return vertices[origin], normals[origin], uv.astype(np.float32), corners.astype(np.int32), size


def _texels(
    uv: np.ndarray, triangles: np.ndarray, size: tuple[int, int]
) -> tuple[np.ndarray, Correspondences]:
    """Which texels [H, W] have a triangle at their centre, and where in it: rays through the flat atlas."""
    width, height = size
    flat = np.c_[uv * np.float32([width, height]), np.zeros(len(uv), np.float32)].astype(np.float32)
    upwards = np.tile(np.float32([0, 0, 1]), (len(uv), 1))
    atlas = Caster(Surface.from_mesh(flat, triangles, upwards))
    u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    above = np.c_[u.ravel(), v.ravel(), np.ones(u.size)] - atlas.surface.origin_mm
    down = np.broadcast_to(np.float32([0, 0, -1]), above.shape)
    triangle, barycentric, distance = atlas.cast_rays(above.astype(np.float32), down)
    hits = Correspondences(np.arange(u.size, dtype=np.int32), triangle, barycentric, distance)
    return (triangle >= 0).reshape(height, width), hits[triangle >= 0]


def _nearest(surface: Surface, points: np.ndarray, facing: np.ndarray, maps: np.ndarray) -> np.ndarray:
    """``maps`` [V, C] of the surface where a line through ``points`` [N, 3] along ``facing`` [N, 3] meets it,
    or at its nearest vertex."""
    reach = REACH * float(np.ptp(surface.vertices_mm, axis=0).max())
    caster = Caster(surface)
    casts = [
        caster.cast_rays(points + side * reach * facing, -side * facing)
        for side in (np.float32(1), np.float32(-1))
    ]
    off = np.stack([np.abs(distance - reach) for *_, distance in casts])
    best = off.argmin(axis=0)
    rows = np.arange(len(points))
    triangle, barycentric = (np.stack([cast[i] for cast in casts])[best, rows] for i in (0, 1))
    missed = np.flatnonzero(off[best, rows] > reach)
    hits = Correspondences(rows.astype(np.int32), np.maximum(triangle, 0), barycentric, off[best, rows])
    found = hits.interpolate(surface, maps)
    if len(missed):
        found[missed] = maps[cKDTree(surface.vertices_mm).query(points[missed])[1]]
    return found


def _tangents(vertices: np.ndarray, normals: np.ndarray, uv: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Unit tangents along u, and the sign that makes sign·(n × t) point against v, float32 [V, 4]."""
    edge = np.diff(vertices[triangles].astype(np.float64), axis=1)
    step = np.diff(uv[triangles].astype(np.float64), axis=1)
    determinant = step[:, 0, 0] * step[:, 1, 1] - step[:, 0, 1] * step[:, 1, 0]
    along = (edge[:, 0] * step[:, 1, 1:] - edge[:, 1] * step[:, 0, 1:]) * np.sign(determinant)[:, None]
    up = (edge[:, 0] * step[:, 1, :1] - edge[:, 1] * step[:, 0, :1]) * np.sign(determinant)[:, None]
    tangent, against = np.zeros((2, *vertices.shape))
    for corner in triangles.T:
        np.add.at(tangent, corner, along)
        np.add.at(against, corner, up)
    tangent -= dot(tangent, normals)[:, None] * normals
    lost = np.linalg.norm(tangent, axis=1) < 1e-12
    tangent[lost] = np.cross(normals[lost], np.roll(normals[lost], 1, axis=1) + SKEW)
    tangent = unit(tangent)
    sign = np.where(dot(np.cross(normals, tangent), against) < 0, -1.0, 1.0)
    return np.c_[tangent, sign].astype(np.float32)


def _in_basis(normals: np.ndarray, facing: np.ndarray, tangents: np.ndarray) -> np.ndarray:
    """``normals`` [N, 3] in the basis of tangents [N, 4], which are interpolated, and ``facing`` [N, 3]."""
    along = tangents[:, :3] - dot(tangents[:, :3], facing)[:, None] * facing
    along = unit(along)
    across = np.cross(facing, along) * np.sign(tangents[:, 3:])
    return np.stack([dot(normals, along), dot(normals, across), dot(normals, facing)], axis=1)


def _spread(image: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """``image`` [H, W, C] with every texel that is not ``inside`` [H, W] as its nearest one that is."""
    outside = np.uint8(~inside)
    _, label = cv2.distanceTransformWithLabels(outside, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    source = np.zeros(label.max() + 1, np.int64)
    source[label[inside]] = np.flatnonzero(inside)
    return image.reshape(-1, image.shape[-1])[source[label]]
