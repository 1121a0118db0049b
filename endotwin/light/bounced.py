"""Light that tissue throws on tissue, at points of the surface that are seen from some views.

``radiosity`` moves light between patches; this is what of it arrives at points, as a function of the light's
n and q and of how bright the tissue is.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy.sparse
import torch
from torch import Tensor

from endotwin.light.forward import Lobes
from endotwin.light.radiosity import Radiosity
from endotwin.run.ahead import on_all_cores
from endotwin.surface.rows import Rows

BOUNCES_BY, LIGHT_STEP = ("n", "q", "scale"), 0.05
"""What bounced light depends on, n, q and the logarithm of all albedo, and the step of finite differences."""

GAMMA_STEP = 0.01
"""That in γ."""

ALIKE = 0.5
"""Light follows a change of all colours in full, and that of a single place not at all. Taken for halfway,
both settle from step to step: of an error, no more than s/2 / (1 + s/2) is left where s = share·by_scale."""

WITH_ALL = 1 - ALIKE
"""What is left of a change that light follows in full is for the mean colour of all tissue."""

MOST_FOLLOWED = 1.0
"""Of the logarithm of bounced light, that it follows the colours at once."""

DARKEST = 1e-30

_SLOPES = (*BOUNCES_BY, "gamma")


@dataclass(frozen=True)
class Albedo:
    """How much of the light from all around patches send back.

    Attributes:
        base_color: float [P, 3], by the diffuse lobe. glossy: float [P, 1], by the white ones.
    """

    base_color: np.ndarray
    glossy: np.ndarray

    @classmethod
    def of(
        cls, radiosity: Radiosity, base_color: Tensor, roughness: Tensor, lobes: Lobes, triangles: np.ndarray
    ) -> Albedo:
        """That of a surface with ``base_color`` [V, 3] and ``roughness`` [V] at its vertices; ``triangles``
        int [F, 3] are those of the radiosity's surface, whose vertices may be merged."""
        answer = torch.cat([base_color, lobes.glossy_albedo(roughness)[:, None]], dim=1).numpy()
        corners = [answer.take(triangles[:, k], axis=0) for k in range(3)]
        mean = radiosity.mean(sum(corners) / np.float32(3))
        return cls(mean[:, :3], mean[:, 3:])

    def scaled(self, log_scale: float) -> Albedo:
        """With base colours brighter by a factor whose logarithm is ``log_scale``."""
        return replace(self, base_color=np.exp(log_scale) * self.base_color)


@dataclass(frozen=True)
class Places:
    """Points at which bounced light is wanted.

    Attributes:
        weights: CSR [N, P], interpolation from patches (``Radiosity.to_points``).
        view: int [N], in which view each point is seen.
    """

    weights: scipy.sparse.csr_array
    view: np.ndarray

    def of(self, per_patch: np.ndarray) -> np.ndarray:
        """Values [P, M, C] of patches in M views at the points, [N, C]."""
        by_view = np.swapaxes(per_patch, 0, 1).reshape(-1, per_patch.shape[2])
        return self._from_views @ by_view[: self._from_views.shape[1]]

    @cached_property
    def _from_views(self) -> scipy.sparse.csr_array:
        patches = self.weights.shape[1]
        views = np.repeat(self.view.astype(np.int32), np.diff(self.weights.indptr))
        shape = len(self.view), (int(self.view.max(initial=0)) + 1) * patches
        columns = patches * views + self.weights.indices
        return scipy.sparse.csr_array((self.weights.data, columns, self.weights.indptr), shape)


