"""What callers of the Python interface give, checked before anything is done with it."""

from __future__ import annotations

import math
from collections.abc import Iterable
from numbers import Integral, Real

from endotwin.errors import OptionError


def check_positive(name: str, value: object) -> None:
    """Raise OptionError unless ``value`` is a finite number greater than 0."""
    if isinstance(value, bool) or not isinstance(value, Real) or not (math.isfinite(value) and value > 0):
        raise OptionError(f"the {name} is {value!r}, but must be a number greater than 0")


def check_whole(name: str, value: object, least: int = 0) -> None:
    """Raise OptionError unless ``value`` is a whole number of at least ``least``."""
    if isinstance(value, bool) or not isinstance(value, Integral) or value < least:
        raise OptionError(f"the {name} is {value!r}, but must be a whole number, {least} or more")


def texts(name: str, given: Iterable[str] | str) -> list[str]:
    """One text, or several, as a list; raises OptionError for anything else."""
    try:
        each = [given] if isinstance(given, str) else list(given)
    except TypeError:
        each = [given]
    if not all(isinstance(text, str) for text in each):
        raise OptionError(f"{name} is {given!r}, but must be a text or a list of texts")
    return each
