"""The film of fluid from its glints: what outshines the rest of the model, vertex by vertex.

A glint stands where the fluid's normal halves the angle between camera and light guide, to a fraction of a
degree: far better than depth tells normals. Each vertex that shone in a photo gets the normal and the weight
with which it shines in those photos and in no other; a pixel's film is what its triangle's corners mirror,
interpolated, as the renderer shows it. The photos' brightest level says 'at least'.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.sparse import csr_array
from torch import Tensor
from torch.nn.functional import normalize

from endotwin.cameras import Camera
from endotwin.effects import Decision
from endotwin.effects.film import Film as FilmEffect
from endotwin.fit.heal import REACH_PX, healed
from endotwin.fit.lighting import Relighting, lit
from endotwin.fit.model import at_pixels, radiance
from endotwin.fit.state import State
from endotwin.light import shading
from endotwin.light.film import Film, film_in_view, mirrored, mirrors_in_view
from endotwin.light.guides import lamps_mm
from endotwin.pixels.samples import Samples, Views, frame_samples
from endotwin.run.ahead import ahead
from endotwin.run.threads import THREADS
from endotwin.surface.casting import Caster
from endotwin.surface.silhouettes import dilated
from endotwin.twin import Twin

GLINT = 0.1
"""Display values by which a pixel outshines the model to be a glint, in green and in blue: those of tissue
differ less than that from place to place, so that no error of poses or depth shows it."""

LEAST_DB = 0.2
"""A film that explains less of the photos that did not choose it is left off."""

APART = 4
"""Every so many photos one is kept apart, to judge by: between its neighbours, as a held-out photo is."""

ROUGHNESSES = (0.05, 0.06, 0.075, 0.095, 0.12)
STEPS, DAMPING, MOST_DAMPING = 15, 1e-2, 1e6
LEAST_DAMPING, LEAST_TOLD = 1e-6, 1e-12
"""Of Levenberg–Marquardt; the last two keep those vertices regular that no photo tells of."""

LONGEST_SLOPES, LONGEST_LOG = 2.0, 1.5
"""The longest step: of a normal, in widths of the lobe, and of a weight's logarithm."""

JUDGES, MOST = 1_000_000, 1_500_000
"""Samples by which glints are found and judged; samples about glints from which the film is found."""

NEARNESS = 2
"""Pixels count by this power of the share that a vertex has in them."""

LEAST_SHARE = 1e-3
"""A pixel says nothing of a vertex that has less of it: a ray through another has none."""

PEAK, PEAK_SPREAD, GLINT_ERROR = 2.0, 3.0, 0.1
"""Prior of a vertex's peak radiance (its median, and the standard deviation of its logarithm), beside the
error of a glint's display values."""

FAINT = 0.02
"""A vertex whose peak radiance is less has no film."""

Report = Callable[[str, int, int], None]


@dataclass(frozen=True)
class Found:
    """Whether there is a film, and why.

    Attributes:
        model: what is beneath, see ``healed`` where there is a film. film, effect: None without one.
        apart: the film from those photos alone that are not kept apart.
    """

    decision: Decision
    model: Model
    film: Film | None = None
    effect: FilmEffect | None = None
    apart: Film | None = None


