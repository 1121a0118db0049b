"""What a frame sees of the surface, and what another frame sees of the same points."""

from __future__ import annotations

from functools import cached_property
from threading import local

import cv2
import numpy as np

from endotwin.cameras import Camera
from endotwin.surface import Surface
from endotwin.surface.casting import Caster, Correspondences
from endotwin.surface.vectors import dot, shifted
from endotwin.synth.motion import Motion
from endotwin.synth.trajectories import Trajectory

HIDDEN_MM = 1e-3
HIDDEN = 1e-4
"""A point is hidden where a ray to it ends more than HIDDEN_MM + HIDDEN·distance before it."""

ABOUT_PX = 4
STEADY, SLOPE, NOISE = 0.05, 0.02, 1e-4
"""Where the ABOUT_PX² distances about a place are within STEADY of each other, no ray is needed: a point is
seen there whose distance is the one between the pixels, but for SLOPE of their spread and NOISE of itself,
and one is hidden that is STEADY beyond all of them. On a fused colon that is so of 96 % of the points, and
rays say otherwise of one in a million, which a sliver narrower than a pixel hides."""

FAR_MM = 1e9
COLUMNS = 1 << 10

BEHIND_MM = 0.01
"""How far behind a hit the ray goes on that looks for surface hidden by it."""

OCCLUSION_RANGE_MM = 100.0

KEPT = 3
"""Frames whose sights are kept: one and its neighbours."""


