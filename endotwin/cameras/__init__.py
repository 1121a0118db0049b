"""Camera models by name, and the calibrations that ship with endotwin."""

from __future__ import annotations

import json
import os
from dataclasses import MISSING, fields
from math import isfinite
from pathlib import Path

import numpy as np

from endotwin.cameras.base import Camera
from endotwin.cameras.fisheye import Fisheye
from endotwin.cameras.omni import Omni
from endotwin.cameras.pinhole import Pinhole
from endotwin.errors import CameraError
from endotwin.run.jsontext import parsed

__all__ = [
    "CALIBRATIONS",
    "MODELS",
    "Camera",
    "Fisheye",
    "Omni",
    "Pinhole",
    "as_camera",
    "camera_from_dict",
    "read_camera",
    "write_camera",
]

VIEW_GRID = 24
"""A camera is judged by so many pixels a side."""

LEAST_SEEING = 0.1
VIEW_DEG, WIDE_VIEW_DEG = (0.1, 80.0), 175.0
"""The median pixel of a useful pinhole looks so far from its axis, that of a fisheye at most the latter."""

LARGEST = 1e9
"""Magnitude beyond which no parameter of a camera in pixels makes sense."""

MODELS: dict[str, type[Camera]] = {cls.model: cls for cls in (Pinhole, Fisheye, Omni)}

CALIBRATIONS: dict[str, Camera] = {
    "c3vd-v1": Omni(
        width=1350,
        height=1080,
        cx=678.544839263292,
        cy=542.975887548343,
        a0=769.243600037458,
        a2=-8.12770624150226e-4,
        a3=6.25674244578925e-7,
        a4=-1.1966218214428e-9,
        c=0.99998688224999,
        d=0.00288273829525059,
        e=-0.00296316513429569,
    ),
    "c3vd-v2": Omni(
        width=1350,
        height=1080,
        cx=677.739464,
        cy=543.057998,
        a0=767.733696,
        a2=-5.92506e-4,
        a3=-2.6944e-7,
        a4=-2.1638e-10,
    ),
}


def camera_from_dict(description: dict, where: Path) -> Camera:
    """The camera that a ``camera.json`` describes: ``{"model": "pinhole", "width": …, "height": …, …}``.

    ``where`` is the file it came from, for the message. Raises CameraError for an unknown model, a missing or
    unknown key, and a value that is no finite number or not positive where it must be.
    """
    if not isinstance(description, dict):
        raise CameraError(f"{where}: a camera is a JSON object such as {_example(Pinhole)}")
    model = MODELS.get(description.get("model")) if isinstance(description.get("model"), str) else None
    if model is None:
        known = ", ".join(MODELS)
        raise CameraError(
            f"{where}: camera model {description.get('model')!r} is unknown; set 'model' to one of {known}"
        )
    known_keys = {field.name for field in fields(model)}
    unknown = sorted(set(description) - known_keys - {"model"})
    if unknown:
        keys = ", ".join(sorted(known_keys))
        raise CameraError(
            f"{where}: key {unknown[0]!r} is not of a {model.model} camera; its keys are {keys}"
        )
    values = {}
    for field in fields(model):
        if field.name in description:
            values[field.name] = _number(model, field.name, description[field.name], where)
        elif field.default is MISSING:
            raise CameraError(f"{where}: key {field.name!r} is missing from the {model.model} camera; add it")
    camera = model(**values)
    _require_view(camera, where)
    return camera


def read_camera(path: Path) -> Camera:
    """The camera in a ``camera.json``; raises CameraError where it is no camera."""
    try:
        description = parsed(Path(path).read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise CameraError(f"{path} cannot be read ({error.strerror}); check its name") from error
    except ValueError as error:
        raise CameraError(
            f"{path} cannot be read as JSON ({error}); write it as {_example(Pinhole)}"
        ) from error
    return camera_from_dict(description, path)


def as_camera(given: Camera | Path | str) -> Camera:
    """``given`` itself, or the camera in the ``camera.json`` that it names. Raises CameraError where it is
    neither."""
    if isinstance(given, Camera):
        return given
    if isinstance(given, str | os.PathLike):
        return read_camera(Path(given))
    raise CameraError(f"{type(given).__name__} is no camera; give a twin's, any other, or a camera.json")


def write_camera(path: Path, camera: Camera) -> None:
    """Write the ``camera.json`` of a camera, which ``read_camera`` reads back."""
    path.write_text(json.dumps(camera.to_dict(), indent=1) + "\n", encoding="utf-8")


def _require_view(camera: Camera, where: Path) -> None:
    """Raise CameraError unless pixels all over the image see something, and not all the same or all aside."""
    u, v = (np.linspace(0, size - 1, VIEW_GRID) for size in (camera.width, camera.height))
    with np.errstate(all="ignore"):
        z = camera.directions(np.stack(np.meshgrid(u, v), axis=-1))[..., 2]
    seeing = np.isfinite(z).mean()
    if seeing < LEAST_SEEING:
        raise CameraError(
            f"{where}: only {seeing:.0%} of the pixels see anything through this lens; check its distortion"
        )
    aside_deg = np.degrees(np.arccos(np.clip(np.nanmedian(z), -1, 1)))
    widest_deg = VIEW_DEG[1] if camera.model == "pinhole" else WIDE_VIEW_DEG
    if not VIEW_DEG[0] < aside_deg < widest_deg:
        raise CameraError(
            f"{where}: the typical pixel looks {aside_deg:.3g}° away from the axis; check the focal length "
            "and the centre, which are in pixels"
        )


def _number(model: type[Camera], key: str, value: object, where: Path) -> float | int:
    if isinstance(value, bool) or not isinstance(value, int | float) or not isfinite(value):
        raise CameraError(f"{where}: {key!r} is {value!r}, but must be a finite number")
    if abs(value) > LARGEST:
        raise CameraError(f"{where}: {key!r} is {float(value):g}, larger than any camera's; mend it")
    if key in ("width", "height"):
        if value != int(value) or value < 1:
            raise CameraError(
                f"{where}: {key!r} is {value!r}, but must be a whole number of pixels, 1 or more"
            )
        return int(value)
    if key in model.positive and value <= 0:
        raise CameraError(f"{where}: {key!r} is {value!r}, but must be greater than 0")
    return float(value)


def _example(model: type[Camera]) -> str:
    keys = ", ".join(f'"{field.name}": …' for field in fields(model) if field.default is MISSING)
    return f'{{"model": "{model.model}", {keys}}}'
