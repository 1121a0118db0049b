"""Camera models by name, and the calibrations that ship with endotwin."""

from __future__ import annotations

import json
from dataclasses import MISSING, fields
from math import isfinite
from pathlib import Path

from endotwin.cameras.base import Camera
from endotwin.cameras.fisheye import Fisheye
from endotwin.cameras.omni import Omni
from endotwin.cameras.pinhole import Pinhole
from endotwin.errors import CameraError

__all__ = [
    "CALIBRATIONS",
    "MODELS",
    "Camera",
    "Fisheye",
    "Omni",
    "Pinhole",
    "camera_from_dict",
    "read_camera",
]

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
    return model(**values)


def read_camera(path: Path) -> Camera:
    """The camera in a ``camera.json``; raises CameraError where it is no camera."""
    try:
        description = json.loads(Path(path).read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise CameraError(
            f"{path} cannot be read as JSON ({error}); write it as {_example(Pinhole)}"
        ) from error
    return camera_from_dict(description, path)


def _number(model: type[Camera], key: str, value: object, where: Path) -> float | int:
    if isinstance(value, bool) or not isinstance(value, int | float) or not isfinite(value):
        raise CameraError(f"{where}: {key!r} is {value!r}, but must be a finite number")
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
