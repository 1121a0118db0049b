"""From which n the search for light that bounces sets out, on photos of a tube that is known."""

from dataclasses import replace

import numpy as np
import pytest
import tube_twin

from endotwin.effects import Effects
from endotwin.effects.interreflection import Interreflection
from endotwin.effects.specular import Specular
from endotwin.fit.lighting import Relighting, lit
from endotwin.fit.scout import SIGMAS, likeliest_n
from endotwin.pixels.start import LIGHT_SPREAD, PRIOR, start_at
from endotwin.surface.casting import Caster


@pytest.mark.slow
@pytest.mark.parametrize("n", [pytest.param(1.2, marks=pytest.mark.long), 3.4])
def test_where_light_bounces_the_search_sets_out_from_a_shape_of_light_near_the_true_one(n):
    surface = tube_twin.seen(tube_twin.surface(fold_mm=2.0))
    twin = tube_twin.fitted(surface)
    materials = replace(
        twin.materials, metallic=0 * twin.materials.metallic, base_color=1.2 * twin.materials.base_color
    )
    effects = Effects([Specular(), Interreflection(cell_mm=3.0)])
    twin = replace(twin, materials=materials, light=replace(twin.light, n=n), effects=effects)
    poses = np.stack([tube_twin.pose(s) for s in np.linspace(0.2, 0.8, 8)])
    samples = tube_twin.photographed(twin, tube_twin.CAMERA, poses)
    caster = Caster(surface)
    start = start_at(samples, surface.triangles, len(surface.vertices_mm), **PRIOR)
    relighting = Relighting(surface, caster, effects, samples.views)
    found = likeliest_n(lit(samples, surface, caster, effects), surface, start, relighting, ("q", "L0"))
    apart = np.diff(SIGMAS).max() * LIGHT_SPREAD[0] / PRIOR["gamma"]
    assert abs(found - n) < 0.75 * apart
    assert relighting.effects == effects
