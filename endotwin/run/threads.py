"""How many threads work is spread over."""

from __future__ import annotations

import os

THREADS = 2
"""Of readers and ray casters: more of them wait for each other's memory."""


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
