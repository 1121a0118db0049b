"""Radiance of a scene's frames, and the photos that its camera takes."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from independent.colon import Colon
from independent.gloss import Gloss
from independent.light import F0_WATER, burley, dot, ggx, lambert
from independent.mucosa import mucosa
from independent.path import fly
from independent.radiosity import Bounce, Radiosity
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
        self.scene = scene
        self.wall = Wall(colon.points_mm)
        self.tissue = mucosa(rng[1], self.wall.shape, scene.roughness)
        self.poses = fly(rng[2], colon, scene.path, scene.frames)
        self._finer = (self.tissue.shape[0] - 1) / (self.wall.shape[0] - 1)
        self._gloss, self._film = Gloss(scene.f0), Gloss(F0_WATER)
        self._bounce = self._transported(rng[3]) if "interreflection" in scene.effects else None
        self._expose()

    def view(self, frame: int, u: np.ndarray, v: np.ndarray) -> View:
        """What rays through pixel coordinates [N] of a frame meet."""
        pose, lens = self.poses[frame], self.scene.lens
        centre_mm, rotation = pose[:3, 3].astype(np.float32), pose[:3, :3].astype(np.float32)
        directions = lens.rays(u, v).astype(np.float32) @ rotation.T
        hits = self.wall.cast(centre_mm, directions)
        seen = [self._seen(pose, hits, guide_mm) for guide_mm in self.scene.lamp.guides_mm]
        return View(
            frame,
            hits.rays,
            (hits.points_mm - centre_mm) @ rotation,
            hits.normals @ rotation,
            lens.squared_radius(u, v)[hits.rays].astype(np.float32),
            hits.place,
            sampled(self.tissue, self._finer * hits.place),
            np.stack(seen, axis=1),
        )

    def radiance(self, view: View, scene: Scene, glossy: bool = True) -> np.ndarray:
        """Exposed radiance [N, 3] of the view's points under the lights and effects of ``scene``, times
        2π."""
        to_eye, lamp = unit(-view.points_mm), scene.lamp
        albedo, roughness = view.tissue[:, :3], view.tissue[:, 3]
        diffuse, shine = np.zeros(len(to_eye), np.float32), np.zeros(len(to_eye), np.float32)
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
        x = 2 * albedo * diffuse[:, None] + 2 * np.pi * shine[:, None]
        if "interreflection" in scene.effects:
            arriving, mirrored = self._bounce.at(view.frame, view.place)
            share, through = self._glossy(scene, dot(view.normals, to_eye), roughness)
            x += 2 * scene.L0 * (through[:, None] * albedo * arriving + share[:, None] * mirrored)
        if "vignetting" in scene.effects:
            x *= np.exp(-scene.vignetting * view.squared_radius)[:, None]
        return x * scene.gains[view.frame]

    def photo(self, frame: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """8-bit photo [H, W, 3], and z-depth in mm [H, W] (0: none), of the pixels' centres."""
        scene, lens = self.scene, self.scene.lens
        v, u = np.mgrid[: lens.height, : lens.width]
        x = np.zeros((lens.height * lens.width, 3), np.float32)
        for aside in (np.arange(SAMPLES) + 0.5) / SAMPLES - 0.5:
            for down in (np.arange(SAMPLES) + 0.5) / SAMPLES - 0.5:
                view = self.view(frame, (u + aside).ravel(), (v + down).ravel())
                x[view.ray] += self.radiance(view, scene) / SAMPLES**2
        shown = 255 * displayed(x, scene) + scene.noise_levels * rng.standard_normal(x.shape)
        inside = lens.lit(u, v)
        photo = np.rint(np.clip(shown, 0, 255)).astype(np.uint8).reshape(*u.shape, 3) * inside[..., None]
        return photo, self._depth_mm(frame, lens.rays(u, v).reshape(-1, 3)).reshape(u.shape) * inside

    def _depth_mm(self, frame: int, directions: np.ndarray) -> np.ndarray:
        pose = self.poses[frame]
        hits = self.wall.cast(pose[:3, 3], directions @ pose[:3, :3].T)
        depth_mm = np.zeros(len(directions))
        depth_mm[hits.rays] = np.maximum((hits.points_mm - pose[:3, 3]) @ pose[:3, 2], 0)
        return depth_mm

    def _seen(self, pose: np.ndarray, hits: Hits, guide_mm: tuple[float, ...]) -> np.ndarray:
        if not any(guide_mm):
            return np.ones(len(hits.rays), bool)
        return self.wall.sees(pose[:3, 3] + pose[:3, :3] @ np.asarray(guide_mm), hits.points_mm)

    def _glossy(self, scene: Scene, cos: np.ndarray, roughness: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Share of light from about the mirror's direction that lobes send to the eye, [N], and share of what
        tissue sends there that passes the coat, where it does not mirror."""
        share, through = self._gloss.at(cos, roughness), np.ones_like(cos)
        if "coat" in scene.effects:
            film = scene.coat_weight * self._film.at(cos, np.full_like(cos, scene.coat_roughness))
            share, through = film + (1 - film) * share, 1 - film
        return share, through

    def _transported(self, rng: np.random.Generator) -> Bounce:
        """The light between tissue and tissue in every frame, for L0 = 1."""
        scene, radiosity = self.scene, Radiosity(self.wall, self.tissue, rng)
        lamp, rough = replace(scene.lamp, L0=1.0), radiosity.tissue[:, 3]
        lobes = [(self._gloss, 1.0, rough)]
        if "coat" in scene.effects:
            lobes.append((self._film, scene.coat_weight, np.full_like(rough, scene.coat_roughness)))
        direct = np.stack([radiosity.direct(lamp, pose) for pose in self.poses], axis=1)
        glossy, mirrored = np.zeros_like(rough), np.zeros_like(direct)
        for lobe, weight, roughness in lobes:
            glossy = glossy + weight * lobe.mean(roughness)
            for frame, pose in enumerate(self.poses):
                found = radiosity.mirrored(lamp, pose, roughness, lobe.f0, rng)
                mirrored[:, frame] += weight * found
        facets = [(lobe.f0, weight, roughness) for lobe, weight, roughness in lobes]
        shown = [radiosity.shown(pose, facets, rng) for pose in self.poses]
        return radiosity.bounce(direct, radiosity.tissue[:, :3], glossy, mirrored, shown)

    def _expose(self) -> None:
        """Set L0 by what a coarse look at all frames shows."""
        bright, lens = [], self.scene.lens
        v, u = np.mgrid[4 : lens.height : 8, 4 : lens.width : 8]
        inside = lens.lit(u, v)
        for frame in range(self.scene.frames):
            view = self.view(frame, u[inside], v[inside])
            bright.append(self.radiance(view, self.scene, glossy=False).max(axis=1))
        factor = BRIGHT / float(np.quantile(np.concatenate(bright), SHARE))
        self.scene = replace(self.scene, L0=self.scene.L0 * factor)


def displayed(x: np.ndarray, scene: Scene) -> np.ndarray:
    """Display values in [0, 1] of radiance x: x^γ, and with a tone curve as much of its smooth step."""
    value = np.minimum(np.maximum(x, 0) ** scene.gamma, 1)
    tone = scene.tone if "tone" in scene.effects else 0.0
    return (1 - tone) * value + tone * value**2 * (3 - 2 * value)
