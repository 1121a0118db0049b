"""Named ways to spend time: what ``--config`` reads, and the presets that ship with endotwin."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field, fields
from importlib import resources
from pathlib import Path

import yaml

from endotwin.effects import NAMES, STATES
from endotwin.errors import OptionError
from endotwin.run.yamltext import parsed

METHODS = ("twin", "endopbr")
SUFFIXES = (".yaml", ".yml")
DEFAULT = "standard"


@dataclass(frozen=True)
class FuseConfig:
    """How finely to fuse.

    Attributes:
        scale: factor on the image size, of the fit's photos too.
        voxel: factor on the voxel edge that the pixels' footprint and the depth's noise ask for.
        frames: of more training frames than these, so many are used, evenly spread; null: all.
    """

    scale: float = 1.0
    voxel: float = 1.0
    frames: int | None = 300


@dataclass(frozen=True)
class FitConfig:
    """How long to fit.

    Attributes:
        method: ``twin``, or ``endopbr`` (Han & Wu 2025 as published).
        pixels: at most about so many training pixels are looked at.
        detail: edge of the finest features in mesh edges; larger is faster and softer.
        steps: Gauss–Newton steps on the finest features; 0 leaves them out.
        tilts: rounds in which the normals tilt to what the photos show.
        budget: bound on the wall-clock seconds, as ``10``, ``10s`` or ``2m``; null: until the steps are done.
    """

    method: str = "twin"
    pixels: int = 4_000_000
    detail: float = 1.0
    steps: int = 2
    tilts: int = 2
    budget: float | None = None


@dataclass(frozen=True)
class Config:
    """One way to go from a sequence to a twin; the defaults are the preset ``standard``.

    ``effects`` has auto, on or off by name of the effect; auto unless named.
    """

    fuse: FuseConfig = field(default_factory=FuseConfig)
    fit: FitConfig = field(default_factory=FitConfig)
    effects: dict[str, str] = field(default_factory=dict)


STANDARD = Config()

LEAST = {"steps": 0, "tilts": 0}
"""Numbers must be greater than 0, whole ones at least 1, except for these."""


def seconds(text: str | float) -> float:
    """Seconds of ``10``, ``10s``, ``2m`` or ``1.5h``; raises OptionError for anything else, and for 0."""
    units = {"s": 1, "m": 60, "h": 3600}
    words = str(text).strip().lower()
    number, unit = (words[:-1], units[words[-1]]) if words[-1:] in units else (words, 1)
    try:
        value = float(number) * unit
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and value > 0):
        raise OptionError(f"the budget '{text}' is no time greater than 0; write it as 10, 10s or 2m")
    return value


def preset_names() -> list[str]:
    """Names of the presets that ship with endotwin, in the order of the alphabet."""
    names = [entry.name for entry in resources.files("endotwin.configs").iterdir()]
    return sorted(name.removesuffix(".yaml") for name in names if name.endswith(".yaml"))


def load_config(name: str | Path) -> Config:
    """The preset of that name, or the config in that YAML file.

    Raises:
        OptionError: no such preset or file, or one that says something a config has no place for.
    """
    text = str(name)
    if Path(text).suffix in SUFFIXES:
        path = Path(text)
    elif text in preset_names():
        path = resources.files("endotwin.configs") / f"{text}.yaml"
    else:
        raise OptionError(
            f"there is no config '{text}'; name one of {', '.join(preset_names())}, or a file ending in .yaml"
        )
    try:
        document = parsed(path.read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise OptionError(f"{path} cannot be read ({error.strerror}); check its name") from error
    except ValueError as error:
        raise OptionError(f"{path} is not YAML ({error}); mend that line") from error
    return from_document(document, str(path))


def from_document(document: object, origin: str) -> Config:
    """A config from parsed YAML; ``origin`` names its file in errors."""
    sections = {part.name: part.default_factory for part in fields(Config)}
    made = {}
    for section, values in _mapping(document, origin, "a config", sections).items():
        kind = sections[section]
        if section == "effects":
            made[section] = _states(values, origin)
            continue
        known = {part.name: part for part in fields(kind)}
        values = _mapping(values, origin, f"section '{section}'", known)
        made[section] = kind(
            **{
                key: _checked(value, known[key].type, f"{section}.{key}", origin)
                for key, value in values.items()
            }
        )
    return Config(**made)


def to_yaml(config: Config) -> str:
    """The config as YAML, every knob written out; ``load_config`` reads it back as it was."""
    sections = asdict(config)
    return yaml.safe_dump(sections, sort_keys=False)


def _states(values: object, origin: str) -> dict[str, str]:
    """The section ``effects``; YAML reads a bare on and off as true and false."""
    words = {True: "on", False: "off"}
    states = {
        name: words.get(state, state) if isinstance(state, bool) else state
        for name, state in _mapping(values, origin, "section 'effects'", dict.fromkeys(NAMES)).items()
    }
    for name, state in states.items():
        if state not in STATES:
            raise OptionError(f"{origin}: effects.{name} is {state!r}; choose one of: {', '.join(STATES)}")
    return states


def _mapping(value: object, origin: str, what: str, known: dict) -> dict:
    """``value`` as a mapping whose keys are all ``known``; nothing at all is an empty one."""
    value = {} if value is None else value
    if not isinstance(value, dict):
        raise OptionError(f"{origin}: {what} must be keys with values, but is {value!r}")
    for key in value:
        if key not in known:
            raise OptionError(f"{origin}: {what} has no key '{key}'; it has {', '.join(known)}")
    return value


def _checked(value: object, kind: str, key: str, origin: str) -> object:
    """``value`` as the field's type, or an OptionError that names file and key."""
    if key == "fit.method":
        if value not in METHODS:
            raise OptionError(f"{origin}: {key} is {value!r}; choose one of: {', '.join(METHODS)}")
        return value
    if value is None and "None" in kind:
        return None
    if key == "fit.budget":
        try:
            return seconds(value)
        except OptionError as error:
            raise OptionError(f"{origin}: fit.budget: {error}") from error
    least = LEAST.get(key.split(".")[1], 1)
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not _finite(value):
        raise OptionError(f"{origin}: {key} is {value!r}, but must be a number")
    if kind.startswith("int") and (value != int(value) or value < least):
        raise OptionError(f"{origin}: {key} is {value!r}, but must be a whole number of at least {least}")
    if kind == "float" and not value > 0:
        raise OptionError(f"{origin}: {key} is {value!r}, but must be greater than 0")
    return int(value) if kind.startswith("int") else float(value)


def _finite(value: float) -> bool:
    """Whether floating point holds the number: a whole one of more than 308 digits is too large for it."""
    try:
        return math.isfinite(value)
    except OverflowError:
        return False
