"""Whether the tissue wears a wet coat: what its highlights show beside the lobe of the tissue itself."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from endotwin.effects import Decision
from endotwin.effects.coat import Coat
from endotwin.evidence.probe import Verdict, compared
from endotwin.pixels.fixed_effects import Design, regress, robust_losses

ROUGHNESSES = (0.06, 0.09, 0.13, 0.19, 0.27)
LEAST_SIGHTINGS = 16

SEARCH_ROUNDS = 2
"""Of the regression by which roughnesses are ranked."""


@dataclass(frozen=True)
class Highlights:
    """Sightings of vertices near the mirror direction, S of them, beside a prediction without a coat.

    Attributes:
        vertex: int [S]. residual: ln photo − ln prediction [S]. by_f0, by_coat: d ln C by ln f0 and by the
            weight of a coat [S].
    """

    vertex: np.ndarray
    residual: np.ndarray
    by_f0: np.ndarray
    by_coat: np.ndarray


def judged(under: Callable[[float], Highlights], wanted: str) -> tuple[Coat | None, Decision]:
    """The coat that the highlights call for, or that is ``wanted`` (auto, on or off); and why.

    Args:
        under: the highlights, by the roughness of the coat whose weight is sought.
    """
    if wanted == "off":
        return None, Decision("off", "forced off")
    began = time.perf_counter()
    coat, verdict = best_coat(under)
    took_s = round(time.perf_counter() - began, 3)
    forced = "forced on; " if wanted == "on" else ""
    if wanted == "auto" and not verdict.keep:
        reason = f"does not predict held-out highlights better ({verdict})"
        return None, Decision("off", reason, round(verdict.gain_db, 3), took_s)
    reason = f"{forced}predicts held-out highlights better by {verdict}"
    return coat, Decision("on", reason, round(verdict.gain_db, 3), took_s)


def best_coat(under: Callable[[float], Highlights]) -> tuple[Coat, Verdict]:
    """The coat that predicts highlights best, and by how much better than none it does on vertices that did
    not choose its weight."""
    width, least, best = 0.0, np.inf, None
    for roughness in ROUGHNESSES:
        seen = under(roughness)
        if len(seen.residual) < LEAST_SIGHTINGS:
            break
        vertex = np.unique(seen.vertex, return_inverse=True)[1].reshape(-1)
        coated = Design(np.c_[seen.by_f0, seen.by_coat], vertex, int(vertex.max()) + 1)
        plain = replace(coated, columns=coated.columns[:, :1])
        width = width or regress(seen.residual, plain).width
        found = regress(seen.residual, coated, rounds=SEARCH_ROUNDS)
        loss = float(robust_losses(seen.residual, coated, found, width).sum())
        if found.coefficients[1] > 0 and loss < least:
            least, best = loss, (Coat(float(found.coefficients[1]), roughness), seen.residual, plain, coated)
    if best is None:
        return Coat(0.0, ROUGHNESSES[0]), Verdict(0.0, 0.0)
    coat, residual, plain, coated = best
    half = (np.random.default_rng(0).random(plain.count) < 0.5)[plain.group]
    return coat, compared(residual, plain, coated, half, width)
