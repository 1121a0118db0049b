"""What is usual of materials, light and response before any photo is asked."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from endotwin.fit.hashgrid import HashOperator
from endotwin.fit.model import Globals
from endotwin.fit.state import GLOBAL_RANGE, ROUGHNESS_RANGE
from endotwin.light.shading import F0_DIELECTRIC
from endotwin.pixels.start import LIGHT_MEAN, LIGHT_SPREAD, PRIOR, VIGNETTING_SPREAD

COLOR_SPREAD = 0.5
ROUGHNESS_LOGIT_SPREAD = 0.1 * 4 / (ROUGHNESS_RANGE[1] - ROUGHNESS_RANGE[0])
"""Standard deviation of a table entry of a COARSE_MM cell: base colour, roughness."""

COARSE_MM = 12.0

GLOBAL_MEAN = (0.0, *LIGHT_MEAN, math.log(F0_DIELECTRIC), 0.0, 0.0, 0.0)
GLOBAL_SPREAD = (5.0, *LIGHT_SPREAD, 0.5, VIGNETTING_SPREAD, 0.5, 0.5)
"""Prior of the shared parameters, in the order of EVERY_GLOBAL."""

USUAL_SIGMAS = 3.0
AT_EDGE = 0.01
"""Beyond so many standard deviations of the prior, and so near an edge of their range in shares of one, n, q
and γ are no endoscope's."""


def prior_precision(operator: HashOperator, unit_mm: float) -> Tensor:
    """Inverse prior variance of each table entry, float32 [R, 4]."""
    cell = torch.from_numpy(operator.cells_mm[operator.level] / (unit_mm * COARSE_MM)).float()
    color = 1 / (COLOR_SPREAD**2 * cell)
    roughness = 1 / (ROUGHNESS_LOGIT_SPREAD**2 * cell**2)
    return torch.stack([color, color, color, roughness], dim=1)


def global_prior(unit_mm: float, shared: Globals) -> tuple[Tensor, Tensor]:
    """Mean and standard deviation of the ``shared`` parameters; L0 is the light at a distance of 1 mm,
    but its prior that at 1 unit."""
    mean, spread = (
        torch.tensor(values, dtype=torch.float64)[shared.places] for values in (GLOBAL_MEAN, GLOBAL_SPREAD)
    )
    mean[0] += mean[2] * math.log(unit_mm)
    return mean, spread


def unusual(shared: Globals) -> list[str]:
    """Those of n, q and γ, with what is usual, that lie more than USUAL_SIGMAS of the prior from its mean, or
    at an edge of their range."""
    _, n, q = shared.log_light
    found = []
    for index, name, value in ((1, "n", n), (2, "q", q), (3, "γ", shared.gamma)):
        scale = 1.0 if name == "γ" else PRIOR["gamma"]
        mean, spread = GLOBAL_MEAN[index] / scale, GLOBAL_SPREAD[index] / scale
        low, high = max(0.0, mean - USUAL_SIGMAS * spread), mean + USUAL_SIGMAS * spread
        from_edge = min(abs(float(shared.vector[index]) - edge) for edge in GLOBAL_RANGE[index])
        at_edge = from_edge < AT_EDGE * GLOBAL_SPREAD[index]
        if at_edge or not low <= value <= high:
            edge = "the edge of what is tried, " if at_edge else ""
            found.append(f"{name} {value:.3f} ({edge}usually {low:.3f} to {high:.3f})")
    return found
