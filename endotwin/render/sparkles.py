"""The sparkles of one view: facets that mirror a light guide to the camera, as spots in its picture."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch

from endotwin.cameras.base import Camera, solid_angle
from endotwin.light import shading
from endotwin.light.film import mirrors
from endotwin.light.guides import lamps_mm, visible_from
from endotwin.light.sparkle import REACH, Facets, Facing, bare, facets_about, lobe
from endotwin.render.illumination import ViewLight, log_light
from endotwin.surface.vectors import dot, unit
from endotwin.twin import Twin

CHUNK = 1 << 16
"""Triangles whose facets are made at once: memory stays flat."""

LEAST_PX = 0.5
"""Least standard deviation of a spot: a narrower one would fall between the pixels."""

SPOT = 3
"""A spot ends at so many standard deviations."""

HIDDEN = 0.02
"""A facet is hidden where its pixel sees a surface nearer by this share of its distance."""

FAINT = 1e-5
"""A spot with a fainter peak (radiance; 1 is display white) is left out."""

PIXELS = 1 << 22
"""Of spots that are drawn at once."""


def rough_mm2(twin: Twin) -> np.ndarray | None:
    """Area of each triangle on which facets lie, as far as they lie there, float64 [F]; 0 where the triangle
    has none at all. None: there are no sparkles."""
    if (effect := twin.effects.get("sparkle")) is None:
        return None
    triangles, film = twin.surface.triangles, twin.film
    first, second = (
        twin.surface.vertices_mm[triangles[:, k]] - twin.surface.vertices_mm[triangles[:, 0]] for k in (1, 2)
    )
    area_mm2 = np.linalg.norm(np.cross(first, second), axis=1).astype(np.float64) / 2
    if film is not None:
        area_mm2 *= np.where(film.wets(triangles), 1, effect.dry)
    area_mm2[bare(np.arange(len(triangles)), effect.density * area_mm2)] = 0
    return area_mm2


def sparkles(light: ViewLight, rough_mm2: np.ndarray, camera: Camera, distance_mm: np.ndarray) -> np.ndarray:
    """What sparkles add to the radiance of the view from ``light.T_local_camera`` through ``camera``, whose
    pixels see a surface at ``distance_mm`` [H, W] (0: none), float32 [H, W].

    ``rough_mm2`` [F] is that of the surface at rest: tissue that is stretched has no other facets.
    """
    added, shape = np.zeros(distance_mm.size), distance_mm.shape
    sigma_px = max(LEAST_PX, light.twin.effects["sparkle"].size * shape[0])
    at_once = max(1, int(PIXELS / (2 * SPOT * sigma_px + 2) ** 2))
    for points_mm, flux in _shining(_Scene.of(light, rough_mm2, camera, float(distance_mm.max(initial=0)))):
        spots = _Spots.of(points_mm, flux, camera, distance_mm, sigma_px)
        for start in range(0, len(spots.flux), at_once):
            added += spots[start : start + at_once].drawn(shape)
    return np.where(distance_mm > 0, added.reshape(distance_mm.shape), 0).astype(np.float32)


@dataclass(frozen=True, eq=False)
class _Scene:
    """A surface in the camera's frame, and the light on it.

    Attributes:
        points_mm, normals: float32 [V, 3]. triangles: int [F], those with facets that the camera may see.
            rough_mm2: [F], of each. light: of the view.
    """

    points_mm: np.ndarray
    normals: np.ndarray
    triangles: np.ndarray
    rough_mm2: np.ndarray
    light: ViewLight

    @classmethod
    def of(cls, light: ViewLight, rough_mm2: np.ndarray, camera: Camera, farthest_mm: float) -> _Scene:
        surface, pose = light.twin.surface, light.T_local_camera
        rotation = pose[:3, :3].astype(np.float32)
        points_mm = ((surface.vertices_mm - pose[:3, 3]) @ pose[:3, :3]).astype(np.float32)
        distance_mm = np.sqrt(dot(points_mm, points_mm))
        steepest = np.nanmin(camera.pixel_directions[..., 2])
        seen = (points_mm[:, 2] >= steepest * distance_mm) & (distance_mm <= (1 + HIDDEN) * farthest_mm)
        chosen = np.flatnonzero(rough_mm2)
        chosen = chosen[seen[surface.triangles[chosen]].any(axis=1)]
        return cls(points_mm, surface.normals @ rotation, chosen, rough_mm2[chosen], light)

    @property
    def guides_mm(self) -> np.ndarray:
        return lamps_mm(self.light.twin.effects.guides_mm)

    def mirrors(self, points_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """``film.mirrors`` of points [N, 3]: half vectors [N, K, 3] and strengths [N, K]."""
        twin = self.light.twin
        half, strength = mirrors(points_mm, self.guides_mm, twin.effects.profile, log_light(twin))
        return half, strength.numpy()


def _shining(scene: _Scene) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Places float32 [N, 3] in the camera frame, and flux [N] (radiance × solid angle), of the facets that
    shine, some triangles and one guide after the other."""
    effect, surface = scene.light.twin.effects["sparkle"], scene.light.twin.surface
    spread, width = effect.spread**2, effect.roughness**2
    for start in range(0, len(scene.triangles), CHUNK):
        name = scene.triangles[start : start + CHUNK]
        corners = surface.triangles[name]
        facing = Facing.of(scene.points_mm, scene.normals, corners)
        half = scene.mirrors(scene.points_mm[corners].reshape(-1, 3))[0].reshape(len(corners), 3, -1, 3)
        area_mm2 = scene.rough_mm2[start : start + CHUNK]
        for guide in range(half.shape[2]):
            slopes = facing.slope(half[:, :, guide])
            facets = facets_about(name, area_mm2, slopes, effect.density, spread, width)
            points_mm = np.einsum("nk,nka->na", facets.barycentric, scene.points_mm[corners[facets.row]])
            yield _mirrored(scene, facing[facets.row], facets, points_mm, guide)


