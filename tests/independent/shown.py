"""What each effect of a scene changes in its photos that nothing else could have changed.

The scene is rendered with the effect and without it. From the change of the photos' values, what the rest of
a model would take up is fitted away, to first order: an albedo of its own for each cell of the wall, γ, n and
q, and a gain of each frame where the camera's gain changes anyway. The light's profile and the lens's
vignetting are nearly one thing: each has to show beside the other. What remains is what the effect shows, as
root mean square. The light that bounces stays as it is while guides and profile change.
"""

from __future__ import annotations

import math

import numpy as np

from independent.picture import Studio, View, displayed

STEP = 3
"""Of the pixels, every third each way is looked at."""

CELL = 2.0
"""An albedo of its own has each cell of so many quads of the wall, each way."""

LEAST_LEVELS = 1.0
"""An effect that shows by less than one of 255 levels is too faint to be asked for."""

DARKEST = 1e-4


def shown_levels(studio: Studio) -> dict[str, dict[str, float]]:
    """Of each effect of the studio's scene: ``levels`` of 255 that it shows, and ``db`` by which a perfect
    model without it would lie above the photos' noise."""
    scene = studio.scene
    views = [_coarse(studio, frame) for frame in range(scene.frames)]
    full = np.concatenate([studio.radiance(view, scene).mean(axis=1) for view in views])
    noise2 = scene.noise_levels**2 + 1 / 12
    found = {}
    for name in sorted(scene.effects):
        lacking = scene.without(name)
        other = np.concatenate([studio.radiance(view, lacking).mean(axis=1) for view in views])
        levels = 255 * _left(views, full, other, scene.gamma, _rest(name, lacking.effects))
        found[name] = {"levels": levels, "db": 10 * math.log10(1 + levels**2 / noise2)}
    return found


def _coarse(studio: Studio, frame: int) -> View:
    lens = studio.scene.lens
    v, u = np.mgrid[1 : lens.height : STEP, 1 : lens.width : STEP]
    inside = lens.lit(u, v)
    return studio.view(frame, u[inside].astype(float), v[inside].astype(float))


def _rest(name: str, others: frozenset[str]) -> set[str]:
    """Effects whose parameters may take up what the effect ``name`` changes."""
    instead = {"vignetting": {"profile"}, "profile": {"vignetting"} if "offset" in others else set()}
    return {"gain", "profile", "vignetting"} & others | instead.get(name, set())


def _left(views: list[View], full: np.ndarray, other: np.ndarray, gamma: float, rest: set[str]) -> float:
    """Root mean square of what the rest of a model cannot make of the change from ``other`` to ``full``."""
    points_mm = np.concatenate([view.points_mm for view in views])
    place = np.concatenate([view.place for view in views])
    frame = np.concatenate([np.full(len(view.ray), view.frame) for view in views])
    distance = np.linalg.norm(points_mm, axis=1)
    cos = np.maximum(points_mm[:, 2] / distance, DARKEST)
    columns = [np.log(np.maximum(other, DARKEST)), np.log(cos), np.log(distance)]
    if "profile" in rest:
        columns.append(cos)
    if "vignetting" in rest:
        squared_radius = np.concatenate([view.squared_radius for view in views])
        columns += [squared_radius, squared_radius**2]
    if "gain" in rest:
        columns += [(frame == number).astype(float) for number in range(1, len(views))]
    value = displayed(other, gamma)
    slope = np.where(value < 1, gamma * value, 0)
    change = displayed(full, gamma) - value
    row, column = np.floor(place / CELL).astype(np.int64).T
    cell = np.unique(row * 65536 + column, return_inverse=True)[1].reshape(-1)
    weighted = np.stack([change, *(slope * values for values in columns)], axis=1)
    weight = np.bincount(cell, slope**2)
    for k, values in enumerate(weighted.T):
        mean = np.bincount(cell, slope * values) / np.maximum(weight, 1e-12)
        weighted[:, k] = values - slope * mean[cell]
    change, design = weighted[:, 0], weighted[:, 1:]
    solution = np.linalg.lstsq(design, change, rcond=None)[0]
    return float(np.sqrt(np.mean((change - design @ solution) ** 2)))
