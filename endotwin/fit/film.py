"""Whether the tissue wears a wet film: what its highlights show beside the lobe of the tissue itself."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from endotwin.effects import Decision
from endotwin.effects.coat import Coat
from endotwin.effects.probe import Verdict, compared
from endotwin.fit.fixed_effects import Design, regress, robust_losses
from endotwin.fit.model import GLOBALS, Globals
from endotwin.fit.start import DIFFUSE_SIN2
from endotwin.fit.within import LEAST_SIGHTINGS, Within

ROUGHNESSES = (0.06, 0.09, 0.13, 0.19, 0.27)
PIXELS = 30_000
"""Of the highlights, all of some vertices; more would not change the mind."""

SEARCH_ROUNDS = 2
"""Of the regression by which roughnesses are ranked."""

F0 = GLOBALS.index("ln f0")


def judged(
    within: Within, material: Tensor, shared: Globals, noise: float, wanted: str
) -> tuple[Coat | None, Decision]:
    """The coat that the highlights call for, or that is ``wanted`` (auto, on or off); and why."""
    if wanted == "off":
        return None, Decision("off", "forced off")
    began = time.perf_counter()
    coat, verdict = film(within, material, shared, noise)
    took_s = round(time.perf_counter() - began, 3)
    forced = "forced on; " if wanted == "on" else ""
    if wanted == "auto" and not verdict.keep:
        reason = f"does not predict held-out highlights better ({verdict})"
        return None, Decision("off", reason, round(verdict.gain_db, 3), took_s)
    reason = f"{forced}predicts held-out highlights better by {verdict}"
    return coat, Decision("on", reason, round(verdict.gain_db, 3), took_s)


def film(within: Within, material: Tensor, shared: Globals, noise: float) -> tuple[Coat, Verdict]:
    """The coat that predicts highlights best, and by how much better than none it does on vertices that did
    not choose its weight.

    Args:
        material: [N, 4] at the samples. noise: of a pixel, in display values.
    """
    shiny = within.samples.sin2 < DIFFUSE_SIN2
    shiny &= torch.from_numpy(within.vertex % max(1, int(shiny.sum()) // PIXELS) == 0)
    width, least, best = 0.0, np.inf, None
    for roughness in ROUGHNESSES:
        seen = within.sightings(material, replace(shared, coat=Coat(0.0, roughness)), shiny, noise)
        if len(seen.residual) < LEAST_SIGHTINGS:
            break
        vertex = np.unique(seen.vertex, return_inverse=True)[1].reshape(-1)
        coated = Design(np.c_[seen.slopes[:, F0], seen.by_coat], vertex, int(vertex.max()) + 1)
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
