"""From which n the search for light that bounces sets out.

Half of the bounce beside another n explains photos nearly as well, and steps that set out too far off end
there. So a few pixels are explained with coarse materials under lights of several n, each with the bounce
that belongs to it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from operator import attrgetter

import numpy as np
import torch

from endotwin.effects import Effects
from endotwin.effects.tone import Tone
from endotwin.fit.lighting import Relighting
from endotwin.fit.state import State
from endotwin.fit.steps import solver_of, started, stepped
from endotwin.pixels.length_unit import unit_mm
from endotwin.pixels.samples import Samples, whole_groups
from endotwin.pixels.start import LIGHT_SPREAD, PRIOR, Start
from endotwin.surface import Surface

SIGMAS = (-1.0, -0.5, 0.0, 0.5, 1.0, 1.5, 2.0)
"""The values of n that are tried, in standard deviations from the prior's mean."""

PIXELS, CELL_MM = 19_000, 6.4
"""Of some vertices; and the finest cells, in units of the scene."""

STEPS, KEPT = 3, 3
"""Steps under each light, and how many lights are worth as many more."""


@dataclass(frozen=True)
class _Path:
    """A state, the effects that were found with it, and the noise that is left beside it."""

    state: State
    effects: Effects
    left: float


_LEFT = attrgetter("left")


def likeliest_n(
    samples: Samples,
    surface: Surface,
    start: Start,
    relighting: Relighting,
    held: tuple[str, ...],
    tone: Tone | None = None,
) -> float:
    """The n beside which the light of ``start``, whose parameters ``held`` stay, leaves least of the
    ``samples`` unexplained, as they look through the ``tone`` curve."""
    few, effects, unit = _few_of(samples, surface), relighting.effects, unit_mm(surface)
    solver, operator = solver_of(few, surface, unit, CELL_MM)
    solver.held = ("n", "gamma", *held)

    def gone_on(path: _Path, joint: bool) -> _Path:
        """A path after STEPS more, the first of the materials alone unless it is ``joint``."""
        relighting.effects = path.effects
        solver.relight(relighting.exposed(few))
        relighting(solver, path.state)
        state = path.state
        for together in (joint, *(True,) * (STEPS - joint)):
            state, _ = stepped(solver, relighting, state, together)
        return _Path(state, relighting.effects, solver.noise(state))

    relighting.keep_light()
    paths = []
    for sigma in SIGMAS:
        light = replace(start.light, n=PRIOR["n"] + sigma * LIGHT_SPREAD[0] / PRIOR["gamma"])
        state = started(operator, replace(start, light=light), relighting, solver.pattern.told, tone)
        paths.append(gone_on(_Path(state, effects, math.inf), joint=False))
    paths = [gone_on(path, joint=True) for path in sorted(paths, key=_LEFT)[:KEPT]]
    relighting.effects = effects
    relighting.keep_light(False)
    return min(paths, key=_LEFT).state.shared.light.n


def _few_of(samples: Samples, surface: Surface) -> Samples:
    vertex = samples.nearest(surface.triangles)
    rows = whole_groups(vertex, len(surface.vertices_mm), PIXELS, np.random.default_rng(0))
    return samples[torch.from_numpy(rows)]
