"""Whether a lens vignettes, on photos of a tube in which light bounces."""

from dataclasses import replace

import numpy as np
import pytest
import tube_twin

from endotwin.effects import Effects
from endotwin.effects.interreflection import Interreflection
from endotwin.effects.specular import Specular
from endotwin.effects.vignetting import Vignetting
from endotwin.fit.gauss_newton import GaussNewton
from endotwin.fit.light_stage import BOUNCE_HELD
from endotwin.fit.lighting import Relighting, lit
from endotwin.fit.model import Globals
from endotwin.fit.state import State
from endotwin.fit.steps import stepped
from endotwin.fit.vignetting import tried
from endotwin.surface.casting import Caster


def found_without(k2: float) -> tuple[GaussNewton, Relighting, State]:
    """What a fit that knows of no lens finds of photos behind one of ``k2``."""
    twin = tube_twin.fitted(tube_twin.seen(tube_twin.surface(fold_mm=2.0)))
    materials = replace(twin.materials, metallic=0 * twin.materials.metallic)
    effects = Effects([Specular(), Interreflection(cell_mm=3.0)])
    twin = replace(twin, materials=materials, effects=effects.including(Vignetting(k2)))
    poses = np.stack([tube_twin.pose(s) for s in np.linspace(0.2, 0.8, 6)])
    samples, caster = tube_twin.photographed(twin, tube_twin.CAMERA, poses), Caster(twin.surface)
    relighting = Relighting(twin.surface, caster, effects, samples.views)
    shared = Globals.of(twin.light, twin.response, twin.materials.f0, bounce=True)
    state = replace(tube_twin.state_of(twin), shared=shared)
    samples = lit(samples, twin.surface, caster, effects)
    solver = GaussNewton(samples, twin.surface.triangles, state.operator)
    relighting(solver, state)
    solver.held = BOUNCE_HELD
    for _ in range(4):
        state, _ = stepped(solver, relighting, state, joint=True)
    return solver, relighting, state


def test_where_light_bounces_all_pixels_tell_a_lens_that_vignettes_from_light_of_another_exponent():
    solver, relighting, state = found_without(-0.3)
    found, decision = tried(solver, relighting, state)
    assert state.shared.light.n > 2.1
    assert decision.state == "on" and relighting.effects["vignetting"]
    assert found.shared.k2 == pytest.approx(-0.3, rel=0.3)
    assert abs(found.shared.light.n - 2) < abs(state.shared.light.n - 2) / 2


@pytest.mark.parametrize("k2", [0.0, 0.2])
def test_a_lens_that_dims_nothing_at_its_rim_is_none_that_vignettes(k2):
    found, decision = tried(*found_without(k2))
    assert decision is None
    assert found.shared.k2 == pytest.approx(0.0, abs=0.02)
