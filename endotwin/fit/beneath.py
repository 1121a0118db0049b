"""What a twin shows beneath its fluid: the model that was fitted before film, sparkles and bloom, which are
told from what photos show beyond it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from endotwin.fit.lighting import Relighting, lit
from endotwin.fit.model import at_pixels, log_exposure, radiance
from endotwin.fit.state import State
from endotwin.light import shading
from endotwin.light.film import Film, film_in_view
from endotwin.light.guides import lamps_mm
from endotwin.pixels.samples import Samples, Views, frame_samples, unsharpened
from endotwin.surface.casting import Caster
from endotwin.twin import Twin

GLINT = 0.1
"""Display values by which a pixel outshines the model to be a glint, in green and in blue: those of tissue
differ less than that from place to place, so that no error of poses or depth shows it."""

APART = 4
"""Every so many photos one is kept apart, to judge by: between its neighbours, as a held-out photo is."""


@dataclass(frozen=True)
class Model:
    """All that was fitted before the film."""

    twin: Twin
    state: State
    relighting: Relighting
    caster: Caster

    @property
    def guides_mm(self) -> np.ndarray:
        """Places of the light guides in the camera frame, [K, 3]."""
        return lamps_mm(self.relighting.effects.guides_mm)

    def photo(self, views: Views, row: int) -> Based:
        """All pixels of the photo of ``row`` among the ``views``, with what the model shows there."""
        twin, effects = self.twin, self.relighting.effects
        frame = unsharpened(twin.sequence().frame(int(views.frames[row])), views.processor)
        part = frame_samples(twin, self.caster, frame, views.lens_mask, 1.0, np.random.default_rng(0))
        return self.based(lit(Samples.joined([part], views), twin.surface, self.caster, effects))

    def shining(self, samples: Samples, row: int, film: Film, roughness: float) -> Tensor:
        """Radiance [N, 1] of a ``film`` at samples of the photo of ``row`` among their views."""
        effects, surface = self.relighting.effects, self.twin.surface
        caster = self.caster if "shadows" in effects else None
        more = self.guides_mm, effects.profile, self.state.shared.log_light, caster
        glow = film_in_view(film, roughness, surface.vertices_mm, samples.views.T_local_camera[row], *more)
        corners = torch.from_numpy(glow[surface.triangles[samples.triangle.numpy()]])
        return (samples.barycentric * corners).sum(dim=1, keepdim=True) * self.exposure(samples)

    def exposure(self, samples: Samples) -> Tensor:
        """Gain and vignetting, [N, 1], or [1, 1] of 1."""
        log_factor = log_exposure(samples, self.state.shared)
        return torch.ones(1, 1) if log_factor is None else log_factor.exp()[:, None]

    def based(self, samples: Samples) -> Based:
        """``samples``, which the guides light, with what the model shows there."""
        triangles = torch.from_numpy(self.twin.surface.triangles.astype(np.int64))
        samples = self.relighting.relit(samples, triangles, self.state)
        material = at_pixels(samples, triangles, self.state.materials)
        return Based(self, samples, radiance(samples, material, self.state.shared))


@dataclass(frozen=True)
class Based:
    """Samples, and the radiance [N, 3] that the model without a film shows there."""

    model: Model
    samples: Samples
    radiance: Tensor

    @property
    def shown(self) -> Tensor:
        """The photos' display values [N, 3], before a tone curve."""
        shown, tone = self.samples.color.float() / 255, self.model.state.shared.tone
        return shown if tone is None else torch.from_numpy(tone.undone(shown.numpy()))

    def predicted(self, film: Tensor | float = 0.0) -> Tensor:
        """Display values [N, 3] with the radiance [N, 1] of a ``film``."""
        return shading.respond(self.radiance + film, self.model.state.shared.gamma).clamp(max=1)

    def __getitem__(self, index: Tensor) -> Based:
        return Based(self.model, self.samples[index], self.radiance[index])

    @property
    def apart(self) -> Tensor:
        """Bool [N]: pixels of photos that are kept apart."""
        return torch.from_numpy(kept_apart(self.samples.views.row(self.samples.frame)))

    @property
    def shines(self) -> Tensor:
        """Bool [N]: glints."""
        return (self.shown - self.predicted())[:, 1:].amin(dim=1) > GLINT

    def vertices(self) -> np.ndarray:
        """The vertices that glints are nearest to, ascending."""
        return np.unique(self.samples[self.shines].nearest(self.model.twin.surface.triangles))

    def most_db(self) -> float:
        """What explaining every glint would gain."""
        squared = ((self.shown - self.predicted()) ** 2).sum(dim=1).double()
        return decibels(float(squared.sum()), float(squared[~self.shines].sum()))


def kept_apart(row: np.ndarray | Tensor) -> np.ndarray | Tensor:
    """Which photos, of those ``row`` among the views, are kept apart."""
    return row % APART == APART // 2


def decibels(before: float, after: float) -> float:
    return 10 * math.log10(max(before, 1e-12) / max(after, 1e-12))
