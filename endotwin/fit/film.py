"""The film of fluid from its glints: whether what outshines the rest of the model tells of one.

A glint stands where the fluid's normal halves the angle between camera and light guide, to a fraction of a
degree: far better than depth tells normals. Each vertex that shone in a photo may be wet; photos from which
no film was found judge it.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from endotwin.cameras import Camera
from endotwin.effects import Decision, unjudged
from endotwin.effects.film import Film as FilmEffect
from endotwin.fit.beneath import APART, Based, Model, kept_apart
from endotwin.fit.by_pixels import by_pixels
from endotwin.fit.glints import Glints, Lobes, gains_in_other_photos_db
from endotwin.fit.heal import REACH_PX, healed
from endotwin.fit.lighting import lit
from endotwin.fit.tilt import falling_on
from endotwin.light.film import Film
from endotwin.pixels.samples import Samples, frame_samples, unsharpened
from endotwin.run.ahead import ahead
from endotwin.run.threads import THREADS
from endotwin.surface.silhouettes import dilated

LEAST_DB = 0.2
"""A film that explains less of the photos that did not choose it is left off."""

ROUGHNESSES = (0.05, 0.06, 0.075, 0.095, 0.12)
"""Of the lobes that are tried."""

JUDGES, MOST = 1_000_000, 1_500_000
"""Samples by which glints are found and judged; samples about glints from which the film is found."""

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


def film(model: Model, samples: Samples, wanted: str, report: Report) -> Found:
    """The film that the photos call for, or that is ``wanted`` (auto, on or off); and why. Light may have
    fallen on ``samples`` before the model's normals were tilted."""
    if wanted == "off":
        return Found(unjudged(wanted), model)
    began = time.perf_counter()

    def decided(state: str, reason: str, gain_db: float) -> Decision:
        return Decision(state, reason, round(gain_db, 3), round(time.perf_counter() - began, 3))

    some = samples.thinned(JUDGES, np.random.default_rng(0))
    judges = model.based(falling_on(model.twin.surface, some, model.relighting.effects))
    most_db = judges.most_db()
    if not judges.shines.any() or (wanted == "auto" and most_db < LEAST_DB):
        return Found(decided("off", f"glints beyond the model cost {most_db:.2f} dB", most_db), model)
    whole = replace(model, state=healed(model.state, model.twin.surface, judges.samples, judges.shines))
    if whole.state is not model.state:
        judges = whole.based(judges.samples)
    shown = whole.based(_about(judges, report))
    glints = Glints.of(shown, shown.vertices())
    ours = glints[~kept_apart(glints.row)]
    lobes, gain_db = _sharpest(judges, ours)
    judged = len(samples.views.frames) > APART // 2
    if wanted == "auto" and judged and gain_db < LEAST_DB:
        return Found(decided("off", "does not predict the glints of other photos", gain_db), model)
    every, finer = glints.fitted(lobes.roughness), by_pixels(shown[~shown.apart], ours, lobes)
    (finer_db,) = gains_in_other_photos_db(judges, glints.vertex, [finer])
    if finer_db > gain_db:
        lobes, gain_db, every = finer, finer_db, by_pixels(shown, glints, every)
    wet = every.film(glints)
    reason = f"predicts glints of other photos, on {len(wet):,} vertices ({gain_db:+.2f} dB)"
    if not judged:
        reason = f"glints cost {most_db:.2f} dB, on {len(wet):,} vertices; no photo is left to judge it by"
    if wanted == "on":
        reason = f"forced on; {reason}"
    decision = decided("on", reason, gain_db if judged else most_db)
    return Found(decision, whole, wet, FilmEffect(roughness=lobes.roughness), lobes.film(ours))


def _sharpest(judges: Based, glints: Glints) -> tuple[Lobes, float]:
    """The sharpest lobes of ``glints`` that predict about as well as any, and what they gain: broader ones
    also shine in views that no photo had."""
    trials = [glints.fitted(each) for each in ROUGHNESSES]
    gains_db = gains_in_other_photos_db(judges, glints.vertex, trials)
    return next(pair for pair in zip(trials, gains_db, strict=True) if pair[1] >= max(gains_db) - LEAST_DB)


def _about(judges: Based, report: Report) -> Samples:
    """Pixels of the same photos about the vertices that shine for the ``judges``."""
    model, views = judges.model, judges.samples.views
    twin = model.twin
    sequence = twin.sequence()
    points_mm = twin.surface.vertices_mm[judges.vertices()]

    def one(row: int) -> Samples:
        frame = unsharpened(sequence.frame(int(views.frames[row])), views.processor)
        pose = views.T_local_camera[row]
        near = _splatted(views.camera, (points_mm - pose[:3, 3]) @ pose[:3, :3])
        share = MOST / len(views.frames) / max(1, int(near.sum()))
        return frame_samples(
            twin, model.caster, frame, near & views.lens_mask, share, np.random.default_rng(row)
        )

    parts = []
    for done, part in enumerate(ahead(one, range(len(views.frames)), THREADS), 1):
        parts.append(part)
        report("find the film", done, len(views.frames))
    return lit(Samples.joined(parts, views), twin.surface, model.caster, model.relighting.effects)


def _splatted(camera: Camera, points_mm: np.ndarray) -> np.ndarray:
    """Bool [H, W]: pixels within REACH_PX of where ``points_mm`` [N, 3] (camera frame) are seen."""
    seen = np.zeros((camera.height, camera.width), bool)
    uv = np.rint(camera.project(points_mm[points_mm[:, 2] > 0])).astype(np.int64)
    inside = ((uv >= 0) & (uv < (camera.width, camera.height))).all(axis=1)
    seen[uv[inside, 1], uv[inside, 0]] = 1
    return dilated(seen, REACH_PX)
