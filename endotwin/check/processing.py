"""What processor and recorder did to photos before they were kept."""

from __future__ import annotations

import numpy as np

from endotwin.effects import effect_class
from endotwin.errors import SequenceError
from endotwin.run.ahead import ahead
from endotwin.run.threads import THREADS
from endotwin.sequence import Sequence

LEAVES_MARKS = ("auto_gain", "interlacing", "processor", "overlay", "chroma", "codec")


def processing(sequence: Sequence) -> list[str]:
    """A note each on what photos, and depth for the gain, tell; none of what leaves no mark, as a tone curve
    or a video's bitrate does not."""
    try:
        told = list(ahead(lambda name: effect_class(name).evidence(sequence), LEAVES_MARKS, THREADS))
    except SequenceError:  # photos are all black, or damaged: others say so
        return []
    marks = [f"{effect.name}: {reason}" for effect, reason in told if effect is not None]
    notes = [f"{mark}; 'synth --effects like=…' does the same to renderings" for mark in marks]
    if _bluer_than_red(sequence):
        notes.append(
            "The photos are more blue than red, as no tissue with blood in it is: red and blue may be "
            "swapped (OpenCV takes what it writes for BGR), or the tissue dyed."
        )
    return notes


def _bluer_than_red(sequence: Sequence, most: int = 5) -> bool:
    """Whether most of what a few photos show is: haemoglobin absorbs blue light ten times as much as red."""
    return bool(np.median([np.median(sequence.color(f) @ (-1, 0, 1)) for f in sequence.spread(most)]) > 0)
