"""At what quality a photo was a JPEG picture: by its file, or by what rounding left in its pixels."""

from __future__ import annotations

from functools import cache
from io import BytesIO
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.fft import dctn

from endotwin.effects.luma import LUMA
from endotwin.sequence.images import read_color, unclipped

BLOCK = 8

ROUNDED = float(np.sqrt((1 + LUMA @ LUMA) / 12))
"""Standard deviation that a decoder's rounding, of luminance and then of R, G and B to 8 bits, leaves in a
cosine coefficient, levels."""

STRAY = 0.01
"""Share of the coefficients that may lie anywhere, so that no single one rules a quality out."""

CHANCE = 1e-6
"""Greatest probability that a photo which never was a JPEG picture is taken for one."""

FAR = 12.0
"""Step, in deviations of a decoder's rounding, from which on only the nearest multiple counts: half of it is
six deviations."""

DECIMALS = 3
"""Of coefficients that count as equal."""


def quality_of(file: Path) -> float | None:
    """libjpeg's quality, 1 to 100, of a photo: a JPEG file's, or one that it went through before it was kept
    as a file of another kind; None where neither is told.

    Of a file the quality whose steps of brightness are nearest to its own, by their logarithms. Raises
    SequenceError where the file is damaged.
    """
    steps = _steps(file)
    if steps is None:
        return quality_in(read_color(file))
    return 1.0 + np.abs(np.log(_steps_by_quality()) - np.log(steps)).mean(axis=1).argmin()


def quality_in(photo: np.ndarray) -> float | None:
    """libjpeg's quality, 1 to 100, that a photo uint8 [H, W, 3] was coded with last; None: with none, or the
    grid of its blocks no longer begins at the first pixel, or its values were changed afterwards.

    Maximum likelihood of the steps (Fan & de Queiroz 2003, "Identification of bitmap compression history:
    JPEG detection and quantizer estimation", section III): rounded coefficients lie at multiples of their
    step, spread by the decoder's rounding, and others lie anywhere between. Where they lie anywhere, some
    quality is as many times likelier as there are qualities over CHANCE with no more probability than CHANCE
    (Markov's inequality). Of qualities that are equally likely, since they differ
    in steps that no coefficient reaches, it is the highest.
    """
    coefficients = np.abs(_coefficients(photo))
    likelihood = np.zeros(100)
    for values, steps in zip(coefficients.T[1:], _steps_by_quality().T[1:], strict=True):
        unlike, place = np.unique(steps, return_inverse=True)
        likelihood += _log_likelihood_ratios(values, unlike)[place]
    best = 99 - likelihood[::-1].argmax()
    return 1.0 + best if likelihood[best] > np.log(len(likelihood) / CHANCE) else None


def _coefficients(photo: np.ndarray) -> np.ndarray:
    """Cosine coefficients [N, 64] of the luminance of a photo's unlike blocks that are nowhere clipped."""
    down, across = (size // BLOCK for size in photo.shape[:2])
    whole = photo[: down * BLOCK, : across * BLOCK].reshape(down, BLOCK, across, BLOCK, 3)
    blocks = whole.transpose(0, 2, 1, 3, 4).reshape(-1, BLOCK, BLOCK, 3)
    usable = unclipped(photo)[: down * BLOCK, : across * BLOCK].reshape(down, BLOCK, across, BLOCK)
    blocks = blocks[usable.all(axis=(1, 3)).ravel()]
    found = dctn(blocks @ LUMA.astype(float), axes=(1, 2), norm="ortho").reshape(-1, BLOCK**2)
    return found[np.unique(found[:, 1:].round(DECIMALS), axis=0, return_index=True)[1]]


def _log_likelihood_ratios(values: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Of magnitudes [N] as multiples of each of the ascending ``steps`` [S] that were decoded, against any
    value between two multiples, [S].

    Those below half a step are left out: small ones are many in every photo.
    """
    descending = np.sort(values)[::-1]
    counts = np.searchsorted(-descending, -steps / 2)
    step = np.repeat(steps, counts)
    value = descending[np.arange(len(step)) - np.repeat(np.cumsum(counts) - counts, counts)]
    apart, apiece = (value - step * np.rint(value / step)) / ROUNDED, step / ROUNDED
    density = np.exp(-0.5 * apart**2)
    close = counts[: np.searchsorted(steps, FAR * ROUNDED)].sum()
    others = apart[:close] + apiece[:close] * np.array([[-2], [-1], [1], [2]])
    density[:close] += np.exp(-0.5 * others**2).sum(axis=0)
    ratio = np.log(STRAY + (1 - STRAY) / np.sqrt(2 * np.pi) * apiece * density)
    return np.bincount(np.repeat(np.arange(len(steps)), counts), ratio, len(steps))


@cache
def _steps_by_quality() -> np.ndarray:
    """Steps of libjpeg's luminance, [100, 64], of qualities 1 to 100."""
    tables = []
    for quality in range(1, 101):
        coded = BytesIO()
        Image.new("L", (8, 8)).save(coded, "JPEG", quality=quality)
        tables.append(_steps(coded))
    return np.stack(tables)


def _steps(file: Path | BytesIO) -> np.ndarray | None:
    """Steps, [64], in which a JPEG file keeps the cosine coefficients of brightness; None of other files."""
    try:
        with Image.open(file) as photo:
            tables = getattr(photo, "quantization", None)
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):
        return None
    return np.asarray(tables[0], float) if tables and 0 in tables else None
