"""Light that tissue throws on tissue: form factors of a fixed surface, and its irradiance under a moving
light.

The surface is gathered into patches. Once, cosine-weighted rays from each patch count which patches it sees:
the form factors K (Goral et al. 1984; Monte Carlo estimate, Cohen & Wallace 1993, ch. 4). Then the indirect
irradiance E under any light is E = K·ρ(E_direct + E), a few sparse products a bounce; what white lobes make
of direct light is not even, and has factors of its own (``mirror``).

A lumen is closed, and a mesh of what depth maps showed is not: from half of a wall's directions comes light
of tissue that nobody saw. The surface's wall stands for it, with the albedo of the nearest patch that was
seen; and where that ends too, tissue like that which is seen from there, in as much indirect light, but only
UNSEEN_DIRECT of the direct one: a light beside the camera hardly reaches what the camera does not see.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy.sparse
import torch
from scipy.spatial import cKDTree

from endotwin.light.guides import COSINE, SHADOW_BIAS, log_axis
from endotwin.light.incidence import COS_MIN, DISTANCE_MIN_MM
from endotwin.light.mirror import mirrored
from endotwin.surface import Surface
from endotwin.surface.casting import Caster
from endotwin.surface.vectors import dot, unit

RAYS = 256
"""Rays of a patch that count its form factors: one part in 16 of noise, and half of that after a bounce."""

POINTS = 4
"""Points of a patch at which direct light is evaluated."""

FACETS = 16
"""Of each such point, in which it mirrors light. A picture needs fewer, but some decisions do not stand
without them."""

NEIGHBOURS = 4
"""Patches between which a vertex interpolates."""

FACING = 1.0
"""Patches that face opposite ways count as so many patch sizes apart, so that light does not leak through
a fold."""

LEAST_AREA = 0.1
"""Of a patch, as a share of its cell's face: smaller ones, where the surface cuts a cell's corner or turns
over an edge, are one with the nearest larger one."""

LIFT = 1e-3
"""Rays start this share of a patch's size above it."""

UNSEEN_DIRECT = 0.1
"""What a walled surface lacks is mostly slits beside the wall. With this, random colons get their bounce to
8 % (``benchmarks/bench_bounce.py``), with all of the light there more than theirs."""

LEAST_SEEN = 0.1
"""Share of its directions that a patch must see something in for that to stand for the rest."""

BOUNCES = 6
"""One by one, before all that follow are taken for a geometric series."""

