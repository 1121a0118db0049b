"""From which n the search for light that bounces sets out.

Half of the bounce beside another n explains photos nearly as well, and steps that set out too far off end
there. So a few pixels are explained with coarse materials under lights of several n, each with the bounce
that belongs to it.
"""

from __future__ import annotations

import math
from copy import copy
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
from endotwin.run.ahead import on_all_cores
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
    few, unit = _few_of(samples, surface), unit_mm(surface)
    solver, operator = solver_of(few, surface, unit, CELL_MM)
    solver.held = ("n", "gamma", "k2", "contrast", *held)

    def gone_on(path: _Path, joint: bool) -> _Path:
        """A path after STEPS more, the first of the materials alone unless it is ``joint``."""
        own, lighting, state = copy(solver), copy(relighting), path.state
        lighting.effects = path.effects
        own.relight(lighting.exposed(few))
        lighting(own, state)
        for together in (joint, *(True,) * (STEPS - joint)):
            state, _ = stepped(own, lighting, state, together)
        return _Path(state, lighting.effects, own.noise(state))

    def set_out(sigma: float) -> _Path:
        light = replace(start.light, n=PRIOR["n"] + sigma * LIGHT_SPREAD[0] / PRIOR["gamma"])
        state = started(operator, replace(start, light=light), relighting, solver.pattern.told, tone)
        return gone_on(_Path(state, relighting.effects, math.inf), joint=False)

    relighting.keep_light()
    nearest = sorted(on_all_cores(set_out, SIGMAS), key=_LEFT)[:KEPT]
    paths = on_all_cores(lambda path: gone_on(path, joint=True), nearest)
    found = min(paths, key=_LEFT).state.shared.light.n
    relighting.keep_light(False)
    return found


def _few_of(samples: Samples, surface: Surface) -> Samples:
    vertex = samples.nearest(surface.triangles)
    rows = whole_groups(vertex, len(surface.vertices_mm), PIXELS, np.random.default_rng(0))
    return samples[torch.from_numpy(rows)]
