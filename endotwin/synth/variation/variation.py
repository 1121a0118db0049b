"""Variation: edits whose numbers are drawn from ranges, for each frame or each clip, from a YAML file."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path

import numpy as np
import scipy.sparse

from endotwin.effects import NAMES as EFFECTS
from endotwin.errors import OptionError
from endotwin.run.streams import Stream
from endotwin.run.yamltext import parsed
from endotwin.synth.variation.edits import (
    LIGHTS,
    MATERIALS,
    OFFSETS,
    RESPONSES,
    TINTS,
    Edit,
    edit_light,
    edit_materials,
    edit_response,
    exposure,
    finite,
    require_possible,
    split_edit,
)
from endotwin.synth.variation.regions import Region, read_region
from endotwin.synth.variation.switches import (
    edit_effects,
    edit_offset,
    parameter_names,
    require_switchable,
    switched,
)
from endotwin.twin import Twin

RANGE = re.compile(r"(?P<low>.+?)\.\.(?P<high>.+)")
NAMES = {
    "material": MATERIALS,
    "light": (*LIGHTS, *TINTS, *OFFSETS),
    "response": RESPONSES,
    "parameters": parameter_names(),
}
KEYS = ("per", "clip", *NAMES, "regions", "effects")
CLIP_FRAMES = 50


@dataclass(frozen=True)
class Range:
    """An edit whose number is drawn evenly from ``low`` to ``high``."""

    name: str
    operation: str
    low: float
    high: float

    def __str__(self) -> str:
        number = f"{self.low!r}..{self.high!r}" if self.low != self.high else f"{self.low!r}"
        return f"{self.name}{self.operation}{number}"

    def draw(self, generator: np.random.Generator) -> Edit:
        """One edit of the range."""
        return Edit(self.name, self.operation, float(generator.uniform(self.low, self.high)))


@dataclass(frozen=True)
class Draw:
    """What one frame is rendered with: edits of the twin, in order.

    Attributes:
        material, light, response: edits of the whole. parameters: edits of effects. regions: edits of each
            region's materials, one tuple a region. effects: (name, on or off) of effects that are switched.
    """

    material: tuple[Edit, ...] = ()
    light: tuple[Edit, ...] = ()
    response: tuple[Edit, ...] = ()
    parameters: tuple[Edit, ...] = ()
    regions: tuple[tuple[Edit, ...], ...] = ()
    effects: tuple[tuple[str, bool], ...] = ()

    def edited(self, twin: Twin, regions: Sequence[Region] = ()) -> tuple[Twin, np.ndarray]:
        """The twin with all edits, and the factor float32 [3] on its radiance."""
        materials = edit_materials(twin.materials, self.material)
        for region, edits in zip(regions, self.regions, strict=True):
            materials = edit_materials(materials, edits, region.weight)
        effects = switched(edit_offset(twin.effects, self.light), self.effects)
        twin = replace(
            twin,
            materials=materials,
            light=edit_light(twin.light, self.light),
            response=edit_response(twin.response, self.response),
            effects=edit_effects(effects, self.parameters),
        )
        return twin, exposure([*self.light, *self.response])

    def to_dict(self, regions: Sequence[Region] = ()) -> dict:
        """What was drawn, for JSON."""
        kinds = {kind: [str(edit) for edit in getattr(self, kind)] for kind in NAMES}
        painted = {
            region.name: [str(edit) for edit in edits]
            for region, edits in zip(regions, self.regions, strict=True)
        }
        switched = {name: "on" if on else "off" for name, on in self.effects}
        return {
            name: value for name, value in {**kinds, "regions": painted, "effects": switched}.items() if value
        }


@dataclass(frozen=True)
class Variation:
    """Ranges to draw from.

    Attributes:
        material, light, response: edits of the whole. parameters: edits of effects. regions: parts of the
            surface.
        region_edits: edits of each region's materials, one tuple a region.
        effects: chance that each effect is on. clip: frames that share a draw.
    """

    material: tuple[Range, ...] = ()
    light: tuple[Range, ...] = ()
    response: tuple[Range, ...] = ()
    parameters: tuple[Range, ...] = ()
    regions: tuple[Region, ...] = ()
    region_edits: tuple[tuple[Range, ...], ...] = ()
    effects: dict[str, float] = field(default_factory=dict)
    clip: int = 1

    def carried(self, weights: scipy.sparse.csr_array) -> Variation:
        """The same for a surface whose vertices have ``weights`` CSR [W, V] of the old ones."""
        regions = (replace(each, weight=(weights @ each.weight).astype(np.float32)) for each in self.regions)
        return replace(self, regions=tuple(regions))

    def draw(self, frames: Iterable[int], seed: int) -> tuple[Draw, ...]:
        """One draw for each of the numbers ``frames``, the same for the same seed whatever is rendered."""
        drawn = cache(lambda clip: self._draw(Stream.VARIATION.generator(seed, clip)))
        return tuple(drawn(int(frame) // self.clip) for frame in frames)

    def _draw(self, generator: np.random.Generator) -> Draw:
        def drawn(ranges: Sequence[Range]) -> tuple[Edit, ...]:
            return tuple(each.draw(generator) for each in ranges)

        return Draw(
            drawn(self.material),
            drawn(self.light),
            drawn(self.response),
            drawn(self.parameters),
            tuple(drawn(edits) for edits in self.region_edits),
            tuple((name, bool(generator.random() < chance)) for name, chance in self.effects.items()),
        )

    def to_dict(self) -> dict:
        """The ranges, for JSON."""
        kinds = {kind: [str(each) for each in getattr(self, kind)] for kind in NAMES}
        painted = {
            region.name: {"vertices": region.vertices, "material": [str(each) for each in edits]}
            for region, edits in zip(self.regions, self.region_edits, strict=True)
        }
        return {"clip": self.clip, **kinds, "regions": painted, "effects": self.effects}


def fixed(material: Sequence[Edit] = (), light: Sequence[Edit] = ()) -> Variation:
    """The variation that draws the same edits for every frame."""
    ranges = [
        tuple(Range(e.name, e.operation, e.number, e.number) for e in each) for each in (material, light)
    ]
    return Variation(*ranges)


def read_variation(path: Path, twin: Twin, before: Variation) -> Variation:
    """The ranges of a YAML file, after the fixed edits of ``before``.

    Its keys: ``per`` (frame or clip), ``clip`` (frames of a clip), ``material``, ``light`` and ``response``
    (lists of edits such as ``roughness*0.8..1.3``), ``regions`` (each with ``name``, ``box`` or ``vertices``,
    and ``material``), ``effects`` (each on, off, or the chance of on), and ``parameters`` (edits of effects,
    such as ``noise.read_noise*0.5..2``).

    Raises:
        OptionError: the file cannot be read, or a part of it is not understood.
    """
    try:
        content = parsed(Path(path).read_text(encoding="utf-8-sig")) or {}
    except OSError as error:
        raise OptionError(f"{path} cannot be read ({error.strerror}); check its name") from error
    except ValueError as error:
        raise OptionError(f"{path} cannot be read as YAML ({error}); check the file") from error
    _require_mapping(content, KEYS, str(path))
    kinds = {kind: _ranges(content.get(kind), kind, kind, path) for kind in NAMES}
    described = content.get("regions") or []
    if not isinstance(described, list):
        raise OptionError(f"{path}: 'regions' is no list; write '- name: …' for each region")
    regions = [read_region(each, twin.surface, Path(path)) for each in described]
    _require_own_names(regions, path)
    return replace(
        before,
        material=before.material + kinds["material"],
        light=before.light + kinds["light"],
        response=before.response + kinds["response"],
        parameters=before.parameters + kinds["parameters"],
        regions=tuple(regions),
        region_edits=tuple(
            _ranges(each.get("material"), "material", f"region {region.name}", path)
            for each, region in zip(described, regions, strict=True)
        ),
        effects=_effects(content.get("effects"), twin, path),
        clip=_clip(content, path),
    )


def _require_own_names(regions: Sequence[Region], path: Path) -> None:
    """Raise OptionError where two regions share a name, by which records tell them apart."""
    names = [region.name for region in regions]
    for name in names:
        if names.count(name) > 1:
            raise OptionError(f"{path}: two regions are called {name!r}; give each a name of its own")


def _ranges(entries: object, kind: str, where: str, path: Path) -> tuple[Range, ...]:
    """Ranges from a list of edits whose numbers may be ``LOW..HIGH``."""
    entries = [entries] if isinstance(entries, str) else entries or []
    if not isinstance(entries, list):
        raise OptionError(f"{path}: {where!r} is no list; write edits such as '- {NAMES[kind][1]}*0.8..1.2'")
    ranges = []
    for text in entries:
        try:
            name, operation, number = split_edit(text, kind, NAMES[kind])
            between = RANGE.fullmatch(number)
            low, high = (between["low"], between["high"]) if between else (number, number)
            low, high = (finite(end, text, kind, NAMES[kind]) for end in (low, high))
            for end in (low, high):
                require_possible(name, operation, end, text, kind)
        except OptionError as error:
            raise OptionError(f"{path}: {error}; NUMBER may be a range LOW..HIGH") from error
        if low > high:
            raise OptionError(f"{path}: {text!r} has its ends the wrong way round; write LOW..HIGH")
        ranges.append(Range(name, operation, low, high))
    return tuple(ranges)


def _effects(entries: object, twin: Twin, path: Path) -> dict[str, float]:
    """The chance of on, by effect; YAML reads ``on`` and ``off`` as true and false."""
    chances = {}
    _require_mapping(entries or {}, EFFECTS, f"{path}, effects")
    for name, chance in (entries or {}).items():
        chance = chance == "on" if chance in ("on", "off") else chance
        if not isinstance(chance, int | float) or not 0 <= chance <= 1:
            raise OptionError(
                f"{path}: effect {name!r} is {chance!r}; write on, off, or a chance from 0 to 1"
            )
        if chance > 0:
            require_switchable(name, twin.effects)
        chances[name] = float(chance)
    return chances


def _clip(content: dict, path: Path) -> int:
    per, clip = content.get("per", "frame"), content.get("clip", CLIP_FRAMES)
    if per not in ("frame", "clip"):
        raise OptionError(f"{path}: 'per' is {per!r}; write frame or clip")
    if isinstance(clip, bool) or not isinstance(clip, int) or clip < 1:
        raise OptionError(f"{path}: 'clip' is {clip!r}; write the number of frames of a clip")
    return clip if per == "clip" else 1


def _require_mapping(content: object, keys: Sequence[str], where: str) -> None:
    known = ", ".join(keys)
    if not isinstance(content, dict):
        raise OptionError(f"{where} holds no keys; its keys are {known}")
    for key in content:
        if key not in keys:
            raise OptionError(f"{where}: {key!r} is not understood; its keys are {known}")
