"""Training pixels under the effects that are on: guides and shadows, profile, exposure, bounced light."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from endotwin.effects import Effects
from endotwin.fit.gauss_newton import HUBER, GaussNewton, State
from endotwin.fit.model import Globals, at_pixels, slope_by_log_exposure
from endotwin.fit.normal_equations import Residual
from endotwin.light import shading
from endotwin.light.guides import AT_LENS, COSINE, Guided, guided, log_axis, visible_from
from endotwin.light.radiosity import Radiosity
from endotwin.pixels.samples import Bounce, Samples
from endotwin.surface.casting import Caster
from endotwin.surface.vectors import unit
from endotwin.twin import Twin

LIGHT_STEP = 0.05
"""Step of the finite differences of the bounced light, in n, q and the logarithm of all albedo."""


def lit(samples: Samples, twin: Twin, caster: Caster, effects: Effects) -> Samples:
    """``samples`` as the effects light and expose them, all but interreflection."""
    if effects.guides_mm is not None:
        samples = replace(samples, guides=_guided(samples, twin, caster, effects))
    elif effects.profile != COSINE:
        axis = torch.from_numpy(log_axis(samples.log_cos_axis.exp().numpy(), effects.profile))
        samples = replace(samples, log_cos_axis=axis)
    if "gain" in effects or "vignetting" in effects:
        samples = exposed(samples, twin, effects)
    return samples


def exposed(samples: Samples, twin: Twin, effects: Effects) -> Samples:
    """``samples`` with the gain and vignetting of ``effects``."""
    return replace(samples, log_exposure=_log_exposure(samples, twin, effects))


def _log_exposure(samples: Samples, twin: Twin, effects: Effects) -> Tensor:
    exposure = np.ones(len(samples), np.float32)
    if "gain" in effects:
        exposure *= effects["gain"].of(samples.frame.numpy())
    if "vignetting" in effects:
        exposure *= effects["vignetting"].transmission(twin.camera, samples.pixel.numpy())
    return torch.from_numpy(np.log(exposure))


def _guided(samples: Samples, twin: Twin, caster: Caster, effects: Effects) -> Guided:
    """How the guides light the samples, frame by frame."""
    surface, guides_mm = twin.surface, np.asarray(effects.guides_mm, np.float32)
    directions = twin.camera.pixel_directions.reshape(-1, 3)
    poses = twin.source.open().T_world_camera
    frame = samples.frame.numpy()
    order = np.argsort(frame, kind="stable")
    found = {
        name: np.empty((len(samples), len(guides_mm)), np.float32) for name in Guided.__dataclass_fields__
    }
    for rows in np.split(order, np.flatnonzero(np.diff(frame[order])) + 1):
        part = samples[torch.from_numpy(rows)]
        pose = poses[int(frame[rows[0]])]
        points_mm = directions[part.pixel.numpy()] * part.log_distance.exp().numpy()[:, None]
        corners = surface.normals[surface.triangles[part.triangle.numpy()]]
        normals = np.einsum("nk,nka->na", part.barycentric.numpy(), corners)
        normals = unit(normals @ pose[:3, :3].astype(np.float32))
        visible = None
        if "shadows" in effects:
            visible = visible_from(caster, surface.to_local(pose), points_mm, guides_mm)
        for name, value in vars(guided(points_mm, normals, guides_mm, effects.profile, visible)).items():
            found[name][rows] = value.numpy()
    return Guided(**{name: torch.from_numpy(value) for name, value in found.items()})


class Relighting:
    """What of the light depends on the materials, renewed as the fit finds them."""

    def __init__(self, twin: Twin, caster: Caster, effects: Effects, frames: np.ndarray):
        self.effects = effects
        self._twin = twin
        self._bouncer = Bouncer(twin, caster, effects, frames) if effects.bounce else None

    @property
    def bounces(self) -> bool:
        return self._bouncer is not None

    @property
    def needed(self) -> bool:
        return self.bounces or "gain" in self.effects

    def without_bounce(self, solver: GaussNewton, state: State) -> State:
        """From here on no light bounces: the photos show none. ``state`` as if there had never been any."""
        self._bouncer = None
        self.effects = self.effects.including(replace(self.effects["interreflection"], strength=0.0))
        solver.relight(replace(solver.samples, bounce=None))
        return replace(state, shared=state.shared.without_scale())

    def __call__(self, solver: GaussNewton, state: State) -> None:
        """Relight the samples of ``solver`` as ``state`` says."""
        samples, materials = solver.samples, state.materials
        if self.bounces:
            roughness = at_pixels(samples, solver.triangles, materials[:, 3:])[:, 0]
            per_triangle = materials[solver.triangles].mean(dim=1)
            samples = self._bouncer.bounced(samples, roughness, per_triangle, state.shared)
        if "gain" in self.effects and state.table is not None and bool(state.table.any()):
            width = HUBER * solver.noise(state)
            material = at_pixels(samples, solver.triangles, materials)
            self.effects = regained(samples, material, state.shared, self.effects, width)
            samples = exposed(samples, self._twin, self.effects)
        if self.needed:
            solver.relight(samples)


class Bouncer:
    """Interreflection of the training frames, renewed from the albedo and the light that the fit has
    found."""

    def __init__(self, twin: Twin, caster: Caster, effects: Effects, frames: np.ndarray):
        surface = twin.surface
        self._surface, self._frames = surface, frames
        self._radiosity = Radiosity(surface, caster, effects["interreflection"].cell_mm)
        poses = twin.source.open().T_world_camera
        guides = effects.guides_mm or AT_LENS
        self._lamps = [
            [
                self._radiosity.lamp(surface.to_local(poses[int(frame)]), np.asarray(guide), effects.profile)
                for guide in guides
            ]
            for frame in frames
        ]
        weights = self._radiosity.to_vertex
        self._nearest = weights.indices.reshape(len(surface.vertices_mm), -1)
        self._weight = weights.data.reshape(len(surface.vertices_mm), -1)

    def bounced(self, samples: Samples, roughness: Tensor, per_triangle: Tensor, shared: Globals) -> Samples:
        """``samples``, whose ``roughness`` is [N], with the bounce under materials ``per_triangle`` [F, 4]
        and the light of ``shared``."""
        _, n, q = shared.log_light
        scale, f0 = shared.log_scale, shared.f0 * math.exp(shared.log_scale)
        base_color = self._radiosity.mean(per_triangle[:, :3].numpy())
        glossy = self._radiosity.mean(shading.specular_albedo(per_triangle[:, 3], f0).numpy()[:, None])
        corner = samples.barycentric.argmax(dim=1).numpy()
        vertex = self._surface.triangles[samples.triangle.numpy(), corner]
        frame = np.searchsorted(self._frames, samples.frame.numpy())
        nearest, weight = self._nearest[vertex], self._weight[vertex]

        def log_irradiance(n: float, q: float, scale: float) -> np.ndarray:
            direct = np.stack(
                [self._radiosity.direct(lamps, n, q).mean(axis=1) for lamps in self._lamps], axis=1
            )
            patch = self._radiosity.indirect(direct, np.exp(scale) * base_color + glossy)
            at_pixels = np.zeros((len(vertex), 3), np.float32)
            for k in range(nearest.shape[1]):
                at_pixels += weight[:, k, None] * patch[nearest[:, k], frame]
            return np.log(np.maximum(at_pixels, 1e-30))

        here = log_irradiance(n, q, scale)
        moved = ((n + LIGHT_STEP, q, scale), (n, q + LIGHT_STEP, scale), (n, q, scale + LIGHT_STEP))
        slopes = [(log_irradiance(*at) - here).mean(axis=1) / LIGHT_STEP for at in moved]
        level = here - (n * slopes[0] + q * slopes[1] + scale * slopes[2])[:, None]
        columns = [torch.from_numpy(np.ascontiguousarray(x, np.float32)) for x in (level, *slopes)]
        gloss = shading.specular_of_even_light(samples.cos, roughness, f0) * math.exp(-scale)
        return replace(samples, bounce=Bounce(*columns, gloss))


def regained(samples: Samples, material: Tensor, shared: Globals, effects: Effects, width: float) -> Effects:
    """``effects`` with each frame's gain moved to where its residual is least to first order.

    Args:
        material: [N, 4] of the samples. width: of the robust loss, in display values.
    """
    gain = effects["gain"]
    predicted, slope = slope_by_log_exposure(samples, material, shared)
    residual = Residual.of(samples, predicted, width)
    frame = np.searchsorted(gain.frames, samples.frame.numpy())
    pull, normal = (
        np.bincount(frame, (residual.weight * slope * other).sum(dim=1).numpy(), len(gain.frames))
        for other in (residual.error, slope)
    )
    log_gain = np.asarray(gain.log_gain) + pull / np.maximum(normal, 1e-12)
    return effects.including(replace(gain, log_gain=tuple(map(float, log_gain - log_gain.mean()))))
