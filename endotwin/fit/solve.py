"""The method ``twin``: a closed-form start, then Gauss–Newton from coarse features to fine ones.

Light and response are found on coarse features, from the pixels that can tell them: where the surface's
normal is certain and the photo is not clipped. The fine features then only have to explain what is left,
from all pixels.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch

from endotwin.effects import Decision, Effects
from endotwin.errors import SequenceError
from endotwin.evidence.coat import judged as judged_coat
from endotwin.evidence.decide import decide
from endotwin.evidence.glints import Glints
from endotwin.fit.film import Found, Model
from endotwin.fit.gauss_newton import (
    CPU,
    GaussNewton,
    State,
    as_bouncing,
    halfway,
    roughness_to_raw,
    too_dark,
    unusual,
    without_furnace,
)
from endotwin.fit.hashgrid import HashGrid, HashOperator
from endotwin.fit.lighting import Relighting, lit
from endotwin.fit.model import Globals, at_pixels
from endotwin.fit.sparkle import sparkle
from endotwin.fit.tilt import Tilter
from endotwin.fit.unexplained import residual_warning
from endotwin.fit.within import Renewed, Varied, Within
from endotwin.light.film import Film
from endotwin.light.shading import F0_DIELECTRIC, ROUGHNESS_TISSUE
from endotwin.pixels.length_unit import unit_mm
from endotwin.pixels.pace import ITERATIONS, LIGHT, Pace
from endotwin.pixels.samples import Samples, Views, drawn, gather
from endotwin.pixels.start import ALBEDO_TOP, BRIGHT, Start, closed_form, start_at
from endotwin.run.threads import THREADS
from endotwin.surface import Surface
from endotwin.surface.casting import Caster
from endotwin.twin import Light, Materials, Response, Twin

logger = logging.getLogger("endotwin")

Price = Callable[[Twin, Caster, Views], Twin]

LIGHT_CELL_MM = 1.6
LIGHT_COARSEST_MM = 12.0
"""Cells of the features beside which light and response are found, in units of the scene."""

LIGHT_PIXELS, LIGHT_STEPS = 400_000, 6
HOLD_STEPS, BOUNCE_STEPS = 1, 10
"""Steps where light is bounced, and depends on the materials; before HOLD_STEPS the albedo's scale is
held."""

SETTLING = 2
"""Steps of the materials under a light that was found beside a bounce."""

WORSE, HALVINGS = 1.25, 2
"""A step under whose light the photos cost so many times what they did is too long, and halved so often."""

BOUNCE_HELD = ("q", "L0")
"""Where light bounces, q stays where the fit starts, at the inverse square of a small light: what the bounce
off a mesh errs by would bend it, and γ with it. L0 is told by the albedo's scale."""

COAT_STEP, BOUNCE_COAT_STEP = 2, 4
"""A coat that nobody asked for is judged when light and materials are near."""

LIGHT_SHARE = 0.25
"""Of fewer pixels than it takes to find LIGHT_PIXELS, this share."""

DETAIL_GROWTH = 1.6
DETAIL_COARSEST_MM = 2.56
"""Coarsest cell that detail may correct: the light's pixels leave out the creases."""

ASSEMBLY = 0.4
"""Share of the time left for the detail that summing over its pixels may take."""

PROXIES = 4
"""Vertices are merged to so many points a finest cell while only coarse features are fitted."""

CERTAIN_NORMAL_DEG = 5.0
"""A triangle whose vertex normals differ by more bends too much for its normal to be certain."""

CONVERGED = 2e-4
"""A step that changes the cost by a smaller share than this is the last."""


