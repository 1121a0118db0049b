"""Random numbers of a dataset: a stream of its own for each thing that is drawn, all from one seed."""

from __future__ import annotations

from enum import IntEnum

import numpy as np


class Stream(IntEnum):
    """What is drawn at random."""

    JITTER = 1
    SWAY = 2
    VARIATION = 3
    SENSOR = 4
    POLYP = 5
    FLUID = 6

    def generator(self, seed: int, index: int = 0) -> np.random.Generator:
        """The numbers of one frame (or clip) ``index``, the same whatever else is drawn.

        A spawn key keeps apart what a list of integers would not: those that differ by zeros at their end.
        """
        return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(self, index)))
