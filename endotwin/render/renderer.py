"""Relighting: what the twin looks like from any pose."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
import torch

from endotwin.cameras import Camera, as_camera
from endotwin.errors import OptionError
from endotwin.light.forward import Lit
from endotwin.light.incidence import to_camera
from endotwin.light.radiosity import Radiosity
from endotwin.render.illumination import Illumination, ViewLight
from endotwin.render.sparkles import rough_mm2, sparkles
from endotwin.run.threads import THREADS
from endotwin.sequence.poses import as_pose
from endotwin.surface.casting import Caster, Correspondences
from endotwin.surface.silhouettes import discontinuities
from endotwin.surface.vectors import dot, turned_along
from endotwin.twin import Twin, as_twin

SUBPIXELS = 2
"""A pixel at a silhouette, a shadow's edge or a sharp highlight is the mean of SUBPIXELS² rays."""

BENT = 0.5 / 255
"""A pixel whose mean differs from its centre by more, as displayed, is where a highlight is sharp."""

FACING = 0.05
"""Least cosine between normal and ray of a surface that shows its colour. At the rim of a fold less of it
than a hundredth of a pixel is steeper: what is there in a mesh is the back of a sliver, a black dot."""


@dataclass(frozen=True, eq=False)
class Rays:
    """Viewing rays that need no camera: unit ``pixel_directions`` float32 [..., 3] in the camera frame."""

    pixel_directions: np.ndarray


@dataclass(frozen=True, eq=False)
class View:
    """One rendered view and the labels that come with it.

    Attributes:
        color: float32 [H, W, 3], display-encoded, in [0, 1]; 0 where no part of a pixel shows surface.
        radiance: float32 [H, W, 3], linear, before the response; 1 is display white.
        hits: the pixel → surface correspondences behind it.
        shape: (H, W).
    """

    color: np.ndarray
    radiance: np.ndarray
    hits: Correspondences
    shape: tuple[int, int]
    _renderer: Renderer
    _met: _Met

    def image(self, values: np.ndarray, empty: float = 0.0) -> np.ndarray:
        """Values of the hits, [N, ...], as an image [H, W, ...] with ``empty`` where no surface is seen."""
        return self.hits.laid_out(values, self.shape, empty)

    @cached_property
    def mask(self) -> np.ndarray:
        """Bool [H, W]: pixels that see the surface."""
        return self.image(np.ones(len(self.hits), bool), False)

    @property
    def averaged(self) -> np.ndarray:
        """Bool [H, W]: pixels whose colour is a mean over their area."""
        return self._met.edges

    @cached_property
    def depth_mm(self) -> np.ndarray:
        """Float32 [H, W], z-depth; NaN where no surface is seen."""
        z = self._renderer.camera.pixel_directions.reshape(-1, 3)[:, 2].take(self.hits.pixel)
        return self.image(self.hits.distance_mm * z, np.nan)

    @cached_property
    def normals(self) -> np.ndarray:
        """Float32 [H, W, 3], unit normals in the camera frame; 0 where no surface is seen."""
        return self.image(self._met.centres.normals)

    @cached_property
    def albedo(self) -> np.ndarray:
        """Float32 [H, W, 3], base colour, linear RGB; 0 where no surface is seen."""
        return self.image(self.material[:, :3])

    @property
    def material(self) -> np.ndarray:
        """Base colour, roughness and metallic of the hits, float32 [N, 5]."""
        return self._met.centres.material.numpy()

    def attribute(self, per_vertex: np.ndarray) -> np.ndarray:
        """A vertex attribute [V, ...] interpolated at the hits, [N, ...]."""
        return self.hits.interpolate(self._renderer.twin.surface, per_vertex)


