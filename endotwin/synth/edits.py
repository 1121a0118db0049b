"""Edits of materials and light, such as ``roughness*1.3`` or ``intensity=0.8``."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass, replace
from math import isfinite

import numpy as np

from endotwin.errors import OptionError
from endotwin.twin import Light, Materials

MATERIALS = {"base_color": 1.0, "roughness": 1.0, "metallic": 1.0}
"""Materials that can be edited, and the largest value of each; the least is 0."""

LIGHTS = {"intensity": "L0", "n": "n", "q": "q"}
"""Lights' parameters that can be edited, and the field of Light that each one is; the least is 0."""

OPERATIONS = {
    "*": lambda value, number: value * number,
    "+": lambda value, number: value + number,
    "-": lambda value, number: value - number,
    "=": lambda value, number: value * 0 + number,
}

EDIT = re.compile(r"\s*(?P<name>\w+)\s*(?P<operation>[-+*=])\s*(?P<number>\S+)\s*")


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
    """An edit of ``base_color``, ``roughness`` or ``metallic``; raises OptionError for anything else."""
    return _parse(text, "material", tuple(MATERIALS))


def parse_light_edit(text: str) -> Edit:
    """An edit of the light's ``intensity`` (L0), ``n`` or ``q``; raises OptionError for anything else."""
    return _parse(text, "light", tuple(LIGHTS))


def edit_materials(materials: Materials, edits: Iterable[Edit]) -> Materials:
    """The materials after ``edits``, one after the other, each value kept within [0, 1]."""
    for edit in edits:
        values = edit.apply(getattr(materials, edit.name))
        clamped = np.clip(values, 0, MATERIALS[edit.name]).astype(np.float32)
        materials = replace(materials, **{edit.name: clamped})
    return materials


def edit_light(light: Light, edits: Iterable[Edit]) -> Light:
    """The light after ``edits``, one after the other, each value at least 0."""
    for edit in edits:
        field = LIGHTS[edit.name]
        light = replace(light, **{field: max(0.0, float(edit.apply(getattr(light, field))))})
    return light


def _parse(text: str, kind: str, names: tuple[str, ...]) -> Edit:
    allowed = (
        f"write NAME*NUMBER, NAME+NUMBER, NAME-NUMBER or NAME=NUMBER with NAME one of {', '.join(names)}"
    )
    match = EDIT.fullmatch(text)
    if match is None:
        raise OptionError(f"{kind} edit {text!r} is not understood; {allowed}")
    if match["name"] not in names:
        raise OptionError(f"{kind} edit {text!r}: there is no {match['name']!r} to edit; {allowed}")
    try:
        number = float(match["number"])
    except ValueError:
        number = float("nan")
    if not isfinite(number):
        raise OptionError(f"{kind} edit {text!r}: {match['number']!r} is not a finite number; {allowed}")
    return Edit(match["name"], match["operation"], number)
