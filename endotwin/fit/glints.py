"""Lobes of a film from its glints: Levenberg–Marquardt, each vertex for itself.

Each vertex that shone in a photo gets the normal and the weight with which it shines in those photos and in
no other; a pixel's film is what its triangle's corners mirror, interpolated, as the renderer shows it. The
photos' brightest level says 'at least'.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.sparse import csr_array
from torch import Tensor
from torch.nn.functional import normalize

from endotwin.fit.beneath import Based, Model, decibels
from endotwin.light import shading
from endotwin.light.film import Film, mirrored, mirrors_in_view
from endotwin.pixels.samples import Views

STEPS, DAMPING, MOST_DAMPING = 15, 1e-2, 1e6
LEAST_DAMPING, LEAST_TOLD = 1e-6, 1e-12
"""Of Levenberg–Marquardt; the last two keep those vertices regular that no photo tells of."""

LONGEST_SLOPES, LONGEST_LOG = 2.0, 1.5
"""The longest step: of a normal, in widths of the lobe, and of a weight's logarithm."""

NEARNESS = 2
"""Pixels count by this power of the share that a vertex has in them."""

LEAST_SHARE = 1e-3
"""A pixel says nothing of a vertex that has less of it: a ray through another has none."""

PEAK, PEAK_SPREAD, GLINT_ERROR = 2.0, 3.0, 0.1
"""Prior of a vertex's peak radiance (its median, and the standard deviation of its logarithm), beside the
error of a glint's display values."""

PRECISION = (GLINT_ERROR / PEAK_SPREAD) ** 2
"""Of that logarithm, beside squared display values."""

FAINT = 0.02
"""A vertex whose peak radiance is less has no film."""


@dataclass(frozen=True)
class Glints:
    """What vertices that may be wet show in each photo, P pairs of the two: means of the pixels about them.

    Attributes:
        vertex: int [M], ascending. row: int [P], of the photo among the views. of_vertex: int [P], among
            ``vertex``. half: [P, K, 3], half vectors in the surface's frame. strength: [P, K], 2πL of each
            guide, as exposed. shown, radiance: [P, 3], the photo's display values, and what the model without
            a film shows. normal: [M, 3], of the surface. gamma: of the response.
    """

    vertex: np.ndarray
    row: Tensor
    of_vertex: Tensor
    half: Tensor
    strength: Tensor
    shown: Tensor
    radiance: Tensor
    normal: Tensor
    gamma: float

    @classmethod
    def of(cls, based: Based, vertex: np.ndarray) -> Glints:
        model, samples = based.model, based.samples
        mix, row, place = pairs_in(based, vertex)
        half, strength = _mirrors_of(model, samples.views, vertex, row, place)
        near = mix.power(NEARNESS)
        near = (near / near.sum(axis=0)).T.tocsr()
        shown = model.exposure(samples).expand(len(samples), 1), based.shown, based.radiance
        means = [torch.from_numpy(near @ each.numpy()) for each in shown]
        return cls(
            vertex,
            torch.from_numpy(row),
            torch.from_numpy(place),
            half,
            strength * means[0],
            *means[1:],
            torch.from_numpy(model.twin.surface.normals[vertex]),
            model.state.shared.gamma,
        )

    def __getitem__(self, chosen: Tensor) -> Glints:
        """The ``chosen`` pairs, bool [P]."""
        names = ("row", "of_vertex", "half", "strength", "shown", "radiance")
        return replace(self, **{name: getattr(self, name)[chosen] for name in names})

    def _cost(self, film: Tensor) -> Tensor:
        """Half the squared error of each pair, [P], with the radiance [P] of its film."""
        error, _ = missed(self.shown, self.radiance, film, self.gamma)
        return (error**2).sum(dim=1) / 2

    def _total(self, values: Tensor) -> Tensor:
        """Sums [M, ...] over the pairs of each vertex of ``values`` [P, ...]."""
        total = torch.zeros(len(self.vertex), *values.shape[1:], dtype=values.dtype)
        return total.index_add_(0, self.of_vertex, values)

    def fitted(self, roughness: float) -> Lobes:
        """The lobes that show the pairs best: Levenberg–Marquardt, each vertex for itself."""
        lobes, damping = self._start(roughness), torch.full((len(self.vertex),), DAMPING)

        def cost(lobes: Lobes, film: Tensor) -> Tensor:
            return self._total(self._cost(film)) + PRECISION / 2 * self.off(lobes) ** 2

        film, slopes = lobes.linearised(self)
        before = cost(lobes, film)
        for _ in range(STEPS):
            normal, pull = self._normal_equations(film, slopes)
            normal[:, 2, 2] += PRECISION
            pull[:, 2] -= PRECISION * self.off(lobes)
            moved = lobes.moved(_damped(normal, pull, damping))
            tried = moved.linearised(self)
            after = cost(moved, tried[0])
            better = after < before
            lobes = replace(lobes, values=torch.where(better[:, None], moved.values, lobes.values))
            before = torch.where(better, after, before)
            damping = (damping * torch.where(better, 0.3, 5.0)).clamp(max=MOST_DAMPING)
            chosen = better.index_select(0, self.of_vertex)
            film = torch.where(chosen, tried[0], film)
            slopes = torch.where(chosen[:, None], tried[1], slopes)
        return lobes

    def _normal_equations(self, film: Tensor, slopes: Tensor) -> tuple[Tensor, Tensor]:
        """JᵀJ [M, 3, 3] and Jᵀe [M, 3] where the pairs' ``film`` [P] has ``slopes`` [P, 3]."""
        error, by_film = missed(self.shown, self.radiance, film, self.gamma)
        pull = (by_film * error).sum(dim=1, keepdim=True) * slopes
        slopes = by_film.double().norm(dim=1, keepdim=True) * slopes
        return self._total(slopes[:, :, None] * slopes[:, None]), self._total(pull.double())

    def off(self, lobes: Lobes) -> Tensor:
        """How far ln of the weights is from its prior's mean, [M]; 0 where no guide shines."""
        return torch.nan_to_num(lobes.values[:, 2] - self.log_weight_of_peak(lobes.roughness))

    def log_weight_of_peak(self, roughness: float) -> Tensor:
        """ln of the weight that gives each vertex a peak radiance of PEAK, [M]; −∞ where no guide shines."""
        strength = torch.zeros(len(self.vertex))
        strength.scatter_reduce_(0, self.of_vertex, self.strength.amax(dim=1), "amax")
        peak = mirrored(strength, torch.zeros_like(strength), roughness)
        return torch.where(strength > 0, math.log(PEAK) - torch.log(peak), -torch.inf)

    def _start(self, roughness: float) -> Lobes:
        """Lobes about the mean half vector of each vertex' glints, each with the guide whose half vector is
        nearest to the surface's normal."""
        bare = shading.respond(self.radiance, self.gamma)
        excess = (self.shown - bare)[:, 1:].amin(dim=1, keepdim=True).clamp_min(0)
        nearest = (self.half * self.normal[self.of_vertex][:, None]).sum(dim=2).argmax(dim=1)
        half = self.half[torch.arange(len(nearest)), nearest]
        axis = normalize(self._total(excess**2 * half) + 1e-9 * self.normal, dim=1)
        values = torch.cat([torch.zeros(len(axis), 2), self.log_weight_of_peak(roughness)[:, None]], dim=1)
        return Lobes(axis, values, roughness)


