"""Whether the lens vignettes, asked of all pixels where light bounces.

Light of another exponent passes for vignetting but for what bounces, so that where the probe's bounce errs,
the exponent may stand for a lens. Beside the light and materials that all pixels have found, a step in which
the lens may vignette says by how much that explains more than everything else could.
"""

from __future__ import annotations

import math
import time
from dataclasses import replace

from endotwin.effects import Decision
from endotwin.effects.vignetting import Vignetting
from endotwin.evidence.verdict import Verdict
from endotwin.evidence.worth import vignettes
from endotwin.fit.gauss_newton import GaussNewton
from endotwin.fit.lighting import Relighting
from endotwin.fit.model import K2
from endotwin.fit.state import State
from endotwin.fit.steps import stepped


def tried(solver: GaussNewton, relighting: Relighting, state: State) -> tuple[State, Decision | None]:
    """What a step from ``state`` finds behind a lens that may vignette, the samples of ``solver`` exposed so;
    and why that is kept, None where it is not worth it.

    γ·k2 at z of its standard deviations beside all else has lowered the cost by z²/2 (Wald).
    """
    began = time.perf_counter()
    noise, shown = solver.noise(state), float(solver.samples.color.float().mean()) / 255
    cost = solver.cost(state, noise)
    relighting.expose(solver, relighting.effects.including(Vignetting()))
    behind = replace(state, shared=state.shared.behind(Vignetting()))
    found, _ = stepped(solver, relighting, behind, joint=True)
    sigmas = float(-found.shared.vector[K2] / max(float(solver.spread[K2]), 1e-12))
    verdict = Verdict(10 * math.log10(1 + sigmas**2 / 2 / cost), sigmas)
    if not vignettes(verdict, noise / shown):
        return found, None
    reason = f"light of another exponent explains all pixels less well ({verdict})"
    took_s = round(time.perf_counter() - began, 3)
    return found, Decision("on", reason, round(verdict.gain_db, 3), took_s)