class Sight:
    """What one frame sees: rays of ``camera`` at ``T_world_camera`` [4, 4] into the surface of ``caster``."""

    def __init__(self, caster: Caster, camera: Camera, T_world_camera: np.ndarray):
        self.caster, self.T_world_camera = caster, T_world_camera
        self._camera = camera

    @property
    def surface(self) -> Surface:
        """As it is in this frame."""
        return self.caster.surface

    @cached_property
    def hits(self) -> Correspondences:
        """What the rays through the pixels' centres meet."""
        return self.caster.cast(self._camera, self.T_world_camera)

    def towards(self, hits: Correspondences) -> np.ndarray:
        """From the camera to where the points of ``hits``, of any frame, are in this one, along the world's
        axes, mm, float32 [N, 3]: within 1e-7 of their length."""
        return hits.interpolate(self.surface, self._vertices)

    @cached_property
    def _vertices(self) -> np.ndarray:
        """From the camera to the vertices, mm, float32 [V, 3]."""
        return shifted(self.surface.vertices_mm, self.surface.origin_mm - self.T_world_camera[:3, 3])

    def places(self, towards: np.ndarray) -> np.ndarray:
        """Where points [N, 3], as ``towards`` gives them, lie in the picture, px, float64 [N, 2]; NaN where
        the lens does not see in that direction."""
        return self._camera.project(towards @ self.T_world_camera[:3, :3].astype(np.float32))

    def shows(self, towards: np.ndarray, uv: np.ndarray) -> np.ndarray:
        """Bool [N]: points of the surface [N, 3], as ``towards`` gives them, at ``uv`` [N, 2], that are in
        the picture and not hidden."""
        width, height = self._camera.width, self._camera.height
        u, v = uv.T
        distance_mm = np.sqrt(dot(towards, towards))
        seen, known = self._at_a_glance(u, v, distance_mm)
        asked = np.flatnonzero(~known)
        u, v = u[asked], v[asked]
        asked = asked[(u > -0.5) & (u < width - 0.5) & (v > -0.5) & (v < height - 0.5)]
        distance_mm = distance_mm[asked].astype(np.float64)
        rays = (towards[asked] / np.maximum(distance_mm, 1e-9)[:, None]).astype(np.float32)
        centre = (self.T_world_camera[:3, 3] - self.surface.origin_mm).astype(np.float32)
        length_mm = distance_mm * (1 - HIDDEN) - HIDDEN_MM
        seen[asked] = self.caster.unobstructed(np.broadcast_to(centre, rays.shape), rays, length_mm)
        return seen

    def hides_surface(self) -> np.ndarray:
        """Bool [N]: hits with more surface behind them on the same ray, within OCCLUSION_RANGE_MM of the
        camera (C3VD's occlusion)."""
        view = self._camera, self.T_world_camera, self.hits
        return self.caster.hides(*view, BEHIND_MM, OCCLUSION_RANGE_MM)

    @cached_property
    def _distances(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Distance at the pixels, float32 [H, W], NaN where no surface is; the least and the greatest of the
        ABOUT_PX² about the place between a pixel and the next ones to the right and down."""
        shape = self._camera.height, self._camera.width
        distance_mm = self.hits.laid_out(self.hits.distance_mm, shape, np.nan)
        about, anchor = np.ones((ABOUT_PX, ABOUT_PX), np.uint8), (ABOUT_PX // 2 - 1,) * 2
        none_is_far = np.where(np.isnan(distance_mm), np.float32(FAR_MM), distance_mm)
        nearest, farthest = (way(none_is_far, about, anchor=anchor) for way in (cv2.erode, cv2.dilate))
        return distance_mm, nearest, farthest

    def _at_a_glance(
        self, u: np.ndarray, v: np.ndarray, distance_mm: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Bool [N] each: points at places ``u``, ``v`` that are seen for certain, and those of which it is
        certain whether they are."""
        at, nearest, farthest = self._distances
        height, width = at.shape
        seen, known = np.zeros(len(u), bool), np.zeros(len(u), bool)
        chosen = np.flatnonzero((u >= 0) & (u < width - 1) & (v >= 0) & (v < height - 1))
        u, v = (each.take(chosen).astype(np.float32) for each in (u, v))
        distance_mm = distance_mm.take(chosen)
        pixel = v.astype(np.int32) * width + u.astype(np.int32)
        near, far = nearest.reshape(-1).take(pixel), farthest.reshape(-1).take(pixel)
        spread = far - near
        off = np.abs(distance_mm - _between(at, u, v)) <= SLOPE * spread + NOISE * distance_mm
        steady = spread < STEADY * near
        seen[chosen] = steady & off
        known[chosen] = steady & (off | (distance_mm > (1 + STEADY) * far))
        return seen, known


def _between(image: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Values of ``image`` [H, W] at places ``u``, ``v``, between the pixels, float32 [N]; NaN beside NaN."""
    places = np.zeros((2, (len(u) // COLUMNS + 1) * COLUMNS), np.float32)  # OpenCV takes pictures of them
    places[0, : len(u)], places[1, : len(u)] = u, v
    columns, rows = places.reshape(2, -1, COLUMNS)
    return cv2.remap(image, columns, rows, cv2.INTER_LINEAR).reshape(-1)[: len(u)]


class Sights:
    """What the frames of a dataset see of one surface at rest, or of one a frame."""

    def __init__(self, rest: Surface, motion: Motion | None, trajectory: Trajectory, camera: Camera):
        self._motion, self._trajectory, self._camera = motion, trajectory, camera
        self.at_rest = Caster(rest, threads=1)
        self._kept = local()  # a thread's own: another's rays are under way in its casters

    @property
    def move(self) -> bool:
        """Whether frames have surfaces of their own."""
        return self._motion is not None

    def __getitem__(self, index: int) -> Sight:
        """That of frame ``index``; those of the latest frames are kept."""
        kept = vars(self._kept).setdefault("sights", {})
        sight = kept.pop(index, None)
        if sight is None:
            before = kept.pop(next(iter(kept))) if len(kept) >= KEPT else None
            caster, T_world_camera = self._caster(index, before), self._trajectory.T_world_camera[index]
            sight = Sight(caster, self._camera, T_world_camera)
        kept[index] = sight
        return sight

    def _caster(self, index: int, before: Sight | None) -> Caster:
        """Rays into the surface of frame ``index``, in the place of those of a sight that is kept no more."""
        if self._motion is None:
            return self.at_rest
        unused = before.caster if before else Caster(self.at_rest.surface, threads=1)
        return unused.moved(self._motion.surface(float(self._trajectory.timestamps_s[index])))
