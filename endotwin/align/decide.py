"""From a twin's surface to corrections of its photos' poses, as far as other photos bear them out."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from endotwin.align import depths
from endotwin.align.corrections import Corrections
from endotwin.align.judge import Errors, Verdict, errors
from endotwin.align.photos import read_photos
from endotwin.align.scene import Scene
from endotwin.align.solve import Looked, look, step
from endotwin.errors import OptionError
from endotwin.sequence import Sequence
from endotwin.sequence.spread import spread
from endotwin.surface.casting import Caster
from endotwin.twin import Registration, Twin

STATES = ("auto", "on", "off")

WIDTH = 675
"""Photos are looked at in at most this width: a tenth of a pixel there is a few micrometres of tissue."""

PHOTOS, VERTICES = 72, 15_000
"""At most so many photos, evenly spread, choose and judge; so many vertices are looked at."""

GLANCE_PHOTOS, GLANCE_VERTICES = 12, 6_000

JUDGES, FIRST = 3, 1
"""Every third photo, from the second on, judges what the others choose; where these are not sure, the other
two thirds do so in turn."""

BLURS = (0.006, 0.003, 0.0015, 0.0015, 0.0015, 0.0015)
"""Widths of the blurs, coarse to fine, of the image's width."""

LENS_BLURS = BLURS[3:]
OWN_BLURS = (0.0015, 0.0015, 0.0015)

SETTLED, MOST_STEPS = 0.25, 8
"""Steps of all photos end with one that goes by less than half of a standard deviation in each correction, or
after so many."""

LEAST_BLUR_PX = 0.7

MIN_GAIN_DB, MIN_SIGMAS = 1.0, 3.0
"""Corrections are kept where they lower other photos' error by so much, and by so many sigmas: what the model
of light lacks is alike in all photos, and to move them all may hide a little of it. Real photos whose surface
is rough gain 0.8 dB so, and lose by it; a hand-eye error of 0.13 mm and 0.08° is worth 2.3 dB."""

LENS_GAIN_DB, LENS_SIGMAS = 0.25, 2.0
"""Intrinsics are put right beside poses that prove to be wrong, where that gains so much more than poses
alone: where they were right it gained -0.04 to 0.04 dB on four sequences, where a focal length was 0.5 % off
0.3 to 0.4, and a centre 0.4 % of the width as well, 0.8."""

LEAST_ASKED_DB = 0.25
"""Less to gain at a glance, and nothing is sought."""

LEAST_PHOTOS = 8
"""Fewer can neither choose nor judge."""


@dataclass(frozen=True)
class Alignment:
    """What was decided, and why.

    Attributes:
        registration: the corrections; None: the photos stay. reason: in a line. gain_db: what judging photos
            gained; None where none judged. seconds: what it took.
    """

    registration: Registration | None
    reason: str
    gain_db: float | None
    seconds: float

    def to_dict(self) -> dict:
        """Plain values for a twin's record."""
        found = self.registration.found if self.registration else {}
        return {"reason": self.reason, "gain_db": self.gain_db, "seconds": self.seconds, **found}


Progress = Callable[[str, int, int], None]


