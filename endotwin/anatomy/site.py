"""A place of the wall on which a polyp can stand: its axes, its curvature, and what is in the way."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from endotwin.anatomy.shape import Shape
from endotwin.surface import Surface
from endotwin.surface.casting import Caster
from endotwin.surface.vectors import dot, frame_along, unit

RINGS, AROUND = 7, 16
"""Of points at which the wall is probed."""

BAND = 0.45
"""Share of the disc's radius, and at least BAND_MM, by which wall may be off its curved plane and yet be the
same layer of it."""
BAND_MM = 0.6

CORE = 0.7
WHOLE, MOSTLY = 0.97, 0.8
"""Share of the probes that must meet the wall within CORE of the disc's radius, and no second layer of it;
and share of those beyond."""

SLANTING = 0.25
"""Least cosine between the wall's normal and the axis."""

ROOM = 1.15
"""A polyp needs so many times its own way to each of its points."""


@dataclass(frozen=True, eq=False)
class Site:
    """A disc of wall.

    Attributes:
        foot_mm: float64 [3], in the surface's frame. axes: [3, 3], rows: two across, and the axis, which
            points into the lumen. bend: [6], coefficients of 1, a, b, a², ab, b² of the wall's height.
        band_mm: how far the wall may be off that. met: share of the probes that met wall, as a
            part of what is asked for. single: share of them that met one layer of it.
    """

    foot_mm: np.ndarray
    axes: np.ndarray
    bend: np.ndarray
    band_mm: float
    met: float
    single: float

    @classmethod
    def at(cls, point_mm: np.ndarray, normal: np.ndarray, radius_mm: float, caster: Caster) -> Site:
        """About the point [3] of the wall with the ``normal`` [3], as wide as a shape's ``radius_mm``."""
        t, angle = np.meshgrid(np.sqrt((np.arange(RINGS) + 0.5) / RINGS), np.arange(AROUND) / AROUND)
        t, angle = t.ravel() * radius_mm, 2 * np.pi * angle.ravel()
        across = np.c_[t * np.cos(angle), t * np.sin(angle)]
        band_mm = max(BAND * radius_mm, BAND_MM)
        axis = unit(normal.astype(np.float64))
        for _ in range(3):
            axes = frame_along(axis)
            starts = point_mm + across @ axes[:2] + (radius_mm / 2 + band_mm) * axes[2]
            triangle, barycentric, distance_mm = _cast(caster, starts, -axes[2])
            normals = _normals(caster, triangle, barycentric)
            found = (distance_mm < radius_mm + 2 * band_mm) & (normals @ axes[2] > SLANTING)
            if found.sum() < 6:
                return cls(point_mm, axes, np.zeros(6), band_mm, 0.0, 0.0)
            axis = unit(normals[found].astype(np.float64).mean(axis=0))
        c = radius_mm / 2 + band_mm - distance_mm[found]
        bend = np.linalg.lstsq(_powers(across[found]), c, rcond=None)[0]
        site = cls(point_mm, axes, bend, band_mm, 0.0, 0.0)
        off_mm = np.abs(c - site.height_mm(across[found]))
        core = t < CORE * radius_mm
        met = min(
            float((off_mm < band_mm)[part[found]].sum() / part.sum()) / whole
            for part, whole in ((core, WHOLE), (~core, MOSTLY))
        )
        below = starts[found] - (distance_mm[found, None] + 0.01) * axes[2]
        _, _, next_mm = _cast(caster, below, -axes[2])
        return cls(point_mm, axes, bend, band_mm, met, float((next_mm > band_mm).mean()))

    def height_mm(self, across_mm: np.ndarray) -> np.ndarray:
        """Of the wall, as its curved plane has it, above the foot at ``across_mm`` [N, 2], [N]."""
        return _powers(across_mm) @ self.bend

    def along(self, local_mm: np.ndarray) -> np.ndarray:
        """Bool [N]: points [N, 3], along the site's axes, on the wall's curved plane."""
        return np.abs(local_mm[:, 2] - self.height_mm(local_mm[:, :2])) < self.band_mm

    def near(self, surface: Surface, radius_mm: float) -> np.ndarray:
        """Bool [F]: triangles whose box may meet the disc of ``radius_mm``, as thick as the band."""
        reach_mm = radius_mm + 2 * self.band_mm
        off = surface.vertices_mm - self.foot_mm.astype(np.float32)
        low, high = (off < -reach_mm)[surface.triangles], (off > reach_mm)[surface.triangles]
        return ~(low.all(axis=1) | high.all(axis=1)).any(axis=1)

    def _torn(self, shape: Shape, surface: Surface) -> bool:
        """Whether triangles lead from the wall that is to move to other surface above or below it, or it
        has a seam, which would gape."""
        triangles = surface.triangles[self.near(surface, shape.radius_mm)]
        vertices, corners = np.unique(triangles, return_inverse=True)
        corners = corners.reshape(-1, 3)
        local_mm = self.within(surface.vertices_mm[vertices].astype(np.float64))
        rho_mm, along = np.linalg.norm(local_mm[:, :2], axis=1), self.along(local_mm)
        disc, core = rho_mm < shape.radius_mm, rho_mm < CORE * shape.radius_mm
        leads = (disc & along)[corners].any(axis=1) & (disc & ~along)[corners].any(axis=1)
        ends = np.sort(corners[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
        edges, times = np.unique(ends, axis=0, return_counts=True)
        seams = (core & along)[edges[times == 1]].any(axis=1)
        return bool(leads.any() or seams.any())

    def within(self, points_mm: np.ndarray) -> np.ndarray:
        """Points [N, 3] of the surface's frame along the site's axes, [N, 3]."""
        return (points_mm - self.foot_mm) @ self.axes.T

    def placed(self, local_mm: np.ndarray) -> np.ndarray:
        """The inverse of ``within``."""
        return local_mm @ self.axes + self.foot_mm

    def grown(self, shape: Shape, across_mm: np.ndarray) -> np.ndarray:
        """Where points of the curved plane at ``across_mm`` [N, 2] go, along the site's axes, [N, 3]."""
        points, soft = shape.at(across_mm)
        points[:, 2] += soft * self.height_mm(points[:, :2])
        return points

    def fault(self, shape: Shape, caster: Caster) -> str:
        """What hinders the shape from growing here, as the end of a sentence; empty where nothing does."""
        if self.met < 1:
            return "the wall there is not whole, or too bent"
        if self.single < WHOLE:
            return "the wall there lies in layers"
        if not self._has_room(shape, caster):
            return "the lumen is too narrow there" if shape.height_mm > 0 else "the wall there is too thin"
        torn = self._torn(shape, caster.surface)  # which takes the longest
        return "the wall there is not whole, or too bent" if torn else ""

    def _has_room(self, shape: Shape, caster: Caster) -> bool:
        """Whether nothing is in the way of a shape that grows here."""
        if shape.height_mm <= 0:
            return shape.flat or self._is_deep(shape, caster)
        points = self.grown(shape, shape.rings(16, 12, shape.edge))
        top = points[points[:, 2].argmax()]
        risen = points[points[:, 2] > max(0.3 * shape.height_mm, self.band_mm)]
        inside = np.c_[risen[:, 2:] / top[2] * top[:2], risen[:, 2]]
        starts = np.concatenate([[[0, 0, self.band_mm]], inside])
        ends = np.concatenate([[top], risen])
        way = self.placed(starts + ROOM * (ends - starts)) - self.placed(starts)
        length_mm = np.sqrt(dot(way, way))
        far = length_mm > 1e-6
        starts = self.placed(starts)[far].astype(np.float32)
        return caster.unobstructed(starts, unit(way[far]).astype(np.float32), length_mm[far]).all()

    def _is_deep(self, shape: Shape, caster: Caster) -> bool:
        """Whether a shape below the wall ends above what lies behind the wall."""
        across = shape.rings(16, 24, shape.edge)
        sunk = self.grown(shape, across)
        above = np.c_[sunk[:, :2], self.height_mm(sunk[:, :2]) + self.band_mm]
        *_, wall_mm = _cast(caster, self.placed(above), -self.axes[2])
        met = np.isfinite(wall_mm)
        above = above[met] - np.c_[np.zeros((met.sum(), 2)), wall_mm[met] + 0.01]
        *_, behind_mm = _cast(caster, self.placed(above), -self.axes[2])
        return bool((above[:, 2] - behind_mm < sunk[met, 2] + (ROOM - 1) * shape.height_mm).all())


def _powers(across: np.ndarray) -> np.ndarray:
    a, b = across.T
    return np.stack([np.ones_like(a), a, b, a * a, a * b, b * b], axis=1)


def _cast(caster: Caster, starts: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, ...]:
    towards = np.broadcast_to(direction, starts.shape)
    return caster.cast_rays(starts.astype(np.float32), towards.astype(np.float32))


def _normals(caster: Caster, triangle: np.ndarray, barycentric: np.ndarray) -> np.ndarray:
    corners = caster.surface.normals[caster.surface.triangles[triangle]]
    return unit((corners * barycentric[..., None]).sum(axis=1)) * (triangle >= 0)[:, None]
