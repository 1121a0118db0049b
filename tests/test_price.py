"""What an effect costs a picture."""

from dataclasses import replace

import numpy as np
import pytest
import tube_twin
from scenes import pinhole

from endotwin.effects import Decision, Effects
from endotwin.effects.interreflection import Interreflection
from endotwin.effects.vignetting import Vignetting
from endotwin.light.radiosity import Radiosity
from endotwin.pixels.samples import Views
from endotwin.render import Renderer, price
from endotwin.surface.casting import Caster

EFFECTS = Effects([Interreflection(cell_mm=3.0), Vignetting(k2=-0.2)])
POSE = tube_twin.pose(0.3)


@pytest.fixture(scope="module")
def twin():
    camera, on = pinhole(), {name: Decision("on", "forced on") for name in EFFECTS}
    fitted = tube_twin.fitted(tube_twin.surface())
    return replace(fitted, camera=camera, effects=EFFECTS, decisions=on)


def priced(twin):
    mask = np.ones((twin.camera.height, twin.camera.width), bool)
    poses = twin.surface.to_local(np.stack([POSE]))
    return price.priced(twin, Caster(twin.surface), Views(twin.camera, mask, np.arange(1), poses))


def test_what_is_found_once_for_all_pictures_is_no_pictures_price(twin, monkeypatch):
    found, pictures, timed = [], [], price.best_ms

    def spied(whole, name: str):
        def spy(*args):
            found.append(name)
            return whole(*args)

        return spy

    def best_ms(render) -> float:
        found.clear()
        ms = timed(render)
        pictures.append(list(found))
        return ms

    for where, name in ((Radiosity, "to_points"), (Radiosity, "_counted"), (Vignetting, "transmission")):
        monkeypatch.setattr(where, name, spied(getattr(where, name), name))
    monkeypatch.setattr(price, "best_ms", best_ms)
    priced(twin)
    assert pictures == [[], [], []]


def test_a_renderer_with_the_form_factors_of_its_surface_renders_the_same(twin):
    radiosity = Radiosity(twin.surface, Caster(twin.surface), cell_mm=3.0)
    shared, own = Renderer(twin, radiosity=radiosity), Renderer(twin)
    np.testing.assert_array_equal(shared.view(POSE).color, own.view(POSE).color)


def test_an_edit_without_an_effect_renders_as_the_twin_without_it_from_scratch(twin):
    whole = Renderer(twin)
    whole.view(POSE)
    for name in EFFECTS:
        without = replace(twin, effects=EFFECTS.without((name,)))
        edited = whole.edited(without).view(POSE).color
        np.testing.assert_array_equal(edited, Renderer(without).view(POSE).color)
        assert not np.array_equal(edited, whole.view(POSE).color)
