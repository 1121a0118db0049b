"""Training pixels under the effects that are on: guides and shadows, profile, exposure, bounced light."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from itertools import product

import numpy as np
import torch
from torch import Tensor

from endotwin.effects import Effects
from endotwin.effects.gain import Gain
from endotwin.effects.offset import Offset
from endotwin.effects.vignetting import squared_radius
from endotwin.fit.faint import NOTHING, Faint
from endotwin.fit.gauss_newton import HUBER, MOST_GAIN_STEP, GaussNewton
from endotwin.fit.model import Globals, at_pixels, slope_by_log_exposure
from endotwin.fit.normal_equations import CHUNK, Residual
from endotwin.fit.state import State
from endotwin.fit.within import Renewed, Varied
from endotwin.light.bounced import GAMMA_STEP, Albedo, BouncedLight, Places
from endotwin.light.guides import AT_LENS, COSINE, Guided, guided, log_axis, visible_in_views
from endotwin.light.radiosity import Radiosity
from endotwin.pixels.samples import Samples, Views
from endotwin.run.ahead import on_all_cores
from endotwin.surface import Surface
from endotwin.surface.casting import Caster

MOVING = ("n", "scale")
"""What a fit changes of the light that bounces: q stays."""


def lit(samples: Samples, surface: Surface, caster: Caster, effects: Effects) -> Samples:
    """``samples`` as the effects light and expose them, all but interreflection."""
    if effects.guides_mm is not None:
        samples = replace(samples, guides=_guided(samples, surface, caster, effects))
    elif effects.profile != COSINE:
        axis = torch.from_numpy(log_axis(samples.log_cos_axis.exp().numpy(), effects.profile))
        samples = replace(samples, log_cos_axis=axis)
    return exposed(samples, effects)


def exposed(samples: Samples, effects: Effects) -> Samples:
    """``samples`` with the gain of ``effects``, if there is any, and, if the lens vignettes, with where they
    lie in its picture, and what stays of that while k2 is found."""
    parts, radius2, lens = [], None, effects.get("vignetting")
    if "gain" in effects:
        parts.append(torch.from_numpy(np.log(effects["gain"].of(samples.frame.numpy()))))
    if lens is not None:
        radius2 = samples.radius2
        if radius2 is None:
            radius2 = torch.from_numpy(squared_radius(samples.views.camera, samples.pixel.numpy()))
        parts += [lens.k4 * radius2**2] * bool(lens.k4)
    return replace(samples, log_exposure=sum(parts) if parts else None, radius2=radius2)


def _guided(samples: Samples, surface: Surface, caster: Caster, effects: Effects) -> Guided:
    """How the guides light the samples."""
    guides_mm = np.asarray(effects.guides_mm, np.float32)

    def one(part: Samples) -> Guided:
        visible = _visible(part, caster, guides_mm) if "shadows" in effects else None
        return guided(part.points_mm, part.normals(surface), guides_mm, effects.profile, visible)

    parts = list(on_all_cores(one, samples.chunks(CHUNK))) or [one(samples)]
    rows = {name: [getattr(part, name).T for part in parts] for name in Guided.__dataclass_fields__}
    return Guided(**{name: torch.cat(each, dim=1).T for name, each in rows.items()})


def _visible(samples: Samples, caster: Caster, guides_mm: np.ndarray) -> np.ndarray:
    """Bool [N, K]: which of guides [K, 3] see each sample's point."""
    poses, view = samples.views.T_local_camera, samples.views.row(samples.frame)
    points_mm = np.einsum("nab,nb->na", samples.rotation, samples.points_mm)
    points_mm += poses[:, :3, 3].astype(np.float32)[view]
    return visible_in_views(caster, poses, view, points_mm, guides_mm)


def guides_aside(
    samples: Samples, surface: Surface, caster: Caster, effects: Effects, step_mm: float
) -> Iterator[tuple[Samples, Samples]]:
    """``samples`` lit by each guide moved by ``step_mm`` along x, then along y and z, and as far back."""
    guides_mm = np.asarray(effects.guides_mm, np.float32)
    visible = _visible(samples, caster, guides_mm) if "shadows" in effects else None
    normals, points_mm = samples.normals(surface), samples.points_mm

    def lit_aside(k: int, aside_mm: np.ndarray) -> Samples:
        moved_mm = guides_mm.copy()
        moved_mm[k] += aside_mm
        seen = None if visible is None else visible.copy()
        if seen is not None:
            seen[:, k] = _visible(samples, caster, moved_mm[k : k + 1])[:, 0]
        return replace(samples, guides=guided(points_mm, normals, moved_mm, effects.profile, seen))

    for k, along_mm in product(range(len(guides_mm)), step_mm * np.eye(3, dtype=np.float32)):
        yield lit_aside(k, along_mm), lit_aside(k, -along_mm)


