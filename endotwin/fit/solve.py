"""The method ``twin``: a closed-form start, then Gauss–Newton from coarse features to fine ones.

Light and response are found on coarse features, from the pixels that can tell them: where the surface's
normal is certain and the photo is not clipped. The fine features then only have to explain what is left,
from all pixels.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from endotwin.effects import Decision, Effect, Effects, unjudged
from endotwin.errors import SequenceError
from endotwin.evidence.decide import Decided, decide
from endotwin.evidence.glints import Glints
from endotwin.evidence.guide_search import Guides
from endotwin.fit.beneath import Model
from endotwin.fit.bloom import bloom
from endotwin.fit.faint import NOTHING, Faint
from endotwin.fit.film import Found
from endotwin.fit.film import film as found_film
from endotwin.fit.gauss_newton import CPU, GaussNewton
from endotwin.fit.hashgrid import HashGrid, HashOperator
from endotwin.fit.heal import extended
from endotwin.fit.light_stage import Cost, FoundLight, LightStage
from endotwin.fit.lighting import Relighting
from endotwin.fit.prior import unusual
from endotwin.fit.sparkle import sparkle
from endotwin.fit.state import State
from endotwin.fit.tilt import Tilter
from endotwin.fit.unexplained import Remains, odd_photos_warning, residual_warning
from endotwin.light.film import Film
from endotwin.light.guides import AT_LENS
from endotwin.light.radiosity import Radiosity
from endotwin.pixels.length_unit import unit_mm
from endotwin.pixels.pace import ITERATIONS, Pace
from endotwin.pixels.samples import Samples, Views, drawn, gather, whole_groups
from endotwin.pixels.start import ALBEDO_TOP, BRIGHT, Start, closed_form, start_at
from endotwin.run.threads import THREADS, one_core
from endotwin.surface import Surface
from endotwin.surface.casting import Caster
from endotwin.twin import Light, Materials, Response, Twin

logger = logging.getLogger("endotwin")

Price = Callable[[Twin, Caster, Views, Radiosity | None], Twin]

LIGHT_PIXELS = 150_000
LIGHT_SHARE = 0.25
"""Of fewer pixels than it takes to find LIGHT_PIXELS, this share."""

PIXELS_A_VERTEX = 4
"""Of those at least: with one nothing varies within a vertex. With all there are few vertices, between which
materials are a guess."""

DETAIL_GROWTH = 1.6
DETAIL_COARSEST_MM = 2.56
"""Coarsest cell that detail may correct: the light's pixels leave out the creases."""

SUMS = 0.4
"""Share of the time left for the detail that going through its pixels once may take."""

LEAST_A_VERTEX = 2
"""Of pixels, those of the detail, on average and whatever the budget: with fewer most of it is a guess."""

CERTAIN_NORMAL_DEG = 5.0
"""A triangle whose vertex normals differ by more bends too much for its normal to be certain."""


