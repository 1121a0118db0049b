"""Bounced light as a probe's pixels would get it: what tells whether a scene calls for interreflection."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
import torch

from endotwin.evidence.log_light import Bounced
from endotwin.evidence.probe import Hypothesis, Probe
from endotwin.light.bounced import Albedo, BouncedLight, Places
from endotwin.light.forward import Lobes
from endotwin.light.radiosity import Radiosity
from endotwin.light.shading import F0_DIELECTRIC, ROUGHNESS_TISSUE
from endotwin.pixels.start import PRIOR
from endotwin.run.ahead import on_all_cores

CELL = 0.15
"""Size of a patch as a share of the median viewing distance: 3 mm at 20 mm."""

PROBE_RAYS = 64
"""That each of the probe's patches sends."""

PROBE_ALBEDOS = (0.55, 0.7, 0.85)
"""98th percentiles of the brightest channel that the probe tries: they tell how strong the bounce is."""

FIXED_POINT_ROUNDS = 2


class Patches:
    """The tissue of the scene of a probe, in patches that throw light on each other.

    Attributes:
        cell_mm: their size. light: what they throw on each other in the light of some frames, as of
            ``_light``; what was asked for last is kept.
    """

    def __init__(self, probe: Probe):
        self.cell_mm = CELL * probe.samples.distance_mm
        self.radiosity = Radiosity(probe.twin.surface, probe.caster, self.cell_mm, PROBE_RAYS)
        self._views, self.light = probe.samples.views, lru_cache(1)(self._light)

    def _light(
        self, frames: tuple[int, ...], guides_mm: tuple[tuple[float, float, float], ...], profile: float
    ) -> BouncedLight:
        poses = self._views.T_local_camera[np.searchsorted(self._views.frames, frames)]
        return BouncedLight(self.radiosity, poses, guides_mm, profile)


class Surroundings:
    """The tissue that throws light on a probe's pixels."""

    def __init__(self, probe: Probe, patches: Patches):
        self._probe, self._patches, roughness = probe, patches, torch.tensor(ROUGHNESS_TISSUE)
        samples, radiosity = probe.samples, patches.radiosity
        self._radiosity, self._patch = radiosity, radiosity.patch_of[samples.triangle.numpy()]
        self._places = Places(radiosity.to_points(probe.local_points_mm, probe.local_normals), probe.frame)
        self._linear = (np.maximum(samples.color.numpy(), 1) / 255.0) ** (1 / PRIOR["gamma"])
        lobes = Lobes(F0_DIELECTRIC)
        self._glossy = np.full((radiosity.count, 1), lobes.glossy_albedo(roughness))
        self._gloss = lobes.gloss(samples.cos, roughness)[:, 0].numpy()

    def bounced(self, hypothesis: Hypothesis) -> Bounced:
        """Indirect light at the pixels, with n, q and γ at their priors.

        The plain closed form is biased by the bounce. The albedo is that of the photos; it starts without the
        bounce and is corrected for it in a few fixed-point rounds. The specular lobe, of the usual tissue,
        sends its share of the light back, and on to the camera: for each pixel, the irradiance is that under
        which base colours alone would look as bright.
        """
        light, direct = self._lights(hypothesis)
        tried = list(on_all_cores(lambda each: self._under(light, direct, each), PROBE_ALBEDOS))
        models = [self._probe.fit(replace(hypothesis, bounced=each)) for each in tried]
        gains_db = [self._probe.compare(models[0], model).gain_db for model in models]
        return tried[int(np.argmax(gains_db))]

    def log_colors(self, hypothesis: Hypothesis) -> np.ndarray:
        """ln of the light, direct and bounced, that each channel gets at the pixels, [N, 3], with n, q and γ
        at their priors, if the brightest tissue has the middle one of PROBE_ALBEDOS."""
        light, direct = self._lights(hypothesis)
        albedo = self._albedo(light, direct, PROBE_ALBEDOS[1])
        irradiance = light.at(self._places, PRIOR["n"], PRIOR["q"], albedo)
        color = self._places.weights @ albedo.base_color
        return np.log(direct[:, None] + irradiance * (1 + self._gloss[:, None] / color))

    def _lights(self, hypothesis: Hypothesis) -> tuple[BouncedLight, np.ndarray]:
        """What throws light, and the irradiance [N] that comes from there itself."""
        direct = self._probe.direct_light(hypothesis, PRIOR["n"], PRIOR["q"])
        frames = tuple(self._probe.frames.tolist())
        return self._patches.light(frames, hypothesis.guides_mm, hypothesis.profile), direct

    def _albedo(self, light: BouncedLight, direct: np.ndarray, brightest: float) -> Albedo:
        """That of patches, the brightest of them ``brightest``, if ``direct`` [N] comes from the ``light``
        itself."""
        there = direct
        for _ in range(FIXED_POINT_ROUNDS):
            base_color = _patch_albedo(self._linear, there, self._patch, self._radiosity.count, brightest)
            albedo = Albedo(base_color, self._glossy)
            there = direct + self._seen(light.at(self._places, PRIOR["n"], PRIOR["q"], albedo), base_color)
        return albedo

    def _under(self, light: BouncedLight, direct: np.ndarray, brightest: float) -> Bounced:
        """The bounce off patches of such albedo. Arguments as of ``_albedo``."""
        n, q, albedo = PRIOR["n"], PRIOR["q"], self._albedo(light, direct, brightest)
        found = light.expanded(self._places, n, q, albedo, by=("n", "q"))
        seen = self._seen(found.irradiance(n, q).numpy(), albedo.base_color)
        return Bounced(np.log(np.maximum(seen, 1e-30)), found.by_n.numpy(), found.by_q.numpy())

    def _seen(self, irradiance: np.ndarray, base_color: np.ndarray) -> np.ndarray:
        """Irradiance [N, 3] as tissue of base colours [P, 3] shows it, [N]."""
        color = self._places.weights @ base_color
        return (irradiance * (color + self._gloss[:, None])).sum(axis=1) / color.sum(axis=1)


def _patch_albedo(
    linear: np.ndarray, light: np.ndarray, patch: np.ndarray, count: int, brightest: float
) -> np.ndarray:
    """Least-squares albedo [P, 3] of patches from linear photo values [N, 3] under ``light`` [N], with
    ``brightest`` as its scale; the median where no pixel is."""
    weight = np.bincount(patch, light * light, count)
    sums = np.stack([np.bincount(patch, light * channel, count) for channel in linear.T], axis=1)
    seen = weight > 0
    albedo = np.where(seen[:, None], sums / np.where(seen, weight, 1)[:, None], 0)
    albedo[~seen] = np.median(albedo[seen], axis=0)
    return albedo * brightest / float(np.percentile(albedo[seen].max(axis=1), 98))
