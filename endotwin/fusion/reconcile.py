"""Carve and patch: the surface that no depth map contradicts."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from endotwin.cameras import Camera
from endotwin.fusion.agreement import Tolerance, compare
from endotwin.fusion.carve import Votes
from endotwin.fusion.mesh import surface_of
from endotwin.fusion.patch import Patches
from endotwin.fusion.views import View
from endotwin.surface import Surface


def reconciled(
    camera: Camera, surface: Surface, views: Iterable[View], tolerance: Tolerance, voxel_mm: float
) -> Surface:
    """``surface`` without what hides measured pixels, and with what they lack; each view is cast once.

    A hole that carving opens is patched by the next call, and a patch that other views see through is
    carved by it.
    """
    votes, patches = Votes(surface), Patches(camera, surface, voxel_mm)
    for seen in compare(camera, surface, views, tolerance):
        votes.add(seen)
        patches.add(seen)
    triangles = np.concatenate([surface.triangles[votes.kept()], patches.triangles])
    return surface_of(surface.origin_mm, patches.vertices_mm, triangles)