ALBEDO_MAX = 0.95
"""Beyond, a furnace that tissue is not."""


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
        cell_mm: size of the patches. patch_of: int [F], patch of each triangle. count: P patches.
        centre_mm: float32 [P, 3], local frame.
        form_factors: CSR [P + W, P + W], W patches of the wall last; rows sum to at most 1 (less where the
            mesh is open).
        unseen: float32 [P + W], directions in which a patch meets nothing for each in which it does.
    """

    def __init__(self, surface: Surface, caster: Caster, cell_mm: float, rays: int = RAYS, seed: int = 0):
        self.cell_mm = cell_mm
        self._caster = caster
        self._lift_mm = LIFT * cell_mm
        generator = np.random.default_rng(seed)
        whole, own = _with_wall(surface), len(surface.triangles)
        corners = whole.vertices_mm[whole.triangles]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        double_area = np.sqrt(dot(normal, normal))
        normal = normal / np.maximum(double_area, np.finfo(np.float32).tiny)[:, None]
        middle = np.einsum("nka->na", corners) / 3
        pieces = [
            _patches(middle[k], normal[k], double_area[k] / 2, cell_mm) for k in (np.s_[:own], np.s_[own:])
        ]
        self.patch_of = pieces[0]
        self.count = int(self.patch_of.max()) + 1
        self._whole_patch = np.r_[pieces[0], self.count + pieces[1]]
        self._area_mm2 = np.bincount(self._whole_patch, double_area / 2)
        self._draw = _Draw(self._whole_patch, double_area, len(self._area_mm2))
        self._whole, self._front = Caster(whole) if len(surface.wall_triangles) else caster, normal
        self.form_factors = self._counted(corners, rays, generator)
        met = np.asarray(self.form_factors.sum(axis=1)).ravel()
        self.unseen = ((1 - met) / np.maximum(met, LEAST_SEEN)).astype(np.float32)
        self._drawn = self._draw(POINTS, generator)
        self._weights = _weights(len(self._drawn), generator)
        self._points_mm = _mixed(self._weights, corners[self._drawn])
        self._normals = normal[self._drawn]
        self._facets = generator.random((len(self._drawn), 2), np.float32)
        centre_mm = _mean_of_points(self._points_mm)
        self.centre_mm = centre_mm[: self.count]
        self._facing = unit(_mean_of_points(self._normals[: self.count * POINTS]))
        seen = surface.seen()
        seen |= not seen.any()
        self._area = double_area[:own] / 2 * seen
        told = np.unique(self.patch_of[seen])
        self._like = told[cKDTree(self.centre_mm[told]).query(centre_mm)[1]]
        self._surface = surface

    def moved(self, caster: Caster) -> Radiosity:
        """The same patches on the moved surface of ``caster``, which has the same triangles: lit where they
        are now, and still with the form factors of this surface, whose wall does not move."""
        other = copy(self)
        vars(other)["to_vertex"] = self.to_vertex
        other._surface, other._caster = caster.surface, caster
        own = self.count * POINTS
        corners = caster.surface.vertices_mm[caster.surface.triangles[self._drawn[:own]]]
        normals = unit(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
        other._points_mm = np.concatenate([_mixed(self._weights[:own], corners), self._points_mm[own:]])
        other._normals = np.concatenate([normals, self._normals[own:]])
        other.centre_mm = _mean_of_points(other._points_mm[:own])
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
        shape ``profile`` (``guides.log_axis``): nothing behind it."""
        rotation = T_local_camera[:3, :3]
        source = (T_local_camera[:3, 3] + rotation @ guide_mm).astype(np.float32)
        ray = self._points_mm - source
        distance_mm = np.maximum(np.sqrt(dot(ray, ray)), DISTANCE_MIN_MM)
        ray = ray / distance_mm[:, None]
        cos, axis = -dot(ray, self._normals), ray @ rotation[:, 2].astype(np.float32)
        facing = np.flatnonzero((cos > 0) & (axis > 0))
        own = np.searchsorted(facing, self.count * POINTS)
        seen = np.zeros(len(cos), bool)
        for caster, some in ((self._caster, facing[:own]), (self._whole, facing[own:])):
            length_mm = distance_mm[some] * (1 - SHADOW_BIAS)
            seen[some] = caster.unobstructed(np.broadcast_to(source, (len(some), 3)), ray[some], length_mm)
        shape = (-1, POINTS)
        return Lamp(
            cos=np.where(seen, cos, 0).astype(np.float32).reshape(shape),
            log_axis=log_axis(np.maximum(axis, COS_MIN), profile).astype(np.float32).reshape(shape),
            log_distance=np.log(distance_mm).reshape(shape),
        )

    def direct(self, lamps: list[Lamp], n: float, q: float) -> np.ndarray:
        """Direct irradiance with L0 = 1 of the patches and those of the wall, float32 [P + W, len(lamps)]."""
        return np.stack(
            [(lamp.cos * np.exp(n * lamp.log_axis - q * lamp.log_distance)).mean(axis=1) for lamp in lamps],
            axis=1,
        )

    def mirror_factors(self, source_mm: np.ndarray, lamps: Sequence[Lamp]) -> scipy.sparse.csr_array:
        """Irradiance that patches' white lobes throw on: CSR [P + W, P + W], to be multiplied with ρ·E, E the
        direct light by ``lamps`` about ``source_mm`` [3] and ρ what lobes send back of light from all around.
        """
        cos = sum(lamp.cos for lamp in lamps)
        share = (cos / np.maximum(cos.sum(axis=1, keepdims=True), np.finfo(np.float32).tiny)).ravel()
        point, met, thrown, _ = self._by_facets(np.flatnonzero(share), source_mm)
        patch = point // POINTS
        thrown = thrown * share[point] * self._area_mm2[patch] / self._area_mm2[met]
        return self._matrix(thrown.astype(np.float32), met, patch)

    def mirrored_factors(self, T_local_camera: np.ndarray) -> scipy.sparse.csr_array:
        """What patches' white lobes show to a camera at the pose [4, 4], of what leaves all patches: CSR
        [P, P + W] by rows that sum to 1, or to less where little or nothing is to be seen.
        """
        eye_mm = T_local_camera[:3, 3]
        seen = self.lamp(T_local_camera, np.zeros(3), COSINE).cos > 0
        points = np.flatnonzero(seen[: self.count])
        point, met, sent, whole = self._by_facets(points, eye_mm)
        patch = point // POINTS
        landed = np.bincount(patch, sent, self.count)
        least = LEAST_SEEN * np.bincount(points // POINTS, whole, self.count)
        shown = sent / np.maximum(landed, least)[patch]
        return self._matrix(shown.astype(np.float32), patch, met)[: self.count]

    def _by_facets(
        self, points: np.ndarray, end_mm: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Ways by facets of ``points`` [S] between ``end_mm`` [3] and patches: the point of each way, [L],
        the patch, and the share of ``mirror.mirrored`` that goes there; and what each point mirrors, [S]."""
        points_mm, normals = self._points_mm[points], self._normals[points]
        to_end = unit(end_mm.astype(np.float32) - points_mm)
        direction, share = mirrored(normals, to_end, self._facets[points], FACETS)
        sent = np.flatnonzero(share)
        origin_mm = (points_mm + self._lift_mm * normals)[sent // FACETS]
        landed, met = self._landed(origin_mm, direction[sent])
        sent = sent[landed]
        return points[sent // FACETS], met, share[sent], share.reshape(-1, FACETS).sum(axis=1)

    def indirect(
        self,
        direct: np.ndarray,
        color: np.ndarray,
        glossy: np.ndarray | float = 0.0,
        mirrors: Sequence[scipy.sparse.csr_array] = (),
    ) -> np.ndarray:
        """Indirect irradiance float32 [P + W, M, 3] of ``direct`` [P + W, M] light.

        Args:
            color: [P, 3], share of all light that patches send back evenly. glossy: [P, 1], that of their
                white lobes: of direct light by ``mirrors``, M of ``mirror_factors``, of all other evenly.
        """
        glossy = np.broadcast_to(np.asarray(glossy, np.float32), (len(color), 1))
        color, glossy = (self.walled(x) for x in (color, glossy))
        unseen = self.unseen[:, None, None]

        def thrown(irradiance: np.ndarray, albedo: np.ndarray, unseen_share: float) -> np.ndarray:
            albedo = np.clip(albedo, 0, ALBEDO_MAX)
            radiosity = (albedo * irradiance).reshape(len(irradiance), -1)
            met = (self.form_factors @ radiosity).reshape(irradiance.shape)
            return met * (1 + unseen_share * unseen)

        each = np.repeat(direct[..., None].astype(np.float32), 3, axis=2)
        added = thrown(each, color, UNSEEN_DIRECT)
        for view, mirror in enumerate(mirrors):
            added[:, view] += (mirror @ (glossy[:, 0] * direct[:, view, None])).astype(np.float32)
        total = added.copy()
        for _ in range(BOUNCES - 1):
            before, added = added.sum(axis=0), thrown(added, color + glossy, 1.0)
            total += added
        ratio = np.clip(added.sum(axis=0) / np.maximum(before, np.finfo(np.float32).tiny), 0, ALBEDO_MAX)
        return total + added * (ratio / (1 - ratio))

    def walled(self, albedo: np.ndarray) -> np.ndarray:
        """``albedo`` [P, C] of tissue where photos tell it, and elsewhere and on the wall that of the nearest
        such patch: float32 [P + W, 1, C]."""
        return albedo[self._like][:, None].astype(np.float32)

    def mean(self, per_triangle: np.ndarray) -> np.ndarray:
        """Means over what photos saw of each patch, [P, C], of values [F, C]; 0 where they saw nothing."""
        sums = [np.bincount(self.patch_of, self._area * column, self.count) for column in per_triangle.T]
        total = np.bincount(self.patch_of, self._area, self.count)
        return np.stack(sums, axis=1) / np.maximum(total, np.finfo(np.float64).tiny)[:, None]

    def _counted(
        self, corners: np.ndarray, rays: int, generator: np.random.Generator
    ) -> scipy.sparse.csr_array:
        triangle = self._draw(rays, generator)
        normal = self._front[triangle]
        direction = _cosine_weighted(normal, generator)
        origin_mm = _inside(corners[triangle], generator) + self._lift_mm * normal
        landed, met = self._landed(origin_mm, direction)
        each = np.full(len(landed), 1 / rays, np.float32)
        return self._matrix(each, self._whole_patch[triangle[landed]], met)

    def _landed(self, origin_mm: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Which of N rays meet the front of a patch, int [L], and what patch, [L]."""
        hit, _, _ = self._whole.cast_rays(origin_mm, direction)
        landed = np.flatnonzero(hit >= 0)
        landed = landed[dot(self._front[hit[landed]], direction[landed]) < 0]
        return landed, self._whole_patch[hit[landed]]

    def _matrix(self, values: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> scipy.sparse.csr_array:
        """Sums of ``values`` [N] by patches, CSR [P + W, P + W]."""
        shape = (len(self._area_mm2),) * 2
        return scipy.sparse.csr_array(scipy.sparse.coo_array((values, (rows, columns)), shape=shape))


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


def _with_wall(surface: Surface) -> Surface:
    """Surface and wall as one mesh."""
    vertices_mm = np.concatenate([surface.vertices_mm, surface.wall_mm])
    wall = surface.wall_triangles + np.int32(len(surface.vertices_mm))
    return replace(surface, vertices_mm=vertices_mm, triangles=np.concatenate([surface.triangles, wall]))


def _mean_of_points(values: np.ndarray) -> np.ndarray:
    """Means over each patch's points, [P, C], of [P · POINTS, C]."""
    return values.reshape(-1, POINTS, values.shape[1]).mean(axis=1)


def _patches(middle_mm: np.ndarray, normal: np.ndarray, area_mm2: np.ndarray, cell_mm: float) -> np.ndarray:
    """Patch of each of N triangles, int [N]: cells of edge ``cell_mm``, split by the axis that the triangle
    faces most."""
    if not len(middle_mm):
        return np.zeros(0, np.int64)
    axis = np.abs(normal).argmax(axis=1)
    facing = 2 * axis + (np.take_along_axis(normal, axis[:, None], axis=1)[:, 0] > 0)
    cell = np.floor(middle_mm / cell_mm).astype(np.int64)
    cell -= cell.min(axis=0)
    x, y, z = cell.T
    width, height, _ = cell.max(axis=0) + 1
    key = ((z * height + y) * width + x) * 6 + facing
    patch = torch.unique(torch.from_numpy(key), return_inverse=True)[1].numpy()
    area = np.bincount(patch, area_mm2)
    large = area >= min(LEAST_AREA * cell_mm**2, area.max())
    place = np.c_[middle_mm, FACING * cell_mm * normal]
    mean = np.stack([np.bincount(patch, area_mm2 * column) for column in place.T], axis=1)
    mean /= np.maximum(area, np.finfo(np.float64).tiny)[:, None]
    number = np.cumsum(large) - 1
    number[~large] = cKDTree(mean[large]).query(mean[~large])[1]
    return number[patch]


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
