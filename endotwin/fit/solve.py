"""The method ``twin``: a closed-form start, then Gauss–Newton from coarse features to fine ones.

Light and response are found on coarse features, from the pixels that can tell them: where the surface's
normal is certain and the photo is not clipped. The fine features then only have to explain what is left,
from all pixels.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch

from endotwin.errors import SequenceError
from endotwin.fit.gauss_newton import ROUGHNESS_MEAN, GaussNewton, State, roughness_to_raw
from endotwin.fit.model import Globals
from endotwin.fit.samples import Samples, gather
from endotwin.fit.start import ALBEDO_TOP, BRIGHT, Start, closed_form
from endotwin.hashgrid import HashGrid, HashOperator
from endotwin.shading import F0_DIELECTRIC
from endotwin.stopwatch import Stopwatch
from endotwin.surface import Surface
from endotwin.twin import Light, Materials, Response, Twin

logger = logging.getLogger("endotwin")

Progress = Callable[[str, int, int], None]

LIGHT_CELL_MM = 1.6
LIGHT_GRID = HashGrid(coarsest_mm=12.0, finest_mm=LIGHT_CELL_MM)
"""The features beside which light and response are found."""

LIGHT_PIXELS, LIGHT_STEPS = 400_000, 4
DETAIL_EDGES = 1.0
"""Edge of the finest hash cell in mesh edges: finer features would say nothing that a vertex can hold."""

DETAIL_GROWTH = 1.6
DETAIL_COARSEST_MM = 2.56
"""Coarsest cell that detail may correct: the light's pixels leave out the creases."""

DETAIL_PIXELS, DETAIL_STEPS = 4_000_000, 2
PROXIES = 4
"""Vertices are merged to so many points a finest cell while only coarse features are fitted."""

CERTAIN_NORMAL_DEG = 5.0
"""A triangle whose vertex normals differ by more bends too much for its normal to be certain."""

CONVERGED = 2e-4
"""A step that lowers the cost by a smaller share than this is the last."""


@dataclass(frozen=True)
class _Clock:
    """Clock and reporting of one fit."""

    stopwatch: Stopwatch
    budget_s: float | None
    report: Progress | None

    def allows(self, seconds: float) -> bool:
        """Whether so many seconds more stay within the budget."""
        return self.budget_s is None or self.stopwatch.total + seconds <= self.budget_s


def fit_twin(twin: Twin, budget_s: float | None, seed: int, progress: Progress | None = None) -> Twin:
    """Fit as the module says. ``budget_s`` bounds the seconds: steps that would pass it are left out.

    Raises:
        SequenceError: the training photos show nothing of the surface.
    """
    stopwatch = Stopwatch()
    clock = _Clock(stopwatch, budget_s, progress)
    surface = twin.surface
    with stopwatch.stage("gather"):
        samples = gather(twin, DETAIL_PIXELS, seed, progress)
    if not len(samples):
        raise SequenceError(
            f"the training photos of {twin.source.path} show nothing of the surface; "
            "check that poses and depth fit it"
        )
    with stopwatch.stage("start"):
        telling = samples[torch.from_numpy(np.flatnonzero(_telling(samples, surface)))]
        telling = telling if len(telling) else samples
        start = closed_form(telling, surface.triangles, len(surface.vertices_mm))
    if start.undetermined:
        logger.warning("the photos cannot tell %s: kept at the prior", " and ".join(start.undetermined))
    with stopwatch.stage("light"):
        state, step_s = _find_light(
            telling.thinned(LIGHT_PIXELS, np.random.default_rng(seed)), surface, start, clock
        )
    with stopwatch.stage("detail"):
        state = _find_detail(samples, surface, state, step_s, clock)
    return _fitted(twin, state).with_record(
        fit={"method": "twin", "undetermined": list(start.undetermined), **stopwatch.to_dict()}
    )


