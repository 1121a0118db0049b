"""Light that tissue throws on tissue: form factors of a fixed surface, and its irradiance under a moving
light.

The surface is gathered into patches. Once, cosine-weighted rays from each patch count which patches it sees:
the form factors K (Goral et al. 1984; Monte Carlo estimate, Cohen & Wallace 1993, ch. 4). Then the indirect
irradiance E under any light is E = K·ρ(E_direct + E), a few sparse products a bounce.

A lumen is closed, and a mesh of what depth maps showed is not: from half of a wall's directions comes light
of tissue that nobody saw. It is taken to be like the tissue that is seen from there, in less light:
UNSEEN_DIRECT of the direct irradiance (a light beside the camera hardly reaches what the camera does not see)
and UNSEEN_INDIRECT of the indirect one.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse
import torch
from scipy.spatial import cKDTree

from endotwin.light.guides import SHADOW_BIAS, log_axis
from endotwin.light.incidence import COS_MIN, DISTANCE_MIN_MM
from endotwin.surface import Surface
from endotwin.surface.casting import Caster
from endotwin.surface.vectors import dot, unit

RAYS = 256
"""Rays of a patch that count its form factors: one part in 16 of noise, and half of that after a bounce."""

POINTS = 4
"""Points of a patch at which direct light is evaluated."""

NEIGHBOURS = 4
"""Patches between which a vertex interpolates."""

FACING = 1.0
"""Patches that face opposite ways count as so many patch sizes apart, so that light does not leak through
a fold."""

LIFT = 1e-3
"""Rays start this share of a patch's size above it."""

UNSEEN_DIRECT, UNSEEN_INDIRECT = 0.1, 0.8
"""Against whole colons these bring the bounce from a mesh of what was seen from 36 % (red) and 65 % (green)
of its strength to within 6 %, and halve its error from place to place; a convex hull about the mesh does
worse."""

LEAST_SEEN = 0.1
"""Share of its directions that a patch must see something in for that to stand for the rest."""

BOUNCES = 12
ALBEDO_MAX = 0.95
"""With twelve bounces at most 0.95¹² = 54 % of an impossible furnace is missing; tissue (below 0.8) loses
7 %."""


@dataclass(frozen=True)
class Lamp:
    """What a view's light meets on the patches' points; it does not depend on the light's strength or shape.

    Attributes:
        cos: float32 [P, POINTS], n·ω; 0 in shadow. log_axis, log_distance: float32 [P, POINTS].
    """

    cos: np.ndarray
    log_axis: np.ndarray
    log_distance: np.ndarray


