"""No frame of a test may have been seen: neither by a twin nor by the network that is trained."""

from __future__ import annotations

import hashlib
import logging
from pathlib import Path

import numpy as np

from endotwin.errors import EndotwinError, SequenceError
from endotwin.run.ahead import ahead
from endotwin.run.threads import THREADS
from endotwin.sequence import Sequence
from endotwin.twin import Twin

logger = logging.getLogger("endotwin")


class LeakError(EndotwinError):
    """A test sequence is known to what it shall judge."""


def require_unseen(tests: list[Sequence], real: list[Sequence], twins: dict[Path, Twin]) -> str:
    """Raise LeakError where a photo or a depth map of a test was fused, fitted or is trained on.

    Compared are the folders, and the pixels of every photo and depth map, so that a copy under another name
    is found too. A twin whose sequence is gone is judged by the folder's name alone, with a warning.

    Returns:
        what was compared, in words.
    """
    known = {str(sequence.path): sequence for sequence in real}
    makers = {name: f"--real {name}" for name in known}
    lost = []
    for folder, twin in twins.items():
        source = Path(twin.source.path)
        makers[str(source)] = f"the twin {folder}"
        try:
            known[str(source)] = twin.source.open()
        except SequenceError:
            lost.append(source)
            logger.warning(
                "%s, from which %s was made, is gone: whether a test is a copy of it is judged by name alone",
                *(source, folder),
            )
    seen = {name: fingerprints(sequence) for name, sequence in known.items()}
    for test in tests:
        own = fingerprints(test)
        for name, prints in seen.items():
            same = Path(name).resolve() == test.path.resolve()
            if same or own & prints:
                raise LeakError(
                    f"{test.path} cannot be a test: {makers[name]} knows {len(own & prints)} of its photos "
                    "and depth maps; test on another sequence"
                )
        for source in lost:
            if source.name == test.path.name:
                raise LeakError(
                    f"{test.path} cannot be a test: {makers[str(source)]} was made from a sequence of this "
                    "name; test on another sequence"
                )
    compared = sum(map(len, seen.values()))
    return (
        f"none of the photos and depth maps of {len(tests)} test sequences is among the {compared:,} that "
        "the twins were made from or the networks were trained on"
    )


def fingerprints(sequence: Sequence) -> set[str]:
    """SHA-256 of the pixels of every photo and of every depth map that is not empty."""

    def read(index: int) -> list[str]:
        depth_mm = sequence.depth_mm(index)
        found = [_digest(sequence.color(index))]
        return [*found, _digest(depth_mm)] if np.isfinite(depth_mm).any() else found

    return {print_ for prints in ahead(read, range(len(sequence)), THREADS) for print_ in prints}


def _digest(image: np.ndarray) -> str:
    return hashlib.sha256(repr(image.shape).encode() + np.ascontiguousarray(image).tobytes()).hexdigest()
