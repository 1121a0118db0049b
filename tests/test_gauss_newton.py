"""The least-squares solver's own promises; what it finds is tested in test_fit."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
import tube_twin

from endotwin.effects import Effects
from endotwin.effects.coat import Coat
from endotwin.effects.interreflection import Interreflection
from endotwin.effects.specular import Specular
from endotwin.effects.tone import Tone
from endotwin.effects.vignetting import Vignetting
from endotwin.fit.gauss_newton import FIRST_ERROR, PASSING, STANDARD_SPREAD, TEMPER, GaussNewton
from endotwin.fit.model import Globals
from endotwin.fit.prior import unusual
from endotwin.fit.state import (
    DARKEST,
    GLOBAL_RANGE,
    State,
    as_bright,
    at_furnace,
    brightest,
    rescaled,
    too_dark,
    without_furnace,
)
from endotwin.light.radiosity import ALBEDO_MAX
from endotwin.twin import Light, Response


def ended_at(gamma: float, n: float, q: float) -> list[str]:
    return unusual(Globals.of(Light(10.0, n, q), Response(gamma), 0.04))


@pytest.mark.parametrize("index, name", [(1, "n"), (2, "q"), (3, "γ")])
@pytest.mark.parametrize("end", [0, 1])
def test_a_parameter_at_the_edge_of_its_range_is_told_with_what_is_usual(index, name, end):
    shared = Globals.of(Light(10.0, 2.0, 2.0), Response(0.45), 0.04)
    vector = shared.vector.clone()
    vector[index] = GLOBAL_RANGE[index][end] + 1e-4 * (1 - 2 * end)
    told = [words for words in unusual(replace(shared, vector=vector)) if words.startswith(f"{name} ")]
    assert len(told) == 1 and "edge of what is tried, usually" in told[0]


@pytest.mark.parametrize(
    "gamma, n, q", [(0.4545, 2.0, 2.0), (0.53, 1.9, 1.9), (0.246, 2.2, 2.9), (0.46, 0.6, 2.0)]
)
def test_what_endoscopes_have_is_not_remarked_upon(gamma, n, q):
    assert ended_at(gamma, n, q) == []


def test_more_than_three_standard_deviations_from_the_prior_are_told():
    assert ended_at(0.1507, 2.84, 3.12)[0].startswith("γ 0.151 (")
    assert ended_at(0.1542, 2.0, 2.0) == ["γ 0.154 (usually 0.155 to 0.755)"]
    assert ended_at(0.4545, 6.0, 2.0) == ["n 6.000 (usually 0.000 to 5.300)"]
    assert ended_at(0.4545, 2.0, 0.3) == ["q 0.300 (usually 0.350 to 3.650)"]


def colored(factor: float, log_scale: float) -> State:
    """Tissue of a hundred albedos up to about ``factor``, as fitted beside a scale."""
    shared = Globals.of(Light(10.0, 2.0, 2.0), Response(0.45), 0.04, bounce=True)
    shown = (factor * torch.linspace(0.2, 1, 100)[:, None] * torch.tensor([1.0, 0.6, 0.5])) ** shared.gamma
    return rescaled(State(None, torch.cat([shown, torch.zeros(100, 1)], dim=1), None, shared), log_scale)


@pytest.mark.parametrize(
    ("rise", "channel"),
    [([3.0, 1, 1], 0), ([0.1, 2.0, 0], 1), ([0.3, 0.3, 0.3], None), ([-1.0, 0.5, 0], None), ([], None)],
)
def test_a_step_is_stopped_by_the_channel_whose_tissue_it_would_make_a_furnace(rise, channel):
    assert at_furnace(colored(0.8, 0.0), np.array(rise)) == channel


def test_tissue_without_a_furnace_reflects_at_most_what_tissue_may():
    for log_scale in (-1.0, 0.1, 2.0):
        moved = without_furnace(colored(0.8, log_scale))
        assert brightest(moved) * math.exp(moved.shared.log_scale) <= ALBEDO_MAX * (1 + 1e-6)


@pytest.mark.parametrize("weight", [0.2, 1.0])
def test_tissue_under_a_coat_throws_as_much_of_the_light_that_bounces_longest_as_it_did_bare(weight):
    def gained(state: State) -> torch.Tensor:
        """1/(1 − ρ), by which an integrating sphere of the mean tissue brightens its own light, [3]."""
        white = state.shared.lobes.glossy_albedo(state.materials[:, 3]).mean()
        return 1 / (1 - math.exp(state.shared.log_scale) * (state.mean_log_color.exp() + white))

    bare = colored(0.8, 0.4)
    coated = replace(bare, shared=replace(bare.shared, coat=Coat(weight, 0.15)))
    kept = gained(as_bright(coated, bare))
    assert kept[0] == pytest.approx(float(gained(bare)[0]), rel=1e-5) and gained(coated)[0] > 1.01 * kept[0]
    assert (kept[1:] > gained(bare)[1:]).all()


@pytest.mark.parametrize("unseen", [0.5, 20.0])
def test_tissue_that_no_photo_shows_neither_limits_the_bounce_nor_counts_in_what_light_follows(unseen):
    told = torch.arange(100) < 60
    state = replace(colored(1.1, 0.1), told=told)
    strange = replace(state, mean=torch.where(told[:, None], state.mean, unseen * state.mean))
    assert brightest(strange) == brightest(state) != brightest(replace(strange, told=None))
    torch.testing.assert_close(strange.mean_log_color, state.mean_log_color)


def test_tissue_is_too_dark_by_what_it_reflects_not_by_its_scale():
    for factor in (0.2, 0.8, 1.6):
        assert too_dark(colored(factor, math.log(0.9 * DARKEST / factor)))
        assert not too_dark(colored(factor, math.log(1.2 * DARKEST / factor)))


def explained(
    gamma: float, bounces: bool, lens: Vignetting | None = None, tone: Tone | None = None
) -> tuple[GaussNewton, State]:
    """A tube under a response of ``gamma`` and a ``tone`` curve, behind a ``lens``, and photos of it that
    show just what is predicted."""
    twin = tube_twin.fitted(tube_twin.seen(tube_twin.surface()))
    poses = np.stack([tube_twin.pose(0.4), tube_twin.pose(0.6)])
    samples = tube_twin.photographed(twin, tube_twin.CAMERA, poses)
    effects = Effects([Specular(), *([Interreflection(4.0)] * bounces), *([lens] if lens else [])])
    shared = Globals.of(twin.light, Response(gamma), twin.materials.f0, bounce=bounces)
    state = replace(tube_twin.state_of(twin), shared=shared.behind(lens).under(tone))
    solver = tube_twin.seen_by_the_fit(twin, samples, state, effects)
    shown = 255 * tube_twin.shown_to_the_fit(solver, state).clamp(0, 1) + 0.5
    solver.relight(replace(solver.samples, color=shown.to(torch.uint8)))
    return solver, state


@pytest.mark.parametrize("bounces", [False, True])
def test_a_response_off_the_displays_costs_what_the_model_errs_by_a_deviation_where_light_bounces(bounces):
    solver, state = explained(0.4, bounces)
    noise = 2 / 255
    cost = solver.cost(state, noise)
    solver.errs_by = 0.0
    deviations = (0.4 - 1 / 2.2) / STANDARD_SPREAD
    expected = bounces * len(solver.samples) * (deviations * FIRST_ERROR / noise) ** 2 / (2 * TEMPER)
    assert cost - solver.cost(state, noise) == pytest.approx(expected, rel=1e-6)


def test_a_step_from_photos_that_are_explained_takes_the_response_towards_that_of_displays():
    solver, state = explained(0.4, bounces=True)
    found = solver.step(state)
    assert found.fell > 0 and 0.402 < found.state.shared.gamma < 1 / 2.2


def test_what_a_model_errs_by_is_what_many_pixels_share_whatever_the_noise():
    solver, state = explained(0.4, bounces=True)
    generator, shown = np.random.default_rng(0), solver.samples.color.float()
    view = solver.samples.views
    row, column = np.divmod(solver.samples.pixel.numpy(), view.camera.width)
    edge = math.ceil(view.camera.width / 16)
    signs = generator.choice([-1.0, 1.0], (view.camera.height, view.camera.width))

    def known(error: float, noise: float) -> float:
        off = error * signs[row // edge, column // edge] + generator.normal(0, noise, len(row))
        colors = (shown + torch.from_numpy(off)[:, None]).round().clamp(0, 255)
        solver.relight(replace(solver.samples, color=colors.to(torch.uint8)))
        solver.errs_by = 1.0
        solver.learn_error(state)
        return 255 * solver.errs_by

    assert known(3.0, 4.0) == pytest.approx(3 * PASSING**0.5, rel=0.1)
    assert known(0.0, 4.0) < 0.5 * PASSING**0.5
    solver.learn_error(state)
    least = solver.errs_by
    known(3.0, 4.0)
    solver.errs_by = least
    solver.learn_error(state)
    assert solver.errs_by == least


def test_where_light_bounces_a_step_finds_what_the_lens_dims_beside_light_and_response():
    solver, true = explained(1 / 2.2, bounces=True, lens=Vignetting(-0.4))
    state = replace(true, shared=true.shared.behind(Vignetting(-0.2)))
    for _ in range(3):
        state = solver.step(state).state
    assert state.shared.k2 == pytest.approx(-0.4, rel=0.1)
    assert state.shared.light.n == pytest.approx(true.shared.light.n, rel=0.02)
    solver.held = ("k2",)
    state = solver.step(replace(true, shared=true.shared.behind(Vignetting(-0.2)))).state
    assert state.shared.k2 == pytest.approx(-0.2)


def test_where_light_bounces_steps_find_the_contrast_of_a_curve_beside_light_response_and_materials():
    solver, true = explained(1 / 2.2, bounces=True, tone=Tone(0.4))
    begun = replace(true, shared=true.shared.under(Tone(0.2)))
    state = begun
    for _ in range(4):
        state = solver.step(state).state
    assert state.shared.tone.contrast == pytest.approx(0.4, abs=0.03)
    assert state.shared.gamma == pytest.approx(1 / 2.2, rel=0.01)
    solver.held = ("contrast",)
    assert solver.step(begun).state.shared.tone.contrast == pytest.approx(0.2)