class Relighting:
    """What of the light depends on the materials, renewed as the fit finds them.

    Of vignetting its ``effects`` say that there is some, and where the fit starts: what it has found is among
    the parameters that all pixels share.
    """

    def __init__(
        self, surface: Surface, caster: Caster, effects: Effects, views: Views, faint: Faint = NOTHING
    ):
        if "gain" in effects:
            effects = effects.including(effects["gain"].at(views.frames))
        self.effects, self.faint = effects, faint
        self._surface, self._caster = surface, caster
        self._bouncer = Bouncer(surface, caster, effects, views) if effects.bounce else None

    @property
    def bounces(self) -> bool:
        return self._bouncer is not None

    @property
    def radiosity(self) -> Radiosity | None:
        """Of the surface, where light bounces."""
        return self._bouncer and self._bouncer.radiosity

    @property
    def needed(self) -> bool:
        return self.bounces or "gain" in self.effects

    @property
    def varied(self) -> Varied:
        """What the light's steps may change beside light and response."""
        return Varied(len(self.effects["gain"].frames) if "gain" in self.effects else 0, self.faint)

    @property
    def moving(self) -> Varied:
        """What changes while guides beside the lens move."""

        def aside(samples: Samples, step_mm: float) -> Iterator[tuple[Samples, Samples]]:
            return guides_aside(samples, self._surface, self._caster, self.effects, step_mm)

        return replace(self.varied, faint=NOTHING, guides=len(self.effects.guides_mm), aside=aside)

    def vary(self, solver: GaussNewton, found: Renewed) -> None:
        """Gains and faint effects as a step has ``found`` them, and the samples of ``solver`` lit so."""
        if len(found.log_gain):
            self.effects = _brightened(self.effects, found.log_gain)
        if found.faint.any():
            self.faint = self.faint.with_more(found.faint)
        if len(found.log_gain) or found.faint.any():
            solver.relight(self.exposed(solver.samples))

    def move_guides(self, solver: GaussNewton, aside_mm: np.ndarray, state: State) -> None:
        """The guides moved by ``aside_mm`` [K, 3], none before the lens, and the samples of ``solver`` lit
        so."""
        guides_mm = np.asarray(self.effects.guides_mm) + aside_mm
        guides_mm[:, 2] = np.minimum(guides_mm[:, 2], 0)
        self._take(self.effects.including(Offset(tuple(map(tuple, guides_mm.tolist())))), solver)
        self(solver, state)

    def _take(self, effects: Effects, solver: GaussNewton) -> None:
        """``effects`` from here on, and the samples of ``solver`` as their guides light them."""
        before, self.effects = self.effects, effects
        if effects.guides_mm == before.guides_mm:
            return
        guides = _guided(solver.samples, self._surface, self._caster, effects)
        solver.relight(replace(solver.samples, guides=guides))
        if self.bounces:
            self._bouncer.light_from(effects)

    def brighten(self, solver: GaussNewton, log_gain: np.ndarray) -> None:
        """Frames brighter by ``log_gain`` [F], or as they are by [0], and the samples of ``solver`` so."""
        if len(log_gain):
            self.effects = _brightened(self.effects, log_gain)
            solver.relight(self.exposed(solver.samples))

    def expose(self, solver: GaussNewton, effects: Effects) -> None:
        """The samples of ``solver`` under ``effects``, which hold from here on, and nothing faint."""
        self._take(effects, solver)
        self.faint = NOTHING
        solver.relight(self.exposed(solver.samples))

    def exposed(self, samples: Samples) -> Samples:
        """``samples`` as ``exposed`` with the effects, and with what is faint."""
        samples = exposed(samples, self.effects)
        if not self.faint.found:
            return samples
        faint = torch.from_numpy(self.faint.log_exposure(samples)).float()
        known = samples.log_exposure
        return replace(samples, log_exposure=faint if known is None else known + faint)

    def lit(self, samples: Samples) -> Samples:
        """``samples`` under all but bounced light and what is faint, as it was found last."""
        return lit(samples, self._surface, self._caster, self.effects)

    def keep_light(self) -> None:
        """From here on light and response stay."""
        if self.bounces:
            self._bouncer.light_stays = True

    def without_bounce(self, solver: GaussNewton, state: State) -> State:
        """From here on no light bounces: the photos show none. ``state`` as if there had never been any."""
        self._bouncer = None
        self.effects = self.effects.including(replace(self.effects["interreflection"], strength=0.0))
        solver.relight(replace(solver.samples, bounce=None))
        return replace(state, shared=state.shared.without_scale())

    def bounced(self, samples: Samples, triangles: Tensor, state: State) -> Samples:
        """``samples`` with the bounce off the materials of ``state``, if light bounces; corners of the
        ``triangles`` [F, 3] are its points."""
        if not self.bounces:
            return samples
        materials = state.materials
        roughness = at_pixels(samples, triangles, materials[:, 3:])[:, 0]
        lit = self._bouncer.bounced(samples, roughness, materials, triangles, state.shared)
        tissue = (state.shared.gamma * state.mean_log_color).float().expand(len(samples), 3)
        return replace(lit, bounce=replace(lit.bounce, tissue=tissue))

    def relit(self, samples: Samples, triangles: Tensor, state: State) -> Samples:
        """``bounced``, and with the gain and what is faint as they were found last."""
        samples = self.bounced(samples, triangles, state)
        return self.exposed(samples) if "gain" in self.effects or self.faint.found else samples

    def __call__(self, solver: GaussNewton, state: State) -> None:
        """Relight the samples of ``solver`` as ``state`` says."""
        samples = self.relit(solver.samples, solver.triangles, state)
        if "gain" in self.effects and state.textured:
            solver.relight(samples)
            width = HUBER * solver.noise(state)
            material = at_pixels(samples, solver.triangles, state.materials)
            self.effects = regained(samples, material, state.shared, self.effects, width)
            samples = self.exposed(samples)
        if self.needed:
            solver.relight(samples)


