"""What a dataset holds, counted while it is rendered: depth, brightness, coverage, and a few thumbnails."""

from __future__ import annotations

from base64 import b64encode
from dataclasses import dataclass, field
from typing import Self

import cv2
import numpy as np

from endotwin.synth.encodings import FLOW_RANGE_PX, encode_color

DEPTH_BINS_MM = np.linspace(0, 100, 51)
BRIGHTNESS_BINS = np.linspace(0, 1, 33)
COVERAGE = {"valid": 255, "unseen": 128, "filled": 64, "none": 0}
"""Kinds of pixels, and the value of each in the mask."""

STRIDE = 4
"""Depth and brightness are counted at every so many pixels, across and down."""

SPARSE = ("depth", "rgb", "mask")

THUMBNAIL_PX = 200
THUMBNAIL_QUALITY = 80


@dataclass
class Statistics:
    """Counts of pixels, and pictures; empty where the label that they come from was not asked for.

    Attributes:
        depth: some of the pixels by depth in DEPTH_BINS_MM; the last bin takes what lies beyond.
        brightness: some of those that show surface, by the mean of the display-encoded channels.
        coverage: for each kind of pixel, its share in each frame, in order.
        flow: by name of the image, how many pixels have flow, and of how many it is beyond its code.
        thumbnails: JPEG pictures, base64, by the frame's index.
    """

    depth: np.ndarray = field(default_factory=lambda: np.zeros(len(DEPTH_BINS_MM) - 1, np.int64))
    brightness: np.ndarray = field(default_factory=lambda: np.zeros(len(BRIGHTNESS_BINS) - 1, np.int64))
    coverage: dict[str, list[float]] = field(default_factory=lambda: {kind: [] for kind in COVERAGE})
    flow: dict[str, list[int]] = field(default_factory=dict)
    thumbnails: dict[int, str] = field(default_factory=dict)

    def add(self, images: dict[str, np.ndarray], thumbnail_of: int | None = None) -> None:
        """Count a frame's images; keep its picture as that of frame ``thumbnail_of`` if given."""
        sparse = {name: image[::STRIDE, ::STRIDE] for name, image in images.items() if name in SPARSE}
        if "depth" in images:
            self.depth += _counts(sparse["depth"], DEPTH_BINS_MM)
        if "rgb" in images:
            brightness = sparse["rgb"].mean(axis=2)
            seen = sparse["mask"] > 0 if "mask" in images else brightness > 0
            self.brightness += _counts(brightness[seen], BRIGHTNESS_BINS)
        if "mask" in images:
            counts = np.bincount(images["mask"].ravel(), minlength=256)
            for kind, value in COVERAGE.items():
                self.coverage[kind].append(float(counts[value] / images["mask"].size))
        for name in ("flow", "flow_forward"):
            if name in images:
                most_px = np.maximum(*np.moveaxis(np.abs(images[name]), -1, 0))
                flows, lost = np.isfinite(most_px), most_px > FLOW_RANGE_PX
                self._add_flow(name, [int(flows.sum()), int(lost.sum())])
        if thumbnail_of is not None:
            self.thumbnails[thumbnail_of] = b64encode(thumbnail(images)).decode()

    def _add_flow(self, name: str, counts: list[int]) -> None:
        self.flow[name] = [a + b for a, b in zip(self.flow.get(name, [0, 0]), counts, strict=True)]

    def merge(self, other: Statistics) -> None:
        """Add the counts of frames that come after these."""
        self.depth += other.depth
        self.brightness += other.brightness
        for kind in COVERAGE:
            self.coverage[kind] += other.coverage[kind]
        for name, counts in other.flow.items():
            self._add_flow(name, counts)
        self.thumbnails |= other.thumbnails

    def mean_coverage(self) -> dict[str, float]:
        """The share of each kind of pixel over all frames; empty where no mask was asked for."""
        return {kind: float(np.mean(shares)) for kind, shares in self.coverage.items() if shares}

    def to_dict(self) -> dict:
        """For JSON."""
        return {
            "depth": self.depth.tolist(),
            "brightness": self.brightness.tolist(),
            "coverage": self.coverage,
            "flow": self.flow,
            "thumbnails": self.thumbnails,
        }

    @classmethod
    def from_dict(cls, content: dict) -> Self:
        """What ``to_dict`` gave."""
        return cls(
            np.array(content["depth"], np.int64),
            np.array(content["brightness"], np.int64),
            content["coverage"],
            content["flow"],
            {int(index): picture for index, picture in content["thumbnails"].items()},
        )


def thumbnail(images: dict[str, np.ndarray]) -> bytes:
    """A small JPEG of the frame's colours or, without any, of another of its images."""
    for name in ("rgb", "diffuse", "albedo", "rgb_linear", "rgb_exr"):
        if name in images:
            picture = encode_color(images[name])
            break
    else:
        image = next((image for name, image in images.items() if name != "vertices"), np.zeros((1, 1)))
        values = np.nan_to_num(image if image.ndim == 2 else image[..., 0]).astype(np.float32)
        picture = encode_color((values - values.min()) / max(float(np.ptp(values)), 1e-9))
    height, width = picture.shape[:2]
    size = (THUMBNAIL_PX, max(round(height * THUMBNAIL_PX / width), 1))
    small = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
    quality = (cv2.IMWRITE_JPEG_QUALITY, THUMBNAIL_QUALITY)
    return cv2.imencode(".jpg", cv2.cvtColor(small, cv2.COLOR_RGB2BGR), quality)[1].tobytes()


def _counts(values: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """How many finite ``values`` fall between even ``edges``; the last bin takes what lies beyond, and none
    what lies before the first edge."""
    bins = len(edges) - 1
    counted = values[np.isfinite(values) & (values >= edges[0])]
    index = (counted - edges[0]) * np.float32(bins / (edges[-1] - edges[0]))
    return np.bincount(np.minimum(index, bins - 1).astype(np.int64), minlength=bins)
