"""What lights a twin's surface in one view: the light at the lens or guides beside it, shadows, bounced
light."""

from __future__ import annotations

import math
from copy import copy
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from endotwin.light.bounced import Albedo, BouncedLight
from endotwin.light.film import film_in_view
from endotwin.light.forward import Lit, Lobes, radiance
from endotwin.light.guides import AT_LENS, COSINE, guided, lamps_mm, log_axis, visible_from
from endotwin.light.incidence import COS_MIN, incidence_on
from endotwin.light.radiosity import Radiosity
from endotwin.surface.casting import Caster, Correspondences
from endotwin.surface.vectors import dot
from endotwin.twin import Twin


class Illumination:
    """The light of one twin; makes only what the twin's effects ask for.

    Args:
        radiosity: of the twin's surface, if it is known.
    """

    def __init__(self, twin: Twin, caster: Caster, radiosity: Radiosity | None = None):
        self.twin = twin
        self._caster = caster
        self._radiosity, self._albedo = radiosity, None
        self._bounce()

    def edited(self, twin: Twin) -> Illumination:
        """That of another edit of the same twin; what the edits have in common is not made again. Form
        factors are kept through edits that have no use for them."""
        other = copy(self)
        other.twin = twin
        if twin.materials is not self.twin.materials or _lobes(twin) != _lobes(self.twin):
            other._albedo = None
        other._bounce()
        return other

    def _bounce(self) -> None:
        """Make what bounces light, where it bounces."""
        effects = self.twin.effects
        if effects.bounce <= 0:
            self._albedo = None
            return
        cell_mm = effects["interreflection"].cell_mm
        if self._radiosity is None or self._radiosity.cell_mm != cell_mm:
            self._radiosity, self._albedo = Radiosity(self.twin.surface, self._caster, cell_mm), None
        if self._albedo is None:
            self._albedo = _albedo(self.twin, self._radiosity)

    def moved(self, twin: Twin, caster: Caster) -> Illumination:
        """That of ``twin`` on the moved surface of ``caster``, which has the same triangles. Tissue throws
        light on tissue by the form factors of the surface at rest."""
        other = copy(self)
        other.twin, other._caster = twin, caster
        if self._radiosity is not None:
            other._radiosity = self._radiosity.moved(caster)
        return other

    @property
    def nbytes(self) -> int:
        """Memory of what is kept between views, bytes."""
        return 0 if self._radiosity is None else self._radiosity.nbytes

    def at(self, T_world_camera: np.ndarray) -> ViewLight:
        """The light of the view from ``T_world_camera`` [4, 4]."""
        T_local_camera = self.twin.surface.to_local(T_world_camera)
        bounced = None if self._albedo is None else self._bounced(T_local_camera)
        return ViewLight(self.twin, self._caster, T_local_camera, bounced, self._film(T_local_camera))

    def _film(self, T_local_camera: np.ndarray) -> np.ndarray | None:
        """Radiance that the film at each vertex sends to the camera, float32 [V]; None without a film."""
        twin, effects, film = self.twin, self.twin.effects, self.twin.film
        if film is None:
            return None
        return effects["film"].amount * film_in_view(
            film,
            effects["film"].roughness,
            twin.surface.vertices_mm,
            T_local_camera,
            lamps_mm(effects.guides_mm),
            effects.profile,
            log_light(twin),
            self._caster if "shadows" in effects else None,
        )

    def _bounced(self, T_local_camera: np.ndarray) -> np.ndarray:
        """``ViewLight.bounced`` of the view from there."""
        light, effects, to_vertex = self.twin.light, self.twin.effects, self._radiosity.to_vertex
        guides_mm = effects.guides_mm or AT_LENS
        bounced = BouncedLight(self._radiosity, T_local_camera[None], guides_mm, effects.profile)
        both = np.concatenate(bounced.between(light.n, light.q, self._albedo), axis=2)
        return np.float32(effects.bounce) * (to_vertex @ both[:, 0])