class Radiosity:
    """Patches of one surface and the light between them.

    Attributes:
        cell_mm: size of the patches. patch_of: int [F], patch of each triangle.
        centre_mm: float32 [P, 3], local frame.
        form_factors: CSR [P, P], rows sum to at most 1 (less where the mesh is open).
        unseen: float32 [P], directions in which a patch meets nothing for each in which it does.
    """

    def __init__(self, surface: Surface, caster: Caster, cell_mm: float, rays: int = RAYS, seed: int = 0):
        self.cell_mm = cell_mm
        self._caster = caster
        self._lift_mm = LIFT * cell_mm
        generator = np.random.default_rng(seed)
        corners = surface.vertices_mm[surface.triangles]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        double_area = np.sqrt(dot(normal, normal))
        normal = normal / np.maximum(double_area, np.finfo(np.float32).tiny)[:, None]
        self.patch_of = _patches(np.einsum("nka->na", corners) / 3, normal, cell_mm)
        self.count = int(self.patch_of.max()) + 1
        self._area = double_area / 2
        self._draw = _Draw(self.patch_of, double_area, self.count)
        self.form_factors = self._counted(corners, normal, rays, generator)
        met = np.asarray(self.form_factors.sum(axis=1)).ravel()
        self.unseen = ((1 - met) / np.maximum(met, LEAST_SEEN)).astype(np.float32)
        self._drawn = self._draw(POINTS, generator)
        self._weights = _weights(len(self._drawn), generator)
        self._points_mm = _mixed(self._weights, corners[self._drawn])
        self._normals = normal[self._drawn]
        self.centre_mm = self._mean_of_points(self._points_mm)
        self._facing = unit(self._mean_of_points(self._normals))
        self._surface = surface

    def moved(self, caster: Caster) -> Radiosity:
        """The same patches on the moved surface of ``caster``, which has the same triangles: lit where they
        are now, and still with the form factors of this surface."""
        other = copy(self)
        vars(other)["to_vertex"] = self.to_vertex
        other._surface, other._caster = caster.surface, caster
        corners = caster.surface.vertices_mm[caster.surface.triangles[self._drawn]]
        other._points_mm = _mixed(self._weights, corners)
        other._normals = unit(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
        other.centre_mm = other._mean_of_points(other._points_mm)
        return other

    @cached_property
    def to_vertex(self) -> scipy.sparse.csr_array:
        """CSR [V, P], interpolation from patches to vertices."""
        return self.to_points(self._surface.vertices_mm, self._surface.normals)

    def to_points(self, points_mm: np.ndarray, normals: np.ndarray) -> scipy.sparse.csr_array:
        """CSR [N, P], interpolation to ``points_mm`` [N, 3] with ``normals`` [N, 3]: Gaussian weights of
        the nearest patches that face alike."""
        apart = FACING * self.cell_mm
        tree = cKDTree(np.c_[self.centre_mm, apart * self._facing])
        neighbours = min(NEIGHBOURS, self.count)
        distance, nearest = tree.query(np.c_[points_mm, apart * normals], neighbours, workers=-1)
        distance, nearest = distance.reshape(-1, neighbours), nearest.reshape(-1, neighbours)
        weight = np.exp((distance[:, :1] ** 2 - distance**2) / self.cell_mm**2).astype(np.float32)
        weight /= weight.sum(axis=1, keepdims=True)
        pointers = np.arange(0, nearest.size + 1, neighbours)
        shape = (len(points_mm), self.count)
        return scipy.sparse.csr_array((weight.ravel(), nearest.ravel().astype(np.int32), pointers), shape)

    @property
    def nbytes(self) -> int:
        """Memory of the matrices, bytes."""
        matrices = (self.form_factors, self.to_vertex)
        return sum(m.data.nbytes + m.indices.nbytes + m.indptr.nbytes for m in matrices)

    def lamp(self, T_local_camera: np.ndarray, guide_mm: np.ndarray, profile: float) -> Lamp:
        """What a guide at ``guide_mm`` [3] (camera frame) of the pose [4, 4] lights, with the angular
        shape ``profile`` (``guides.log_axis``)."""
        rotation = T_local_camera[:3, :3]
        source = (T_local_camera[:3, 3] + rotation @ guide_mm).astype(np.float32)
        ray = self._points_mm - source
        distance_mm = np.maximum(np.sqrt(dot(ray, ray)), DISTANCE_MIN_MM)
        ray = ray / distance_mm[:, None]
        cos = -dot(ray, self._normals)
        facing = np.flatnonzero(cos > 0)
        length_mm = distance_mm[facing] * (1 - SHADOW_BIAS)
        seen = np.zeros(len(cos), bool)
        seen[facing] = self._caster.unobstructed(
            np.broadcast_to(source, (len(facing), 3)), ray[facing], length_mm
        )
        shape = (self.count, POINTS)
        axis = np.maximum(ray @ rotation[:, 2].astype(np.float32), COS_MIN)
        return Lamp(
            cos=np.where(seen, cos, 0).astype(np.float32).reshape(shape),
            log_axis=log_axis(axis, profile).astype(np.float32).reshape(shape),
            log_distance=np.log(distance_mm).reshape(shape),
        )

    def direct(self, lamps: list[Lamp], n: float, q: float) -> np.ndarray:
        """Direct irradiance with L0 = 1 of the patches, float32 [P, len(lamps)]."""
        return np.stack(
            [(lamp.cos * np.exp(n * lamp.log_axis - q * lamp.log_distance)).mean(axis=1) for lamp in lamps],
            axis=1,
        )

    def indirect(self, direct: np.ndarray, albedo: np.ndarray) -> np.ndarray:
        """Indirect irradiance float32 [P, M, 3] of ``direct`` [P, M] light, with patch ``albedo`` [P, 3]."""
        albedo = np.clip(albedo, 0, ALBEDO_MAX).astype(np.float32)[:, None]
        unseen = self.unseen[:, None, None]

        def thrown(irradiance: np.ndarray, unseen_share: float) -> np.ndarray:
            radiosity = (albedo * irradiance).reshape(self.count, -1)
            met = (self.form_factors @ radiosity).reshape(irradiance.shape)
            return met * (1 + unseen_share * unseen)

        first = thrown(np.repeat(direct[..., None].astype(np.float32), 3, axis=2), UNSEEN_DIRECT)
        bounced = first
        for _ in range(BOUNCES - 1):
            bounced = first + thrown(bounced, UNSEEN_INDIRECT)
        return bounced

    def mean(self, per_triangle: np.ndarray) -> np.ndarray:
        """Means over each patch's area, [P, C], of values [F, C]."""
        sums = [np.bincount(self.patch_of, self._area * column, self.count) for column in per_triangle.T]
        total = np.bincount(self.patch_of, self._area, self.count)
        return np.stack(sums, axis=1) / np.maximum(total, np.finfo(np.float64).tiny)[:, None]

    def _mean_of_points(self, values: np.ndarray) -> np.ndarray:
        return values.reshape(self.count, POINTS, -1).mean(axis=1)

    def _counted(
        self, corners: np.ndarray, normal: np.ndarray, rays: int, generator: np.random.Generator
    ) -> scipy.sparse.csr_array:
        triangle = self._draw(rays, generator)
        direction = _cosine_weighted(normal[triangle], generator)
        hit, _, _ = self._caster.cast_rays(
            _inside(corners[triangle], generator) + self._lift_mm * normal[triangle], direction
        )
        origin = np.repeat(np.arange(self.count), rays)
        landed = np.flatnonzero(hit >= 0)
        landed = landed[dot(normal[hit[landed]], direction[landed]) < 0]
        entries = (np.full(len(landed), 1 / rays, np.float32), (origin[landed], self.patch_of[hit[landed]]))
        return scipy.sparse.csr_array(scipy.sparse.coo_array(entries, shape=(self.count, self.count)))


class _Draw:
    """Draws triangles of each patch by area, stratified."""

    def __init__(self, patch_of: np.ndarray, area: np.ndarray, count: int):
        self._order = _grouped(patch_of, count)
        self._cumulated = np.cumsum(area[self._order], dtype=np.float64)
        ends = np.searchsorted(patch_of[self._order], np.arange(count), side="right")
        self._high = self._cumulated[ends - 1]
        self._low = np.r_[0.0, self._high[:-1]]

    def __call__(self, number: int, generator: np.random.Generator) -> np.ndarray:
        """``number`` triangles of each patch, int [P·number]."""
        share = (np.arange(number) + generator.random((len(self._low), number))) / number
        at = self._low[:, None] + share * (self._high - self._low)[:, None]
        found = np.searchsorted(self._cumulated, at.ravel(), side="right")
        return self._order[np.minimum(found, len(self._order) - 1)]


def _grouped(group: np.ndarray, count: int) -> np.ndarray:
    """Stable order of members by ``group`` [N], int [N]: a counting sort."""
    members = np.arange(len(group))
    return scipy.sparse.csr_array((members, (group, members)), shape=(count, len(group))).data


def _patches(centre_mm: np.ndarray, normal: np.ndarray, cell_mm: float) -> np.ndarray:
    """Patch of each triangle: cells of edge ``cell_mm``, split by the axis that the triangle faces most."""
    axis = np.abs(normal).argmax(axis=1)
    facing = 2 * axis + (np.take_along_axis(normal, axis[:, None], axis=1)[:, 0] > 0)
    cell = np.floor(centre_mm / cell_mm).astype(np.int64)
    cell -= cell.min(axis=0)
    x, y, z = cell.T
    width, height, _ = cell.max(axis=0) + 1
    key = ((z * height + y) * width + x) * 6 + facing
    return torch.unique(torch.from_numpy(key), return_inverse=True)[1].numpy()


def _inside(corners: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """One point drawn evenly inside each triangle [N, 3, 3], float32 [N, 3]."""
    return _mixed(_weights(len(corners), generator), corners)


def _weights(count: int, generator: np.random.Generator) -> np.ndarray:
    """Barycentric weights [count, 3] of points drawn evenly inside triangles (Turk 1990)."""
    root, second = np.sqrt(generator.random(count)), generator.random(count)
    return np.stack([1 - root, root * (1 - second), root * second], axis=1)


def _mixed(weights: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Points float32 [N, 3] of barycentric ``weights`` [N, 3] in triangles [N, 3, 3]."""
    return np.einsum("nk,nka->na", weights, corners).astype(np.float32)


def _cosine_weighted(normal: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """Directions float32 [N, 3] about unit normals [N, 3] with density cosθ/π: a point of the unit sphere
    set on the normal's tip (Shirley & Morley 2003, sec. 14.3)."""
    on_sphere = unit(generator.standard_normal(normal.shape))
    return unit(normal + 0.9999 * on_sphere).astype(np.float32)
