"""What one check found: the number measured, and the bound that it was promised to keep."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass


@dataclass(frozen=True)
class Finding:
    """One case of a check.

    Attributes:
        case: what is claimed. measured: the worst that was met. bound: what it may be at most.
        at_least: the bound is a least rather than a most. unit: of both.
    """

    case: str
    measured: float
    bound: float
    at_least: bool = False
    unit: str = ""

    @property
    def ok(self) -> bool:
        """Whether the bound holds; nothing that is not finite keeps a bound."""
        if not math.isfinite(self.measured):
            return False
        return bool(self.measured >= self.bound if self.at_least else self.measured <= self.bound)

    @property
    def promise(self) -> str:
        """The bound as shown."""
        return f"{'≥' if self.at_least else '≤'} {shown(self.bound)} {self.unit}".rstrip()

    def to_dict(self) -> dict:
        """Plain values; ``bound`` is a least where ``at_least``, and what is not finite is None."""
        measured = float(self.measured) if math.isfinite(self.measured) else None
        return {**vars(self), "measured": measured, "bound": float(self.bound), "ok": self.ok}


Check = Callable[[], Iterable[Finding]]


def shown(value: float) -> str:
    """A number in three digits, whatever its size."""
    return f"{value:.3g}" if value == 0 or 1e-3 <= abs(value) < 1e5 else f"{value:.1e}"
