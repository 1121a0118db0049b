"""What the renderer shows is what the fit predicts, whatever lights the scene."""

from dataclasses import replace

import numpy as np
import pytest
import tube_twin
from tube_twin import shown_to_the_fit

from endotwin.effects import Effects
from endotwin.effects.coat import Coat
from endotwin.effects.gain import Gain
from endotwin.effects.interreflection import Interreflection
from endotwin.effects.offset import Offset
from endotwin.effects.profile import Profile
from endotwin.effects.shadows import Shadows
from endotwin.effects.specular import Specular
from endotwin.effects.tone import Tone
from endotwin.effects.vignetting import Vignetting
from endotwin.fit.gauss_newton import GaussNewton
from endotwin.fit.model import Globals
from endotwin.fit.normal_equations import Residual
from endotwin.fit.state import State
from endotwin.fit.tilt import Tilter
from endotwin.render import Renderer
from endotwin.twin import Twin

GUIDES = Offset(((3.2, 0.5, 0.0), (-2.8, 2.7, 0.0)))
SCENES = {
    "light": [],
    "gain": [Gain((0, 1), (-0.2, 0.2))],
    "vignetting": [Vignetting(-0.5, -0.1)],
    "profile": [Profile(0.7)],
    "offset and shadows": [GUIDES, Shadows()],
    "interreflection": [Interreflection(4.0)],
    "coat": [Coat(0.8, 0.15)],
    "tone": [Tone(0.3)],
    "all": [
        GUIDES,
        Shadows(),
        Interreflection(4.0),
        Gain((0, 1), (-0.2, 0.2)),
        Vignetting(-0.5, -0.1),
        Profile(0.7),
        Coat(0.8, 0.15),
        Tone(0.3),
    ],
}
POSES = np.stack([tube_twin.pose(0.3), tube_twin.pose(0.6)])
LEVEL = 1 / 255


@pytest.fixture(scope="module")
def tube() -> Twin:
    """A folded tube without metallic, which a fit does not have."""
    twin = tube_twin.fitted(tube_twin.seen(tube_twin.surface(fold_mm=2.0)))
    return replace(twin, materials=replace(twin.materials, metallic=0 * twin.materials.metallic))


def seen_by_the_fit(tube: Twin, effects: Effects) -> tuple[GaussNewton, State]:
    """The tube's pixels under ``effects`` as the fit has them, and what it would fit."""
    samples, state = tube_twin.photographed(tube, tube.camera, POSES), tube_twin.state_of(tube)
    shared = Globals.of(tube.light, tube.response, tube.materials.f0, bounce=bool(effects.bounce))
    shared = replace(shared, coat=effects.get("coat")).under(effects.get("tone"))
    state = replace(state, shared=shared.behind(effects.get("vignetting")))
    return tube_twin.seen_by_the_fit(tube, samples, state, effects), state


@pytest.mark.parametrize("scene", SCENES)
def test_the_renderers_pixels_are_what_the_fit_predicts(tube, scene):
    effects = Effects([Specular(), *SCENES[scene]])
    twin, (solver, state) = replace(tube, effects=effects), seen_by_the_fit(tube, effects)
    samples, predicted = solver.samples, shown_to_the_fit(solver, state).numpy().clip(0, 1)

    renderer, compared = Renderer(twin), 0
    for frame, pose in enumerate(POSES):
        gain = float(effects["gain"].of(np.array([frame]))[0]) if "gain" in effects else 1.0
        view = renderer.view(pose, exposure=gain)
        rows = np.flatnonzero(samples.frame.numpy() == frame)
        pixel = samples.pixel.numpy()[rows]
        inner = ~view.averaged.ravel()[pixel]
        apart = np.abs(view.color.reshape(-1, 3)[pixel] - predicted[rows])[inner]
        compared += len(apart)
        # Of bounced light the fit has the nearest vertex's, and the renderer what lies between three.
        assert np.quantile(apart, 0.999 if effects.bounce else 1.0) < LEVEL
        assert np.median(apart) < 0.1 * LEVEL
    assert compared > 0.75 * len(samples)


@pytest.mark.parametrize("scene", SCENES)
def test_a_tilt_of_the_normals_starts_from_what_the_fit_predicts(tube, scene):
    effects = Effects([Specular(), *SCENES[scene]])
    solver, state = seen_by_the_fit(tube, effects)
    tilter = Tilter(solver, state, effects)
    _, _, residual = tilter._slopes(solver.samples, tube.surface.normals, np.inf)
    fitted = Residual.of(solver.samples, shown_to_the_fit(solver, state), np.inf)
    np.testing.assert_allclose(residual.error, fitted.error, atol=2e-5)


@pytest.mark.parametrize("scene", [name for name in SCENES if name not in ("light", "gain")])
def test_each_of_these_effects_shows(tube, scene):
    """Else their agreement would say nothing."""
    plain, with_it = (
        Renderer(replace(tube, effects=Effects([Specular(), *more]))).view(POSES[0]).color
        for more in ([], SCENES[scene])
    )
    assert np.abs(plain - with_it).max() > 2 * LEVEL
