"""Effects that are too faint to be decided, and bend the response all the same.

What predicts held-out pixels hardly better is no effect (``evidence.decide``). But three percent of γ show by
a tenth of one of 255 levels; guides a few millimetres beside the lens, or a lens that passes a little less
light at its rim, may stay undecided with five times that, and bend γ by ten percent. So light and response
are found beside what could be there, to first order a factor on exposure, which the twin then lacks.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from endotwin.effects import Effects
from endotwin.effects.noise import LEVEL
from endotwin.effects.vignetting import squared_radius
from endotwin.pixels.length_unit import unit_mm
from endotwin.pixels.samples import Samples
from endotwin.pixels.start import COS_MIN, PRIOR
from endotwin.surface import Surface

VIGNETTING = 0.8
"""k2 of the shape: a lens that passes 45 % at the middle of the shorter border."""

ASIDE_MM = 6.0
"""Guides of the shapes end so far beside the lens, all to one side of it or all around."""

MOST = 1.0
"""Of the logarithm: to first order only, near grazing light and beside the lens, it would be any."""


@dataclass(frozen=True)
class Faint:
    """What may be there of effects that are off: shapes over the pixels of ln exposure.

    Attributes:
        vignetting: whether there may be some: r². offset: whether guides may stand beside the lens: what
            their mean place along x and y changes, and the mean square of how far they stand from it.
        surface: that is looked at. unit_mm: its unit of length.
        mean: float64 [K], of the shapes over what is looked at: what they change is no light's strength.
        coefficients: float64 [K], of the shapes: within ±1, or no endoscope has them.
    """

    vignetting: bool = False
    offset: bool = False
    surface: Surface | None = None
    unit_mm: float = 1.0
    mean: np.ndarray | float = 0.0
    coefficients: np.ndarray = field(default_factory=lambda: np.zeros(0))

    @classmethod
    def beside(cls, effects: Effects, wanted: Mapping[str, str], samples: Samples, surface: Surface) -> Faint:
        """Nothing so far of what is neither among the ``effects`` nor ``wanted`` off, at ``samples``."""
        vignetting, offset = (
            name not in effects and wanted.get(name) != "off" for name in ("vignetting", "offset")
        )
        none = cls(vignetting, offset, surface, unit_mm(surface))
        mean = none.shapes(samples).mean(axis=0)
        return replace(none, mean=mean, coefficients=0 * mean)

    @property
    def found(self) -> bool:
        """Whether there is any."""
        return bool(self.coefficients.any())

    @property
    def possible(self) -> bool:
        """Whether an endoscope may have it; else the model lacks something that is not faint."""
        return bool((np.abs(self.coefficients) <= 1).all())

    def shows(self, samples: Samples, gamma: float) -> bool:
        """Whether it changes middle grey by one of 255 levels, root mean square over samples: what changes it
        by less is what the model errs by elsewhere."""
        return gamma * float(self.log_exposure(samples).std()) / 2 >= LEVEL

    def with_more(self, coefficients: np.ndarray) -> Faint:
        """The same with ``coefficients`` [K] added."""
        other = replace(self, coefficients=self.coefficients + coefficients)
        vars(other)["_kept"] = vars(self).get("_kept")
        return other

    def shapes(self, samples: Samples) -> np.ndarray:
        """The shapes at samples, float64 [N, K]; kept for those asked of last, whatever lights them."""
        if not (self.vignetting or self.offset):
            return np.zeros((len(samples), 0))
        kept = vars(self).get("_kept")
        if kept is None or kept[0] is not samples.pixel:
            kept = samples.pixel, self._shapes(samples)
            vars(self)["_kept"] = kept
        return kept[1]

    def _shapes(self, samples: Samples) -> np.ndarray:
        shapes = []
        if self.vignetting:
            shapes.append(VIGNETTING * squared_radius(samples.views.camera, samples.pixel.numpy()))
        if self.offset:
            shapes += self._aside(samples.points_mm, samples.normals(self.surface))
        return np.stack(shapes, axis=1, dtype=np.float64) - self.mean

    def log_exposure(self, samples: Samples) -> np.ndarray:
        """ln of the factor on samples, float64 [N]."""
        return np.clip(self.shapes(samples) @ self.coefficients, -MOST, MOST)

    def _aside(self, points_mm: np.ndarray, normals: np.ndarray) -> list[np.ndarray]:
        """Three shapes [N] at ``points_mm`` [N, 3] with ``normals`` [N, 3], in the camera frame.

        With v from a point to the guide, light that falls as cosⁿθ/d^q is (n·v) v_z^n |v|^{−(1+n+q)}. Its
        logarithm has the gradient g by the guide's place in the plane of the lens; guides all around at a
        distance a add a²/4 of its Laplacian over itself, |g|² + div g.
        """
        power, aside_mm = 1 + PRIOR["n"] + PRIOR["q"], ASIDE_MM * self.unit_mm
        distance_mm = np.maximum(np.linalg.norm(points_mm, axis=1), aside_mm)
        facing = np.maximum(-np.einsum("na,na->n", normals, points_mm), COS_MIN * distance_mm)
        across = points_mm[:, :2] / distance_mm[:, None] ** 2
        along = normals[:, :2] / facing[:, None]
        slope = along + power * across
        bend = (slope**2 - along**2 + 2 * power * across**2).sum(axis=1) - 2 * power / distance_mm**2
        return [*(aside_mm * slope.T), aside_mm**2 / 4 * bend]


NOTHING = Faint()
"""Where no faint effect may be."""