def fit_twin(
    twin: Twin,
    pace: Pace,
    seed: int,
    states: Mapping[str, str],
    price: Price,
    device: torch.device = CPU,
) -> Twin:
    """Fit as the module says, in the time that ``pace`` gives, with effects as ``states`` say (auto unless
    named), whose prices in its decisions are those that ``price`` finds. Gauss–Newton runs on ``device``.

    Raises:
        SequenceError: the training photos show nothing of the surface.
    """
    surface, stopwatch = twin.surface, pace.stopwatch
    with stopwatch.stage("gather"):
        caster = Caster(surface, threads=1)
        samples = gather(twin, pace, seed, caster)
    if not len(samples):
        raise SequenceError(
            f"the training photos of {twin.source.path} show nothing of the surface; "
            "check that poses and depth fit it"
        )
    with stopwatch.stage("start"):
        pixels = _Pixels.of(samples, twin, pace, seed)
        start = closed_form(samples[pixels.start], surface.triangles, len(surface.vertices_mm))
    if start.undetermined:
        asked = "what there was time to look at of the photos" if pace.hurried else "the photos"
        logger.warning("%s cannot tell %s: kept at the prior", asked, " and ".join(start.undetermined))
    fit = _Fit(twin, caster.threaded(THREADS), pace, states, device)
    lighted = fit.light(pixels, start)
    relighting = lighted.relighting
    if casts := lighted.decided.casts:
        logger.warning("%s", casts)
    with stopwatch.stage("detail"):
        samples = relighting.lit(lighted.samples)
        state, normals, remains = fit.detail(lighted, samples)
        state = extended(state, surface, samples)
        twin = replace(twin, surface=replace(surface, normals=normals))
    wet, beyond, why = fit.beyond(Model(twin, state, relighting, fit.caster), samples)
    if odd := unusual(state.shared):
        logger.warning(
            "the fit ended at %s, as it does on wrong poses, depth or photos, or without an effect that they "
            "show: do not trust it; 'endotwin check %s' looks for the cause",
            *(" and ".join(odd), twin.source.path),
        )
    with stopwatch.stage("price"):
        decisions = lighted.decisions | why
        if remains is not None:
            _warn(remains, twin, decisions)
        effects = relighting.effects
        for effect in beyond:
            effects = effects.including(effect)
        fitted = _fitted(twin, wet.model.state, effects, decisions, wet.film)
        priced = price(fitted, fit.caster, samples.views, relighting.radiosity)
    sharpened, casts = samples.views.processor, lighted.decided.casts
    return priced.with_record(
        fit={
            "method": "twin",
            "undetermined": list(lighted.start.undetermined),
            "sharpening_undone": sharpened
            and {"amount": sharpened.sharpening, "radius_px": sharpened.radius},
            "casts_undone": casts and casts.to_dict(),
            **stopwatch.to_dict(),
        }
    )


def _warn(remains: Remains, twin: Twin, decisions: Mapping[str, Decision]) -> None:
    """Say where a fit leaves more than it should."""
    if said := residual_warning(remains.sigma, twin.sequence(), decisions):
        logger.warning("%s; 'endotwin check %s' looks for the cause", said, twin.source.path)
    if said := odd_photos_warning(remains):
        logger.warning("%s", said)


