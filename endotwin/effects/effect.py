"""What every effect is: named parameters with bounds, and how it changes the picture.

An effect is a frozen dataclass whose fields are its parameters, in a module of its name. Light meets them
on its way in this order:

- where it comes from and how it falls (offset, profile, shadows, interreflection);
- how tissue answers it (specular, coat, film, sparkle);
- when pixels see it (motion blur, rolling shutter, interlacing);
- what the lens makes of the radiance image (vignetting, defocus, chromatic, bloom, lens);
- what the sensor makes of that (gain, auto_gain, tone, noise);
- what becomes of the picture afterwards (processor, overlay, chroma, codec, video).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from dataclasses import fields as dataclass_fields
from typing import ClassVar

STATES = ("auto", "on", "off")


@dataclass(frozen=True)
class Parameter:
    """A parameter as a user sees it, and the bounds that it may take."""

    name: str
    low: float
    high: float


def parameter(default: float, low: float, high: float) -> float:
    """A dataclass field that is a scalar parameter."""
    return field(default=default, metadata={"low": low, "high": high})


@dataclass(frozen=True)
class Effect:
    """Base of all effects."""

    name: ClassVar[str]

    def __str__(self) -> str:
        """The name, and the scalar parameters with their values."""
        told = ", ".join(f"{each.name} {getattr(self, each.name):.4g}" for each in self.parameters())
        return f"{self.name} ({told})" if told else self.name

    @classmethod
    def parameters(cls) -> tuple[Parameter, ...]:
        """The scalar parameters, in the order of the fields."""
        return tuple(
            Parameter(f.name, f.metadata["low"], f.metadata["high"])
            for f in dataclass_fields(cls)
            if "low" in f.metadata
        )


@dataclass(frozen=True)
class Decision:
    """Why an effect is on or off, and what that costs.

    Attributes:
        state: ``on`` or ``off``. reason: one sentence with the evidence.
        gain_db: held-out gain of the probe; None where none was needed.
        fit_s: seconds that deciding and fitting it took. render_ms: milliseconds it adds to a frame.
        memory_mb: memory it holds.
    """

    state: str
    reason: str
    gain_db: float | None = None
    fit_s: float = 0.0
    render_ms: float = 0.0
    memory_mb: float = 0.0


def unjudged(state: str) -> Decision:
    """Why an effect is off that was not judged, where its ``state`` was asked for."""
    return Decision("off", "forced off" if state == "off" else "no time to judge")