@dataclass(frozen=True)
class Bounce(Rows):
    """Indirect irradiance at N points, E = L0·exp(log + n·by_n + q·by_q + ln κ·by_scale + γ·by_gamma +
    ln κf0·by_f0), κ a factor on all albedo, γ the response through which photos show it, κf0 the reflectance
    of the tissue's white lobe.

    Attributes:
        log, by_scale, by_gamma: float32 [N, 3]. by_n, by_q: float32 [N], the channels' mean.
        gloss: float32 [N, 2], ``Lobes.gloss`` of the points, of the first what does not grow with f0, over κ;
            None: nobody asked for it.
        by_f0: float32 [N, 3], gloss_by_f0: float32 [N], how both grow with f0; None: they stay as they are.
        surroundings: float32 [N, 3], radiosity of that over E; None: 1.
        shown: float32 [N, 3], γ·ln of the points' base colours that throw it; None: it follows no colours.
        tissue: float32 [N, 3], γ times the mean of ln of all tissue's, alike in all rows.
    """

    log: Tensor
    by_n: Tensor
    by_q: Tensor
    by_scale: Tensor
    by_gamma: Tensor
    gloss: Tensor | None = None
    by_f0: Tensor | None = None
    gloss_by_f0: Tensor | None = None
    surroundings: Tensor | None = None
    shown: Tensor | None = None
    tissue: Tensor | None = None

    def to(self, device: torch.device) -> Bounce:
        """The same on ``device``."""
        return Bounce(**{name: None if x is None else x.to(device) for name, x in vars(self).items()})

    def irradiance(
        self, n: float, q: float, log_scale: float = 0.0, gamma: float = 0.0, f0: float = 0.0
    ) -> Tensor:
        """E with L0 = 1, [N, 3]."""
        by_light = (n * self.by_n + q * self.by_q)[:, None]
        log = self.log + by_light + log_scale * self.by_scale + gamma * self.by_gamma
        if self.by_f0 is not None and f0 > 0:
            log = log + (log_scale + torch.log(torch.as_tensor(f0, dtype=torch.float64))) * self.by_f0
        return torch.exp(log)

    def glossy(self, f0: float) -> Tensor:
        """``Lobes.gloss`` of the points, the first over κ, [N, 2]."""
        if self.gloss_by_f0 is None:
            return self.gloss
        return torch.stack([self.gloss[:, 0] + f0 * self.gloss_by_f0, self.gloss[:, 1]], dim=1)

    def beside_lobe(self, f0: float, log_scale: float, share: Tensor, gloss_by_f0: Tensor) -> Bounce:
        """The same, exact at this ``f0`` and scale, where all f0 grow: of what albedos do to it if all grow,
        the ``share`` [3], and ``gloss_by_f0`` [N] to what the points mirror."""
        by_f0 = share * self.by_scale
        log = self.log - (log_scale + math.log(f0)) * by_f0
        gloss = torch.stack([self.gloss[:, 0] - f0 * gloss_by_f0, self.gloss[:, 1]], dim=1)
        return replace(self, log=log, gloss=gloss, by_f0=by_f0, gloss_by_f0=gloss_by_f0)

    def mirrored(self, irradiance: Tensor) -> Tensor:
        """Radiosity [N, 3] of what the points mirror to their cameras, where this is their E [N, 3]."""
        return irradiance if self.surroundings is None else irradiance * self.surroundings

    @property
    def following(self) -> Tensor:
        """d ln E / d ln base colour of the points, [N, 3], as far as the tissue about them changes alike."""
        return ALIKE * self.by_scale

    def followed(self, log_color: Tensor, gamma: float, tissue: Tensor | None = None) -> Tensor:
        """Factor [N, 3] on it with base colours of logarithm ``log_color`` [N, 3], where the mean of all
        tissue's is ``tissue`` [3] (None: what it was)."""
        log_factor = self.following * (log_color - self.shown / gamma)
        if tissue is not None and self.tissue is not None:
            log_factor = log_factor + WITH_ALL * self.by_scale * (tissue - self.tissue / gamma)
        return torch.exp(log_factor.clamp(-MOST_FOLLOWED, MOST_FOLLOWED))


