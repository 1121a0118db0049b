"""Edits of materials, light and response: ``roughness*1.3``, ``base_color.r+0.1``, ``intensity=0.8``."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass, replace
from math import inf, isfinite

import numpy as np

from endotwin.effects import effect_class
from endotwin.errors import OptionError
from endotwin.twin import Light, Materials, Response

CHANNELS = ("r", "g", "b")

MATERIALS = ("base_color", "roughness", "metallic", *(f"base_color.{channel}" for channel in CHANNELS))
"""Materials that can be edited, each kept within [0, 1]."""

LIGHTS = {"intensity": "L0", "n": "n", "q": "q"}
"""Parameters of the light that can be edited, and the field of Light that each one is; the least is 0."""

TINTS = tuple(f"color.{channel}" for channel in CHANNELS)
"""The light's colour, a factor on each channel of the radiance, 1 unless edited; the least is 0."""

OFFSETS = ("offset.x", "offset.y", "offset.z")
"""Places of the light guides in the camera frame, mm; 0 where the light is at the lens."""

RESPONSES = ("gamma", "gain")
"""γ of the camera response, at least GAMMA_LEAST, and a factor on the radiance before it, 1 unless edited, at
least 0."""

GAMMA_LEAST = 0.15
"""The least γ that a fit finds; less shows nearly every radiance alike."""

OPERATIONS = {
    "*": lambda value, number: value * number,
    "+": lambda value, number: value + number,
    "-": lambda value, number: value - number,
    "=": lambda value, number: value * 0 + number,
}

EDIT = re.compile(r"\s*(?P<name>[\w.]+)\s*(?P<operation>[-+*=])\s*(?P<number>\S+)\s*")


@dataclass(frozen=True)
class Edit:
    """One change ``name operation number`` of a parameter; ``str(edit)`` is how it would be typed."""

    name: str
    operation: str
    number: float

    def __str__(self) -> str:
        return f"{self.name}{self.operation}{self.number!r}"

    def apply(self, value: np.ndarray | float) -> np.ndarray | float:
        """``value`` after the edit, not yet in its physical range."""
        return OPERATIONS[self.operation](value, self.number)


def parse_material_edit(text: str) -> Edit:
    """An edit of one of ``MATERIALS``; raises OptionError for anything else."""
    return parse_edit(text, "material", MATERIALS)


def parse_light_edit(text: str) -> Edit:
    """An edit of the light's ``intensity`` (L0), ``n``, ``q``, colour or offset; raises OptionError for
    anything else."""
    return parse_edit(text, "light", (*LIGHTS, *TINTS, *OFFSETS))


def edit_materials(
    materials: Materials, edits: Iterable[Edit], weight: np.ndarray | None = None
) -> Materials:
    """The materials after ``edits``, one after the other, each value kept within [0, 1].

    Args:
        weight: float32 [V] in [0, 1], how much of the edit each vertex takes; all of it unless given.
    """
    for edit in edits:
        name, _, channel = edit.name.partition(".")
        values = getattr(materials, name)
        edited = edit.apply(values).astype(np.float32)
        if channel:
            edited = np.where(np.array(CHANNELS) == channel, edited, values)
        if weight is not None:
            edited = values + (edited - values) * weight.reshape(-1, *[1] * (values.ndim - 1))
        materials = replace(materials, **{name: np.clip(edited, 0, 1).astype(np.float32)})
    return materials


def edit_light(light: Light, edits: Iterable[Edit]) -> Light:
    """The light after those ``edits`` that are of its own fields, one after the other, each at least 0."""
    for edit in edits:
        if edit.name in LIGHTS:
            field = LIGHTS[edit.name]
            light = replace(light, **{field: max(0.0, float(edit.apply(getattr(light, field))))})
    return light


def edit_response(response: Response, edits: Iterable[Edit]) -> Response:
    """The response after ``edits`` of ``gamma``, at least GAMMA_LEAST; ``gain`` is ``exposure``'s."""
    for edit in edits:
        if edit.name == "gamma":
            response = replace(response, gamma=max(GAMMA_LEAST, float(edit.apply(response.gamma))))
    return response


def exposure(edits: Iterable[Edit]) -> np.ndarray:
    """The factor float32 [3] on the radiance that edits of ``gain`` and ``color.r``, ``.g``, ``.b`` make."""
    factor = np.ones(3)
    gain = 1.0
    for edit in edits:
        if edit.name == "gain":
            gain = max(0.0, float(edit.apply(gain)))
        elif edit.name in TINTS:
            channel = TINTS.index(edit.name)
            factor[channel] = max(0.0, float(edit.apply(factor[channel])))
    return (factor * gain).astype(np.float32)


def parse_edit(text: str, kind: str, names: tuple[str, ...]) -> Edit:
    """The edit ``NAME*NUMBER`` (or ``+``, ``-``, ``=``), NAME one of ``names``; else raises OptionError."""
    name, operation, number = split_edit(text, kind, names)
    value = finite(number, text, kind, names)
    require_possible(name, operation, value, text, kind)
    return Edit(name, operation, value)


def require_possible(name: str, operation: str, value: float, text: str, kind: str) -> None:
    """Raise OptionError for a factor that would make the parameter negative where it cannot be, for a value
    beyond its limits, and for a γ, or a factor on it, below GAMMA_LEAST."""
    low, high = limits(name)
    if operation in "*=" and value < 0 <= low:
        raise OptionError(f"{kind} edit {text!r}: {name} cannot be negative; write a number of at least 0")
    if name == "gamma" and operation in "*=" and value < GAMMA_LEAST:
        raise OptionError(
            f"{kind} edit {text!r}: so small a γ shows all light alike; write at least {GAMMA_LEAST}"
        )
    if operation == "=" and not low <= value <= high:
        raise OptionError(
            f"{kind} edit {text!r}: {name} lies between {low:g} and {high:g}; write such a number"
        )


def limits(name: str) -> tuple[float, float]:
    """The least and the greatest value of what can be edited under ``name``."""
    if name in OFFSETS:
        return -inf, inf
    if name in (*MATERIALS, *LIGHTS, *TINTS, *RESPONSES):
        return 0.0, 1.0 if name in MATERIALS else inf
    effect, _, parameter = name.partition(".")
    return next((each.low, each.high) for each in effect_class(effect).parameters() if each.name == parameter)


def split_edit(text: str, kind: str, names: tuple[str, ...]) -> tuple[str, str, str]:
    """Name, operation and number of an edit, the number as it was typed; raises OptionError."""
    match = EDIT.fullmatch(str(text))
    if match is None:
        raise OptionError(f"{kind} edit {text!r} is not understood; {_allowed(names)}")
    if match["name"] not in names:
        raise OptionError(f"{kind} edit {text!r}: there is no {match['name']!r} to edit; {_allowed(names)}")
    return match["name"], match["operation"], match["number"]


def finite(number: str, text: str, kind: str, names: tuple[str, ...]) -> float:
    """The number that was typed as part of the edit ``text``; raises OptionError unless it is finite."""
    try:
        value = float(number)
    except ValueError:
        value = float("nan")
    if not isfinite(value):
        raise OptionError(f"{kind} edit {text!r}: {number!r} is not a finite number; {_allowed(names)}")
    return value


def _allowed(names: tuple[str, ...]) -> str:
    return f"write NAME*NUMBER, NAME+NUMBER, NAME-NUMBER or NAME=NUMBER with NAME one of {', '.join(names)}"
