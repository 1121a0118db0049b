"""How much work fits the time: which photos the any-time fit reads, how many pixels, how many steps.

Without a budget everything is done. With one, photos are read in an order whose every beginning is evenly
spread, later stages look at as many pixels as what was timed so far allows, and iterations end when the time
is up. Only ratios of work are assumed; seconds are always measured, since machines and their load differ.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

from endotwin.config import FitConfig
from endotwin.run.stopwatch import Stopwatch

GATHER, LIGHT, LIGHT_AGAIN, ITERATIONS = 0.2, 0.4, 0.7, 0.92
"""Shares of the budget after which no photo is read, no step looks for the light, nor, where a tone curve was
found and taken off the photos, for the light beside it, unless that leaves time for all of the detail, and no
iteration begins."""

LEAST_LIGHT = 1 / 3
"""Share of what is left once the effects are decided that light's steps may have in any case: beside a light
that was not found, no detail is right."""

PIXELS_A_SECOND = 100_000
"""Pixels a second of budget: more would leave no time to fit them."""

START_PIXELS_A_SECOND = 25_000
"""Of these, for the closed-form start: light and response are few numbers."""

LEAST_PIXELS = 60_000
"""Whatever the budget: fewer say nothing."""

PIXELS_A_PHOTO = 60_000
"""Least pixels to take of a photo under a budget: reading one costs about as much."""


class Pace:
    """Clock, plan and reporting of one fit."""

    def __init__(self, plan: FitConfig, report: Callable[[str, int, int], None] | None = None):
        self.plan = plan
        self.stopwatch = Stopwatch()
        self.report = report or (lambda label, done, total: None)
        self.budget_s = plan.budget or math.inf
        self._light, self._light_end_s = LIGHT, LIGHT * self.budget_s

    @property
    def hurried(self) -> bool:
        """Whether there is a budget."""
        return math.isfinite(self.budget_s)

    @property
    def pixels(self) -> int:
        """At most so many pixels are gathered."""
        return self._affordable(PIXELS_A_SECOND)

    @property
    def start_pixels(self) -> int:
        """At most so many pixels go into the closed-form start."""
        return self._affordable(START_PIXELS_A_SECOND)

    def _affordable(self, a_second: int) -> int:
        return int(min(self.plan.pixels, max(LEAST_PIXELS, a_second * self.budget_s)))

    def share(self, frames: int, pixels: int) -> float:
        """Share of its pixels to take of each of ``frames`` photos with so many ``pixels`` each."""
        least = PIXELS_A_PHOTO if self.hurried else 0
        return min(self.plan.pixels / frames, max(self.pixels / frames, least)) / max(1, pixels)

    def photos(self, frames: list[int]) -> Iterator[int]:
        """The frames to read: all in order, or evenly spread ones, at least one, while there is time."""
        if not self.hurried:
            yield from frames
            return
        for done, position in enumerate(spread_order(len(frames))):
            if done and not self.left(GATHER):
                return
            yield frames[position]

    def left(self, share: float = 1.0) -> float:
        """Seconds until so much of the budget is used, at least 0."""
        return max(0.0, share * self.budget_s - self.stopwatch.total)

    @property
    def light_left(self) -> float:
        """Seconds until the light's steps should end, at least 0."""
        return max(0.0, self._light_end_s - self.stopwatch.total)

    def light_is_over(self) -> bool:
        """Whether the light's steps should end."""
        return not self.light_left

    def leave(self, detail_s: float) -> None:
        """From here on light's steps have their share of the budget, or what is left beside ``detail_s``,
        seconds of all steps of the detail (infinite before those are known), and LEAST_LIGHT of what is left
        in any case."""
        now_s, end_s = self.stopwatch.total, ITERATIONS * self.budget_s
        least_s = now_s + LEAST_LIGHT * self.left(ITERATIONS)
        self._light_end_s = max(self._light * self.budget_s, end_s - detail_s, least_s)

    def find_light_again(self, took_s: float) -> bool:
        """What was found of the light, in ``took_s`` seconds, was found beside photos under a tone curve:
        there is more time; whether as much as that."""
        self._light, self._light_end_s = LIGHT_AGAIN, LIGHT_AGAIN * self.budget_s
        return self.light_left >= took_s

    def out_of_time(self) -> bool:
        """Whether no iteration should begin any more."""
        return not self.left(ITERATIONS)


def spread_order(count: int) -> list[int]:
    """The numbers below ``count`` in an order whose every beginning is about evenly spread.

    That is the van der Corput sequence: the numbers sorted by their bits read backwards.
    """
    bits = max(1, (count - 1).bit_length())
    return sorted(range(count), key=lambda number: f"{number:0{bits}b}"[::-1])
