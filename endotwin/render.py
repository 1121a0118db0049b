"""Relighting: what the twin looks like from any pose."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch

from endotwin import shading
from endotwin.cameras import Camera
from endotwin.casting import Caster, Correspondences
from endotwin.errors import TwinError
from endotwin.incidence import Incidence, incidence_on, to_camera
from endotwin.silhouettes import discontinuities
from endotwin.twin import Twin

SUBPIXELS = 2
"""A silhouette pixel is the mean of SUBPIXELS² rays."""


@dataclass(frozen=True)
class Rays:
    """Viewing rays that need no camera: unit ``pixel_directions`` float32 [..., 3] in the camera frame."""

    pixel_directions: np.ndarray


@dataclass(frozen=True)
class View:
    """One rendered view and the labels that come with it.

    Attributes:
        color: float32 [H, W, 3], display-encoded, in [0, 1]; 0 where no surface is seen.
        hits: the pixel → surface correspondences behind it.
        shape: (H, W).
    """

    color: np.ndarray
    hits: Correspondences
    shape: tuple[int, int]
    _renderer: Renderer
    _normals: np.ndarray

    def image(self, values: np.ndarray, empty: float = 0.0) -> np.ndarray:
        """Values of the hits, [N, ...], as an image [H, W, ...] with ``empty`` where no surface is seen."""
        return laid_out(values, self.hits.pixel, self.shape, empty)

    @cached_property
    def mask(self) -> np.ndarray:
        """Bool [H, W]: pixels that see the surface."""
        return self.image(np.ones(len(self.hits), bool), False)

    @cached_property
    def depth_mm(self) -> np.ndarray:
        """Float32 [H, W], z-depth; NaN where no surface is seen."""
        z = self._renderer.camera.pixel_directions.reshape(-1, 3)[:, 2].take(self.hits.pixel)
        return self.image(self.hits.distance_mm * z, np.nan)

    @cached_property
    def normals(self) -> np.ndarray:
        """Float32 [H, W, 3], unit normals in the camera frame; 0 where no surface is seen."""
        return self.image(self._normals)

    def attribute(self, per_vertex: np.ndarray) -> np.ndarray:
        """A vertex attribute [V, ...] interpolated at the hits, [N, ...]."""
        return self.hits.interpolate(self._renderer.twin.surface, per_vertex)


def laid_out(values: np.ndarray, pixel: np.ndarray, shape: tuple[int, int], empty: float = 0.0) -> np.ndarray:
    """Values [N, ...] of row-major pixels [N] as an image [H, W, ...] with ``empty`` elsewhere."""
    rows = np.concatenate([values, np.full((1, *values.shape[1:]), empty, values.dtype)])
    row = np.full(shape[0] * shape[1], len(values), np.int32)
    row[pixel] = np.arange(len(values))
    return rows.take(row, axis=0).reshape(*shape, *values.shape[1:])


class Renderer:
    """Renders views of one fitted twin through one camera; may be called from several threads."""

    def __init__(self, twin: Twin, camera: Camera | None = None, threads: int = 2):
        if not twin.fitted:
            raise TwinError("the twin has no materials yet; run 'endotwin fit' on it first")
        self.twin = twin
        self.camera = camera or twin.camera
        self._caster = Caster(twin.surface, threads)
        materials = twin.materials
        columns = [materials.base_color, materials.roughness[:, None], materials.metallic[:, None]]
        self._normal_and_material = np.concatenate([twin.surface.normals, *columns], axis=1)

    def view(self, T_world_camera: np.ndarray, mask: np.ndarray | None = None) -> View:
        """The view from ``T_world_camera`` [4, 4], of the pixels in ``mask`` [H, W] if given.

        Colours of silhouette pixels (and of those beside the mask's edge), and only those, are means over the
        pixel's area; labels are of its centre.
        """
        shape = (self.camera.height, self.camera.width)
        hits, normals, radiance = self._cast(self.camera, T_world_camera, mask)
        z = self.camera.pixel_directions.reshape(-1, 3)[:, 2].take(hits.pixel)
        radiance = laid_out(radiance, hits.pixel, shape)
        silhouette = discontinuities(laid_out(hits.distance_mm * z, hits.pixel, shape, np.nan))
        silhouette &= self._sees if mask is None else mask
        radiance[silhouette] = self._mean_radiance(np.argwhere(silhouette)[:, ::-1], T_world_camera)
        color = shading.respond(torch.from_numpy(radiance), self.twin.response.gamma).clamp(0, 1).numpy()
        return View(color, hits, shape, self, normals)

    @cached_property
    def _sees(self) -> np.ndarray:
        """Bool [H, W]: pixels through which the lens sees at all."""
        return np.isfinite(self.camera.pixel_directions).all(axis=2)

    def _mean_radiance(self, uv: np.ndarray, T_world_camera: np.ndarray) -> np.ndarray:
        """Radiance float32 [N, 3], averaged over the area of pixels ``uv`` [N, 2]; no surface is black."""
        inside = (np.arange(SUBPIXELS) + 0.5) / SUBPIXELS - 0.5
        offsets = np.stack(np.meshgrid(inside, inside), axis=-1).reshape(-1, 2)
        rays = Rays(self.camera.directions(uv[:, None] + offsets).astype(np.float32))
        hits, _, radiance = self._cast(rays, T_world_camera)
        return laid_out(radiance, hits.pixel, (len(uv), len(offsets))).mean(axis=1)

    def _cast(
        self, rays: Camera | Rays, T_world_camera: np.ndarray, mask: np.ndarray | None = None
    ) -> tuple[Correspondences, np.ndarray, np.ndarray]:
        """Hits [N], their unit normals in the camera frame [N, 3], and their radiance [N, 3]."""
        hits = self._caster.cast(rays, T_world_camera, mask)
        mixed = hits.interpolate(self.twin.surface, self._normal_and_material)
        normals = to_camera(mixed[:, :3], T_world_camera)
        return (
            hits,
            normals,
            self._shade(incidence_on(normals, hits, rays), torch.from_numpy(mixed[:, 3:])).numpy(),
        )

    def _shade(self, geometry: Incidence, material: torch.Tensor) -> torch.Tensor:
        """Radiance [N, 3] of hits with ``material`` [N, 5]: base colour, roughness, metallic."""
        light, twin = self.twin.light, self.twin
        cos, sin2, log_cos_axis, log_distance = (torch.from_numpy(value) for value in vars(geometry).values())
        strength = torch.exp(
            shading.log_spotlight(
                math.log(max(light.L0, 1e-30)), light.n, light.q, log_cos_axis, log_distance
            )
        )
        roughness = material[:, 3]
        lobe = shading.diffuse(material[:, :3], material[:, 4])
        if twin.materials.diffuse == "burley":
            lobe = lobe * shading.burley(cos, cos, torch.ones_like(cos), roughness)[:, None]
        shine = twin.materials.f0 * shading.specular_colocated(cos, sin2, roughness)
        return (lobe + shine[:, None]) * (strength * cos * (2 * math.pi))[:, None]
