"""Ctrl-C and SIGTERM: a command stops wherever it is, but not in the middle of an import."""

from __future__ import annotations

import signal
from types import FrameType

RETRY_S = 0.05


class Stopped(BaseException):
    """The user, or the system, asked the command to stop."""


def heed_signals() -> None:
    """From now on SIGINT and SIGTERM raise Stopped."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _stop)


def _stop(number: int, frame: FrameType | None) -> None:
    """Raise Stopped, or try again soon: a library that is being imported would make an ImportError of it."""
    if not _importing(frame):
        raise Stopped(number)
    signal.signal(signal.SIGALRM, lambda _, later: _stop(number, later))
    signal.setitimer(signal.ITIMER_REAL, RETRY_S)


def _importing(frame: FrameType | None) -> bool:
    while frame is not None and frame.f_code.co_filename != "<frozen importlib._bootstrap>":
        frame = frame.f_back
    return frame is not None