class Bouncer:
    """Interreflection of the training views, renewed from the albedo and the light that the fit has found.

    Attributes:
        radiosity: of the surface. light_stays: light and response are held, so that what they change of it is
            not asked for.
    """

    def __init__(self, surface: Surface, caster: Caster, effects: Effects, views: Views):
        self._surface, self.light_stays = surface, False
        self._placed: tuple[Tensor | None, Places | None] = None, None
        self.radiosity = Radiosity(surface, caster, effects["interreflection"].cell_mm)
        self._poses = views.T_local_camera
        self.light_from(effects)

    def light_from(self, effects: Effects) -> None:
        """From here on the guides of ``effects`` throw the light that bounces."""
        guides_mm = effects.guides_mm or AT_LENS
        self._light = BouncedLight(self.radiosity, self._poses, guides_mm, effects.profile)

    def bounced(
        self, samples: Samples, roughness: Tensor, materials: Tensor, triangles: Tensor, shared: Globals
    ) -> Samples:
        """``samples``, whose ``roughness`` is [N], with the bounce under the light of ``shared`` and
        ``materials`` [V, 4] at the corners of ``triangles`` [F, 3]."""
        _, n, q = shared.log_light
        scale, lobes = shared.log_scale, shared.lobes.brighter(math.exp(shared.log_scale))

        def albedo(base_color: Tensor) -> Albedo:
            return Albedo.of(self.radiosity, base_color, materials[:, 3], lobes, triangles.numpy())

        places, base_color = self._places(samples), materials[:, :3]
        gloss = lobes.gloss(samples.cos, roughness) * torch.tensor([math.exp(-scale), 1.0])
        by, seen_by = ("scale",), None
        if not self.light_stays:
            steeper = base_color ** (shared.gamma / (shared.gamma + GAMMA_STEP))
            by, seen_by = MOVING, (shared.gamma, albedo(steeper))
        bounce = self._light.expanded(places, n, q, albedo(base_color), gloss, scale, seen_by, by)
        shown = shared.gamma * torch.log(at_pixels(samples, triangles, base_color))
        if shared.f0 > 0:
            share = lobes.f0_albedo(materials[:, 3].mean()) / (math.exp(scale) * base_color.mean(dim=0))
            by_f0 = lobes.gloss_by_f0(samples.cos, roughness)
            bounce = bounce.beside_lobe(shared.f0, scale, share, by_f0)
        return replace(samples, bounce=replace(bounce, shown=shown))

    def _places(self, samples: Samples) -> Places:
        """Where the samples lie; kept for the steps that follow, of the samples that any thread asked for
        last."""
        pixel, places = self._placed
        if pixel is not samples.pixel:
            to_vertex, triangles = self.radiosity.to_vertex, self._surface.triangles
            view = samples.views.row(samples.frame)
            places = Places(to_vertex[samples.nearest(triangles)], view)
            self._placed = samples.pixel, places
        return places


def regained(samples: Samples, material: Tensor, shared: Globals, effects: Effects, width: float) -> Effects:
    """``effects``, whose gain holds all frames of the samples' views, with each frame's gain moved to where
    its residual is least to first order.

    Args:
        material: [N, 4] of the samples. width: of the robust loss, in display values.
    """
    count = len(effects["gain"].frames)

    def one(rows: slice) -> np.ndarray:
        part = samples[rows]
        predicted, slope = slope_by_log_exposure(part, material[rows], shared)
        residual, frame = Residual.of(part, predicted, width), part.views.row(part.frame)
        terms = [(residual.weight * slope * other).sum(dim=1) for other in (residual.error, slope)]
        return np.stack([np.bincount(frame, each.numpy(), count) for each in terms])

    chunks = [slice(start, start + CHUNK) for start in range(0, len(samples), CHUNK)]
    pull, normal = sum(on_all_cores(one, chunks), np.zeros((2, count)))
    return _brightened(effects, pull / np.maximum(normal, 1e-12))


def _brightened(effects: Effects, log_gain: np.ndarray) -> Effects:
    gain, step = effects["gain"], np.clip(log_gain, -MOST_GAIN_STEP, MOST_GAIN_STEP)
    return effects.including(Gain.centred(gain.frames, np.add(gain.log_gain, step)))