def missed(shown: Tensor, radiance: Tensor, film: Tensor, gamma: float) -> tuple[Tensor, Tensor]:
    """What display values ``shown`` [N, 3] have more than ``radiance`` [N, 3] and a ``film`` [N] give, and
    their slope by the film, [N, 3]; what is clipped, and rightly so, has none."""
    x = radiance + film[:, None]
    given = shading.respond(x, gamma)
    by_film = gamma * (given + shading.RADIANCE_MIN**gamma) / (x + shading.RADIANCE_MIN)
    return shown - given.clamp(max=1), by_film * ((given < 1) | (shown < 1))


def _damped(normal: Tensor, pull: Tensor, damping: Tensor) -> Tensor:
    """Steps [M, 3] that solve (N + damping·diag N)·step = pull, N [M, 3, 3]; 0 where nothing tells."""
    scale = normal.diagonal(dim1=1, dim2=2).clamp_min(LEAST_TOLD).rsqrt()
    scaled = normal * scale[:, :, None] * scale[:, None]
    scaled = scaled + torch.diag_embed((damping[:, None] + LEAST_DAMPING).expand_as(scale))
    return (scale * torch.linalg.solve(scaled, scale * pull)).float()


def pairs_in(based: Based, vertex: np.ndarray) -> tuple[csr_array, np.ndarray, np.ndarray]:
    """Shares float32 [N, P] in each sample of the pairs of a photo and one of ``vertex``, none less than
    LEAST_SHARE; the photo's row among the views, and the place in ``vertex``, of each pair, ascending, both
    [P].
    """
    surface, samples = based.model.twin.surface, based.samples
    place = np.full(len(surface.vertices_mm), -1)
    place[vertex] = np.arange(len(vertex))
    corners = place[surface.triangles[samples.triangle.numpy()]]
    share = samples.barycentric.numpy()
    sample, corner = np.nonzero((corners >= 0) & (share >= LEAST_SHARE))
    row = samples.views.row(samples.frame)[sample]
    pair, which = np.unique(row * len(vertex) + corners[sample, corner], return_inverse=True)
    share = share[sample, corner]
    mix = csr_array((share, (sample, which.reshape(-1))), (len(samples), len(pair)))
    return mix, pair // len(vertex), pair % len(vertex)