class Renderer:
    """Renders views of one fitted twin through one camera; may be called from several threads.

    Args:
        twin: or its folder. camera: the twin's own unless given. threads: of the ray casting.
        caster, radiosity: those of the same surface, to share. exposure: factor on the radiance, one or one a
            channel.
    """

    def __init__(
        self,
        twin: Twin | Path | str,
        camera: Camera | None = None,
        threads: int = THREADS,
        caster: Caster | None = None,
        exposure: Sequence[float] | float = 1.0,
        radiosity: Radiosity | None = None,
    ):
        twin = as_twin(twin)
        twin.require_fitted()
        self.twin = twin
        self.camera = twin.camera if camera is None else as_camera(camera)
        self.caster = caster or Caster(twin.surface, threads)
        self._illumination = Illumination(twin, self.caster, radiosity)
        self._exposure = np.asarray(exposure, np.float32)
        self._material = _material(twin)
        self._rough_mm2 = rough_mm2(twin)

    def edited(self, twin: Twin, exposure: Sequence[float] | float = 1.0) -> Renderer:
        """The renderer of another edit of the same twin; what the edits have in common is not made again."""
        other = copy(self)
        other.twin, other._exposure = twin, np.asarray(exposure, np.float32)
        other._illumination = self._illumination.edited(twin)
        if twin.materials is not self.twin.materials:
            other._material = _material(twin)
        other._rough_mm2 = rough_mm2(twin)
        if twin.effects.get("vignetting") != self.twin.effects.get("vignetting"):
            vars(other).pop("_transmission", None)
        return other

    def moved(self, caster: Caster) -> Renderer:
        """The renderer of the same twin on the moved surface of ``caster``, which has the same triangles."""
        _ = self._sees, self._transmission  # found once for all that this one becomes
        other = copy(self)
        rest, surface, materials = self.twin.surface, caster.surface, self.twin.materials
        if materials.film is not None:
            at = materials.film.vertex
            normal = turned_along(materials.film.normal, rest.normals[at], surface.normals[at])
            materials = replace(materials, film=replace(materials.film, normal=normal))
        other.twin, other.caster = replace(self.twin, surface=surface, materials=materials), caster
        other._illumination = self._illumination.moved(other.twin, caster)
        return other

    def brighter(self, gain: float) -> Renderer:
        """The renderer of the same twin with so many times the light."""
        other = copy(self)
        other._exposure = self._exposure * np.float32(gain)
        return other

    def through(self, camera: Camera) -> Renderer:
        """The renderer of the same twin through another camera."""
        if camera is self.camera:
            return self
        other = copy(self)
        other.camera = camera
        for name in ("_transmission", "_sees"):
            vars(other).pop(name, None)
        return other

    def view(
        self,
        T_world_camera: np.ndarray,
        mask: np.ndarray | None = None,
        exposure: float = 1.0,
        like: View | None = None,
        hits: Correspondences | None = None,
    ) -> View:
        """The view from ``T_world_camera`` [4, 4], of the pixels in ``mask`` [H, W] if given.

        Colours of pixels at silhouettes, shadow edges and sharp highlights (and of those beside the mask's
        edge), and only those, are means over the pixel's area; labels are of its centre. ``exposure`` is a
        factor on the radiance of this view. ``like`` is a view from there by a renderer of the same twin with
        other lobes, through the same camera: what its rays met, and how that is lit, is not looked for again.
        ``hits`` are what the rays through the pixels' centres meet, if that is known.

        Raises:
            TrajectoryError: that is no rigid pose. OptionError: the mask has another shape than the image.
        """
        T_world_camera = as_pose(T_world_camera)
        shape = (self.camera.height, self.camera.width)
        mask = None if mask is None else np.asarray(mask, bool)
        if mask is not None and mask.shape != shape:
            raise OptionError(f"the mask has the shape {mask.shape}, but the image {shape}")
        light = self._illumination.at(T_world_camera)
        if like:
            met, radiance = like._met, like._met.centres.image(light, shape)
        else:
            met, radiance = self._met(light, T_world_camera, mask, hits)
        mean, count = met.mean_radiance(light)
        at = np.nonzero(met.edges)
        radiance[at] = np.where(count[:, None] > 0, mean, radiance[at])
        told = met.told.copy()
        told[at] |= count > 0
        dark = np.zeros_like(told)
        dark[at] = ~radiance[at].any(axis=1)
        told &= ~_alone(dark)
        _close_slits(radiance, told, met.edges)
        if "sparkle" in self.twin.effects:
            distance_mm = met.centres.hits.laid_out(met.centres.hits.distance_mm, shape)
            radiance += sparkles(light, self._rough_mm2, self.camera, distance_mm)[..., None]
        radiance *= self._exposure * exposure
        if self._transmission is not None:
            radiance *= self._transmission
        color = self._displayed(radiance).clip(0, 1)
        return View(color, radiance, met.centres.hits, shape, self, met)

    @property
    def nbytes(self) -> int:
        """Memory of what the effects keep between views, bytes."""
        return self._illumination.nbytes

    @cached_property
    def _transmission(self) -> np.ndarray | None:
        """Share of the light that the lens passes, float32 [H, W, 1]; None: all."""
        if "vignetting" not in self.twin.effects:
            return None
        height, width = self.camera.height, self.camera.width
        passed = self.twin.effects["vignetting"].transmission(self.camera, np.arange(height * width))
        return passed.reshape(height, width, 1)

    @cached_property
    def _sees(self) -> np.ndarray:
        """Bool [H, W]: pixels through which the lens sees at all."""
        return np.isfinite(self.camera.pixel_directions).all(axis=2)

    def _met(
        self,
        light: ViewLight,
        T_world_camera: np.ndarray,
        mask: np.ndarray | None,
        hits: Correspondences | None,
    ) -> tuple[_Met, np.ndarray]:
        """What the rays of a view meet, and the radiance of its centres, [H, W, 3]."""
        shape = (self.camera.height, self.camera.width)
        if hits is None:
            hits = self.caster.cast(self.camera, T_world_camera, mask)
        centres = self._points(self.camera, hits, light, T_world_camera)
        laid_out = centres.hits.laid_out
        distance_mm = laid_out(centres.hits.distance_mm, shape)
        told = laid_out(centres.facing, shape)
        edges = discontinuities(distance_mm) | ((distance_mm > 0) & ~told)
        if centres.visible is not None:
            edges |= shadow_edges(laid_out(centres.visible, shape))
        radiance = centres.image(light, shape)
        # The same ones at any exposure: twice the gain is twice the light.
        edges |= bent(self._displayed(radiance))
        edges &= self._sees if mask is None else mask
        inside = (np.arange(SUBPIXELS) + 0.5) / SUBPIXELS - 0.5
        offsets = np.stack(np.meshgrid(inside, inside), axis=-1).reshape(-1, 2)
        uv = np.argwhere(edges)[:, ::-1]
        rays = Rays(self.camera.directions(uv[:, None] + offsets).astype(np.float32))
        within = self._points(rays, self.caster.cast(rays, T_world_camera), light, T_world_camera)
        return _Met(centres, told, edges, within), radiance

    def _displayed(self, radiance: np.ndarray) -> np.ndarray:
        """Display values of ``radiance`` [H, W, 3], beyond 1 where they clip."""
        return self.twin.displayed(torch.from_numpy(radiance)).numpy()

    def _points(
        self, rays: Camera | Rays, hits: Correspondences, light: ViewLight, T_world_camera: np.ndarray
    ) -> _Points:
        surface = self.twin.surface
        normals = to_camera(hits.interpolate(surface, surface.normals), T_world_camera)
        material = torch.from_numpy(hits.interpolate(surface, self._material))
        facing = -dot(normals, rays.pixel_directions.reshape(-1, 3).take(hits.pixel, axis=0)) > FACING
        lit, visible = light.lit(hits, rays.pixel_directions, normals)
        return _Points(hits, normals, material, facing, lit, visible)


