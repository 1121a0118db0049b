"""Verdicts: by how much one model explains better than another what chose none of its coefficients."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from endotwin.pixels.fixed_effects import Design, FixedEffects, regress, robust_losses

MIN_GAIN_DB = 0.2
MIN_SIGMAS = 3.0
"""An effect is kept where it lowers the held-out error by so much, and by so many of its uncertainties."""

MIN_IMPOSSIBLE_DB = 3.0
"""What it takes if γ, n or q are then such as no endoscope has: the model of light may lack something, and
the effect be there all the same."""

HINT_DB, HINT_SIGMAS = 0.1, 2.0
"""What is worth a longer look, which then has to be worth keeping."""


@dataclass(frozen=True)
class Verdict:
    """By how much one hypothesis predicts unseen pixels better than another: dB, and in its own sigmas; and
    whether light and response of the better one are any endoscope's, or the other's neither, and how much
    likelier than the other's they were before any photo was seen, in nats, if they are any endoscope's."""

    gain_db: float
    sigmas: float
    possible: bool = True
    likelier: float = 0.0

    @property
    def keep(self) -> bool:
        return self.worth(Verdict(MIN_GAIN_DB, MIN_SIGMAS))

    @property
    def contradicts(self) -> bool:
        """Whether the other is as plainly worse as one that is kept is better."""
        return self.gain_db <= -MIN_GAIN_DB and self.sigmas <= -MIN_SIGMAS

    @property
    def hints(self) -> bool:
        return self.gain_db >= HINT_DB and self.sigmas >= HINT_SIGMAS

    def worth(self, least: Verdict) -> bool:
        """Whether both its numbers are at least those of ``least``, and what is possible or else plain."""
        least_db = least.gain_db if self.possible else MIN_IMPOSSIBLE_DB
        return self.gain_db >= least_db and self.sigmas >= least.sigmas

    def __str__(self) -> str:
        impossible = "" if self.possible else ", but with a light that no endoscope has"
        return f"{self.gain_db:+.2f} dB, {self.sigmas:.0f} sigmas{impossible}"


@dataclass(frozen=True)
class Halved:
    """Values whose groups' halves choose coefficients for each other.

    Attributes:
        target: [N]. half: bool [N], of whole groups. chosen: what half and the rest of them choose.
    """

    target: np.ndarray
    design: Design
    half: np.ndarray
    chosen: tuple[FixedEffects, FixedEffects]

    @classmethod
    def of(cls, target: np.ndarray, design: Design, half: np.ndarray, categories: int = 0) -> Halved:
        """``categories`` is the number of the design's."""
        chosen = tuple(regress(target[part], design[part], categories) for part in (half, ~half))
        return cls(target, design, half, chosen)

    def losses(self, width: float) -> np.ndarray:
        """Pseudo-Huber losses [N] of that ``width``, beside what the other half chose."""
        losses = np.zeros(len(self.target))
        for found, judged in zip(self.chosen, (~self.half, self.half), strict=True):
            losses[judged] = robust_losses(self.target[judged], self.design[judged], found, width)
        return losses


def compared(base: Halved, other: Halved, width: float) -> Verdict:
    """How much better ``other`` explains values of groups that did not choose its coefficients; ``width``: of
    the loss."""
    before, after, design = base.losses(width), other.losses(width), base.design
    return verdict_of(np.bincount(design.group, before - after, design.count), float(after.sum()))


def predicts_better(target: np.ndarray, plain: Design, other: Design, half: np.ndarray) -> Verdict:
    """How much better the design ``other`` explains values [N] than ``plain``, of groups that did not choose
    the coefficients; ``half``: bool [N], of whole groups, which each choose for the rest."""
    base, beside = (Halved.of(target, design, half) for design in (plain, other))
    return compared(base, beside, regress(target, plain).width)


def verdict_of(gained: np.ndarray, after: float) -> Verdict:
    """The verdict on losses that groups [G] lost by ``gained``, to ``after`` in all."""
    sigma = max(math.sqrt(float((gained**2).sum())), 1e-30)
    ratio = max(float(gained.sum()) + after, 1e-30) / max(after, 1e-30)
    return Verdict(10 * math.log10(ratio), float(gained.sum()) / sigma)
