"""Tissue beneath glints: where every photo outshines it, its materials are those of the tissue about."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import scipy.sparse
import torch
from scipy.sparse.linalg import spsolve

from endotwin.fit.state import State
from endotwin.fusion.smooth import neighbour_mean
from endotwin.pixels.samples import Samples
from endotwin.surface import Surface
from endotwin.surface.silhouettes import dilated

REACH_PX = 3
"""So far from a pixel that shines its blur goes, and others may shine of which no sample was taken."""

LEAST_SEEN = 0.5
"""Pixels off glints by which a vertex' materials are told."""


def _near(samples: Samples, chosen: torch.Tensor) -> np.ndarray:
    """Bool [N]: samples within REACH_PX of one that is ``chosen``, bool [N], in its photo."""
    found, views = np.zeros(len(samples), bool), samples.views
    row, pixel = views.row(samples.frame), samples.pixel.numpy()
    for each in np.unique(row[chosen.numpy()]):
        of_photo = row == each
        image = np.zeros(views.lens_mask.shape, bool)
        image.flat[pixel[of_photo & chosen.numpy()]] = 1
        found[of_photo] = dilated(image, REACH_PX).flat[pixel[of_photo]]
    return found


def healed(state: State, surface: Surface, samples: Samples, shines: torch.Tensor) -> State:
    """``state`` with harmonic materials (θ at a vertex the mean of its neighbours') where ``samples`` show
    nothing but what ``shines``, bool [N], and pixels about it."""
    corners, share = surface.triangles[samples.triangle.numpy()], samples.barycentric.numpy()
    beside, count = _near(samples, shines), len(surface.vertices_mm)

    def weight(chosen: np.ndarray) -> np.ndarray:
        return np.bincount(corners[chosen].ravel(), share[chosen].ravel(), count)

    hidden = (weight(beside) > 0) & (weight(~beside) < LEAST_SEEN)
    if not hidden.any() or hidden.all():
        return state
    raw, mean = state.raw.numpy().astype(np.float64), neighbour_mean(count, surface.triangles)[hidden]
    system = scipy.sparse.eye_array(int(hidden.sum())) * (1 + 1e-6) - mean[:, hidden]
    raw[hidden] = spsolve(scipy.sparse.csc_array(system), mean[:, ~hidden] @ raw[~hidden])
    return replace(state, operator=None, table=None, mean=torch.from_numpy(raw.astype(np.float32)))
