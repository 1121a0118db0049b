"""What callers of the Python interface give, checked before anything is done with it."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Mapping
from numbers import Integral, Real
from pathlib import Path

from endotwin.errors import OptionError


def check_positive(name: str, value: object) -> float:
    """``value`` as Python's own number; raises OptionError unless it is finite and greater than 0."""
    if isinstance(value, bool) or not isinstance(value, Real) or not (math.isfinite(value) and value > 0):
        raise OptionError(f"the {name} is {value!r}, but must be a number greater than 0")
    return int(value) if isinstance(value, Integral) else float(value)


def check_whole(name: str, value: object, least: int = 0) -> int:
    """``value`` as Python's own number; raises OptionError unless it is whole and at least ``least``."""
    if isinstance(value, bool) or not isinstance(value, Integral) or value < least:
        raise OptionError(f"the {name} is {value!r}, but must be a whole number, {least} or more")
    return int(value)


def as_path(name: str, value: object) -> Path:
    """``value`` as a path; raises OptionError where it is none."""
    if not isinstance(value, str | os.PathLike):
        raise OptionError(f"the {name} is given by its path, and not as {type(value).__name__}")
    return Path(value)


def check_progress(value: object) -> None:
    """Raise OptionError unless ``value`` can be called, or is None."""
    if value is not None and not callable(value):
        raise OptionError(f"the progress is {value!r}, but must be a function of (label, done, total)")


def texts(name: str, given: Iterable[str] | str) -> list[str]:
    """One text, or several, as a list; raises OptionError for anything else, a mapping too."""
    try:
        each = [given] if isinstance(given, str) else list(given)
    except TypeError:
        each = [given]
    if isinstance(given, Mapping) or not all(isinstance(text, str) for text in each):
        raise OptionError(f"{name} is {given!r}, but must be a text or a list of texts")
    return each
