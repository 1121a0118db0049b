"""Whether light bounces: what the hue of a place says as the light on it changes.

White light makes a place brighter or darker and leaves the ratios of its channels; what tissue throws is of
tissue's colour, and turns the hue of a place the more, the less of its light is the lamp's own. Whatever else
a model of the light errs by, where guides stand, how fast light falls off, how strong a photo's gain is,
changes all channels alike: it neither passes for a bounce, nor hides one. What does turn hues is a tone curve
(see ``tone``).
"""

from __future__ import annotations

import numpy as np
import torch

from endotwin.effects.noise import LEVEL
from endotwin.effects.tone import bend
from endotwin.evidence.probe import Fitted, Probe
from endotwin.evidence.tone import RATIO_ERROR, RATIOS
from endotwin.evidence.verdict import Verdict, predicts_better
from endotwin.pixels.fixed_effects import Design


def turned(probe: Probe, model: Fitted, log_colors: np.ndarray) -> Verdict:
    """How much better hues of places that did not choose its strength are predicted by bounced light, beside
    a tone curve of any contrast.

    Args:
        model: of the pixels' brightness. log_colors: ln of the light that each channel gets, [N, 3]; how much
            of it tells of γ and of the tissue's brightness together.
    """
    color, smooth = probe.shown_colors, probe.smooth_colors(model)
    curve = bend(torch.from_numpy(smooth)).numpy() / smooth
    target, bounce, bent = (each @ RATIOS.T for each in (np.log(color), log_colors, curve))
    variance = (LEVEL / color) ** 2 @ RATIOS.T**2 + RATIO_ERROR**2
    ratios = np.arange(len(RATIOS))
    place, count = (probe.vertex[:, None] + probe.count * ratios).ravel(), probe.count * len(ratios)
    half = np.repeat(probe.half, len(ratios))

    def design(*columns: np.ndarray, positive: int) -> Design:
        stacked = np.stack([each.ravel() for each in columns], axis=1)
        return Design(stacked, place, count, weight=1 / variance.ravel(), positive=positive)

    plain, bounced = design(bent, positive=0), design(bounce, bent, positive=1)
    return predicts_better(target.ravel(), plain, bounced, half)
