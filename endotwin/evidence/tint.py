"""What the hue of a place says as the light on it changes: whether light bounces, and which photos have
another white balance.

White light makes a place brighter or darker and leaves the ratios of its channels; what tissue throws is of
tissue's colour, and turns the hue of a place the more, the less of its light is the lamp's own. Whatever else
a model of the light errs by, where guides stand, how fast light falls off, how strong a photo's gain is,
changes all channels alike: it neither passes for a bounce, nor hides one. What does turn hues is a tone curve
(see ``tone``), and white balance, those of all places in a photo alike.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch

from endotwin.effects.noise import LEVEL
from endotwin.effects.tone import bend
from endotwin.evidence.coat import LEAST_SIGHTINGS
from endotwin.evidence.probe import Fitted, Probe
from endotwin.evidence.tone import RATIO_ERROR, RATIOS
from endotwin.evidence.verdict import Halved, Verdict, compared, predicts_better
from endotwin.pixels.casts import Casts, standing_out
from endotwin.pixels.fixed_effects import Design, regress

FAINT = 0.1
"""Of ``log_colors``: γ times a fifth of the bounce that is expected; of random scenes with one none has less
than twice as much."""


@dataclass(frozen=True, eq=False)
class Tints:
    """The hues of a probe's places: two ratios a pixel.

    Attributes:
        model: of the pixels' brightness. log_colors: ln of the light that each channel gets, [N, 3]; how much
            of it tells of γ and of the tissue's brightness together.
    """

    probe: Probe
    model: Fitted
    log_colors: np.ndarray

    @cached_property
    def bounced(self) -> Verdict:
        """How much better hues of places that did not choose its strength are predicted by bounced light,
        beside a tone curve of any contrast."""
        curve, bounce = self._curve, self._of(self.log_colors)
        plain, other = self._design(curve), self._design(bounce, curve, positive=1)
        return predicts_better(self._log_hues, plain, other, self._half)

    @cached_property
    def still(self) -> Verdict:
        """How much better hues are predicted without bounced light than with a FAINT share of it, beside a
        tone curve that the other half of the places chose."""
        plain = self._design(self._curve)
        still = Halved.of(self._log_hues, plain, self._half)
        faint = Halved.of(self._log_hues - FAINT * self._of(self.log_colors), plain, self._half)
        return compared(faint, still, regress(self._log_hues, plain).width)

    def casts(self) -> Casts | None:
        """Photos whose white balance is another than that of the rest, beside a tone curve and a bounce of
        any strength; None if there are none.

        A photo has a cast if it stands out among all, by what either half of the places says, and enough of
        its places are in others.
        """
        every = np.ones_like(self._half)
        if len(self.probe.frames) < 2:
            return None
        log, *by_half = (self._log_casts(part) for part in (every, self._half, ~self._half))
        told = np.min([np.sign(log) * each for each in by_half], axis=0)
        odd = standing_out(log, told) & (self._beside_others >= LEAST_SIGHTINGS)
        if not odd.any():
            return None
        red, blue = log[odd].T
        return Casts(self.probe.frames[odd], np.stack([red, np.zeros_like(red), blue], axis=1))

    def _log_casts(self, part: np.ndarray) -> np.ndarray:
        """By how much ln of red and blue, beside green, is more in each photo than in the median one, [F, 2],
        by the hues of ``part``, bool [2 N]."""
        count = len(self.probe.frames)
        photo = self.probe.frame[:, None] + count * np.arange(len(RATIOS))
        design = self._design(self._of(self.log_colors), self._curve, positive=1, photo=photo.ravel())
        found = regress(self._log_hues[part], design[part], count * len(RATIOS)).intercepts
        found = np.linalg.solve(RATIOS[:, [0, 2]], found.reshape(len(RATIOS), count)).T
        return found - np.median(found, axis=0)

    @property
    def _beside_others(self) -> np.ndarray:
        """How many pixels of each photo are of a place that another shows, too, int [F]."""
        vertex, frame, count = self.probe.vertex, self.probe.frame, len(self.probe.frames)
        shown_by = np.bincount(np.unique(vertex * count + frame) // count, minlength=self.probe.count)
        return np.bincount(frame[shown_by[vertex] > 1], minlength=count)

    @cached_property
    def _log_hues(self) -> np.ndarray:
        return self._of(np.log(self.probe.shown_colors))

    @cached_property
    def _curve(self) -> np.ndarray:
        """What a tone curve adds, for each unit of contrast."""
        smooth = self.probe.smooth_colors(self.model)
        return self._of(bend(torch.from_numpy(smooth)).numpy() / smooth)

    @cached_property
    def _half(self) -> np.ndarray:
        return np.repeat(self.probe.half, len(RATIOS))

    @staticmethod
    def _of(log_colors: np.ndarray) -> np.ndarray:
        """Of ln of channels [N, 3] their ratios', [2 N]."""
        return (log_colors @ RATIOS.T).ravel()

    def _design(self, *columns: np.ndarray, positive: int = 0, photo: np.ndarray | None = None) -> Design:
        """Beside an intercept for each ratio of a place, and for each ``photo`` [2 N], if they are told."""
        probe, ratios = self.probe, np.arange(len(RATIOS))
        place = (probe.vertex[:, None] + probe.count * ratios).ravel()
        variance = (LEVEL / probe.shown_colors) ** 2 @ RATIOS.T**2 + RATIO_ERROR**2
        options = {"category": photo, "weight": 1 / variance.ravel(), "positive": positive}
        return Design(np.stack(columns, axis=1), place, probe.count * len(ratios), **options)
