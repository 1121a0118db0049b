"""Carve and patch: the surface that no depth map contradicts."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from endotwin.cameras import Camera
from endotwin.fusion.agreement import Tolerance, compare
from endotwin.fusion.carve import Votes
from endotwin.fusion.mesh import single, surface_of
from endotwin.fusion.patch import Patches
from endotwin.fusion.views import View
from endotwin.surface import Surface
from endotwin.surface.casting import Caster


def reconciled(
    camera: Camera, surface: Surface, views: Iterable[View], tolerance: Tolerance
) -> tuple[Surface, dict[int, float]]:
    """``surface`` without what hides measured pixels, and with what they lack; each view is cast once.

    A hole that carving opens is patched by the next call, and a patch that other views see through is
    carved by it.

    Returns:
        the surface, and by frame the share of its measured pixels that agreed with the one before.
    """
    caster = Caster(surface)
    votes, patches = Votes(surface), Patches(camera, caster)
    agreeing = {}
    for seen in compare(camera, caster, views, tolerance):
        votes.add(seen)
        patches.add(seen)
        agreeing[seen.view.index] = float(seen.at.sum() / np.isfinite(seen.view.distance_mm).sum())
    triangles = single(np.concatenate([surface.triangles[votes.kept()], patches.triangles]))
    return surface_of(surface.origin_mm, patches.vertices_mm, triangles), agreeing