class Aligner:
    """One search for corrections.

    Attributes:
        frames: int [F], the photos that take part. choosers: those of them that choose first.
    """

    def __init__(self, twin: Twin, caster: Caster, progress: Progress | None):
        scale = min(1.0, WIDTH / twin.camera.width) * twin.source.scale
        self.sequence: Sequence = twin.source.at_scale(scale).open()
        training = np.array(twin.source.training(len(self.sequence)))
        self.frames = training[spread(len(training), PHOTOS)]
        self.choosers, _ = self._sides(FIRST)
        self.caster, self.camera = caster.threaded(1), self.sequence.camera
        self.photos: dict = {}
        self._progress = progress or _silent
        self._looks, self._expected = 0, len(BLURS + LENS_BLURS + OWN_BLURS) + MOST_STEPS

    def blur_px(self, share: float) -> float:
        return max(LEAST_BLUR_PX, share * self.camera.width)

    def asked_db(self) -> float:
        """By how much the photos' error would fall at a glance, if all were granted that some of them ask
        for."""
        some = self.frames[spread(len(self.frames), GLANCE_PHOTOS)]
        scene = Scene.of(self.caster, self.camera, GLANCE_VERTICES)
        now, blur_px = Corrections.none(self.sequence.T_world_camera), self.blur_px(BLURS[1])
        photos = self._read(some)
        before = look(scene, photos, now.poses, some, blur_px)
        after, _ = step(now, before, some, lens=True, own=True)
        return _cost_db(before, look(self._through(scene, after), photos, after.poses, some, blur_px))

    def run(self, forced: bool) -> tuple[Corrections | None, str, Verdict]:
        """The corrections (None: the photos stay), why, and what the judges say of them. If ``forced``, those
        that all photos share are kept whatever the judges say."""
        self._read(self.frames)
        scene = Scene.of(self.caster, self.camera, VERTICES)
        none = Corrections.none(self.sequence.T_world_camera)
        was = self._errors(scene, none)
        shared = self._steps(scene, none, self.choosers, BLURS)
        now = self._errors(scene, shared)
        gained = now.better_than(was)
        if not forced and not _keeps(gained):
            if gained.gain_db >= MIN_GAIN_DB:
                gained = self._judged_by_all(scene, none, was, now)
            if not _keeps(gained):
                return None, f"what the photos ask for does not help others ({gained})", gained
        lensed = self._steps(scene, shared, self.choosers, LENS_BLURS, lens=True)
        seen = self._errors(scene, lensed)
        lens = _keeps(seen.better_than(now), LENS_GAIN_DB, LENS_SIGMAS)
        if lens:
            shared, now = lensed, seen
        own = self._steps(scene, shared, self.choosers, OWN_BLURS, lens, own=True)
        more = self._errors(scene, own)
        if _keeps(more.better_than(now)):
            verdict = more.better_than(was)
            return self._settled(scene, own, lens, own=True), f"shared and drift: {verdict}", verdict
        if lens:
            gained = now.better_than(was)
        return self._settled(scene, shared, lens, own=False), f"shared: {gained}", gained

    def _sides(self, first: int) -> tuple[np.ndarray, np.ndarray]:
        """The frames that choose, and those that judge, every third from the ``first`` on."""
        judging = np.arange(len(self.frames)) % JUDGES == first
        return self.frames[~judging], self.frames[judging]

    def _judged_by_all(self, scene: Scene, none: Corrections, was: Errors, now: Errors) -> Verdict:
        """What all photos say of corrections that the others chose, where the first third says that these
        bring its errors from what they ``was`` to ``now``."""
        self._expected += (JUDGES - 1) * len(BLURS)
        for first in {*range(JUDGES)} - {FIRST}:
            chosen = self._steps(scene, none, self._sides(first)[0], BLURS)
            was = was.and_of(self._errors(scene, none, first))
            now = now.and_of(self._errors(scene, chosen, first))
        return now.better_than(was)

    def _settled(self, scene: Scene, start: Corrections, lens: bool, own: bool) -> Corrections:
        """The corrections that all photos choose, from near them."""
        now = start
        for _ in range(MOST_STEPS):
            now, went = self._step(scene, now, self.frames, BLURS[-1], lens, own)
            if went < SETTLED:
                break
        return now

    def _through(self, scene: Scene, now: Corrections) -> Scene:
        """The scene before the camera that the corrections make of the written one."""
        return scene.through(self.camera.corrected(now.intrinsics))

    def _steps(
        self,
        scene: Scene,
        start: Corrections,
        frames: np.ndarray,
        blurs: tuple[float, ...],
        lens: bool = False,
        own: bool = False,
    ) -> Corrections:
        now = start
        for share in blurs:
            now, _ = self._step(scene, now, frames, share, lens, own)
        return now

    def _step(
        self, scene: Scene, now: Corrections, frames: np.ndarray, share: float, lens: bool, own: bool
    ) -> tuple[Corrections, float]:
        told = look(self._through(scene, now), self.photos, now.poses, frames, self.blur_px(share))
        self._looks += 1
        self._progress("align", self._looks, self._expected)
        return step(now, told, frames, lens, own)

    def _errors(self, scene: Scene, now: Corrections, first: int = FIRST) -> Errors:
        """Of every third photo from the ``first`` on, against what the others paint."""
        scene, blur_px = self._through(scene, now), self.blur_px(BLURS[-1])
        return errors(scene, self.photos, now.poses, *self._sides(first), blur_px)

    def _read(self, frames: np.ndarray) -> dict:
        missing = [frame for frame in frames.tolist() if frame not in self.photos]
        self.photos.update(read_photos(self.sequence, missing))
        return self.photos