@dataclass(frozen=True)
class Model:
    """All that was fitted before the film."""

    twin: Twin
    state: State
    relighting: Relighting
    caster: Caster

    def film(self, samples: Samples, wanted: str, report: Report) -> Found:
        """The film that the photos call for, or that is ``wanted`` (auto, on or off); and why."""
        if wanted == "off":
            return Found(Decision("off", "forced off"), self)
        began = time.perf_counter()

        def decided(state: str, reason: str, gain_db: float) -> Decision:
            return Decision(state, reason, round(gain_db, 3), round(time.perf_counter() - began, 3))

        judges = self.based(samples.thinned(JUDGES, np.random.default_rng(0)))
        most_db = judges.most_db()
        if not judges.shines.any() or (wanted == "auto" and most_db < LEAST_DB):
            return Found(decided("off", f"glints beyond the model cost {most_db:.2f} dB", most_db), self)
        model = replace(self, state=healed(self.state, self.twin.surface, judges.samples, judges.shines))
        if model.state is not self.state:
            judges = model.based(judges.samples)
        shown = model.based(model._about(judges, report))
        glints = _Glints.of(shown, shown.vertices())
        ours = glints[glints.row % APART != APART // 2]
        trials = [ours.fitted(each) for each in ROUGHNESSES]
        gains_db = judges.gains_db(glints.vertex, trials)
        # A broader lobe also shines in views that no photo had: the sharpest that predicts about as well.
        best = next(k for k, each in enumerate(gains_db) if each >= max(gains_db) - LEAST_DB)
        gain_db, roughness = gains_db[best], ROUGHNESSES[best]
        judged = len(samples.views.frames) > APART // 2
        if wanted == "auto" and judged and gain_db < LEAST_DB:
            return Found(decided("off", "does not predict the glints of other photos", gain_db), self)
        film = glints.fitted(roughness).film(glints)
        reason = f"predicts glints of other photos, on {len(film):,} vertices ({gain_db:+.2f} dB)"
        if not judged:
            reason = (
                f"glints cost {most_db:.2f} dB, on {len(film):,} vertices; no photo is left to judge it by"
            )
        if wanted == "on":
            reason = f"forced on; {reason}"
        effect, apart = FilmEffect(roughness=roughness), trials[best].film(ours)
        return Found(decided("on", reason, gain_db if judged else most_db), model, film, effect, apart)

    @property
    def guides_mm(self) -> np.ndarray:
        """Places of the light guides in the camera frame, [K, 3]."""
        return lamps_mm(self.relighting.effects.guides_mm)

    def photo(self, views: Views, row: int) -> Based:
        """All pixels of the photo of ``row`` among the ``views``, with what the model shows there."""
        twin, effects = self.twin, self.relighting.effects
        frame = twin.sequence().frame(int(views.frames[row]))
        part = frame_samples(twin, self.caster, frame, views.lens_mask, 1.0, np.random.default_rng(0))
        return self.based(lit(Samples.joined([part], views), twin.surface, self.caster, effects))

    def shining(self, samples: Samples, row: int, film: Film, roughness: float) -> Tensor:
        """Radiance [N, 1] of a ``film`` at samples of the photo of ``row`` among their views."""
        effects, surface = self.relighting.effects, self.twin.surface
        caster = self.caster if "shadows" in effects else None
        more = self.guides_mm, effects.profile, self.state.shared.log_light, caster
        glow = film_in_view(film, roughness, surface.vertices_mm, samples.views.T_local_camera[row], *more)
        corners = torch.from_numpy(glow[surface.triangles[samples.triangle.numpy()]])
        return (samples.barycentric * corners).sum(dim=1, keepdim=True) * exposure_of(samples)

    def based(self, samples: Samples) -> Based:
        """``samples``, which the guides light, with what the model shows there."""
        triangles = torch.from_numpy(self.twin.surface.triangles.astype(np.int64))
        samples = self.relighting.relit(samples, triangles, self.state)
        material = at_pixels(samples, triangles, self.state.materials)
        return Based(self, samples, radiance(samples, material, self.state.shared))

    def _about(self, judges: Based, report: Report) -> Samples:
        """Pixels of the same photos about the vertices that shine for the ``judges``."""
        twin, views = self.twin, judges.samples.views
        sequence = twin.sequence()
        points_mm = twin.surface.vertices_mm[judges.vertices()]

        def one(row: int) -> Samples:
            frame, pose = sequence.frame(int(views.frames[row])), views.T_local_camera[row]
            near = _splatted(views.camera, (points_mm - pose[:3, 3]) @ pose[:3, :3])
            share = MOST / len(views.frames) / max(1, int(near.sum()))
            return frame_samples(
                twin, self.caster, frame, near & views.lens_mask, share, np.random.default_rng(row)
            )

        parts = []
        for done, part in enumerate(ahead(one, range(len(views.frames)), THREADS), 1):
            parts.append(part)
            report("find the film", done, len(views.frames))
        return lit(Samples.joined(parts, views), twin.surface, self.caster, self.relighting.effects)


def _splatted(camera: Camera, points_mm: np.ndarray) -> np.ndarray:
    """Bool [H, W]: pixels within REACH_PX of where ``points_mm`` [N, 3] (camera frame) are seen."""
    seen = np.zeros((camera.height, camera.width), bool)
    uv = np.rint(camera.project(points_mm[points_mm[:, 2] > 0])).astype(np.int64)
    inside = ((uv >= 0) & (uv < (camera.width, camera.height))).all(axis=1)
    seen[uv[inside, 1], uv[inside, 0]] = 1
    return dilated(seen, REACH_PX)


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

    def gains_db(self, vertex: np.ndarray, trials: Iterable[_Lobes]) -> list[float]:
        """What each of the ``trials``, lobes of ``vertex``, gains in the photos that are kept apart."""
        row = self.samples.views.row(self.samples.frame)
        apart = self[torch.from_numpy(row % APART == APART // 2)]
        mix, row, place = _pairs(apart, vertex)
        half, strength = mirrors_of(self.model, self.samples.views, vertex, row, place)
        glints = _Glints(vertex, None, torch.from_numpy(place), half, strength, None, None, None, 0.0)
        films = (torch.from_numpy(mix @ lobes.radiance(glints).numpy())[:, None] for lobes in trials)
        before, *after = (
            float(((apart.shown - apart.predicted(film)) ** 2).sum())
            for film in (0.0, *(film * exposure_of(apart.samples) for film in films))
        )
        return [decibels(before, each) for each in after]


def exposure_of(samples: Samples) -> Tensor:
    """Gain and vignetting, [N, 1], or [1, 1] of 1."""
    return torch.ones(1, 1) if samples.log_exposure is None else samples.log_exposure.exp()[:, None]


def decibels(before: float, after: float) -> float:
    return 10 * math.log10(max(before, 1e-12) / max(after, 1e-12))


@dataclass(frozen=True)
class _Glints:
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
    def of(cls, based: Based, vertex: np.ndarray) -> _Glints:
        model, samples = based.model, based.samples
        mix, row, place = _pairs(based, vertex)
        half, strength = mirrors_of(model, samples.views, vertex, row, place)
        near = mix.power(NEARNESS)
        near = (near / near.sum(axis=0)).T.tocsr()
        shown = exposure_of(samples).expand(len(samples), 1), based.shown, based.radiance
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

    def __getitem__(self, chosen: Tensor) -> _Glints:
        """The ``chosen`` pairs, bool [P]."""
        names = ("row", "of_vertex", "half", "strength", "shown", "radiance")
        return replace(self, **{name: getattr(self, name)[chosen] for name in names})

    def _cost(self, film: Tensor) -> Tensor:
        """Half the squared error of each pair, [P], with the radiance [P] of its film."""
        error = self.shown - shading.respond(self.radiance + film[:, None], self.gamma).clamp(max=1)
        return (error**2).sum(dim=1) / 2

    def _total(self, values: Tensor) -> Tensor:
        """Sums [M, ...] over the pairs of each vertex of ``values`` [P, ...]."""
        total = torch.zeros(len(self.vertex), *values.shape[1:], dtype=values.dtype)
        return total.index_add_(0, self.of_vertex, values)

    def fitted(self, roughness: float) -> _Lobes:
        """The lobes that show the pairs best: Levenberg–Marquardt, each vertex for itself."""
        lobes, precision = self._start(roughness), (GLINT_ERROR / PEAK_SPREAD) ** 2
        middle, damping = lobes.values[:, 2], torch.full((len(self.vertex),), DAMPING)

        def cost(lobes: _Lobes, film: Tensor) -> Tensor:
            return self._total(self._cost(film)) + precision / 2 * off(lobes) ** 2

        def off(lobes: _Lobes) -> Tensor:
            return torch.nan_to_num(lobes.values[:, 2] - middle)

        film, slopes = lobes.linearised(self)
        before = cost(lobes, film)
        for _ in range(STEPS):
            normal, pull = self._normal_equations(film, slopes)
            normal[:, 2, 2] += precision
            pull[:, 2] -= precision * off(lobes)
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
        """JᵀJ [M, 3, 3] and Jᵀe [M, 3] where the pairs' ``film`` [P] has ``slopes`` [P, 3]; a photo that is
        clipped, and rightly so, pulls at nothing."""
        x = self.radiance + film[:, None]
        shown = shading.respond(x, self.gamma)
        by_film = self.gamma * (shown + shading.RADIANCE_MIN**self.gamma) / (x + shading.RADIANCE_MIN)
        by_film = by_film * ((shown < 1) | (self.shown < 1))
        pull = (by_film * (self.shown - shown.clamp(max=1))).sum(dim=1, keepdim=True) * slopes
        slopes = by_film.double().norm(dim=1, keepdim=True) * slopes
        return self._total(slopes[:, :, None] * slopes[:, None]), self._total(pull.double())

    def log_weight_of_peak(self, roughness: float) -> Tensor:
        """ln of the weight that gives each vertex a peak radiance of PEAK, [M]; −∞ where no guide shines."""
        strength = torch.zeros(len(self.vertex))
        strength.scatter_reduce_(0, self.of_vertex, self.strength.amax(dim=1), "amax")
        peak = mirrored(strength, torch.zeros_like(strength), roughness)
        return torch.where(strength > 0, math.log(PEAK) - torch.log(peak), -torch.inf)

    def _start(self, roughness: float) -> _Lobes:
        """Lobes about the mean half vector of each vertex' glints, each with the guide whose half vector is
        nearest to the surface's normal."""
        bare = shading.respond(self.radiance, self.gamma)
        excess = (self.shown - bare)[:, 1:].amin(dim=1, keepdim=True).clamp_min(0)
        nearest = (self.half * self.normal[self.of_vertex][:, None]).sum(dim=2).argmax(dim=1)
        half = self.half[torch.arange(len(nearest)), nearest]
        axis = normalize(self._total(excess**2 * half) + 1e-9 * self.normal, dim=1)
        values = torch.cat([torch.zeros(len(axis), 2), self.log_weight_of_peak(roughness)[:, None]], dim=1)
        return _Lobes(axis, values, roughness)


def _damped(normal: Tensor, pull: Tensor, damping: Tensor) -> Tensor:
    """Steps [M, 3] that solve (N + damping·diag N)·step = pull, N [M, 3, 3]; 0 where nothing tells."""
    scale = normal.diagonal(dim1=1, dim2=2).clamp_min(LEAST_TOLD).rsqrt()
    scaled = normal * scale[:, :, None] * scale[:, None]
    scaled = scaled + torch.diag_embed((damping[:, None] + LEAST_DAMPING).expand_as(scale))
    return (scale * torch.linalg.solve(scaled, scale * pull)).float()


def _pairs(based: Based, vertex: np.ndarray) -> tuple[csr_array, np.ndarray, np.ndarray]:
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


def mirrors_of(
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
class _Lobes:
    """A lobe of each of M vertices.

    Attributes:
        axis: [M, 3], unit normals to start from, in the surface's frame. values: [M, 3], slope of the normal
            along two tangents of ``axis``, and ln of the weight. roughness: one for all.
    """

    axis: Tensor
    values: Tensor
    roughness: float

    def moved(self, step: Tensor) -> _Lobes:
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

    def radiance(self, glints: _Glints) -> Tensor:
        """What each pair of vertex and photo mirrors, [P]."""
        return self.linearised(glints)[0]

    def linearised(self, glints: _Glints) -> tuple[Tensor, Tensor]:
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

    def film(self, glints: _Glints) -> Film:
        """The film of those that can shine."""
        peak = PEAK * (self.values[:, 2] - glints.log_weight_of_peak(self.roughness)).exp()
        wet = peak > FAINT  # false where no guide shines: −∞ less −∞
        normal, weight = self.normal[wet].numpy(), self.values[wet, 2].exp().numpy()
        return Film(glints.vertex[wet.numpy()].astype(np.int32), normal, weight)
