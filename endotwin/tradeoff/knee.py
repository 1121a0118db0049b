"""What is worth its time: the Pareto front of accuracy against seconds, and its knee."""

from __future__ import annotations

import numpy as np

KNEE = (
    "The knee is the rung of the Pareto front that lies farthest above the chord from its fastest to its "
    "most accurate rung, with PSNR against the logarithm of the seconds, both scaled to [0, 1] "
    "(Satopää et al., Finding a “Kneedle” in a Haystack, 2011)."
)


def pareto_front(seconds: np.ndarray, score: np.ndarray) -> list[int]:
    """Indices, fastest first, of the points that no other point beats in one and matches in the other.

    Args:
        seconds, score: float [N]; fewer seconds and a higher score are better. NaN scores never count.
    """
    front, best = [], -np.inf
    for index in np.lexsort((-np.asarray(score), seconds)):
        if score[index] > best:
            front.append(int(index))
            best = score[index]
    return front


def knee(seconds: np.ndarray, score: np.ndarray) -> int | None:
    """Index of the front's point farthest above the chord, as KNEE says; None where none lies above it."""
    front = pareto_front(seconds, score)
    if len(front) < 3:
        return None
    x, y = np.log(np.asarray(seconds, float)[front]), np.asarray(score, float)[front]
    above = (y - y[0]) / (y[-1] - y[0]) - (x - x[0]) / (x[-1] - x[0])
    return front[int(above.argmax())] if above.max() > 0 else None