@dataclass(frozen=True)
class _Cost:
    """What the light's stage took, from which to tell what the detail's will.

    Attributes:
        setup_s, step_s: seconds of the operator and the solver, and of a step without the light.
        weights: hash weights of its points. pixels: samples that the step summed over.
    """

    setup_s: float
    step_s: float
    weights: int
    pixels: int


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
        smooth, clipped = _smooth(samples, surface), samples.color.amax(dim=1).numpy() >= BRIGHT
        telling = np.flatnonzero(smooth & ~clipped)
        if not len(telling):
            telling = np.arange(len(samples))
            if int(samples.color.amax(dim=1).min()) >= BRIGHT:
                logger.warning(
                    "no training photo of %s has an unclipped pixel: its light and materials are guesses",
                    twin.source.path,
                )
        every = torch.from_numpy(telling)
        telling = every[drawn(len(every), pace.start_pixels, np.random.default_rng(seed))]
        start = closed_form(samples[telling], surface.triangles, len(surface.vertices_mm))
    if start.undetermined:
        logger.warning("the photos cannot tell %s: kept at the prior", " and ".join(start.undetermined))
    with stopwatch.stage("effects"):
        caster = caster.threaded(THREADS)

        def glints() -> Glints:
            return Glints.of(samples[torch.from_numpy(smooth)], surface, start)

        decided = decide(samples[every], twin, caster, glints, states, pace.light_is_over)
        relighting = Relighting(surface, caster, decided.effects, samples.views)
        if decided.light is not None:
            start = start_at(
                samples[telling],
                surface.triangles,
                len(surface.vertices_mm),
                decided.light,
                decided.gamma,
            )
        samples = lit(samples, surface, caster, relighting.effects)
    with stopwatch.stage("light"):
        wanted = states.get("coat", "auto") if "specular" in decided.effects else "off"
        count = min(LIGHT_PIXELS, int(LIGHT_SHARE * pace.start_pixels))
        rows = telling[torch.from_numpy(drawn(len(telling), count, np.random.default_rng(seed)))]
        white = np.flatnonzero(smooth & clipped)
        count = len(white) * len(rows) // len(every)
        white = white[drawn(len(white), count, np.random.default_rng(seed))]
        parts = samples[rows], samples[torch.from_numpy(white)]
        state, cost, coat = _find_light(*parts, surface, start, pace, relighting, wanted, device)
    with stopwatch.stage("detail"):
        samples = relighting.guided(samples)
        state, normals, left = _find_detail(samples, twin, state, cost, pace, relighting, device)
        twin = replace(twin, surface=replace(surface, normals=normals))
    with stopwatch.stage("film"):
        wanted = states.get("film", "auto") if "specular" in decided.effects else "off"
        wet, model = Found(Decision("off", "no time to judge")), Model(twin, state, relighting, caster)
        if not pace.out_of_time():
            wet = model.film(samples, wanted, pace.report)
    with stopwatch.stage("sparkle"):
        wanted = states.get("sparkle", "auto") if "specular" in decided.effects else "off"
        glitter, counted = None, Decision("off", "no time to judge")
        if not pace.out_of_time():
            glitter, counted = sparkle(model, wet, samples.views, wanted, pace.report)
    odd = unusual(state.shared)
    if odd:
        logger.warning(
            "the fit ended at %s, as it does on wrong poses, depth or photos, or without an effect that they "
            "show: do not trust it; 'endotwin check %s' looks for the cause",
            *(" and ".join(odd), twin.source.path),
        )
    with stopwatch.stage("price"):
        decisions = {**decided.decisions, "coat": coat, "film": wet.decision, "sparkle": counted}
        if "interreflection" in decided.effects and not relighting.bounces:
            decisions["interreflection"] = _without_bounce(decisions["interreflection"])
        if left is not None and (said := residual_warning(left, twin.sequence(), decisions)):
            logger.warning("%s; 'endotwin check %s' looks for the cause", said, twin.source.path)
        effects = relighting.effects
        for effect in filter(None, (wet.effect, glitter)):
            effects = effects.including(effect)
        fitted = price(_fitted(twin, state, effects, decisions, wet.film), caster, samples.views)
    return fitted.with_record(
        fit={"method": "twin", "undetermined": list(start.undetermined), **stopwatch.to_dict()}
    )


def _without_bounce(decision: Decision) -> Decision:
    return replace(decision, reason=f"{decision.reason}; but the fit finds none of it: strength 0")


def _smooth(samples: Samples, surface: Surface) -> np.ndarray:
    """Bool [N]: samples off the creases of the surface."""
    smooth = surface.normal_agreement() > np.cos(np.radians(CERTAIN_NORMAL_DEG))
    return smooth[samples.triangle.numpy()]


