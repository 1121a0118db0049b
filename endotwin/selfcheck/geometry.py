"""Meshes with something wrong, rays aimed at their seams, and scenes of any place and size."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import trimesh

from endotwin.fusion.mesh import surface_of
from endotwin.selfcheck.finding import Check, Finding
from endotwin.selfcheck.journey import Journey, travel
from endotwin.selfcheck.tube import Tube
from endotwin.surface import Surface
from endotwin.surface.casting import Caster

RADIUS_MM = 15.0
RAYS = 1_000_000
EYE_MM = np.array([1.0, -2.0, 0.5], np.float32)


def sphere(radius_mm: float = RADIUS_MM) -> tuple[np.ndarray, np.ndarray]:
    """Vertices float32 [V, 3] and triangles int32 [F, 3] of a sphere seen from inside."""
    mesh = trimesh.creation.icosphere(subdivisions=5, radius=radius_mm)
    return np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces, np.int32)[:, ::-1]


def slipped(surface: Surface, eye_mm: np.ndarray, targets_mm: np.ndarray) -> int:
    """How many rays from ``eye_mm`` [3] towards points [N, 3] of a closed surface hit nothing."""
    directions = targets_mm - eye_mm
    directions = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    triangle, _, _ = Caster(surface).cast_rays(np.broadcast_to(eye_mm, directions.shape), directions)
    return int((triangle < 0).sum())


def watertight() -> Iterator[Finding]:
    """Rays along edges and through vertices, at three sizes of the scene."""
    for scale in (1e-3, 1.0, 1e3):
        surface = surface_of(np.zeros(3), *sphere(RADIUS_MM * scale))
        generator = np.random.default_rng(0)
        corners = surface.vertices_mm[surface.triangles][generator.integers(0, len(surface.triangles), RAYS)]
        along = generator.uniform(0, 1, (RAYS, 1)).round(1).astype(np.float32)
        targets = (1 - along) * corners[:, 0] + along * corners[:, 1]
        lost = slipped(surface, EYE_MM * np.float32(scale), targets)
        yield Finding(f"10⁶ rays at shared edges and vertices, scale {scale:g}: slipped through", lost, 0)


def _spoilt() -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """The sphere's mesh with what goes wrong in meshes, by name."""
    vertices, triangles = sphere()
    few = triangles[::50]
    middle = vertices[few[:, :2]].mean(axis=1)
    number = len(vertices) + np.arange(len(few), dtype=np.int32)
    needle = np.stack([few[:, 0], few[:, 1], number], axis=1)
    inside = (vertices[few].mean(axis=1) * 0.8).astype(np.float32)
    fin = np.stack([few[:, 0], few[:, 1], number], axis=1)
    flipped = triangles.copy()
    flipped[::100] = flipped[::100, ::-1]
    return {
        "zero-area triangles": (vertices, np.concatenate([triangles, few[:, [0, 0, 1]], few[:, [2, 2, 2]]])),
        "slivers 1e-6 of an edge wide": (
            np.concatenate([vertices, (middle + 1e-6).astype(np.float32)]),
            np.concatenate([triangles, needle]),
        ),
        "duplicate triangles": (vertices, np.concatenate([triangles, few, few[:, [1, 2, 0]]])),
        "duplicate triangles that face away": (vertices, np.concatenate([triangles, few, few, few[:, ::-1]])),
        "1 % of the windings flipped": (vertices, flipped),
        "edges of three triangles": (np.concatenate([vertices, inside]), np.concatenate([triangles, fin])),
        "vertices far off that no triangle uses": (np.concatenate([vertices, [[1e9, 0, 0]]]), triangles),
    }


def meshes() -> Iterator[Finding]:
    """Normals of spoilt meshes, where the sphere's own vertices are."""
    count = len(sphere()[0])
    for name, (vertices, triangles) in _spoilt().items():
        surface = surface_of(np.zeros(3), np.asarray(vertices, np.float32), triangles)
        radius_mm = np.linalg.norm(surface.vertices_mm, axis=1)
        own = np.abs(radius_mm - RADIUS_MM) < 1e-4
        inward = -surface.vertices_mm[own] / radius_mm[own, None]
        cosine = np.einsum("va,va->v", surface.normals[own], inward)
        lengths = np.linalg.norm(surface.normals, axis=1)
        sound = np.abs(lengths - 1).max() < 1e-5 and own.sum() >= count
        worst = math.degrees(math.acos(np.clip(cosine.min(), -1, 1))) if sound else math.nan
        yield Finding(f"Normals beside {name}", worst, 60 if "three" in name else 2, unit="°")


def _apart(one: Journey, other: Journey) -> tuple[float, float]:
    """Differences of PSNR in dB and of γ as a share, NaN where a twin has anything that is not finite."""
    if one.refused or other.refused or one.not_finite or other.not_finite:
        return math.nan, math.nan
    decibel = abs(one.scores.psnr_covered - other.scores.psnr_covered)
    return decibel, abs(one.twin.response.gamma / other.twin.response.gamma - 1)


def places() -> Iterator[Finding]:
    """The same scene elsewhere, and larger or smaller."""
    here = travel()
    decibel, gamma = _apart(travel(Tube(shift_mm=1e6)), here)
    yield Finding("Scene 10⁶ mm from the origin: PSNR apart", decibel, 0.1, unit="dB")
    yield Finding("Scene 10⁶ mm from the origin: γ apart", 100 * gamma, 0.2, unit="%")
    for scale in (1e-3, 1e3):
        decibel, gamma = _apart(travel(Tube(scale=scale)), here)
        yield Finding(f"Scene scaled by {scale:g}: PSNR apart", decibel, 0.3, unit="dB")
        yield Finding(f"Scene scaled by {scale:g}: γ apart", 100 * gamma, 3, unit="%")


CHECKS: tuple[Check, ...] = (watertight, meshes, places)