def align(twin: Twin, state: str = "auto", progress: Progress | None = None) -> tuple[Twin, Alignment]:
    """The twin with its photos aligned to its surface, and what was decided.

    Args:
        twin: what was fitted to it before is lost where its photos move.
        state: ``auto``: corrections that photos which did not choose them bear out; ``on``: those that all
            photos share in any case; ``off``: none.
        progress: called with (label, done, total).

    Raises:
        OptionError: another state. SequenceError: the photos cannot be read.
    """
    if state not in STATES:
        raise OptionError(f"align is {state!r}; choose one of: {', '.join(STATES)}")
    began = time.perf_counter()

    def decided(registration: Registration | None, reason: str, gain_db: float | None):
        seconds = round(time.perf_counter() - began, 2)
        alignment = Alignment(registration, reason, gain_db, seconds)
        camera = registration.camera(sequence.camera) if registration else sequence.camera
        moved = replace(twin, registration=registration, camera=camera)
        if registration is not None:
            moved = replace(moved, materials=None, light=None, response=None, decisions={})
        return moved.with_record(align=alignment.to_dict()), alignment

    sequence = twin.source.open()
    if state == "off":
        return decided(None, "forced off", None)
    if len(twin.source.training(len(sequence))) < LEAST_PHOTOS:
        return decided(None, "too few photos to choose and to judge", None)
    caster = Caster(twin.surface)
    depth_db = depths.gain_db(twin, sequence, caster)
    if depth_db >= depths.MIN_GAIN_DB:
        surface, found = depths.registered(twin, sequence, progress or _silent)
        twin = replace(twin, surface=surface)
        reason = f"depth maps, which agree better by {depth_db:.1f} dB once each may move with its photo"
        return decided(_registration(found, with_depth=True), reason, None)
    aligner = Aligner(twin, caster, progress)
    if state == "auto":
        asked_db = aligner.asked_db()
        if asked_db < LEAST_ASKED_DB:
            reason = f"the photos lie on the surface: no more than {asked_db:+.2f} dB to gain"
            return decided(None, reason, None)
    found, reason, verdict = aligner.run(state == "on")
    registration = None if found is None else _registration(found)
    return decided(registration, reason, round(verdict.gain_db, 3))


def _silent(label: str, done: int, total: int) -> None:
    """Nobody watches."""


def _keeps(verdict: Verdict, least_db: float = MIN_GAIN_DB, sigmas: float = MIN_SIGMAS) -> bool:
    return verdict.gain_db >= least_db and verdict.sigmas >= sigmas


def _cost_db(before: Looked, after: Looked) -> float:
    """By how much the robust widths of texture fell, dB."""
    return 20 * float(np.log10(before.width / after.width))


def _registration(found: Corrections, with_depth: bool = False) -> Registration:
    norm, shared = np.linalg.norm, found.shared
    own = np.sqrt((found.own**2).mean(axis=0))
    named = {
        "model_mm": norm(shared[3:6]),
        "model_deg": np.degrees(norm(shared[:3])),
        "hand_eye_mm": norm(shared[9:12]),
        "hand_eye_deg": np.degrees(norm(shared[6:9])),
        "lag_frames": shared[12],
        "focal_percent": 100 * np.expm1(found.intrinsics[0]),
        "centre_percent": 100 * norm(found.intrinsics[1:]),
        "own_mm": norm(own[3:]),
        "own_deg": np.degrees(norm(own[:3])),
    }
    named = {name: round(float(value), 4) for name, value in named.items()}
    intrinsics = tuple(found.intrinsics.tolist())
    return Registration(tuple(map(tuple, found.twists.tolist())), named, with_depth, intrinsics)