def _telling(samples: Samples, surface: Surface) -> np.ndarray:
    """Bool [N]: samples off the creases of the surface and below saturation."""
    smooth = surface.normal_agreement() > np.cos(np.radians(CERTAIN_NORMAL_DEG))
    return smooth[samples.triangle.numpy()] & (samples.color.numpy().max(axis=1) < BRIGHT)


def _find_light(samples: Samples, surface: Surface, start: Start, clock: _Clock) -> tuple[State, float]:
    """Light, response, f0 and coarse materials; and the seconds that a step without the light takes."""
    points, group = proxies(surface.vertices_mm, LIGHT_CELL_MM / PROXIES)
    operator = HashOperator.of(points, LIGHT_GRID)
    solver = GaussNewton(samples, group[surface.triangles], operator)
    shown = torch.from_numpy(start.base_color) ** start.response.gamma
    mean = torch.cat([shown.median(dim=0).values, torch.tensor([roughness_to_raw(ROUGHNESS_MEAN)])])
    table = torch.zeros(operator.forward_csr.shape[1], 4)
    state = State(operator, mean, table, Globals.of(start.light, start.response, F0_DIELECTRIC))
    before = clock.stopwatch.total
    state, _ = solver.step(state, joint=False)
    step_s = clock.stopwatch.total - before
    for number in range(LIGHT_STEPS):
        if not clock.allows(2 * step_s):
            break
        state, gain = solver.step(state)
        if clock.report:
            clock.report("find the light", number + 1, LIGHT_STEPS)
        if gain < CONVERGED * solver.cost(state, solver.noise(state)):
            break
    return state, step_s * len(surface.vertices_mm) / len(points)


def _find_detail(samples: Samples, surface: Surface, state: State, step_s: float, clock: _Clock) -> State:
    """The state with finer features on top, as fine as the mesh; light, response and the coarse features
    stay.
    """
    finest_mm = DETAIL_EDGES * median_edge_mm(surface)
    if finest_mm > DETAIL_COARSEST_MM:
        return _at_vertices(state, surface)
    operator = HashOperator.of(surface.vertices_mm, HashGrid(DETAIL_COARSEST_MM, finest_mm, DETAIL_GROWTH))
    table = torch.zeros(operator.forward_csr.shape[1], 4)
    state = State(operator, _at_vertices(state, surface).raw, table, state.shared)
    step_s = step_s + 2e-6 * len(samples)
    if not clock.allows(step_s):
        return state
    solver = GaussNewton(samples, surface.triangles, operator)
    for number in range(DETAIL_STEPS):
        if not clock.allows(step_s):
            break
        before = clock.stopwatch.total
        state, _ = solver.step(state, joint=False)
        step_s = clock.stopwatch.total - before
        if clock.report:
            clock.report("find the detail", number + 1, DETAIL_STEPS)
    return state


def _at_vertices(state: State, surface: Surface) -> State:
    """The state of the coarse features, at the vertices rather than at their proxies."""
    operator = HashOperator.of(surface.vertices_mm, LIGHT_GRID)
    return replace(state, operator=operator, table=operator.adopt(state.table, state.operator))


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


def _fitted(twin: Twin, state: State) -> Twin:
    """Materials of the state, with the scale that light and albedo share fixed by ALBEDO_TOP.

    Metallic is 0: with a white specular lobe it only scales the base colour, so photos cannot tell the two
    apart, and
    the published penalty λm|m| is least at 0.
    """
    materials = state.materials.numpy()
    seen = twin.surface.seen_by > 0
    brightest = materials[seen if seen.any() else slice(None), :3].max(axis=1)
    scale = float(ALBEDO_TOP / np.percentile(brightest, 98))
    light = state.shared.light
    return replace(
        twin,
        materials=Materials(
            base_color=np.clip(materials[:, :3] * scale, 0, 1),
            roughness=np.ascontiguousarray(materials[:, 3]),
            metallic=np.zeros(len(materials), np.float32),
            f0=state.shared.f0 * scale,
        ),
        light=Light(light.L0 / scale, light.n, light.q),
        response=Response(state.shared.gamma),
    )