def _mirrors_of(
    model: Model, views: Views, vertex: np.ndarray, row: np.ndarray, place: np.ndarray
) -> tuple[Tensor, Tensor]:
    """Half vectors [P, K, 3] in the surface's frame and strengths [P, K] of the guides, 0 in their shadow, at
    the vertices ``vertex[place]`` in the views ``row`` (ascending), both [P]."""
    effects, surface = model.relighting.effects, model.twin.surface
    caster = model.caster if "shadows" in effects else None
    guides_mm = model.guides_mm
    halves, strengths = [torch.zeros(0, len(guides_mm), 3)], [torch.zeros(0, len(guides_mm))]
    for view in np.unique(row):
        points_mm = surface.vertices_mm[vertex[place[row == view]]]
        half, strength = mirrors_in_view(
            points_mm,
            views.T_local_camera[view],
            guides_mm,
            effects.profile,
            model.state.shared.log_light,
            caster,
        )
        halves.append(torch.from_numpy(half))
        strengths.append(strength)
    return torch.cat(halves), torch.cat(strengths)


@dataclass(frozen=True)
class Lobes:
    """A lobe of each of M vertices.

    Attributes:
        axis: [M, 3], unit normals to start from, in the surface's frame. values: [M, 3], slope of the normal
            along two tangents of ``axis``, and ln of the weight. roughness: one for all.
    """

    axis: Tensor
    values: Tensor
    roughness: float

    def moved(self, step: Tensor) -> Lobes:
        """The lobes after a ``step`` [M, 3] of their values, no longer than what the slopes at its start
        tell."""
        longest = torch.tensor([LONGEST_SLOPES * self.roughness**2] * 2 + [LONGEST_LOG])
        return replace(self, values=self.values + step.clamp(-longest, longest))

    @property
    def _tangents(self) -> tuple[Tensor, Tensor]:
        other = torch.eye(3, dtype=self.axis.dtype)[self.axis.abs().argmin(dim=1)]
        first = normalize(torch.linalg.cross(self.axis, other), dim=1)
        return first, torch.linalg.cross(self.axis, first)

    @property
    def _bent(self) -> Tensor:
        """Normals [M, 3], longer than 1 where they have a slope."""
        first, second = self._tangents
        return self.axis + self.values[:, :1] * first + self.values[:, 1:2] * second

    @property
    def normal(self) -> Tensor:
        """Unit normals [M, 3]."""
        return normalize(self._bent, dim=1)

    def radiance(self, glints: Glints) -> Tensor:
        """What each pair of vertex and photo mirrors, [P]."""
        return self.linearised(glints)[0]

    def linearised(self, glints: Glints) -> tuple[Tensor, Tensor]:
        """What each pair of vertex and photo mirrors, [P], and its slopes by the vertex' values, [P, 3]."""

        def at_pairs(per_vertex: Tensor) -> Tensor:
            return per_vertex.index_select(0, glints.of_vertex)[:, None]

        normal, length, alpha2 = self.normal, self._bent.norm(dim=1, keepdim=True), self.roughness**4
        apart2 = ((at_pairs(normal) - glints.half) ** 2).sum(dim=2)
        cos, sin2 = 1 - apart2 / 2, apart2 * (1 - apart2 / 4)  # exact near the mirror direction
        each = at_pairs(self.values[:, 2].exp()) * mirrored(glints.strength, sin2, self.roughness)
        by_cos = 4 * cos * (1 - alpha2) * each / (sin2 + alpha2 * (1 - sin2))
        slopes = []
        for tangent in self._tangents:
            across = (tangent - (tangent * normal).sum(dim=1, keepdim=True) * normal) / length
            slopes.append((by_cos * (at_pairs(across) * glints.half).sum(dim=2)).sum(dim=1))
        film = each.sum(dim=1)
        return film, torch.stack([*slopes, film], dim=1)

    def film(self, glints: Glints) -> Film:
        """The film of those that can shine."""
        peak = PEAK * (self.values[:, 2] - glints.log_weight_of_peak(self.roughness)).exp()
        wet = peak > FAINT  # false where no guide shines: −∞ less −∞
        normal, weight = self.normal[wet].numpy(), self.values[wet, 2].exp().numpy()
        return Film(glints.vertex[wet.numpy()].astype(np.int32), normal, weight)


def gains_in_other_photos_db(based: Based, vertex: np.ndarray, trials: Iterable[Lobes]) -> list[float]:
    """What each of the ``trials``, lobes of ``vertex``, gains in the photos that are kept apart."""
    apart = based[based.apart]
    mix, row, place = pairs_in(apart, vertex)
    half, strength = _mirrors_of(based.model, based.samples.views, vertex, row, place)
    glints = Glints(vertex, None, torch.from_numpy(place), half, strength, None, None, None, 0.0)
    films = (torch.from_numpy(mix @ lobes.radiance(glints).numpy())[:, None] for lobes in trials)
    before, *after = (
        float(((apart.shown - apart.predicted(film)) ** 2).sum())
        for film in (0.0, *(film * based.model.exposure(apart.samples) for film in films))
    )
    return [decibels(before, each) for each in after]
