"""Tissue that no photo tells, or only one that outshines it: its materials go on from those about it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import scipy.sparse
import torch
from scipy.sparse.linalg import spsolve

from endotwin.fit.state import State
from endotwin.pixels.samples import Samples
from endotwin.surface import Surface
from endotwin.surface.neighbours import neighbour_mean
from endotwin.surface.silhouettes import dilated

REACH_PX = 3
"""So far from a pixel that shines its blur goes, and others may shine of which no sample was taken."""

LEAST_SEEN = 0.5
"""Pixels by which a vertex' materials are told, off glints where there are some."""

ANCHOR = 1e-8
"""What ties a vertex to the mean of all, against one to its neighbours: pieces of which no photo tells any
have nothing else."""


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


def extended(state: State, surface: Surface, samples: Samples) -> State:
    """``state`` with harmonic materials where ``samples`` show nothing: features that are not told there are
    those of places far off, with which they share slots or coarse cells."""
    return _harmonic(state, surface, _told(samples, surface) < LEAST_SEEN)


def healed(state: State, surface: Surface, samples: Samples, shines: torch.Tensor) -> State:
    """``state`` with harmonic materials where ``samples`` show nothing but what ``shines``, bool [N], and
    pixels about it."""
    beside = torch.from_numpy(_near(samples, shines))
    covered = _told(samples[beside], surface) > 0
    return _harmonic(state, surface, covered & (_told(samples[~beside], surface) < LEAST_SEEN))


def _told(samples: Samples, surface: Surface) -> np.ndarray:
    """Pixels that show each vertex, each shared by the corners of its triangle, float [V]."""
    corners, share = surface.triangles[samples.triangle.numpy()], samples.barycentric.numpy()
    return np.bincount(corners.ravel(), share.ravel(), len(surface.vertices_mm))


def _harmonic(state: State, surface: Surface, hidden: np.ndarray) -> State:
    """``state`` in which θ of vertices that are ``hidden``, bool [V], is the mean of their neighbours'."""
    if not hidden.any() or hidden.all():
        return state
    raw = state.raw.numpy().astype(np.float64)
    mean = neighbour_mean(len(raw), surface.triangles)[hidden].astype(np.float64)
    system = scipy.sparse.diags_array(mean.sum(axis=1) + ANCHOR) - mean[:, hidden]
    known = mean[:, ~hidden] @ raw[~hidden] + ANCHOR * raw[~hidden].mean(axis=0)
    raw[hidden] = spsolve(scipy.sparse.csc_array(system), known)
    return replace(state, operator=None, table=None, mean=torch.from_numpy(raw).to(state.raw.dtype))
