"""What a fit leaves of the photos unexplained, beside what their noise would leave."""

from __future__ import annotations

import math
from collections.abc import Mapping

from endotwin.effects import Decision
from endotwin.effects.noise import LEVEL, Noise
from endotwin.sequence import Sequence

FRAMES = 4
"""Photos in which the noise is measured."""

WORSE = 3.0
"""A fit that leaves so many times the photos' noise lacks something: textures finer than the mesh, and what a
codec adds, leave up to two."""


def residual_warning(left: float, sequence: Sequence, decisions: Mapping[str, Decision]) -> str | None:
    """A sentence on a fit that leaves ``left`` (robust standard deviation, display values) of its photos.

    None where noise and rounding leave as much, or where no noise can be measured.

    The suspect is the effect, of those that are off, that came nearest to being kept.
    """
    noise = Noise.measured(sequence, FRAMES)
    if noise is None:
        return None
    expected = math.hypot(float(noise.sigma(0.5)), LEVEL / math.sqrt(12))
    if left <= WORSE * max(expected, LEVEL):
        return None
    off = {name: each.gain_db for name, each in decisions.items() if each.state == "off" and each.gain_db}
    suspect = max(off, key=off.get, default=None)
    hint = "" if suspect is None or off[suspect] <= 0 else f"suspect {suspect}, which is off, or "
    return (
        f"the fit leaves {left / LEVEL:.1f} of 255 levels of its photos unexplained, "
        f"{left / expected:.0f} times their noise: {hint}poses and depth that do not fit the photos"
    )
