"""The contact sheet of an evaluation: photo, render and their error side by side."""

from __future__ import annotations

import math

import cv2
import numpy as np

WIDTH = 320
"""Of one picture, in pixels."""

ERROR_FULL_SCALE = 0.25
"""Absolute display-value error that is drawn in the brightest colour."""


def sheet_row(
    name: str, photo: np.ndarray, render: np.ndarray, valid: np.ndarray, psnr: float, recall: float
) -> np.ndarray:
    """Photo, render and error of the frame ``name`` side by side, uint8 [h, 3·WIDTH, 3], RGB.

    Args:
        photo, render: [H, W, 3], display-encoded, in [0, 1]. valid: bool [H, W]. psnr: of the render, in dB.
        recall: of the photo's highlights, NaN where it has none.
    """
    found = f", highlights {recall:.0%}" if math.isfinite(recall) else ""
    pictures = {
        f"photo {name}": _eight_bit(photo),
        f"render, {psnr:.1f} dB{found}": _eight_bit(render),
        f"error, 0 to {ERROR_FULL_SCALE:g}": error_heat(photo, render, valid),
    }
    return np.hstack([_labelled(picture, label) for label, picture in pictures.items()])


def error_heat(photo: np.ndarray, render: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Mean absolute error of two pictures [H, W, 3] in [0, 1], where ``valid`` [H, W], as a picture: uint8
    [H, W, 3], RGB, black to bright for 0 to ERROR_FULL_SCALE."""
    error = np.abs(photo - render).mean(axis=-1) / ERROR_FULL_SCALE * valid
    return cv2.cvtColor(cv2.applyColorMap(_eight_bit(error), cv2.COLORMAP_INFERNO), cv2.COLOR_BGR2RGB)


def _eight_bit(values: np.ndarray) -> np.ndarray:
    return np.uint8(np.clip(values, 0, 1) * 255 + 0.5)


def _labelled(picture: np.ndarray, label: str) -> np.ndarray:
    height = round(WIDTH * picture.shape[0] / picture.shape[1])
    small = cv2.resize(picture, (WIDTH, height), interpolation=cv2.INTER_AREA)
    for offset, color in ((1, (0, 0, 0)), (0, (255, 255, 255))):
        corner = (6 + offset, height - 8 + offset)
        cv2.putText(small, label, corner, cv2.FONT_HERSHEY_SIMPLEX, 0.42, color, 1, cv2.LINE_AA)
    return small
