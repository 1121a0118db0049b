"""Effects: what a scene may have beside the paper's light, each simulated only where it is called for.

One module an effect, of the effect's name; ``effect`` says what they share. Which of them a scene calls
for is decided in ``endotwin.evidence``.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict
from importlib import import_module

from endotwin.effects.effect import STATES, Decision, Effect, unjudged
from endotwin.errors import OptionError

FITTED = (
    *("specular", "offset", "shadows", "interreflection", "gain", "vignetting", "profile"),
    *("coat", "film", "sparkle", "tone"),
)
RENDERED = (
    *("auto_gain", "noise", "motion_blur", "defocus", "rolling_shutter", "interlacing", "chromatic"),
    *("bloom", "lens", "processor", "overlay", "chroma", "codec", "video"),
)
NAMES = (*FITTED, *RENDERED)

__all__ = [
    "FITTED",
    "NAMES",
    "RENDERED",
    "STATES",
    "Decision",
    "Effect",
    "Effects",
    "checked_states",
    "effect_class",
    "parse_states",
    "unjudged",
]


class Effects(Mapping[str, Effect]):
    """The effects that are on, by name, in the order of NAMES."""

    def __init__(self, effects: Iterable[Effect] = ()):
        by_name = {effect.name: effect for effect in effects}
        self._effects = {name: by_name[name] for name in NAMES if name in by_name}

    def __getitem__(self, name: str) -> Effect:
        return self._effects[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._effects)

    def __len__(self) -> int:
        return len(self._effects)

    def __repr__(self) -> str:
        return f"Effects({', '.join(self) or 'none'})"

    def including(self, effect: Effect) -> Effects:
        """These effects with ``effect`` on, in place of one of its name."""
        return Effects([*(other for name, other in self.items() if name != effect.name), effect])

    def without(self, names: Iterable[str]) -> Effects:
        """These effects with those ``names`` off."""
        return Effects(effect for name, effect in self.items() if name not in names)

    @property
    def guides_mm(self) -> tuple[tuple[float, float, float], ...] | None:
        """Positions of the light guides in the camera frame; None: the light is at the lens."""
        return self["offset"].guides_mm if "offset" in self else None

    @property
    def profile(self) -> float:
        """Angular shape of the light (``guides.log_axis``), 0 for cosⁿθ."""
        return self["profile"].exponential if "profile" in self else 0.0

    @property
    def bounce(self) -> float:
        """Strength of interreflection; 0 without it."""
        return self["interreflection"].strength if "interreflection" in self else 0.0

    def to_dict(self) -> dict[str, dict]:
        """Parameters by name, as plain values."""
        return {name: asdict(effect) for name, effect in self.items()}

    @classmethod
    def from_dict(cls, document: Mapping[str, Mapping]) -> Effects:
        """What ``to_dict`` gave. Raises TypeError, ValueError or KeyError for anything else."""
        return cls(effect_class(name)(**_tuples(values)) for name, values in document.items())


def effect_class(name: str) -> type[Effect]:
    """The class of the effect ``name``; raises KeyError for any other name."""
    if name not in NAMES:
        raise KeyError(name)
    module = import_module(f"endotwin.effects.{name}")
    return getattr(module, name.title().replace("_", ""))


def parse_states(text: str, like: bool = False) -> dict[str, str]:
    """``shadows=off,gain=on`` as states by name; with ``like``, ``like=SEQUENCE`` too.

    Raises:
        OptionError: an unknown effect or state, or one that is named twice.
    """
    states = {}
    for entry in filter(None, (part.strip() for part in text.split(","))):
        name, _, state = entry.partition("=")
        if name in states:
            raise OptionError(f"'{text}' names {name} twice; say once how it shall be")
        states[name] = state
    return checked_states(states, like)


def checked_states(states: object, like: bool = False) -> dict[str, str]:
    """States by name of the effect, as they are given; with ``like``, that of a sequence too.

    Raises:
        OptionError: no mapping, or an unknown effect or state.
    """
    if not isinstance(states, Mapping):
        raise OptionError(f"effects are states by name, as in {{'gain': 'off'}}, and not {states!r}")
    for name, state in states.items():
        if like and name == "like" and state:
            continue
        if name not in NAMES or state not in STATES:
            raise OptionError(
                f"'{name}={state}' is no choice of an effect; write NAME=auto, on or off with a NAME of "
                f"{', '.join(NAMES)}"
            )
    return dict(states)


def _tuples(values):
    """Lists as tuples, at any depth, as frozen parameters are."""
    if isinstance(values, Mapping):
        return {name: _tuples(value) for name, value in values.items()}
    return tuple(_tuples(value) for value in values) if isinstance(values, list) else values
