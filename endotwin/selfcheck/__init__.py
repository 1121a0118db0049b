"""Checks of the numerics that run on the user's machine: promised bound and measured value of each case."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterator
from importlib import import_module

from endotwin.run.processes import Pool
from endotwin.selfcheck.finding import Finding

__all__ = ["GROUPS", "Finding", "run_checks"]

GROUPS = {
    "brdf": "Light, BRDF and response",
    "geometry": "Geometry",
    "input": "Input",
    "fit": "Fit",
}
"""Modules of checks, and their titles."""

PROCESSES = 2


def run_checks(progress: Callable[[str, int, int], None] | None = None) -> Iterator[tuple[str, Finding]]:
    """All findings with the title of their group, from two processes; a check that raises is a finding that
    failed.

    Args:
        progress: called with (label, done, total) as each check is done.
    """
    checks = [(name, index) for name in GROUPS for index in range(len(_checks(name)))]
    for done, ((name, _), findings) in enumerate(zip(checks, _all_found(checks), strict=True)):
        if progress:
            progress(GROUPS[name], done + 1, len(checks))
        yield from ((GROUPS[name], finding) for finding in findings)


def _all_found(checks: list[tuple[str, int]]) -> Iterator[list[Finding]]:
    if PROCESSES == 1:
        yield from (_found(*check) for check in checks)
        return
    with Pool(PROCESSES) as pool:
        yield from (result.result() for result in [pool.submit(_found, *check) for check in checks])


def _found(name: str, index: int) -> list[Finding]:
    """What one check of a group finds."""
    import torch

    torch.set_num_threads(1)  # small products finish sooner on one
    check = _checks(name)[index]
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", RuntimeWarning)
            return list(check())
    except Exception as error:  # whatever goes wrong in a check is what it found
        return [Finding(f"{check.__name__}: {type(error).__name__}: {error}", math.nan, 0)]


def _checks(name: str) -> tuple:
    return import_module(f"endotwin.selfcheck.{name}").CHECKS