@dataclass(frozen=True)
class _Pixels:
    """Training samples, and which of them say what.

    Attributes:
        smooth: bool [N], off the creases of the surface. telling: rows int64 of those that tell the light:
            smooth, and not clipped. start: of these, that the fit starts from. light: of these, by which the
            light is found, some of each of some vertices: pixels of a place tell by how they differ. white:
            smooth ones that are clipped, to go with those.
    """

    samples: Samples
    smooth: Tensor
    telling: Tensor
    start: Tensor
    light: Tensor
    white: Tensor

    @classmethod
    def of(cls, samples: Samples, twin: Twin, pace: Pace, seed: int) -> _Pixels:
        smooth, clipped = _smooth(samples, twin.surface), samples.color.amax(dim=1).numpy() >= BRIGHT
        telling = np.flatnonzero(smooth & ~clipped)
        if not len(telling):
            telling = np.arange(len(samples))
            if int(samples.color.amax(dim=1).min()) >= BRIGHT:
                logger.warning(
                    "no training photo of %s has an unclipped pixel: its light and materials are guesses",
                    twin.source.path,
                )

        def some(rows: np.ndarray, count: int) -> np.ndarray:
            return rows[drawn(len(rows), count, np.random.default_rng(seed))]

        start = some(telling, pace.start_pixels)
        vertex = samples[torch.from_numpy(telling)].nearest(twin.surface.triangles)
        count = min(LIGHT_PIXELS, int(LIGHT_SHARE * pace.start_pixels))
        light = telling[_of_some_vertices(vertex, count, np.random.default_rng(seed))]
        white = np.flatnonzero(smooth & clipped)
        white = some(white, len(white) * len(light) // len(telling))
        return cls(samples, *map(torch.from_numpy, (smooth, telling, start, light, white)))


def _of_some_vertices(vertex: np.ndarray, count: int, generator: np.random.Generator) -> np.ndarray:
    """Rows of about ``count`` pixels, of those whose vertices are ``vertex`` [N]: about PIXELS_A_VERTEX of a
    vertex, more where those would be too few, and all if there are no more."""
    pixels = np.bincount(vertex)
    few = max(count, PIXELS_A_VERTEX * np.count_nonzero(pixels))
    rows = drawn(len(vertex), few, generator)
    return rows[whole_groups(vertex[rows], len(pixels), count, generator)]


@dataclass(frozen=True)
class _Lighted:
    """The effects that are decided, the samples without casts, where the fit started beside them, what they
    make of the light, what a step cost, what is found, and the seconds that finding it again took."""

    decided: Decided
    samples: Samples
    start: Start
    relighting: Relighting
    cost: Cost
    found: FoundLight
    again_s: float = 0.0

    @property
    def decisions(self) -> dict[str, Decision]:
        """Of every effect of light and response."""
        decisions = {**self.decided.decisions, **self.found.decisions}
        if self.found.state.shared.tone is not None:
            tone = decisions["tone"]
            decisions["tone"] = replace(tone, fit_s=round(tone.fit_s + self.again_s, 3))
        if "interreflection" in self.decided.effects and not self.relighting.bounces:
            decisions["interreflection"] = _without_bounce(decisions["interreflection"])
        return decisions


@dataclass(frozen=True)
class _Fit:
    """One fit of a twin, whose surface rays of the ``caster`` meet, in the time that ``pace`` gives, with
    effects as ``states`` say; Gauss–Newton runs on ``device``."""

    twin: Twin
    caster: Caster
    pace: Pace
    states: Mapping[str, str]
    device: torch.device

    def light(self, pixels: _Pixels, start: Start) -> _Lighted:
        """The effects that the photos show, and light, response and coarse materials beside them; found again
        without a tone curve, if there is one. ``start`` is that of photos as they are."""
        clock = self.pace.stopwatch
        began = clock.total
        first = self._lighted(pixels, start)
        if first.found.toned is None:
            return first
        found = clock.total
        anew = self.pace.find_light_again(found - began)
        again = self._lighted(pixels, start, first, anew)
        return replace(again, again_s=clock.total - found)

    def _lighted(
        self, pixels: _Pixels, start: Start, before: _Lighted | None = None, anew: bool = True
    ) -> _Lighted:
        """As ``light``; without the tone curve that was found ``before``, and near the guides beside which it
        was, or with those effects unless they are to be found ``anew``."""
        samples, surface = pixels.samples, self.twin.surface
        toned, near_mm = None, AT_LENS
        if before is not None:
            toned, near_mm = before.found.toned, before.decided.effects.guides_mm or AT_LENS
        shown = samples if toned is None else samples.untoned(toned[0])
        with self.pace.stopwatch.stage("effects"):
            decided = self._decided(pixels, shown, start, near_mm) if anew else before.decided
            if (casts := decided.casts) is not None:
                shown = casts.taken_off(shown)
                samples = casts.taken_off(samples, toned and toned[0])
            if decided.start is not None or toned is not None:
                start = self._start_beside(decided, shown[pixels.start])
            faint = NOTHING
            if not start.undetermined:
                faint = Faint.beside(decided.effects, self.states, shown[pixels.light], surface)
            relighting = Relighting(surface, self.caster, decided.effects, samples.views, faint)
            telling = relighting.lit(samples[pixels.light])
        with self.pace.stopwatch.stage("light"):
            wanted = {name: self.states.get(name, "auto") for name in ("coat", "tone", "vignetting")}
            if "specular" not in decided.effects:
                wanted["coat"] = "off"
            parts = telling, samples[pixels.white]
            found = before and before.found
            self.pace.leave(math.inf)
            stage = LightStage(*parts, surface, start, self.pace, relighting, wanted, self.device, found)
            self.pace.leave(stage.cost.detail_s(self._weights, len(samples), self.pace.plan.steps))
            return _Lighted(decided, samples, start, relighting, stage.cost, stage.found())

    def _start_beside(self, decided: Decided, shown: Samples) -> Start:
        """Where the fit starts beside the effects that are ``decided``, from what is ``shown``."""
        mesh = self.twin.surface.triangles, len(self.twin.surface.vertices_mm)
        if decided.start is None:
            return closed_form(shown, *mesh)
        n, q, gamma = decided.start
        return start_at(shown, *mesh, n, q, gamma)

    def _decided(self, pixels: _Pixels, shown: Samples, start: Start, near_mm: Guides) -> Decided:
        """The effects that photos which look as ``shown`` tell; guides are sought first ``near_mm``. Glints
        are looked for beside what is decided without them."""

        def glints() -> Glints:
            return Glints.of(shown[pixels.smooth], self.twin.surface, start)

        late, telling = self.pace.light_is_over, shown[pixels.telling]
        with one_core(), ThreadPoolExecutor(1) as beside:
            if self.states.get("offset") != "off":
                glints = beside.submit(glints).result
            return decide(telling, self.twin, self.caster, glints, self.states, late, near_mm)

    def detail(self, lighted: _Lighted, samples: Samples) -> tuple[State, np.ndarray, Remains | None]:
        """The state with finer features on top, normals [V, 3] tilted as the photos show, and what is left of
        the photos (None without time for detail); light, response and the coarse features stay."""
        surface, pace, relighting = self.twin.surface, self.pace, lighted.relighting
        coarse, normals = lighted.found.state, surface.normals
        at_vertices = coarse.mean + coarse.operator.at(surface.vertices_mm, coarse.table)
        finer = self._finer(samples, lighted.cost)
        if finer is None:
            return State(None, at_vertices, None, coarse.shared), normals, None
        operator, samples = finer
        relighting.keep_light()
        unit, mesh = unit_mm(surface), surface.triangles
        solver = GaussNewton(samples, mesh, operator, unit, device=self.device)
        table = torch.zeros(operator.forward_csr.shape[1], 4)
        state = without = State(operator, at_vertices, table, coarse.shared, solver.pattern.told)
        step_s = 0.0
        for number in range(pace.plan.steps):
            if number and pace.left(ITERATIONS) <= step_s / 2:
                break
            before = pace.stopwatch.total
            relighting(solver, state)
            state = solver.step(state, joint=False).state
            step_s = pace.stopwatch.total - before
            pace.report("find the detail", number + 1, pace.plan.steps)
        tilter = Tilter(solver, state, relighting.effects)
        for number in range(pace.plan.tilts):
            if pace.left(ITERATIONS) <= step_s / 2:
                break
            normals = tilter.tilted(normals)
            pace.report("tilt the normals", number + 1, pace.plan.tilts)
        remains = Remains.of(solver.noise(state), *solver.tried(state), solver.tried(without)[1])
        return state, normals, remains

    def _finer(self, samples: Samples, cost: Cost) -> tuple[HashOperator, Samples] | None:
        """Features as fine as the mesh, since finer ones would say nothing that a vertex can hold, and the
        samples that there is time for; None where there is none for either.

        Where there is no time for hash features, each vertex has a value of its own: those lack only what
        vertices learn from others.
        """
        grid, points_mm = self._grid, self.twin.surface.vertices_mm
        if grid.finest_mm > grid.coarsest_mm or not self.pace.plan.steps or self.pace.out_of_time():
            return None
        least_s, left_s = cost.least_s(self._weights), self.pace.left(ITERATIONS)
        if self.pace.hurried:
            sums_s = SUMS * (left_s - least_s if left_s > 2 * least_s else left_s)
            fewest = LEAST_A_VERTEX * np.count_nonzero(self.twin.surface.seen_by)
            count = max(fewest, int(cost.pixels * sums_s / cost.sums_s))
            samples = samples.thinned(count, np.random.default_rng(len(samples)))
        if left_s > 2 * least_s:
            return HashOperator.of(points_mm, grid), samples
        return HashOperator.each(len(points_mm), grid.finest_mm), samples

    @property
    def _grid(self) -> HashGrid:
        """The cells of detail."""
        surface = self.twin.surface
        finest_mm = self.pace.plan.detail * median_edge_mm(surface)
        return HashGrid(unit_mm(surface) * DETAIL_COARSEST_MM, finest_mm, DETAIL_GROWTH)

    @property
    def _weights(self) -> int:
        """How many weights hash features as fine as the mesh have."""
        return len(self.twin.surface.vertices_mm) * len(self._grid.cells_mm)

    def beyond(self, model: Model, samples: Samples) -> tuple[Found, list[Effect], dict[str, Decision]]:
        """What highlights show beyond the model, as far as there is time: the film, effects that are on, and
        why each is on or off."""
        pace, specular = self.pace, "specular" in model.relighting.effects
        film, sparkles, glares = (
            self.states.get(name, "auto") if specular else "off" for name in ("film", "sparkle", "bloom")
        )
        wet = Found(unjudged(film), model)
        glitter, glare = (None, unjudged(sparkles)), (None, unjudged(glares))
        with pace.stopwatch.stage("film"):
            if not pace.out_of_time():
                wet = found_film(model, samples, film, pace.report)
        with pace.stopwatch.stage("sparkle"):
            if not pace.out_of_time():
                glitter = sparkle(wet, samples.views, sparkles, pace.report)
        with pace.stopwatch.stage("bloom"):
            if not pace.out_of_time():
                glare = bloom(wet, samples, glares, pace.report)
        found = [each for each in (wet.effect, glitter[0], glare[0]) if each is not None]
        return wet, found, {"film": wet.decision, "sparkle": glitter[1], "bloom": glare[1]}


def _without_bounce(decision: Decision) -> Decision:
    return replace(decision, reason=f"{decision.reason}; but the fit finds none of it: strength 0")


def _smooth(samples: Samples, surface: Surface) -> np.ndarray:
    """Bool [N]: samples off the creases of the surface."""
    smooth = surface.normal_agreement() > np.cos(np.radians(CERTAIN_NORMAL_DEG))
    return smooth[samples.triangle.numpy()]


def median_edge_mm(surface: Surface) -> float:
    """Median edge length of (at most 100,000 of) the triangles."""
    chosen = surface.triangles[:: max(1, len(surface.triangles) // 100_000)]
    corners = surface.vertices_mm[chosen]
    return float(np.median(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)))


def _fitted(
    twin: Twin, state: State, effects: Effects, decisions: Mapping[str, Decision], film: Film | None
) -> Twin:
    """Materials of the state, with the scale that light and albedo share fixed by ALBEDO_TOP, or by the
    bounce.

    Metallic is 0: with a white specular lobe it only scales the base colour, so photos cannot tell the two
    apart, and the published penalty λm|m| is least at 0.
    """
    materials = state.materials.numpy()
    seen = twin.surface.seen_by > 0
    brightest = materials[seen if seen.any() else slice(None), :3].max(axis=1)
    scale = float(ALBEDO_TOP / np.percentile(brightest, 98))
    if effects.bounce > 0:
        scale = math.exp(state.shared.log_scale)
    light, coat, tone = state.shared.light, state.shared.coat, state.shared.tone
    if state.shared.vignettes:
        effects = effects.including(replace(effects["vignetting"], k2=state.shared.k2))
    if coat is not None:
        effects = effects.including(replace(coat, weight=coat.weight * scale))
    if tone is not None:
        effects = effects.including(tone)
    if (glitter := effects.get("sparkle")) is not None:
        effects = effects.including(replace(glitter, weight=glitter.weight * scale))
    return replace(
        twin,
        materials=Materials(
            base_color=np.clip(materials[:, :3] * scale, 0, 1),
            roughness=np.ascontiguousarray(materials[:, 3]),
            metallic=np.zeros(len(materials), np.float32),
            f0=state.shared.f0 * scale,
            film=None if film is None else replace(film, weight=film.weight * np.float32(scale)),
        ),
        light=Light(light.L0 / scale, light.n, light.q),
        response=Response(state.shared.gamma),
        effects=effects,
        decisions=dict(decisions),
    )
