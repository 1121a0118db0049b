"""Automatic gain: pictures are kept at a target brightness, a little too late."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from endotwin.effects.effect import Effect, parameter
from endotwin.effects.exposures import Exposures
from endotwin.errors import SequenceError
from endotwin.sequence import Sequence

DARKEST = 1e-6
"""Least mean display value; a picture without surface has none."""

PHOTOS, FEWEST = 128, 12
"""From the middle of a sequence, that tell whether its gain is automatic, and how few do not."""

LAGS = 20
"""That are tried: none, and from a quarter of a frame interval to all of the time."""

CORRELATIONS = np.linspace(-0.2, 0.98, 60)
"""That are tried, of one error with the next."""

CHANCE = 1e-6
"""Greatest probability that exposures follow the scene by chance."""

TINY = 1e-12


@dataclass(frozen=True)
class AutoGain(Effect):
    """A gain g on all light, whose logarithm follows that of the wanted gain with first-order lag.

    A picture of linear radiance x has the mean display value mean((g·x)^γ) = g^γ·mean(x^γ) but for what is
    clipped, so the wanted gain is (target / mean(x^γ))^(1/γ). At the first frame the gain is the wanted one.

    Attributes:
        target: mean display value. lag: time constant, s. range: greatest gain; its inverse is the least.
    """

    name: ClassVar[str] = "auto_gain"
    target: float = parameter(0.4, 0.01, 0.99)
    lag: float = parameter(0.25, 0.0, 10.0)
    range: float = parameter(4.0, 1.0, 100.0)

    def wanted(self, level: float, gamma: float) -> float:
        """The gain that brings a picture of mean display value ``level`` to the target."""
        gain = (self.target / max(level, DARKEST)) ** (1 / gamma)
        return float(np.clip(gain, 1 / self.range, self.range))

    def next(self, gain: float, wanted: float, seconds: float) -> float:
        """The gain so many ``seconds`` later than ``gain``, with another wanted all the while."""
        left = np.exp(-seconds / self.lag) if self.lag > 0 else 0.0
        return float(wanted * (gain / wanted) ** left)

    def held(self, log_level: np.ndarray, times_s: np.ndarray) -> np.ndarray:
        """By how much ln of the mean display value is raised, [F], at ``times_s`` of pictures where it were
        ``log_level`` [F] at one gain; 0 at the first."""
        gains = [1.0]
        for level, seconds in zip(log_level[1:] - log_level[0], np.diff(times_s), strict=True):
            gains.append(self.next(gains[-1], np.exp(-level), seconds))
        return np.log(gains)

    @classmethod
    def evidence(cls, sequence: Sequence) -> tuple[AutoGain | None, str]:
        """Exposure that works against what brightness would be without it, by its likelihood against a steady
        one; other changes of exposure are errors, each like the one before (AR(1)). Where it is steady, one
        of the lags is so many times likelier with no more probability than CHANCE (Markov's inequality)."""
        none = "rendered on request: "
        first = max(len(sequence) - PHOTOS, 0) // 2
        frames = range(first, min(first + PHOTOS, len(sequence)))
        if len(frames) < FEWEST:
            return None, f"{none}fewer than {FEWEST} photos do not tell how their exposure is set"
        times_s = sequence.timestamps_s[frames.start : frames.stop]
        steps_s = np.diff(times_s)
        if steps_s.min() <= 0:
            return None, f"{none}the photos have no times that rise"
        try:
            found = Exposures.of(sequence, frames)
        except SequenceError as error:
            return None, f"{none}{error}"
        lags = np.geomspace(steps_s.mean() / 4, steps_s.sum(), LAGS - 1)
        target = float(np.exp(found.log_level.mean()))
        trials = [cls(target=target, lag=float(lag)) for lag in (0.0, *lags)]
        predicted = [np.diff(each.held(found.log_unheld, times_s)) for each in trials]
        likelihood = [_log_likelihood(found.log_change - each) for each in predicted]
        best = trials[int(np.argmax(likelihood))]
        if max(likelihood) - _log_likelihood(found.log_change) < np.log(LAGS / CHANCE):
            return None, f"{none}exposures of the photos do not follow what they show"
        return best, f"exposure holds the mean display value at {best.target:.2f}, {best.lag:.2g} s late"


def _log_likelihood(errors: np.ndarray) -> float:
    """Greatest log likelihood of ``errors`` [F] of first-order autocorrelation, but for a constant."""
    found = []
    for correlation in CORRELATIONS:
        innovations = errors - correlation * np.concatenate([[0.0], errors[:-1]])
        innovations[:1] *= np.sqrt(1 - correlation**2)
        scatter = np.log(max(innovations @ innovations, TINY))
        found.append(np.log(1 - correlation**2) / 2 - len(errors) / 2 * scatter)
    return max(found)
