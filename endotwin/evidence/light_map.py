"""From where about the lens light comes, however many guides there are.

Light adds up: what places about the lens would throw on a pixel each, times how strong each is, is what
lights it. Where the places stay, no shadow jumps, and the strengths that explain the photos, none below 0,
have one optimum. Guides lie where they gather.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from endotwin.evidence.probe import POSSIBLE, TISSUE_SPREAD, VIGNETTING_SPREAD, Fitted, Probe, log_light
from endotwin.pixels.fixed_effects import Design, regress
from endotwin.pixels.start import LIGHT_MEAN, LIGHT_SPREAD, PRIOR

RINGS = ((0.0, 1), (0.5, 6), (1.0, 10), (1.5, 12), (2.0, 14), (2.6, 16))
"""Radii, in those of a search, and how many places lie on each; guides stand within the tip's rim."""

ROUNDS, STILL = 15, 0.05
"""In so many at most shares are found, each linearised about the one before, and none after one that moves
less of the light."""

LEAST = 0.01
"""Of the light that all places would throw on a pixel together: what shows light is lit by so much."""

SHARE_SPREAD = 1.0
"""Standard deviation by which a round changes a share."""


def places_mm(radius_mm: float) -> np.ndarray:
    """Those on RINGS about the lens, in units of ``radius_mm``, float32 [K, 3] in the camera frame."""
    radius = np.concatenate([np.full(count, radius) for radius, count in RINGS])
    angle = np.concatenate([2 * np.pi * np.arange(count) / count for _, count in RINGS])
    return (radius_mm * np.stack([radius * np.cos(angle), radius * np.sin(angle), 0 * angle], axis=1)).astype(
        np.float32
    )


@dataclass(frozen=True)
class LightMap:
    """Places [K, 3] in the camera frame, mm, and the share of the direct light that comes from each, [K]."""

    places_mm: np.ndarray
    share: np.ndarray

    @classmethod
    def of(cls, probe: Probe, base: Fitted, places_mm: np.ndarray, visible: np.ndarray) -> LightMap:
        """Of light that explains the probe's pixels best beside the other effects of ``base``, from places
        [K, 3] that see the pixels as ``visible`` [N, K] says."""
        share, about = np.full(len(places_mm), 1 / len(places_mm)), base.start
        light = _Light.of(probe, base, places_mm, visible)
        for _ in range(ROUNDS):
            before = share
            share, about = light.better(share, about)
            if np.abs(share - before).sum() < 2 * STILL:
                break
        return cls(places_mm, share)

    def guides_mm(self, number: int) -> tuple[np.ndarray, np.ndarray]:
        """So many places [number, 3] that all light is nearest to; and the middle of the light that is
        nearest to each."""
        apart_mm = np.linalg.norm(self.places_mm[:, None] - self.places_mm, axis=2)
        among = np.array(list(combinations(range(len(self.share)), number)))
        chosen = among[int(np.argmin(self.share @ apart_mm[:, among].min(axis=2)))]
        nearest = np.argmin(apart_mm[:, chosen], axis=1)
        share = np.bincount(nearest, self.share, number)
        middle = [np.bincount(nearest, self.share * x, number) for x in self.places_mm.T]
        known = np.maximum(share, np.finfo(float).tiny)
        places_mm = self.places_mm[chosen]
        return places_mm, np.where(share > 0, middle / known, places_mm.T).T


@dataclass(frozen=True)
class _Light:
    """Light of K places at the N pixels of a probe.

    Attributes:
        base: what lights them beside. cast: ln of what each place throws with n = q = 0 on Lambert's tissue,
            [N, K]. retro: ln of what Burley's returns of it more. axis, distance: ln of the angular shape for
            n = 1, and of the distance, [N, K].
    """

    probe: Probe
    base: Fitted
    cast: np.ndarray
    retro: np.ndarray
    axis: np.ndarray
    distance: np.ndarray

    @classmethod
    def of(cls, probe: Probe, base: Fitted, places_mm: np.ndarray, visible: np.ndarray) -> _Light:
        guides_mm = tuple(map(tuple, places_mm.tolist()))
        light = log_light(probe, replace(base.hypothesis, guides_mm=guides_mm, shadows=True), visible)
        cast, lit = np.log(len(places_mm)) + light.log_cos, light.lit.guides
        return cls(probe, base, cast, light.log_burley, lit.log_axis.numpy(), lit.log_distance.numpy())

    def better(
        self, share: np.ndarray, about: tuple[float, float, float]
    ) -> tuple[np.ndarray, tuple[float, float, float]]:
        """Shares [K] nearer to the best than ``share``, and n, q and γ than ``about``."""
        n, q, _ = about
        design, probe = self._design(share, n, q), self.probe
        found = regress(probe.target, design, len(probe.frames), rounds=2).coefficients
        share, (by_n, by_q, gamma) = found[: len(share)], found[len(share) :][:3]
        if not share.any() or gamma < POSSIBLE[0][0]:
            return np.full(len(share), 1 / len(share)), about
        low, high = np.transpose(POSSIBLE)
        gamma, n, q = np.clip([gamma, by_n / gamma, by_q / gamma], low, high)
        return share / share.sum(), (float(n), float(q), float(gamma))

    def _design(self, share: np.ndarray, n: float, q: float) -> Design:
        """Columns: of γ times each share; of γn, γq, γ, and γ times what retro is more than usual; of
        vignetting."""
        probe, hypothesis, bounced = self.probe, self.base.hypothesis, self.base.hypothesis.bounced
        direct = np.exp(self.cast + self.retro + n * self.axis - q * self.distance)
        beside = 0.0 if bounced is None else np.exp(bounced.at(n, q))
        total = np.maximum(direct @ share, LEAST * direct.mean(axis=1)) + beside
        each = direct / total[:, None]
        slopes = (self.axis, -self.distance, self.retro)
        by_n, by_q, by_retro = (np.einsum("nk,nk,k->n", each, slope, share) for slope in slopes)
        if bounced is not None:
            by_n += beside / total * bounced.by_n
            by_q += beside / total * bounced.by_q
        level = np.log(total) - n * by_n - q * by_q - each @ share
        columns, gamma = [each, np.stack([by_n, by_q, level, by_retro], axis=1)], PRIOR["gamma"]
        mean = [*(gamma * share), *LIGHT_MEAN, 0.0]
        spread = [*np.full(len(share), gamma * SHARE_SPREAD), *LIGHT_SPREAD, gamma * TISSUE_SPREAD[0]]
        if hypothesis.vignetting:
            columns.append(probe.vignetting_column[:, None])
            mean, spread = [*mean, 0.0], [*spread, VIGNETTING_SPREAD]
        precision = probe.pixels_a_place / np.square(spread)
        return Design(
            np.concatenate(columns, axis=1),
            probe.vertex,
            probe.count,
            probe.frame if hypothesis.gain else None,
            prior=(np.diag(precision), precision * mean),
            positive=len(share),
        )
