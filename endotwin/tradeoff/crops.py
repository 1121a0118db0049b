"""The same patch of a held-out photo as each rung shows it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from endotwin.sequence import Sequence
from endotwin.twin import Source, Twin

PATCH = 0.25
"""Edge of the patch, as a share of the photo's height."""

LIT = (10, 245)
"""Display values of pixels that show detail: neither black nor clipped."""


@dataclass(frozen=True)
class Patch:
    """Where to look: a held-out frame, and a square of edge ``size`` pixels at (row, column)."""

    frame: int
    row: int
    column: int
    size: int

    def of(self, image: np.ndarray) -> np.ndarray:
        """The patch of an image [H, W, ...]."""
        return image[self.row : self.row + self.size, self.column : self.column + self.size]


def telling_patch(sequence: Sequence, source: Source) -> Patch:
    """The patch with the most detail, lit and with depth, in the middle one of the held-out frames."""
    heldout = source.heldout(len(sequence)) or [0]
    frame = sequence.frame(heldout[len(heldout) // 2])
    size = max(8, round(PATCH * frame.color.shape[0]))
    gray = cv2.cvtColor(frame.color, cv2.COLOR_RGB2GRAY).astype(np.float32)
    shown = np.isfinite(frame.depth_mm) & sequence.lens_mask & (gray > LIT[0]) & (gray < LIT[1])
    fine = np.abs(gray - cv2.GaussianBlur(gray, (0, 0), 3)) * shown
    worth = cv2.boxFilter(fine, -1, (size, size), anchor=(0, 0), borderType=cv2.BORDER_CONSTANT)
    worth *= (
        cv2.boxFilter(
            shown.astype(np.float32), -1, (size, size), anchor=(0, 0), borderType=cv2.BORDER_CONSTANT
        )
        ** 4
    )
    inside = worth[: worth.shape[0] - size + 1, : worth.shape[1] - size + 1]
    row, column = np.unravel_index(int(inside.argmax()), inside.shape)
    return Patch(frame.index, int(row), int(column), size)


def photo(sequence: Sequence, patch: Patch) -> np.ndarray:
    """The patch of the photo, uint8 [S, S, 3], RGB."""
    return patch.of(sequence.color(patch.frame))


def render(folder: Path, patch: Patch) -> np.ndarray:
    """The patch as the twin in ``folder`` shows it at the photos' own size, uint8 [S, S, 3], RGB."""
    from endotwin.render import Renderer

    twin = Twin.load(folder).at_scale(1.0)
    sequence = twin.sequence()
    mask = np.zeros((twin.camera.height, twin.camera.width), bool)
    patch.of(mask)[...] = True
    view = Renderer(twin).view(sequence.T_world_camera[patch.frame], mask)
    return np.uint8(np.clip(patch.of(view.color), 0, 1) * 255 + 0.5)


def save(image: np.ndarray, path: Path) -> None:
    """Write an RGB image as PNG."""
    path.write_bytes(cv2.imencode(".png", image[..., ::-1])[1].tobytes())
