"""Bounced light as a probe's pixels would get it: what tells whether a scene calls for interreflection."""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_array

from endotwin.evidence.probe import Bounced, Hypothesis, Probe
from endotwin.light.radiosity import Radiosity
from endotwin.pixels.start import PRIOR

CELL = 0.15
"""Size of a patch as a share of the median viewing distance: 3 mm at 20 mm."""

PROBE_CELLS, PROBE_RAYS = 2.0, 64
"""The probe's patches are so many times larger, and each sends so many rays."""

PROBE_ALBEDO = 0.8
"""98th percentile of the brightest channel that the probe assumes: any tissue's is near enough to tell
whether light bounces at all."""

FIXED_POINT_ROUNDS = 2
LIGHT_STEP = 0.05
"""Step in n and q of the finite differences of the bounced light."""


def cell_mm(log_distance: np.ndarray) -> float:
    """Size of the patches for a scene seen from distances with logarithms [N]."""
    return CELL * float(np.exp(np.median(log_distance)))


def bounced(probe: Probe, hypothesis: Hypothesis) -> Bounced:
    """Indirect light at the probe's pixels, with n, q and γ at their priors.

    The plain closed form is biased by the bounce. The albedo is that of the photos; it starts without the
    bounce and is corrected for it in a few fixed-point rounds.
    """
    n, q, gamma = PRIOR["n"], PRIOR["q"], PRIOR["gamma"]
    size_mm = PROBE_CELLS * cell_mm(probe.samples.log_distance.numpy())
    radiosity = Radiosity(probe.twin.surface, probe.caster, size_mm, PROBE_RAYS)
    lamps = [
        [radiosity.lamp(pose, np.asarray(guide), hypothesis.profile) for guide in hypothesis.guides_mm]
        for pose in probe.T_local_camera
    ]
    to_pixel = radiosity.to_points(probe.local_points_mm, probe.local_normals)
    patch = radiosity.patch_of[probe.samples.triangle.numpy()]
    linear = (np.maximum(probe.samples.color.numpy(), 1) / 255.0) ** (1 / gamma)
    direct_light = probe.direct_light(hypothesis, n, q)

    def at_pixels(n: float, q: float, albedo: np.ndarray) -> np.ndarray:
        direct = np.stack([radiosity.direct(frame, n, q).mean(axis=1) for frame in lamps], axis=1)
        colored = radiosity.indirect(direct, albedo)
        weighted = (colored * albedo[:, None]).sum(axis=2) / albedo.sum(axis=1)[:, None]
        return _of_own_frame(to_pixel, weighted, probe.frame)

    light = direct_light
    for _ in range(FIXED_POINT_ROUNDS):
        albedo, L0 = _patch_albedo(linear, light, patch, radiosity.count)
        irradiance = at_pixels(n, q, albedo)
        light = direct_light + irradiance
    steps = (irradiance, at_pixels(n + LIGHT_STEP, q, albedo), at_pixels(n, q + LIGHT_STEP, albedo))
    log, further_n, further_q = (np.log(np.maximum(value, 1e-30)) for value in steps)
    return Bounced(log, (further_n - log) / LIGHT_STEP, (further_q - log) / LIGHT_STEP, L0)


def _patch_albedo(
    linear: np.ndarray, light: np.ndarray, patch: np.ndarray, count: int
) -> tuple[np.ndarray, float]:
    """Least-squares albedo [P, 3] of patches from linear photo values [N, 3] under ``light`` [N] for L0 =
    1, with PROBE_ALBEDO as its scale (the median where no pixel is); and the L0 that this scale asks for."""
    weight = np.bincount(patch, light * light, count)
    sums = np.stack([np.bincount(patch, light * channel, count) for channel in linear.T], axis=1)
    seen = weight > 0
    albedo = np.where(seen[:, None], sums / np.where(seen, weight, 1)[:, None], 0)
    albedo[~seen] = np.median(albedo[seen], axis=0)
    scale = PROBE_ALBEDO / float(np.percentile(albedo[seen].max(axis=1), 98))
    return albedo * scale, 1 / (2 * scale)


def _of_own_frame(to_pixel: csr_array, per_patch: np.ndarray, frame: np.ndarray) -> np.ndarray:
    """Values [P, F] of patches in each frame, interpolated at pixels of frames [N]: [N]."""
    nearest = to_pixel.indices.reshape(len(frame), -1)
    weight = to_pixel.data.reshape(len(frame), -1)
    return (weight * per_patch[nearest, frame[:, None]]).sum(axis=1)