def _find_light(
    samples: Samples,
    clipped: Samples,
    surface: Surface,
    start: Start,
    pace: Pace,
    relighting: Relighting,
    coat: str,
    device: torch.device,
) -> tuple[State, _Cost, Decision]:
    """Light, response, f0 and coarse materials; what they cost; and whether there is a coat, which is auto,
    on or off, and held against the ``clipped`` samples, too."""
    unit = unit_mm(surface)
    points, group = proxies(surface.vertices_mm, unit * LIGHT_CELL_MM / PROXIES)
    began = pace.stopwatch.total
    operator = HashOperator.of(points, _light_grid(unit))
    solver = GaussNewton(
        samples,
        group[surface.triangles],
        operator,
        unit,
        out_of_time=pace.light_is_over,
        device=device,
    )
    shown = torch.from_numpy(start.base_color) ** start.response.gamma
    mean = torch.cat([shown.median(dim=0).values, torch.tensor([roughness_to_raw(ROUGHNESS_TISSUE)])])
    table = torch.zeros(operator.forward_csr.shape[1], 4)
    effects = relighting.effects
    options = {"specular": "specular" in effects, "bounce": relighting.bounces}
    shared = Globals.of(start.light, start.response, F0_DIELECTRIC, **options)
    state = State(operator, mean, table, shared)
    relighting(solver, state)
    ready = pace.stopwatch.total
    state, _ = _stepped(solver, state, relighting, joint=False)
    step_s = pace.stopwatch.total - ready
    number, steps, coat_step = 0, LIGHT_STEPS, COAT_STEP
    if relighting.bounces:
        steps, coat_step = BOUNCE_STEPS, BOUNCE_COAT_STEP
    judged = best = None
    while number < steps:
        late = pace.left(LIGHT) <= 2 * step_s
        if late and (relighting.bounces or number):
            break
        within = Within.of(solver.samples, surface, unit)
        material = at_pixels(solver.samples, solver.triangles, state.materials)
        shared, noise = state.shared, solver.noise(state)
        if number == (0 if coat == "on" else coat_step):
            under = relighting.relit(relighting.guided(clipped), solver.triangles, state)
            shiny = Samples.joined([solver.samples, under], solver.samples.views)
            seen = Within.of(shiny, surface, unit)
            seen_material = at_pixels(shiny, solver.triangles, state.materials)
            layer, judged = judged_coat(seen.highlights(seen_material, shared, noise), coat)
            shared = replace(shared, coat=layer)
        if relighting.bounces:
            solver.held = (*start.undetermined, *BOUNCE_HELD, *(("albedo scale",) * (number < HOLD_STEPS)))
            found = within.shone(material, shared, noise) if shared.coat else Renewed(shared)
        else:
            found = within.renewed(material, shared, start.undetermined, noise, relighting.varied)
            relighting.vary(solver, found)
        mean = state.mean + torch.tensor([0.0, 0.0, 0.0, found.roughness])
        state = replace(state, shared=found.shared, mean=mean)
        if late:
            break
        state, gain = _stepped(solver, state, relighting, joint=relighting.bounces)
        number += 1
        if relighting.bounces and too_dark(state):
            state, steps = relighting.without_bounce(solver, state), number + LIGHT_STEPS
        elif relighting.bounces and number > coat_step:
            best = _better(best, solver, state, relighting.effects)
        pace.report("find the light", number, steps)
        if abs(gain) < CONVERGED * solver.cost(state, solver.noise(state)):
            number = max(number, coat_step) if judged is None else steps
    if relighting.bounces and best is not None:
        held = (*start.undetermined, *BOUNCE_HELD, "albedo scale")
        best = _by_what_varies(best, held, solver, surface, relighting, pace)
        state, relighting.effects = best.state, best.effects
        relighting(solver, state)
    cost = _Cost(ready - began, step_s, len(points) * len(operator.cells_mm), len(samples))
    return state, cost, judged or Decision("off", "no time to judge")


@dataclass(frozen=True)
class _Best:
    """A ``state``, with the ``effects`` that were found with it, that costs least under its own light, by the
    ``noise`` at which others are held to it."""

    state: State
    effects: Effects
    cost: float
    noise: float


def _better(best: _Best | None, solver: GaussNewton, state: State, effects: Effects) -> _Best:
    """``state``, by which the samples of ``solver`` are lit, or the ``best`` so far if that costs less."""
    noise = solver.noise(state) if best is None else best.noise
    cost = solver.cost(state, noise)
    return best if best is not None and best.cost <= cost else _Best(state, effects, cost, noise)