@dataclass(frozen=True, eq=False)
class _Points:
    """What rays meet, whatever lobes answer the light there.

    Attributes:
        hits: N of them. normals: float32 [N, 3], unit, in the camera frame. material: base colour, roughness
            and metallic, [N, 5]. facing: bool [N], those that face their ray. lit: what the light guides do.
        visible: which guides they see, [N, K]; None where no shadow is cast.
    """

    hits: Correspondences
    normals: np.ndarray
    material: torch.Tensor
    facing: np.ndarray
    lit: Lit
    visible: np.ndarray | None

    def radiance(self, light: ViewLight) -> np.ndarray:
        """Float32 [N, 3]."""
        return light.radiance(self.hits, self.lit, self.material).numpy()

    def image(self, light: ViewLight, shape: tuple[int, int]) -> np.ndarray:
        """Their radiance [H, W, 3], where they are those of pixels; 0 where no surface is met."""
        return self.hits.laid_out(self.radiance(light), shape)


@dataclass(frozen=True, eq=False)
class _Met:
    """What the rays of a view meet.

    Attributes:
        centres: by the rays through the pixels' centres. told: bool [H, W], pixels whose centre shows its
            colour. edges: bool [H, W], E pixels whose colour is a mean. within: by SUBPIXELS² rays in the
            area of each of those.
    """

    centres: _Points
    told: np.ndarray
    edges: np.ndarray
    within: _Points

    def mean_radiance(self, light: ViewLight) -> tuple[np.ndarray, np.ndarray]:
        """Radiance float32 [E, 3] of the edges, averaged over the rays that meet a surface which faces them,
        and how many do, [E]."""
        facing, edges, inside = self.within.facing, np.count_nonzero(self.edges), SUBPIXELS**2
        seen = np.where(facing[:, None], self.within.radiance(light), 0)
        total = self.within.hits.laid_out(seen, (edges, inside)).sum(axis=1)
        count = np.bincount(self.within.hits.pixel[facing] // inside, minlength=edges).astype(np.float32)
        return total / np.maximum(count, 1)[:, None], count


def _material(twin: Twin) -> np.ndarray:
    """Base colour, roughness and metallic of each vertex, float32 [V, 5]."""
    materials = twin.materials
    return np.column_stack([materials.base_color, materials.roughness, materials.metallic])


def _alone(pixels: np.ndarray) -> np.ndarray:
    """Those of the ``pixels``, bool [H, W], beside which is no other: a single one that no guide lights, at a
    rim, is a shadow narrower than depth maps tell."""
    count = cv2.boxFilter(pixels.view(np.uint8), -1, (3, 3), normalize=False, borderType=cv2.BORDER_CONSTANT)
    return pixels & (count == 1)


def _close_slits(radiance: np.ndarray, told: np.ndarray, edges: np.ndarray) -> None:
    """Give those of the ``edges`` [H, W] that lie in gaps, of one or two pixels, between those whose colour
    is ``told`` [H, W] the mean ``radiance`` [H, W, 3] of the told ones about them.

    Through such a slit, behind the rim of a fold, no depth map saw; but no surface is black.
    """
    closed = cv2.morphologyEx(told.view(np.uint8), cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8)) > 0
    row, column = np.nonzero(closed & ~told & edges)
    about = np.mgrid[-1:2, -1:2].reshape(2, -1, 1)
    rows, columns = (
        np.clip(place + off, 0, size - 1)
        for place, off, size in zip((row, column), about, told.shape, strict=True)
    )
    weight = told[rows, columns].astype(np.float32)
    total = (radiance[rows, columns] * weight[..., None]).sum(axis=0)
    radiance[row, column] = total / np.maximum(weight.sum(axis=0), 1)[:, None]


def bent(shown: np.ndarray) -> np.ndarray:
    """Bool [H, W]: pixels whose mean is not the value of their centre, by the curvature of ``shown`` [H, W,
    3], in display values: a 24th of the Laplacian, for a parabola."""
    mean = (shown[..., 0] + shown[..., 1] + shown[..., 2]) / np.float32(3)
    return np.abs(cv2.Laplacian(mean, -1)) > 24 * BENT


def shadow_edges(visible: np.ndarray) -> np.ndarray:
    """Bool [H, W]: pixels beside which some guide is seen by one and not by another; ``visible`` [H, W,
    K]."""
    cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    edges = cv2.morphologyEx(np.ascontiguousarray(visible), cv2.MORPH_GRADIENT, cross)
    return edges.reshape(*visible.shape).max(axis=2) > 0
