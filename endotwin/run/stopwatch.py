"""What a run cost: the seconds of its named stages and the most memory that its main process held."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

try:
    import resource
except ImportError:  # Windows
    resource = None


def peak_memory_mb() -> float:
    """Most resident memory that this process has held so far, in MB (10⁶ bytes). Workers that it started, as
    those of ``synth`` and ``study``, hold their own, which is not in it.

    Linux's VmHWM where there is one: unlike ``ru_maxrss`` it does not start at the parent's size.
    """
    status = Path("/proc/self/status")
    if status.exists():
        line = next(
            (line for line in status.read_text(encoding="utf-8").splitlines() if line.startswith("VmHWM:")),
            None,
        )
        if line is not None:
            return int(line.split()[1]) * 1024 / 1e6
    if resource is None:
        import psutil

        return psutil.Process().memory_info().peak_wset / 1e6
    unit_bytes = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit_bytes / 1e6


class Stopwatch:
    """Seconds of named stages, in the order in which they were first entered.

    Attributes:
        seconds: wall-clock seconds a stage; a stage entered again adds to its own.
        parts: seconds of the parts of some stages.
    """

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self.parts: dict[str, dict[str, float]] = {}
        self._started = time.perf_counter()
        self._lap: tuple[str, float] | None = None

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time the block as ``name``, also when it raises."""
        started = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - started

    def lap(self, name: str | None) -> None:
        """From now on time ``name``, until another lap (or None) begins."""
        now = time.perf_counter()
        if self._lap is not None:
            lap, started = self._lap
            self.seconds[lap] = self.seconds.get(lap, 0.0) + now - started
        self._lap = None if name is None else (name, now)

    @property
    def total(self) -> float:
        """Seconds since the stopwatch was made, what no stage claimed included."""
        return time.perf_counter() - self._started

    def to_dict(self) -> dict:
        """``{"stages": {name: s}, "parts": {stage: {part: s}}, "seconds": s, "peak_memory_mb": MB}``.

        ``parts`` is left out where there are none. The memory is that of the main process.
        """
        parts = {name: _rounded(seconds) for name, seconds in self.parts.items()}
        return {
            "stages": _rounded(self.seconds),
            **({"parts": parts} if parts else {}),
            "seconds": round(self.total, 3),
            "peak_memory_mb": round(peak_memory_mb(), 1),
        }

    def __str__(self) -> str:
        stages = " · ".join(
            f"{name} {seconds:.1f} s{_shown(self.parts.get(name, {}))}"
            for name, seconds in self.seconds.items()
        )
        return f"{stages} · total {self.total:.1f} s, peak memory {peak_memory_mb() / 1000:.2f} GB"


def _rounded(seconds: dict[str, float]) -> dict[str, float]:
    return {name: round(value, 3) for name, value in seconds.items()}


def _shown(parts: dict[str, float]) -> str:
    return f" ({', '.join(f'{name} {value:.1f}' for name, value in parts.items())})" if parts else ""
