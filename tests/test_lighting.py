"""Training pixels under the effects that the fit has found so far."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import tube_twin

from endotwin.effects import Effects
from endotwin.effects.gain import Gain
from endotwin.fit.gauss_newton import GaussNewton
from endotwin.fit.lighting import Relighting, lit
from endotwin.surface.casting import Caster

LOG_GAIN = np.array([-0.2, 0.1, 0.25, -0.15, 0.0])


@pytest.fixture(scope="module")
def exposed_unevenly():
    """Photos of the tube in frames of different gain, and the state of a fit that has found the tube."""
    twin = tube_twin.fitted(tube_twin.seen(tube_twin.surface(fold_mm=2.0)))
    twin = replace(twin, materials=replace(twin.materials, metallic=0 * twin.materials.metallic))
    poses = np.stack([tube_twin.pose(s) for s in np.linspace(0.3, 0.7, len(LOG_GAIN))])
    samples = tube_twin.photographed(twin, tube_twin.CAMERA, poses)
    factor = np.exp(LOG_GAIN[samples.frame.numpy()] * twin.response.gamma)[:, None]
    color = np.uint8(np.clip(samples.color.numpy() * factor, 0, 255) + 0.5)
    return twin, replace(samples, color=torch.from_numpy(color)), tube_twin.state_of(twin)


@pytest.mark.parametrize("known", [(0, 1, 2, 3, 4), (1, 3), (2,)])
def test_the_detail_begins_with_the_gains_that_the_fit_finds_of_all_frames(exposed_unevenly, known):
    """Also where the probe was wrong about some frames, and looked at only some."""
    twin, samples, state = exposed_unevenly
    effects = Effects([Gain(known, (0.0,) * len(known))])
    relighting = Relighting(twin.surface, Caster(twin.surface), effects, samples.views)
    samples = lit(samples, twin.surface, Caster(twin.surface), relighting.effects)
    solver = GaussNewton(samples, twin.surface.triangles, state.operator)
    assert not state.table.any()
    for _ in range(3):
        relighting(solver, state)
    gain = relighting.effects["gain"]
    assert gain.frames == (0, 1, 2, 3, 4)
    np.testing.assert_allclose(gain.log_gain, LOG_GAIN, atol=0.01)
    shown = gain.of(samples.frame.numpy())
    np.testing.assert_allclose(solver.samples.log_exposure.exp(), shown, rtol=1e-6)


def test_a_frame_that_is_all_black_gets_a_gain_that_is_finite_and_leaves_the_others_theirs(exposed_unevenly):
    twin, samples, state = exposed_unevenly
    effects = Effects([Gain((0, 1, 2, 3, 4), (0.0,) * 5)])
    relighting = Relighting(twin.surface, Caster(twin.surface), effects, samples.views)
    black = torch.where((samples.frame == 4)[:, None], 0, samples.color)
    samples = lit(replace(samples, color=black), twin.surface, Caster(twin.surface), relighting.effects)
    solver = GaussNewton(samples, twin.surface.triangles, state.operator)
    for _ in range(12):
        relighting(solver, state)
    log_gain = np.asarray(relighting.effects["gain"].log_gain)
    assert np.isfinite(log_gain).all() and log_gain[4] < -2
    np.testing.assert_allclose(np.diff(log_gain[:4]), np.diff(LOG_GAIN[:4]), atol=0.01)