def _mirrored(
    scene: _Scene, facing: Facing, facets: Facets, points_mm: np.ndarray, guide: int
) -> tuple[np.ndarray, np.ndarray]:
    """Places and flux of those of the ``facets`` at ``points_mm`` [N, 3] that mirror ``guide`` to the camera.

    A pixel of solid angle Ω sees d²Ω/(n·ωo) mm² of surface, so that N facets a mm² of flux
    weight·L·F·G(s − s_m)·V·(n·ωi)(n·ωo)/(N d² (n·ωm)⁴) have the mean radiance weight·L·F·D·V·(n·ωi): V is
    Smith's, G a facet's lobe, and D = P(s_m)/(n·ωm)⁴ with the distribution P of slopes (Walter et al. 2007).
    """
    effect = scene.light.twin.effects["sparkle"]
    half, strength = (each[:, guide] for each in scene.mirrors(points_mm))
    apart2 = ((facing.slope(half) - facets.slope) ** 2).sum(axis=1)
    wo, wi = unit(-points_mm), unit(scene.guides_mm[guide] - points_mm)
    cos_o, cos_i = dot(facing.normal, wo), dot(facing.normal, wi)
    shines = (apart2 < (REACH * effect.roughness**2) ** 2) & (cos_o > 0) & (cos_i > 0)
    points_mm, cos_o, cos_i = points_mm[shines], cos_o[shines], cos_i[shines]
    alpha = torch.tensor(effect.spread**2)
    visibility = shading.smith_visibility(torch.from_numpy(cos_i), torch.from_numpy(cos_o), alpha).numpy()
    flux = effect.weight * shading.F0_WATER / effect.density * facets.share[shines] * strength[shines]
    flux = flux * lobe(apart2[shines], effect.roughness**2) / dot(facing.normal, half)[shines] ** 4
    flux = flux * cos_i * cos_o * visibility / dot(points_mm, points_mm)
    if "shadows" in scene.light.twin.effects:
        light, guides_mm = scene.light, scene.guides_mm[guide : guide + 1]
        flux = flux * visible_from(light.caster, light.T_local_camera, points_mm, guides_mm)[:, 0]
    return points_mm, flux


@dataclass(frozen=True, eq=False)
class _Spots:
    """Gaussian spots, of one standard deviation ``sigma_px``, in a picture.

    Attributes:
        uv: [N, 2], px. flux: [N], sum of each one's radiance over the pixels.
    """

    uv: np.ndarray
    flux: np.ndarray
    sigma_px: float

    def __getitem__(self, index: np.ndarray | slice) -> _Spots:
        return _Spots(self.uv[index], self.flux[index], self.sigma_px)

    @classmethod
    def of(
        cls, points_mm: np.ndarray, flux: np.ndarray, camera: Camera, distance_mm: np.ndarray, sigma_px: float
    ) -> _Spots:
        """Of facets at ``points_mm`` [N, 3] (camera frame), where the surface that pixels see at
        ``distance_mm`` [H, W] does not hide them."""
        uv = camera.project(points_mm.astype(np.float64))
        inside = ((uv > -0.5) & (uv < np.array(distance_mm.shape[::-1]) - 0.5)).all(axis=1)
        uv, flux, away_mm = uv[inside], flux[inside], np.sqrt(dot(points_mm, points_mm))[inside]
        column, row = np.rint(uv).astype(np.int64).T
        seen = away_mm < (1 + HIDDEN) * distance_mm[row, column]
        spots = cls(uv[seen], flux[seen] / solid_angle(camera, uv[seen]), sigma_px)
        return spots[spots.flux > FAINT * 2 * math.pi * sigma_px**2]

    def drawn(self, shape: tuple[int, int]) -> np.ndarray:
        """Their radiance [H·W]; within the picture the sum of each spot is its flux."""
        radius = math.ceil(SPOT * self.sigma_px)
        at = np.rint(self.uv).astype(np.int64)[:, :, None] + np.arange(-radius, radius + 1)
        spread = np.exp(-(((at - self.uv[:, :, None]) / self.sigma_px) ** 2) / 2)
        across, down = np.moveaxis(spread / spread.sum(axis=2, keepdims=True), 1, 0)
        values = self.flux[:, None, None] * down[:, :, None] * across[:, None]
        inside = (at >= 0) & (at < np.array(shape[::-1])[:, None])
        inside = inside[:, 1, :, None] & inside[:, 0, None]
        pixel = at[:, 1, :, None] * shape[1] + at[:, 0, None]
        return np.bincount(pixel[inside], values[inside], minlength=shape[0] * shape[1])