@dataclass(frozen=True)
class ViewLight:
    """The light of one view.

    Attributes:
        T_local_camera: the pose in the surface's frame, float64 [4, 4].
        bounced: indirect irradiance of each vertex and radiosity of what it mirrors to the camera, float32
            [V, 6], with L0 = 1; None: no light bounces.
        film: radiance that the film at each vertex sends to the camera, float32 [V]; None: nothing.
    """

    twin: Twin
    caster: Caster
    T_local_camera: np.ndarray
    bounced: np.ndarray | None
    film: np.ndarray | None

    def lit(
        self, hits: Correspondences, directions: np.ndarray, normals: np.ndarray
    ) -> tuple[Lit, np.ndarray | None]:
        """What the guides do to hits, without what comes from other tissue.

        Args:
            directions: unit viewing rays of all pixels, float32 [..., 3]. normals: float32 [N, 3]; both in
                the camera frame.

        Returns:
            it; and which guides each point sees, float32 [N, K] (None where no shadow is cast).
        """
        effects = self.twin.effects
        if effects.guides_mm is None:
            geometry = incidence_on(normals, hits, directions)
            if effects.profile != COSINE:
                axis = log_axis(np.exp(geometry.log_cos_axis), effects.profile)
                geometry = replace(geometry, log_cos_axis=axis)
            return Lit.at_lens(*(torch.from_numpy(value) for value in vars(geometry).values())), None
        view = directions.reshape(-1, 3).take(hits.pixel, axis=0)
        points_mm = view * hits.distance_mm[:, None]
        guides_mm, visible = np.asarray(effects.guides_mm, np.float32), None
        if "shadows" in effects:
            visible = visible_from(self.caster, self.T_local_camera, points_mm, guides_mm)
        guides = guided(points_mm, normals, guides_mm, effects.profile, visible)
        cos_o = np.clip(-dot(normals, view), COS_MIN, 1)
        return Lit(torch.from_numpy(cos_o), guides), visible

    def radiance(self, hits: Correspondences, lit: Lit, material: Tensor) -> Tensor:
        """Radiance of hits, float32 [N, 3], that the guides light so; ``material``: base colour, roughness
        and metallic of the hits, [N, 5]."""
        twin, roughness = self.twin, material[:, 3]
        if self.bounced is not None:
            gloss = _lobes(twin).gloss(lit.cos_o.clamp(max=1), roughness)
            irradiance, mirrored = np.split(hits.interpolate(twin.surface, self.bounced), 2, axis=1)
            lit = replace(
                lit,
                irradiance=torch.from_numpy(irradiance),
                mirrored=torch.from_numpy(mirrored),
                gloss=gloss,
            )
        base_color = material[:, :3] * (1 - material[:, 4:])
        x = radiance(lit, log_light(twin), base_color, roughness, _lobes(twin))
        if self.film is not None:
            x = x + torch.from_numpy(hits.interpolate(twin.surface, self.film))[:, None]
        return x


def log_light(twin: Twin) -> tuple[float, float, float]:
    """ln L0, n and q."""
    return math.log(max(twin.light.L0, 1e-30)), twin.light.n, twin.light.q


def _lobes(twin: Twin) -> Lobes:
    coat = twin.effects.get("coat")
    return Lobes(twin.materials.f0, twin.materials.diffuse == "burley", coat and coat.lobe)


def _albedo(twin: Twin, radiosity: Radiosity) -> np.ndarray:
    """Share of light from all around that each patch sends back, float [P, 3]."""
    materials = twin.materials
    diffuse = torch.from_numpy(materials.base_color * (1 - materials.metallic)[:, None])
    roughness = torch.from_numpy(materials.roughness)
    return Albedo.of(radiosity, diffuse, roughness, _lobes(twin), twin.surface.triangles).scaled(0.0)
