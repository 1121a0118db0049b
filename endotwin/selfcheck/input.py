"""Sequences with something wrong: the twin stays finite, as right as they let it be, and says what they lack.

A case that the twin survives is measured by the PSNR of what its training photos covered. It counts as
failed where anything is not finite, or where a warning that is due was not given.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from endotwin.selfcheck.finding import Check, Finding
from endotwin.selfcheck.journey import Journey, travel
from endotwin.selfcheck.tube import Damage, Tube, flight

SIMCOL_STEP_MM = 200 / 255
"""SimCol3D's depth has 8 bits for 200 mm."""


def survived(case: str, journey: Journey, least_db: float, says: str | None = "") -> Finding:
    """The finding of a sequence that must become a twin; ``says`` is the warning that is due (None: any)."""
    told = says is None or (says in journey.said if says else not journey.said)
    sound = not journey.refused and told and not journey.not_finite
    return Finding(
        case, journey.scores.psnr_covered if sound and journey.scores else math.nan, least_db, True, "dB"
    )


def refused(case: str, journey: Journey, says: str) -> Finding:
    """The finding of a sequence that must be refused with a sentence that ``says`` why: 0 where it was."""
    return Finding(f"{case}: refused otherwise than by '{says}'", float(says not in journey.refused), 0)


def on_depth(change) -> Damage:
    """``change`` of each depth map [H, W] in mm, given a random generator of its own."""
    return lambda index, photo, depth_mm: (photo, change(depth_mm, np.random.default_rng(index)))


def on_photo(change) -> Damage:
    """``change`` of each photo, as float64 [H, W, 3]."""
    return lambda index, photo, depth_mm: (
        np.uint8(np.clip(change(photo.astype(np.float64)), 0, 255)),
        depth_mm,
    )


def somewhere(share: float, value) -> Damage:
    """Depth replaced by ``value`` at a random share of the pixels."""
    return on_depth(lambda depth_mm, rng: np.where(rng.random(depth_mm.shape) < share, value, depth_mm))


def salt(depth_mm: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Depth anywhere from 1 to 100 mm at 2 % of the pixels."""
    return np.where(rng.random(depth_mm.shape) < 0.02, rng.uniform(1, 100, depth_mm.shape), depth_mm)


def depth() -> Iterator[Finding]:
    """Depth maps that are not what they should be."""
    yield survived("Clean sequence", travel(), 35)
    yield survived("Depth NaN at 10 % of the pixels", travel(damage=somewhere(0.1, np.nan)), 35)
    yield survived("Depth 0 at 10 %", travel(damage=somewhere(0.1, 0)), 35)
    yield survived("Depth 65535 mm at 10 %", travel(damage=somewhere(0.1, 65535.0)), 33, says=None)
    yield survived("Depth infinite at 10 %", travel(damage=somewhere(0.1, np.inf)), 35)
    yield survived("Salt noise at 2 %", travel(damage=on_depth(salt)), 35)
    coarse = on_depth(lambda depth_mm, _: np.round(depth_mm / SIMCOL_STEP_MM) * SIMCOL_STEP_MM)
    yield survived("Depth of 8 bits (SimCol3D's)", travel(damage=coarse), 35, says=None)
    shifted = on_depth(lambda depth_mm, _: np.roll(depth_mm, 1, axis=1))
    yield survived("Depth one pixel aside of the photo", travel(damage=shifted), 35)
    gone = travel(
        damage=lambda index, photo, depth_mm: (photo, depth_mm if index != 3 else depth_mm * np.nan)
    )
    yield survived("One frame without depth", gone, 35, "0003.npy has no valid depth and is skipped")
    yield refused("No depth at all", travel(damage=somewhere(1.1, np.nan)), "valid depth")


def photos() -> Iterator[Finding]:
    """Photos that show little."""
    yield refused("Black photos", travel(damage=on_photo(lambda photo: 0 * photo)), "has only black photos")
    white = travel(damage=on_photo(lambda photo: 0 * photo + 255))
    kept = "cannot tell n and q and gamma" in white.said and not white.not_finite
    yield Finding(
        "White photos: γ off its prior", abs(white.twin.response.gamma - 1 / 2.2) if kept else math.nan, 1e-9
    )
    yield survived("Photos three times too bright", travel(damage=on_photo(lambda photo: 3 * photo)), 24)
    dark = travel(damage=lambda index, photo, depth_mm: (photo * (index != 3), depth_mm))
    yield survived("One black photo among eight", dark, 35, "0003.png is black or clipped")


def motion() -> Iterator[Finding]:
    """Cameras that move too little, and scenes that are seen too little of."""
    one = travel(poses=flight(1))
    bad = one.not_finite if one.twin and "cannot tell" in one.said else math.nan
    yield Finding("One frame: values that are not finite", bad, 0)
    still = "cannot tell n and q and gamma"
    yield survived("Two identical frames", travel(poses=np.repeat(flight(1), 2, axis=0)), 30, still)
    yield survived("A camera that never moves", travel(poses=np.repeat(flight(1), 8, axis=0)), 30, still)
    yield survived("A camera that only rotates", travel(poses=flight(8, 0, 0)), 30, "cannot tell n and q")
    yield survived("A tube with no far end", travel(Tube(far_mm=np.inf)), 35)
    near = Tube(far_mm=5.0, light=2.5)
    yield survived("A tube closed at 5 mm", travel(near, flight(8, 0.3)), 35)
    half = flight()
    half[:, :3, :3] = half[:, :3, :3] @ [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]
    yield survived("A tube of which one half is never seen", travel(poses=half), 33)


def touching() -> Iterator[Finding]:
    """Frames with the lens nearly on the wall, or outside."""
    for gap_mm in (0.1, 0.01):
        poses = flight()
        for index in (2, 5):
            poses[index, :2, 3] = (10 - gap_mm) * np.array([np.cos(index), np.sin(index)])
        yield survived(f"Two frames {gap_mm} mm off the wall", travel(poses=poses), 33, says=None)


CHECKS: tuple[Check, ...] = (depth, photos, motion, touching)
