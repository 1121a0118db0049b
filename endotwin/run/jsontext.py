"""JSON from files that others wrote: whatever is wrong with the text, the error is a ValueError."""

from __future__ import annotations

import json

LONGEST_WHOLE = 18
"""Digits of a whole number that is kept as one; longer ones become floating point, and infinite beyond it."""


def parsed(text: str) -> object:
    """The value that ``text`` holds. Raises ValueError where it is no JSON, or nested too deeply."""
    try:
        return json.loads(text, parse_int=_whole)
    except RecursionError:
        raise ValueError("its brackets are nested too deeply") from None


def _whole(digits: str) -> int | float:
    return int(digits) if len(digits) <= LONGEST_WHOLE else float(digits)
