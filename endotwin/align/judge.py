"""What corrections are worth: photos that did not choose them judge."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.special

from endotwin.align.photos import Photo
from endotwin.align.rims import rim
from endotwin.align.scene import Scene
from endotwin.align.solve import even, paint_of
from endotwin.align.texture import sighted
from endotwin.align.views import View
from endotwin.align.within import Within, within
from endotwin.robust import robust_std
from endotwin.run.ahead import on_all_cores

LEAST = 100
"""A photo judges by no fewer vertices, or pixels beside rims."""


@dataclass(frozen=True)
class Verdict:
    """By how much corrections lower the error of ``photos`` that did not choose them: dB, and in sigmas: the
    normal deviate that is as rare as Student's t of so few photos."""

    gain_db: float
    sigmas: float
    photos: int

    def __str__(self) -> str:
        return (
            f"{self.gain_db:+.2f} dB, {self.sigmas:.0f} sigmas, on {self.photos} photos that did not choose"
        )


@dataclass(frozen=True, eq=False)
class Errors:
    """Of J judging photos: squared residuals of texture and beside rims, each list [J] of arrays or None."""

    texture: list
    rims: list

    def and_of(self, others: Errors) -> Errors:
        """Of these photos and the ``others``."""
        return Errors(self.texture + others.texture, self.rims + others.rims)

    def better_than(self, other: Errors) -> Verdict:
        """How much lower these are than ``other``'s."""
        total = np.zeros((len(self.texture), 2))
        for mine, others in ((self.texture, other.texture), (self.rims, other.rims)):
            both = [k for k in range(len(mine)) if mine[k] is not None and others[k] is not None]
            if both:
                width = robust_std(np.concatenate([others[k] for k in both]))
                total[both, 0] += [_loss(others[k], width) for k in both]
                total[both, 1] += [_loss(mine[k], width) for k in both]
        total = total[total[:, 0] > 0]
        if len(total) < 2:
            return Verdict(0.0, 0.0, len(total))
        gained = total[:, 0] - total[:, 1]
        t = float(gained.mean()) / max(float(gained.std(ddof=1)) / np.sqrt(len(gained)), 1e-12)
        gain_db = 10 * np.log10(total[:, 0].sum() / max(total[:, 1].sum(), 1e-12))
        rare = scipy.special.stdtr(len(gained) - 1, -abs(t))
        sigmas = -np.sign(t) * scipy.special.ndtri(max(rare, 1e-300))
        return Verdict(float(gain_db), float(sigmas), len(total))


def errors(
    scene: Scene,
    photos: dict[int, Photo],
    poses: np.ndarray,
    choosers: np.ndarray,
    judges: np.ndarray,
    sigma_px: float,
) -> Errors:
    """Errors of the photos ``judges`` [J] against the twin that the photos ``choosers`` [F] paint, all at
    their ``poses`` [N, 4, 4]."""
    texture = within(scene, photos, poses, choosers, sigma_px)
    paint = paint_of(scene, texture)

    def one(judge: int) -> tuple[np.ndarray | None, np.ndarray | None]:
        view = View.of(scene, poses[judge], sigma_px)
        seen = rim(scene, photos[judge], view, paint, texture.light)
        by_rims = even(seen)[0] if len(seen.residual) >= LEAST else None
        return _texture(scene, photos[judge], view, texture), by_rims

    found = list(on_all_cores(one, judges.tolist()))
    return Errors([by_texture for by_texture, _ in found], [by_rims for _, by_rims in found])


def _texture(scene: Scene, photo: Photo, view: View, texture: Within) -> np.ndarray | None:
    """Residuals of one photo at the vertices that others painted, less each cell's median."""
    seen = sighted(scene, photo, view)
    left = seen.shown - seen.columns @ texture.light - texture.log_albedo[seen.vertex]
    known = np.isfinite(left)
    if known.sum() < LEAST:
        return None
    left, cell = left[known], np.unique(seen.cell[known], return_inverse=True)[1].reshape(-1)
    return left - (np.bincount(cell, left) / np.bincount(cell))[cell]


def _loss(residuals: np.ndarray, width: float) -> float:
    """Mean pseudo-Huber loss of residuals in units of ``width``."""
    return float(np.mean(np.sqrt(1 + (residuals / max(width, 1e-9)) ** 2) - 1))
