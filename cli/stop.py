"""Ctrl-C and SIGTERM: a command stops wherever it is, within seconds, with one line."""

from __future__ import annotations

import _thread
import atexit
import os
import signal
import socket
import sys
import time
from contextlib import suppress
from threading import Event, Thread, Timer
from types import FrameType

RETRY_S = 0.05
PATIENCE_S = 1.2
"""Time that a command has to heed a signal: a long call of C code does not."""
TIDY_S = 8.0
"""Time that it then has to tidy up after itself; what it leaves then, the next one sweeps."""

UNINTERRUPTED = ("<frozen importlib._bootstrap>", "_workplace", "end_if_told")
"""A file and functions, one of them of ``run.output``, within which a signal waits."""

SIGNALS = (signal.SIGINT, signal.SIGTERM)
AGAIN = (signal.SIGALRM,) if hasattr(signal, "setitimer") else ()
"""Those that are heeded, and by which one that was put off is tried again."""

_heeded = Event()
_told: list[int] = []
"""The exit code, once it was said that the command stops."""
_put_off: list[int] = []
"""Signals that came where none may interrupt."""


class Stopped(BaseException):
    """The user, or the system, asked the command to stop."""


def heed_signals() -> None:
    """From now on SIGINT and SIGTERM raise Stopped."""
    for number in SIGNALS:
        signal.signal(number, _stop)


def tell(stopped: Stopped) -> int:
    """Say on stderr what was stopped; the exit code."""
    code = 128 + stopped.args[0]
    _told.append(code)
    print("stopped;", *getattr(stopped, "__notes__", ["nothing was written"]), file=sys.stderr)
    return code


def end_if_told() -> None:
    """End the process where it was stopped, be it in the moment in which it ended by itself; from here on
    there is nothing left to stop, and a signal that was put off is not tried a second time."""
    for number in (*SIGNALS, *AGAIN):
        signal.signal(number, signal.SIG_IGN)
    if _put_off and not _told:
        print("stopped", file=sys.stderr)
        _told.append(128 + _put_off[0])
    if _told:
        end(_told[0])


def end(code: int) -> None:
    """End the process at once: graphics and tensors would take a second or more to be unloaded. What cannot
    be written to stdout or stderr any more is left to Python, which says so."""
    with suppress(OSError):
        atexit._run_exitfuncs()
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def lose_patience() -> None:
    """From now on the process ends soon after SIGINT or SIGTERM, even within a long call of C code."""
    listening, told = socket.socketpair()  # a pipe would block, on Windows
    told.setblocking(False)
    signal.set_wakeup_fd(told.detach(), warn_on_full_buffer=False)
    Thread(target=_end_after, args=(listening,), daemon=True).start()


def _end_after(listening: socket.socket) -> None:
    while (number := listening.recv(1)[0]) not in SIGNALS:
        pass
    time.sleep(PATIENCE_S)
    if _heeded.is_set():
        time.sleep(TIDY_S)
    if not _told:
        print("stopped", file=sys.stderr, flush=True)
    os._exit(128 + number)


def _stop(number: int, frame: FrameType | None) -> None:
    """Raise Stopped, or try again soon: a library that is being imported would make an ImportError of it, and
    a workplace that is being made or removed would stay."""
    if not _within(frame, *UNINTERRUPTED):
        _heeded.set()
        raise Stopped(number)
    _put_off.append(number)
    if AGAIN:
        signal.signal(*AGAIN, lambda _, later: _stop(number, later))
        signal.setitimer(signal.ITIMER_REAL, RETRY_S)
    else:  # Windows
        again = Timer(RETRY_S, _thread.interrupt_main, (number,))
        again.daemon = True
        again.start()


def _within(frame: FrameType | None, *places: str) -> bool:
    """Whether ``frame`` was called from one of the files or functions ``places``."""
    while frame is not None and not {frame.f_code.co_filename, frame.f_code.co_name} & {*places}:
        frame = frame.f_back
    return frame is not None
