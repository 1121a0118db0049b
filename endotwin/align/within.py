"""The vertices' sightings in many photos, with every vertex's albedo and every image's smooth light taken
out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from endotwin.align.coupled import coupled
from endotwin.align.photos import Photo
from endotwin.align.scene import SHADING, SHADING_MEAN, SHADING_SPREAD, Scene
from endotwin.align.texture import LIGHT_CELLS, Sighted, sighted
from endotwin.align.views import View
from endotwin.robust import robust_std
from endotwin.run.ahead import ahead
from endotwin.run.threads import THREADS

HUBER = 2.0
ROUNDS = 4
"""Of reweighting, and of taking out vertices' and cells' means in turn."""


@dataclass(frozen=True, eq=False)
class Within:
    """N sightings in F photos.

    Attributes:
        views: of the photos [F]. slopes: float32 [N, 9].
        vertex, photo, cell: int [N]; ``cell`` counts those of all photos.
        residual: float64 [N], ln photo less shading, vertex and cell. weight: [N], at most 1. width: of the
            residuals. light: [6], coefficients of the shading. log_albedo: [V], of the scene's vertices, NaN
            unseen.
    """

    views: list[View]
    vertex: np.ndarray
    photo: np.ndarray
    cell: np.ndarray
    slopes: np.ndarray
    residual: np.ndarray
    weight: np.ndarray
    width: float
    light: np.ndarray
    log_albedo: np.ndarray

    def normal_equations(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Matrix [F, 9, F, 9] and right-hand side [F, 9] of the twists and intrinsics of ``count`` photos, in
        units of the residuals' variance."""
        rows = self.slopes, self.residual, self.weight, self.photo, self.vertex
        matrix, right = coupled(*rows, (count, len(self.log_albedo)))
        return matrix / self.width**2, right / self.width**2


def within(
    scene: Scene, photos: dict[int, Photo], poses: np.ndarray, frames: np.ndarray, sigma_px: float
) -> Within:
    """Sightings in the photos of ``frames`` [F], whose poses are ``poses`` [N, 4, 4] by frame."""
    views, seen = [], []

    def one(frame: int) -> tuple[View, Sighted]:
        view = View.of(scene, poses[frame], sigma_px)
        return view, sighted(scene, photos[frame], view)

    for view, part in ahead(one, frames.tolist(), THREADS):
        views.append(view)
        seen.append(part)
    photo = np.repeat(np.arange(len(seen)), [len(part.vertex) for part in seen])
    vertex = np.concatenate([part.vertex for part in seen])
    often = np.bincount(vertex, minlength=len(scene.vertices))[vertex] > 1
    cells = photo * (LIGHT_CELLS + 1) ** 2 + np.concatenate([part.cell for part in seen])
    cell = np.unique(cells, return_inverse=True)[1].reshape(-1)
    shown, columns = (np.concatenate([getattr(part, name) for part in seen]) for name in ("shown", "columns"))
    groups = _Groups(vertex, cell, len(scene.vertices))
    light, weight, width, residual = _explained(shown, columns, groups, often)
    seen_weight = np.bincount(vertex, weight, groups.vertices)
    with np.errstate(invalid="ignore"):
        log_albedo = np.bincount(vertex, weight * (shown - columns @ light), groups.vertices) / seen_weight
    slopes = np.concatenate([part.slopes(light) for part in seen])
    slopes = np.stack([x - groups.of_cells(x, weight)[cell] for x in slopes.T], axis=1).astype(np.float32)
    weight = np.where(often, weight, 0.0)
    return Within(views, vertex, photo, cell, slopes, residual, weight, width, light, log_albedo)


@dataclass(frozen=True)
class _Groups:
    """Sightings by vertex and by cell, int [N] each."""

    vertex: np.ndarray
    cell: np.ndarray
    vertices: int

    def of_cells(self, values: np.ndarray, weight: np.ndarray) -> np.ndarray:
        """Weighted means of the cells, [C]."""
        return np.bincount(self.cell, weight * values) / np.maximum(np.bincount(self.cell, weight), 1e-9)

    def without(self, values: np.ndarray, weight: np.ndarray) -> np.ndarray:
        """``values`` [N, K] less what vertices and cells explain, by turns."""
        found = values.copy()
        by_vertex = np.maximum(np.bincount(self.vertex, weight, self.vertices), 1e-9)
        for column in found.T:
            for _ in range(ROUNDS):
                column -= self.of_cells(column, weight)[self.cell]
                column -= (np.bincount(self.vertex, weight * column, self.vertices) / by_vertex)[self.vertex]
        return found


def _explained(shown: np.ndarray, columns: np.ndarray, groups: _Groups, often: np.ndarray):
    """Coefficients of the shading [6], weights [N], robust width, and residuals [N] without vertices and
    cells."""
    weight, light = np.ones(len(shown)), SHADING_MEAN
    for _ in range(2):
        left = groups.without(np.c_[columns, shown], weight)
        a, r = left[:, :SHADING], left[:, SHADING]
        width = robust_std((r - a @ light)[often], 1e-3) if often.any() else 1.0
        normal = (a * weight[:, None]).T @ a / width**2 + np.diag(1 / SHADING_SPREAD**2)
        right = a.T @ (weight * r) / width**2 + SHADING_MEAN / SHADING_SPREAD**2
        light = np.linalg.solve(normal, right)
        residual = r - a @ light
        width = robust_std(residual[often], 1e-3) if often.any() else 1.0
        weight = 1 / np.maximum(1, np.abs(residual) / (HUBER * width))
    return light, weight, width, residual
