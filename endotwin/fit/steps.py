"""Steps of light and materials; where light bounces it depends on these. And where steps begin."""

from __future__ import annotations

import math

import numpy as np
import torch

from endotwin.effects.tone import Tone
from endotwin.fit.gauss_newton import GaussNewton
from endotwin.fit.hashgrid import HashGrid, HashOperator
from endotwin.fit.lighting import Relighting
from endotwin.fit.model import Globals
from endotwin.fit.state import State, brightest, halfway, rescaled, roughness_to_raw, without_furnace
from endotwin.light.shading import F0_DIELECTRIC, ROUGHNESS_TISSUE
from endotwin.pixels.samples import Samples
from endotwin.pixels.start import Start
from endotwin.surface import Surface
from endotwin.surface.cells import merged

COARSEST_MM = 12.0
"""Of the cells of features, in units of the scene."""

PROXIES = 4
"""Vertices are merged to so many points a finest cell."""

PALE = 0.75
"""Brightest channel of the even tissue from which the strength of a bounce is sought: it is found in fewer
steps from above than from below, and beside albedos near that of a furnace it is lost in the first."""

WORSE, HALVINGS = 1.25, 2
"""What costs so many times what there was before is plainly worse. A step under whose light the photos do is
too long, and halved so often."""


def solver_of(
    samples: Samples, surface: Surface, unit_mm: float, cell_mm: float, **options
) -> tuple[GaussNewton, HashOperator]:
    """A solver for ``samples`` of the surface, beside features whose finest cells are ``cell_mm`` units of
    the scene, and their operator; ``options`` are the solver's."""
    points, group = merged(surface.vertices_mm, unit_mm * cell_mm / PROXIES)
    operator = HashOperator.of(points.astype(np.float32), HashGrid(unit_mm * COARSEST_MM, unit_mm * cell_mm))
    return GaussNewton(samples, group[surface.triangles], operator, unit_mm, **options), operator


def started(
    operator: HashOperator,
    start: Start,
    relighting: Relighting,
    told: torch.Tensor,
    tone: Tone | None = None,
) -> State:
    """Even tissue under the light of ``start``, for photos that tell of the vertices ``told``, bool [V];
    where light bounces, PALE."""
    shown = torch.from_numpy(start.base_color) ** start.response.gamma
    mean = torch.cat([shown.median(dim=0).values, torch.tensor([roughness_to_raw(ROUGHNESS_TISSUE)])])
    options = {"specular": "specular" in relighting.effects, "bounce": relighting.bounces}
    shared = Globals.of(start.light, start.response, F0_DIELECTRIC, **options).under(tone)
    shared = shared.behind(relighting.effects.get("vignetting"))
    state = State(operator, mean, torch.zeros(operator.forward_csr.shape[1], 4), shared, told)
    return rescaled(state, math.log(PALE / brightest(state))) if relighting.bounces else state


def stepped(solver: GaussNewton, relighting: Relighting, state: State, joint: bool) -> tuple[State, float]:
    """A step, of the materials alone where a ``joint`` one finds nothing lower, with the samples relit by
    what it has found; and by how much the cost fell (below 0: it rose).

    A step knows what it does to bounced light to first order. Where that was too far, it goes half the way.
    """
    found = solver.step(state, joint, gains=joint and "gain" in relighting.effects)
    if joint and not found.fell:
        found = solver.step(state, joint=False)
    relighting.brighten(solver, found.log_gain)
    moved = found.state
    if not relighting.bounces:
        relighting(solver, moved)
        return moved, found.fell
    noise = solver.noise(state)
    before = solver.cost(state, noise)
    for halving in range(HALVINGS + 1):
        moved = without_furnace(moved)
        relighting(solver, moved)
        after = solver.cost(moved, noise)
        if after <= WORSE * before or halving == HALVINGS:
            break
        moved = halfway(state, moved)
    return moved, before - after