def _by_what_varies(
    best: _Best,
    held: tuple[str, ...],
    solver: GaussNewton,
    surface: Surface,
    relighting: Relighting,
    pace: Pace,
) -> _Best:
    """Light and response by what varies within vertices, beside a bounce of the strength that was found with
    coarse albedo, for as long as all pixels say that it is better: coarse albedo bends γ, and what a video
    processor does to colours bends what varies."""
    varied = Varied(relighting.varied.frames)
    relighting.effects = best.effects
    relighting(solver, best.state)
    for _ in range(LIGHT_STEPS):
        if pace.light_is_over():
            break
        material = at_pixels(solver.samples, solver.triangles, best.state.materials)
        within = Within.of(solver.samples, surface, unit_mm(surface))
        found = within.renewed(material, best.state.shared, held, best.noise, varied)
        relighting.brighten(solver, found.log_gain)
        state = replace(best.state, shared=found.shared)
        for _ in range(SETTLING):
            state, _ = _stepped(solver, state, relighting, joint=False)
        newer = _better(best, solver, state, relighting.effects)
        if newer is best:
            break
        best = newer
    return best


def _stepped(solver: GaussNewton, state: State, relighting: Relighting, joint: bool) -> tuple[State, float]:
    """A step of ``solver``, of the materials alone where a ``joint`` one finds nothing lower, with the
    samples relit by what it has found; and by how much the cost fell (below 0: it rose).

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
    if not joint:
        moved = as_bouncing(moved, state)
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


def _find_detail(
    samples: Samples,
    twin: Twin,
    state: State,
    cost: _Cost,
    pace: Pace,
    relighting: Relighting,
    device: torch.device,
) -> tuple[State, np.ndarray, float | None]:
    """The state with finer features on top, normals [V, 3] tilted as the photos show, and what is left of the
    photos (None without time for detail); light, response and the coarse features stay.

    They are as fine as the mesh: finer ones would say nothing that a vertex can hold. Where there is no time
    for hash features, each vertex has a value of its own: those lack only what vertices learn from others.
    """
    surface = twin.surface
    unit, normals = unit_mm(surface), surface.normals
    at_vertices = state.mean + state.operator.at(surface.vertices_mm, state.table)
    state = State(None, at_vertices, None, state.shared)
    finest_mm, coarsest_mm = pace.plan.detail * median_edge_mm(surface), unit * DETAIL_COARSEST_MM
    grid = HashGrid(coarsest_mm, finest_mm, DETAIL_GROWTH)
    setup_s = cost.setup_s * len(surface.vertices_mm) * len(grid.cells_mm) / cost.weights
    left_s = pace.left(ITERATIONS)
    if finest_mm > coarsest_mm or not pace.plan.steps or left_s <= cost.step_s / 2:
        return state, normals, None
    if np.isfinite(left_s):
        assembly_s = ASSEMBLY * (left_s - setup_s if left_s > 2 * setup_s else left_s)
        count = int(cost.pixels * assembly_s / cost.step_s)
        samples = samples.thinned(count, np.random.default_rng(len(samples)))
    if left_s > 2 * setup_s:
        operator = HashOperator.of(surface.vertices_mm, grid)
    else:
        operator = HashOperator.each(len(surface.vertices_mm), finest_mm)
    state = State(operator, at_vertices, torch.zeros(operator.forward_csr.shape[1], 4), state.shared)
    solver = GaussNewton(samples, surface.triangles, operator, unit, 0, pace.out_of_time, device)
    step_s = 0.0
    for number in range(pace.plan.steps):
        if pace.left(ITERATIONS) <= step_s / 2:
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
    return state, normals, solver.noise(state)


def _light_grid(unit: float) -> HashGrid:
    return HashGrid(unit * LIGHT_COARSEST_MM, unit * LIGHT_CELL_MM)


def proxies(vertices_mm: np.ndarray, cell_mm: float) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [V, 3] merged by cells of edge ``cell_mm``: mean points float32 [P, 3], and the point of each
    vertex [V].
    """
    cells = np.floor(vertices_mm / cell_mm).astype(np.int64)
    _, group, count = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    group = group.reshape(-1)
    sums = [np.bincount(group, vertices_mm[:, axis]) for axis in range(3)]
    return (np.stack(sums, axis=1) / count[:, None]).astype(np.float32), group


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
    light, coat = state.shared.light, state.shared.coat
    if coat is not None:
        effects = effects.including(replace(coat, weight=coat.weight * scale))
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
