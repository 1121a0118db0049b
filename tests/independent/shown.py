"""What a scene's photos tell: of each effect, and of γ, n and q.

An effect is judged by what it changes in the photos that nothing else could have changed. The scene is
rendered with it and without it. From the change of the photos' values, what the rest of a model would take up
is fitted away, to first order: an albedo of its own for each cell of the wall, γ, n and q, and the parameters
of the scene's other effects. The light's profile and the lens's vignetting are nearly one thing: each has to
show beside the other. What remains is what the effect shows, as root mean square. The light that bounces
stays as it is while guides and profile change.

A tone curve is judged on the photos' values, channel by channel, since it turns hues; all else on grey ones
as they are without a curve.

In the same way, what a wrong γ, n or q shows is what is left of its change after the best fit of all else:
the smaller, the more does a small fault of a model bend it.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from independent.picture import Studio, View, displayed
from independent.scene import Scene

STEP = 3
"""Of the pixels, every third each way is looked at."""

CELL = 2.0
"""An albedo of its own has each cell of so many quads of the wall, each way."""

LEAST_LEVELS = 1.0
"""An effect that shows by less than one of 255 levels is too faint to be asked for."""

WRONG = 0.03
"""γ, n and q are tried so far off, as a share of themselves."""

DARKEST = 1e-4


def shown_levels(studio: Studio) -> dict[str, dict[str, float]]:
    """Of each effect of the studio's scene: ``levels`` of 255 that it shows, and ``db`` by which a perfect
    model without it would lie above the photos' noise."""
    scene, plain = studio.scene, studio.scene.without("tone")
    found = _shown(Pixels(studio), plain, plain.effects)
    if "tone" in scene.effects:
        found |= _shown(Pixels(studio, channels=3), scene, {"tone"})
    return found


def _shown(pixels: Pixels, scene: Scene, names: Collection[str]) -> dict[str, dict[str, float]]:
    """What the effects ``names`` of the scene show at the pixels."""
    full, found = displayed(pixels.radiance(scene.effects), scene), {}
    for name in sorted(names):
        lacking = scene.without(name)
        x = pixels.radiance(lacking.effects)
        value = displayed(x, lacking)
        columns = {"gamma": np.log(x), "n": pixels.log_axis, "q": pixels.log_distance}
        rest = pixels.taken_up(_rest(name, lacking.effects))
        left = pixels.left(full - value, value, [*columns.values(), *rest])
        found[name] = {"levels": left, "db": 10 * math.log10(1 + left**2 / (scene.noise_levels**2 + 1 / 12))}
    return found


def wrong_levels(studio: Studio) -> dict[str, float]:
    """Levels of 255 that γ, n and q show where each is ``WRONG`` and all else fits as well as it can."""
    scene, pixels = studio.scene, Pixels(studio)
    x = pixels.radiance(scene.effects)
    value = displayed(x, scene.without("tone"))
    columns = {"gamma": np.log(x), "n": scene.n * pixels.log_axis, "q": scene.q * pixels.log_distance}
    taken_up = pixels.taken_up(_rest("", scene.effects))
    found = {}
    for name, column in columns.items():
        change = WRONG * scene.gamma * column * pixels.unclipped(value)
        others = [values for other, values in columns.items() if other != name]
        found[name] = pixels.left(change, value, [*others, *taken_up])
    return found


@dataclass(frozen=True)
class Pixels:
    """Some pixels of all frames of a studio's scene, grey; or their 3 ``channels``, one after the other, that
    share everything but albedo."""

    studio: Studio
    channels: int = 1

    @cached_property
    def _views(self) -> list[View]:
        lens = self.studio.scene.lens
        v, u = np.mgrid[1 : lens.height : STEP, 1 : lens.width : STEP]
        inside = lens.lit(u, v)
        return [self.studio.view(frame, u[inside], v[inside]) for frame in range(self.studio.scene.frames)]

    def radiance(self, effects: frozenset[str]) -> np.ndarray:
        """Radiance [N] as if the scene had these of its effects."""
        scene = self.studio.scene.having(effects)
        x = np.concatenate([self.studio.radiance(view, scene) for view in self._views]).astype(np.float64)
        return np.maximum(x.mean(axis=1) if self.channels == 1 else x.T.ravel(), DARKEST)

    def unclipped(self, value: np.ndarray) -> np.ndarray:
        """Display values [N] where they answer to radiance: 0 where they are clipped."""
        return np.where(value < 1, value, 0)

    @cached_property
    def log_distance(self) -> np.ndarray:
        """ln of the distance [N] from the lens."""
        return np.log(np.linalg.norm(self._points_mm, axis=1))

    @cached_property
    def log_axis(self) -> np.ndarray:
        """ln cosθ [N], θ from the optical axis."""
        return np.log(np.maximum(self._points_mm[:, 2] / np.exp(self.log_distance), DARKEST))

    @cached_property
    def _points_mm(self) -> np.ndarray:
        points_mm = np.concatenate([view.points_mm for view in self._views]).astype(np.float64)
        return np.tile(points_mm, (self.channels, 1))

    @cached_property
    def cell(self) -> np.ndarray:
        """Number of the cell of the wall that each pixel [N] sees, others for each channel."""
        row, column = np.floor(np.concatenate([view.place for view in self._views]) / CELL).astype(np.int64).T
        cell = np.unique(row * 65536 + column, return_inverse=True)[1].reshape(-1)
        return np.concatenate([cell + channel * (cell.max() + 1) for channel in range(self.channels)])

    def taken_up(self, effects: set[str]) -> list[np.ndarray]:
        """What the parameters of effects do to the logarithm of radiance: columns [N]."""
        columns = []
        if "profile" in effects:
            columns.append(np.exp(self.log_axis))
        if "vignetting" in effects:
            r2 = np.tile(np.concatenate([view.squared_radius for view in self._views]), self.channels)
            columns += [r2, r2 * r2]
        if "gain" in effects:
            frame = np.concatenate([np.full(len(view.ray), view.frame) for view in self._views])
            frame = np.tile(frame, self.channels)
            columns += [(frame == number).astype(float) for number in range(1, len(self._views))]
        return columns

    def left(self, change: np.ndarray, value: np.ndarray, columns: list[np.ndarray]) -> float:
        """Levels of 255 of ``change`` [N] in display ``value`` [N] (root mean square) that neither cells'
        albedo nor ``columns`` [N] of the logarithm of radiance take up."""
        slope = self.unclipped(value)
        weighted = np.stack([change, *(slope * values for values in columns)], axis=1)
        weight = np.maximum(np.bincount(self.cell, slope**2), 1e-12)
        for k, values in enumerate(weighted.T):
            weighted[:, k] = values - slope * (np.bincount(self.cell, slope * values) / weight)[self.cell]
        solution = np.linalg.lstsq(weighted[:, 1:], weighted[:, 0], rcond=None)[0]
        return 255 * float(np.sqrt(np.mean((weighted[:, 0] - weighted[:, 1:] @ solution) ** 2)))


def _rest(name: str, others: frozenset[str]) -> set[str]:
    """Effects whose parameters may take up what the effect ``name`` changes."""
    instead = {"vignetting": {"profile"}, "profile": {"vignetting"} if "offset" in others else set()}
    return {"gain", "profile", "vignetting"} & others | instead.get(name, set())