class BouncedLight:
    """Indirect irradiance under the lights of M views.

    Args:
        radiosity: of the surface. T_local_camera: the views' poses in its frame, float64 [M, 4, 4].
        guides_mm: [K, 3] in the camera frame, equally bright. profile: see ``guides.log_axis``.
    """

    def __init__(self, radiosity: Radiosity, T_local_camera: np.ndarray, guides_mm, profile: float):
        self._radiosity = radiosity
        self._lamps = [
            [radiosity.lamp(pose, np.asarray(guide), profile) for guide in guides_mm]
            for pose in T_local_camera
        ]
        middle_mm = np.mean(np.asarray(guides_mm), axis=0)
        self._sources_mm = T_local_camera[:, :3, 3] + T_local_camera[:, :3, :3] @ middle_mm
        self._T_local_camera = T_local_camera

    def at(self, places: Places, n: float, q: float, albedo: Albedo) -> np.ndarray:
        """Irradiance float32 [N, 3] with L0 = 1 and patches of ``albedo``."""
        return places.of(self._between(n, q, albedo)[1][: self._radiosity.count])

    def between(self, n: float, q: float, albedo: Albedo) -> tuple[np.ndarray, np.ndarray]:
        """Indirect irradiance of patches of ``albedo``, and radiosity of what they mirror to the cameras,
        float32 [P, M, 3], with L0 = 1."""
        direct, arriving = self._between(n, q, albedo)
        return arriving[: self._radiosity.count], self._mirrored(direct, arriving, albedo)

    def _between(self, n: float, q: float, albedo: Albedo) -> tuple[np.ndarray, np.ndarray]:
        """Direct irradiance [P + W, M] and indirect one [P + W, M, 3] of patches and the wall's, float32."""
        radiosity = self._radiosity
        direct = np.stack([radiosity.direct(lamps, n, q).mean(axis=1) for lamps in self._lamps], axis=1)
        mirrors = self._mirrors if albedo.glossy.any() else ()
        return direct, radiosity.indirect(direct, albedo.base_color, albedo.glossy, mirrors)

    def _mirrored(self, direct: np.ndarray, arriving: np.ndarray, albedo: Albedo) -> np.ndarray:
        """Radiosity of what patches mirror to the cameras, float32 [P, M, 3], in the light of ``_between``:
        as if it came from all around where nothing is to be seen, or no lobe is white."""
        mirrored = arriving[: self._radiosity.count].copy()
        if not albedo.glossy.any():
            return mirrored
        color, glossy = (self._radiosity.walled(x) for x in (albedo.base_color, albedo.glossy))
        leaving = color * (direct[..., None] + arriving) + glossy * arriving
        for view, factors in enumerate(self._shown):
            mirrored[:, view] *= (1 - factors.sum(axis=1))[:, None]
            mirrored[:, view] += factors @ leaving[:, view]
        return mirrored

    @cached_property
    def _mirrors(self) -> list[scipy.sparse.csr_array]:
        """What each view's light throws on where white lobes mirror it."""
        views = zip(self._sources_mm, self._lamps, strict=True)
        return list(on_all_cores(lambda view: self._radiosity.mirror_factors(*view), views))

    @cached_property
    def _shown(self) -> list[scipy.sparse.csr_array]:
        """What white lobes show to each view's camera."""
        return [self._radiosity.mirrored_factors(pose) for pose in self._T_local_camera]

    def expanded(
        self,
        places: Places,
        n: float,
        q: float,
        albedo: Albedo,
        gloss: Tensor | None = None,
        log_scale: float = 0.0,
        seen_by: tuple[float, Albedo] | None = None,
        by: Collection[str] = BOUNCES_BY,
    ) -> Bounce:
        """The bounce as a function of n, q, the albedo's scale and γ, exact where they are as given here.

        ``gloss`` [N, 2] is the bounce's; None: what points mirror is not asked for. ``seen_by``: γ, and the
        albedo that photos tell of with γ + GAMMA_STEP; None: whatever γ, the albedo is the same. ``by``:
        those of BOUNCES_BY that are to change; each of them takes its time.
        """
        about = {"n": n, "q": q, "scale": log_scale}
        steps = dict.fromkeys(by, LIGHT_STEP)
        jobs = [(*about.values(), albedo, gloss is not None)]
        jobs += [(*(about | {name: about[name] + LIGHT_STEP}).values(), albedo, False) for name in by]
        if seen_by is not None:
            jobs.append((*about.values(), seen_by[1], False))
            about["gamma"], steps["gamma"] = seen_by[0], GAMMA_STEP
        (here, surroundings), *found = on_all_cores(lambda job: self._expected(places, *job), jobs)
        slopes = {name: torch.zeros(here.shape[:1] if name in ("n", "q") else here.shape) for name in _SLOPES}
        level = here
        for (name, step), (moved, _) in zip(steps.items(), found, strict=True):
            slope = (moved - here) / step
            if name in ("n", "q"):
                slope = slope.mean(dim=1, keepdim=True)
            level = level - about[name] * slope
            slopes[name] = slope.reshape(slopes[name].shape)
        return Bounce(level, *slopes.values(), gloss, surroundings=surroundings)

    def _expected(
        self, places: Places, n: float, q: float, log_scale: float, albedo: Albedo, mirrored: bool
    ) -> tuple[Tensor, Tensor | None]:
        """ln of the irradiance of ``places`` [N, 3], and, if it is asked what is ``mirrored`` there, the
        bounce's ``surroundings``."""
        albedo = albedo.scaled(log_scale)
        direct, arriving = self._between(n, q, albedo)
        irradiance = torch.from_numpy(places.of(arriving[: self._radiosity.count])).float().clamp_min(DARKEST)
        if not mirrored:
            return irradiance.log(), None
        surroundings = torch.from_numpy(places.of(self._mirrored(direct, arriving, albedo))).float()
        return irradiance.log(), surroundings / irradiance
