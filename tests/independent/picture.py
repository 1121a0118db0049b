"""Radiance of a scene's frames, and the photos that its camera takes."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from independent.colon import Colon
from independent.light import F0_WATER, burley, dot, ggx, lambert
from independent.mucosa import mucosa
from independent.path import fly
from independent.radiosity import Radiosity
from independent.scene import Scene
from independent.wall import Hits, Wall, sampled, unit

SAMPLES = 2
"""Rays of a pixel, each way."""

BRIGHT, SHARE = 0.9, 0.99
"""So bright is the tissue of this share of the pixels at most, highlights left out."""


@dataclass(frozen=True)
class View:
    """Points of the wall that rays of one frame meet.

    Attributes:
        frame: its number. ray: int [N], which of the rays. points_mm, normals: [N, 3] in the camera frame.
        squared_radius: [N], of the lens's picture. place: [N, 2] on the wall. tissue: albedo and roughness
            [N, 4]. seen: bool [N, K], by each guide.
    """

    frame: int
    ray: np.ndarray
    points_mm: np.ndarray
    normals: np.ndarray
    squared_radius: np.ndarray
    place: np.ndarray
    tissue: np.ndarray
    seen: np.ndarray


class Studio:
    """A scene's colon with its materials, the poses of its frames, and the light between tissue and
    tissue."""

    def __init__(self, scene: Scene):
        rng = [np.random.default_rng([scene.seed, stream]) for stream in range(2, 6)]
        colon = Colon.draw(rng[0])
        self.wall = Wall(colon.points_mm)
        self.tissue = mucosa(rng[1], self.wall.shape, scene.roughness)
        self.poses = fly(rng[2], colon, scene.path, scene.frames)
        self._finer = (self.tissue.shape[0] - 1) / (self.wall.shape[0] - 1)
        self._bounced: list[np.ndarray] = []
        self.scene = scene
        if "interreflection" in scene.effects:
            self._radiosity = Radiosity(self.wall, self.tissue[..., :3], rng[3])
            direct = np.stack([self._radiosity.direct(scene.lamp, pose) for pose in self.poses], axis=1)
            indirect = self._radiosity.indirect(direct)
            self._bounced = [self._radiosity.as_map(indirect[:, f]) for f in range(scene.frames)]
        self._expose()

    def view(self, frame: int, u: np.ndarray, v: np.ndarray) -> View:
        """What rays through pixel coordinates [N] of a frame meet."""
        pose, lens = self.poses[frame], self.scene.lens
        hits = self.wall.cast(pose[:3, 3], lens.rays(u, v) @ pose[:3, :3].T)
        seen = [self._seen(pose, hits, guide_mm) for guide_mm in self.scene.lamp.guides_mm]
        return View(
            frame,
            hits.rays,
            (hits.points_mm - pose[:3, 3]) @ pose[:3, :3],
            hits.normals @ pose[:3, :3],
            lens.squared_radius(u, v)[hits.rays],
            hits.place,
            sampled(self.tissue, self._finer * hits.place),
            np.stack(seen, axis=1),
        )

    def radiance(self, view: View, scene: Scene, glossy: bool = True) -> np.ndarray:
        """Exposed radiance x [N, 3] of the view's points under the lights and effects of ``scene``; 2π of it
        is a factor of L0."""
        to_eye, lamp = unit(-view.points_mm), scene.lamp
        albedo, roughness = view.tissue[:, :3], view.tissue[:, 3]
        diffuse, shine = np.zeros(len(to_eye)), np.zeros(len(to_eye))
        for guide in range(len(lamp.guides_mm)):
            strength, to_light = lamp.arriving(guide, view.points_mm)
            if "shadows" in scene.effects:
                strength = strength * view.seen[:, guide]
            if scene.diffuse == "burley":
                diffuse += strength * burley(view.normals, to_light, to_eye, roughness)
            else:
                diffuse += strength * lambert(dot(view.normals, to_light))
            if glossy:
                shine += strength * ggx(view.normals, to_light, to_eye, roughness, scene.f0)
            if glossy and "coat" in scene.effects:
                film = ggx(view.normals, to_light, to_eye, scene.coat_roughness, F0_WATER)
                shine += scene.coat_weight * strength * film
        irradiance = diffuse[:, None]
        if "interreflection" in scene.effects:
            bounced = self._radiosity.at(self._bounced[view.frame], view.place)
            irradiance = irradiance + scene.L0 / self.scene_L0 * bounced
        x = 2 * albedo * irradiance + 2 * np.pi * shine[:, None]
        if "vignetting" in scene.effects:
            x = x * np.exp(-scene.vignetting * view.squared_radius)[:, None]
        return x * scene.gains[view.frame]

    def photo(self, frame: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """8-bit photo [H, W, 3], and z-depth in mm [H, W] (0: none), of the pixels' centres."""
        scene, lens = self.scene, self.scene.lens
        v, u = np.mgrid[: lens.height, : lens.width]
        x = np.zeros((lens.height * lens.width, 3))
        for aside in (np.arange(SAMPLES) + 0.5) / SAMPLES - 0.5:
            for down in (np.arange(SAMPLES) + 0.5) / SAMPLES - 0.5:
                view = self.view(frame, (u + aside).ravel(), (v + down).ravel())
                x[view.ray] += self.radiance(view, scene) / SAMPLES**2
        shown = 255 * displayed(x, scene.gamma) + scene.noise_levels * rng.standard_normal(x.shape)
        inside = lens.lit(u, v)
        photo = np.rint(np.clip(shown, 0, 255)).astype(np.uint8).reshape(*u.shape, 3) * inside[..., None]
        centres = self.view(frame, u.ravel().astype(float), v.ravel().astype(float))
        depth_mm = np.zeros(u.size)
        depth_mm[centres.ray] = np.maximum(centres.points_mm[:, 2], 0)
        return photo, depth_mm.reshape(u.shape) * inside

    def _seen(self, pose: np.ndarray, hits: Hits, guide_mm: tuple[float, ...]) -> np.ndarray:
        if not any(guide_mm):
            return np.ones(len(hits.rays), bool)
        return self.wall.sees(pose[:3, 3] + pose[:3, :3] @ np.asarray(guide_mm), hits.points_mm)

    def _expose(self) -> None:
        """Set L0 by what a coarse look at all frames shows."""
        self.scene_L0 = self.scene.L0
        bright = []
        for frame in range(self.scene.frames):
            v, u = np.mgrid[4 : self.scene.lens.height : 8, 4 : self.scene.lens.width : 8]
            inside = self.scene.lens.lit(u, v)
            view = self.view(frame, u[inside].astype(float), v[inside].astype(float))
            bright.append(self.radiance(view, self.scene, glossy=False).max(axis=1))
        factor = BRIGHT / float(np.quantile(np.concatenate(bright), SHARE))
        self.scene = replace(self.scene, L0=self.scene.L0 * factor)


def displayed(x: np.ndarray, gamma: float) -> np.ndarray:
    """Display values in [0, 1] of radiance x."""
    return np.minimum(np.maximum(x, 0) ** gamma, 1)
