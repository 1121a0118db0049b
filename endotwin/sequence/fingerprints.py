"""What a sequence holds, in checksums: whether two have a frame in common, and whether one has changed."""

from __future__ import annotations

import hashlib
import json

import numpy as np

from endotwin.run.ahead import ahead
from endotwin.run.threads import THREADS
from endotwin.sequence.sequence import Sequence


def fingerprints(sequence: Sequence) -> list[str]:
    """SHA-256 of the pixels of every photo and of every depth map that is not empty; reads them all.

    Raises SequenceError if one cannot be read.
    """

    def read(index: int) -> list[str]:
        depth_mm = sequence.depth_mm(index)
        found = [_digest(sequence.color(index))]
        return [*found, _digest(depth_mm)] if np.isfinite(depth_mm).any() else found

    return [print_ for prints in ahead(read, range(len(sequence)), THREADS) for print_ in prints]


def checksum(sequence: Sequence, prints: list[str]) -> str:
    """SHA-256 of a sequence with such ``fingerprints``, its poses and its camera."""
    told = [prints, sequence.camera.to_dict(), _digest(sequence.T_world_camera)]
    return hashlib.sha256(json.dumps(told).encode()).hexdigest()


def _digest(image: np.ndarray) -> str:
    return hashlib.sha256(repr(image.shape).encode() + np.ascontiguousarray(image).tobytes()).hexdigest()
