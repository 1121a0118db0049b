"""Two folders change names at one instant, where the system can do that."""

from __future__ import annotations

import ctypes
import os
from pathlib import Path

SWAP = 2
"""RENAME_EXCHANGE of Linux, RENAME_SWAP of macOS."""

HERE = -100
"""AT_FDCWD: paths are relative to the working folder."""


def exchanged(one: Path, other: Path) -> bool:
    """Whether each has the other's name now; if not, nothing was changed."""
    names = os.fsencode(one), os.fsencode(other)
    try:
        system = ctypes.CDLL(None)
        if hasattr(system, "renameat2"):
            return system.renameat2(HERE, names[0], HERE, names[1], SWAP) == 0
        return system.renamex_np(*names, SWAP) == 0
    except (AttributeError, OSError, TypeError):  # neither Linux nor macOS
        return False
