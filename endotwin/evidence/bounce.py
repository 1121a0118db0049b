"""Bounced light as a probe's pixels would get it: what tells whether a scene calls for interreflection."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from endotwin.evidence.log_light import Bounced
from endotwin.evidence.probe import Hypothesis, Probe
from endotwin.light.bounced import Albedo, BouncedLight, Places
from endotwin.light.forward import Lobes
from endotwin.light.radiosity import Radiosity
from endotwin.light.shading import F0_DIELECTRIC, ROUGHNESS_TISSUE
from endotwin.pixels.start import PRIOR

CELL = 0.15
"""Size of a patch as a share of the median viewing distance: 3 mm at 20 mm."""

PROBE_RAYS = 64
"""That each of the probe's patches sends."""

PROBE_ALBEDOS = (0.55, 0.7, 0.85)
"""98th percentiles of the brightest channel that the probe tries: they tell how strong the bounce is."""

FIXED_POINT_ROUNDS = 2


def cell_mm(log_distance: np.ndarray) -> float:
    """Size of the patches for a scene seen from distances with logarithms [N]."""
    return CELL * float(np.exp(np.median(log_distance)))


def bounced(probe: Probe, hypothesis: Hypothesis) -> Bounced:
    """Indirect light at the probe's pixels, with n, q and γ at their priors.

    The plain closed form is biased by the bounce. The albedo is that of the photos; it starts without the
    bounce and is corrected for it in a few fixed-point rounds. The specular lobe, of the usual tissue, sends
    its share of the light back, and on to the camera: for each pixel, the irradiance is that under which base
    colours alone would look as bright.
    """
    n, q, gamma = PRIOR["n"], PRIOR["q"], PRIOR["gamma"]
    samples, roughness = probe.samples, torch.tensor(ROUGHNESS_TISSUE)
    size_mm = cell_mm(samples.log_distance.numpy())
    radiosity = Radiosity(probe.twin.surface, probe.caster, size_mm, PROBE_RAYS)
    light = BouncedLight(radiosity, probe.T_local_camera, hypothesis.guides_mm, hypothesis.profile)
    places = Places(radiosity.to_points(probe.local_points_mm, probe.local_normals), probe.frame)
    patch = radiosity.patch_of[samples.triangle.numpy()]
    linear = (np.maximum(samples.color.numpy(), 1) / 255.0) ** (1 / gamma)
    lobes = Lobes(F0_DIELECTRIC)
    glossy = np.full((radiosity.count, 1), lobes.glossy_albedo(roughness))
    gloss = lobes.gloss(samples.cos, roughness).numpy()
    direct_light = probe.direct_light(hypothesis, n, q)

    def seen(irradiance: np.ndarray, base_color: np.ndarray) -> np.ndarray:
        """Irradiance [N, 3] as tissue of base colours [P, 3] shows it, [N]."""
        color = places.weights @ base_color
        return (irradiance * (color + gloss[:, None])).sum(axis=1) / color.sum(axis=1)

    def under(brightest: float) -> Bounced:
        light_there = direct_light
        for _ in range(FIXED_POINT_ROUNDS):
            base_color = _patch_albedo(linear, light_there, patch, radiosity.count, brightest)
            albedo = Albedo(base_color, glossy)
            light_there = direct_light + seen(light.at(places, n, q, albedo.scaled(0.0)), base_color)
        found = light.expanded(places, n, q, albedo, by=("n", "q"))
        log = np.log(np.maximum(seen(found.irradiance(n, q).numpy(), base_color), 1e-30))
        return Bounced(log, found.by_n.numpy(), found.by_q.numpy())

    tried = [under(brightest) for brightest in PROBE_ALBEDOS]
    models = [probe.fit(replace(hypothesis, bounced=each)) for each in tried]
    gains_db = [probe.compare(models[0], model).gain_db for model in models]
    return tried[int(np.argmax(gains_db))]


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
