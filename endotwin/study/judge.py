"""A network judged on a test sequence: on its photos as they are, and after each corruption."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import islice

import numpy as np
import torch
from torch import nn

from endotwin.sequence.sequence import resized_depth
from endotwin.study.accuracy import METRICS, accuracy, error_by_depth, median_scaled
from endotwin.study.corruptions import CORRUPTIONS, SEVERITIES, corrupted
from endotwin.study.frames import Frame, Frames, Size, shrunk
from endotwin.study.train import predicted

BATCH = 8
CORRUPTED_FRAMES = 12
CORRUPTED_WIDTH = 320
"""Pixels across of the photos that are corrupted, which the strengths are meant for."""


def judged(network: nn.Module, test: Frames, device: torch.device) -> dict:
    """Scores of the whole test.

    Returns:
        ``{"metric": {metric: mean over the images}, "scaled": the same, each image scaled by its median,
        "by_depth": mean |p−d|/d of all pixels in each bin of accuracy.EDGES_MM, None where there are none,
        "images": number}``
    """
    metric, scaled, sums = [], [], 0.0
    for depth_mm, found_mm in _predictions(network, test, device):
        metric.append(accuracy(depth_mm, found_mm))
        scaled.append(accuracy(depth_mm, median_scaled(depth_mm, found_mm)))
        sums = sums + error_by_depth(depth_mm, found_mm)
    error, count = sums
    return {
        "metric": _means(metric),
        "scaled": _means(scaled),
        "by_depth": [e / c if c else None for e, c in zip(error.tolist(), count.tolist(), strict=True)],
        "images": len(metric),
    }


def judged_corrupted(networks: dict[str, nn.Module], test: Frames, size: Size, device: torch.device) -> dict:
    """AbsRel, each image scaled by its median, after each corruption.

    Args:
        test: at about ``CORRUPTED_WIDTH``; photos are shrunk to ``size``, that of the networks, once they are
            corrupted.

    Returns:
        ``{network: {corruption: [mean over the images, one a severity]}}``, and ``clean`` beside them.
    """
    found: dict[str, dict[str, list[float]]] = {name: {} for name in networks}
    frames = [test.some(CORRUPTED_FRAMES)[index] for index in range(min(CORRUPTED_FRAMES, len(test)))]
    depths = [resized_depth(depth_mm, *size) for _, depth_mm in frames]
    for kind, severities in (("clean", (0,)), *((name, SEVERITIES) for name in CORRUPTIONS)):
        for severity in severities:
            photos = [
                shrunk(photo if kind == "clean" else corrupted(photo, kind, severity, index), size)
                for index, (photo, _) in enumerate(frames)
            ]
            for name, network in networks.items():
                scores = [
                    accuracy(depth_mm, median_scaled(depth_mm, found_mm))["abs_rel"]
                    for depth_mm, found_mm in _predictions(network, zip(photos, depths, strict=True), device)
                ]
                found[name].setdefault(kind, []).append(float(np.mean(scores)))
    return found


def _predictions(network: nn.Module, frames: Iterable[Frame], device: torch.device) -> Iterator[Frame]:
    """Depth and prediction, both [H, W] in mm, of each frame that has depth."""
    known = (frame for frame in frames if np.isfinite(frame[1]).any())
    while some := list(islice(known, BATCH)):
        found = predicted(network, np.stack([color for color, _ in some]), device)
        yield from zip((depth_mm for _, depth_mm in some), found, strict=True)


def _means(scores: list[dict[str, float]]) -> dict[str, float]:
    return {metric: float(np.mean([score[metric] for score in scores])) for metric in METRICS}
