"""Text for terminals, files and pipes that cannot show every character: spelled out instead of an error."""

from __future__ import annotations

import codecs
import io
import sys

SPELLED = {"γ": "gamma", "θ": "theta", "°": " deg", "×": "x", "·": "|", "–": "-", "→": "->", "…": "..."}
SPELLED |= {"≤": "<=", "≥": ">=", "²": "^2", "ⁿ": "^n", "−": "-", "±": "+-", "σ": "sigma", "ω": "omega"}


def spell_out() -> None:
    """From now on stdout and stderr spell out what their encoding lacks."""
    codecs.register_error("spelled", _spelled)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="spelled")


def _spelled(error: UnicodeError) -> tuple[str, int]:
    if not isinstance(error, UnicodeEncodeError):
        raise error
    lacking = error.object[error.start : error.end]
    return "".join(SPELLED.get(each, ascii(each)[1:-1]) for each in lacking), error.end
