"""Fixtures shared by all tests."""

import os

if "PYTEST_XDIST_WORKER_COUNT" in os.environ:  # before any library counts the cores: workers share them
    share = (os.cpu_count() or 1) // int(os.environ["PYTEST_XDIST_WORKER_COUNT"])
    os.environ.setdefault("OMP_NUM_THREADS", str(max(1, share)))

import signal
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import tube_sequence

import endotwin
from endotwin.run import locks

if "PYTEST_XDIST_WORKER" in os.environ and hasattr(os, "sched_setaffinity"):  # each has cores of its own
    number, count = (int(os.environ[f"PYTEST_XDIST_WORKER{name}"].lstrip("gw")) for name in ("", "_COUNT"))
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[number::count] or os.sched_getaffinity(0))


@pytest.fixture(scope="session")
def data_root() -> Path:
    """Folder of the larger sequences with truth (colon_direct, …), named in ENDOTWIN_DATA."""
    if "ENDOTWIN_DATA" not in os.environ:
        pytest.skip("ENDOTWIN_DATA is not set: it names the folder with the larger test sequences")
    return Path(os.environ["ENDOTWIN_DATA"]).resolve()


@pytest.fixture(scope="session")
def example() -> Path:
    """The bundled example sequence."""
    return Path(__file__).parents[1] / "examples" / "colon_small"


@pytest.fixture(scope="session")
def once(tmp_path_factory) -> Callable[[str, Callable[[], endotwin.Twin]], endotwin.Twin]:
    """A twin by its name, made once a run, whichever worker needs it first."""
    root = tmp_path_factory.getbasetemp()
    root = root.parent if "PYTEST_XDIST_WORKER" in os.environ else root

    def once(name: str, make: Callable[[], endotwin.Twin]) -> endotwin.Twin:
        kept, turn = root / "once" / name, root / f"once-{name}.lock"
        turn.touch()
        lock = locks.take(turn)
        try:
            if not kept.exists():
                kept.parent.mkdir(exist_ok=True)
                make().save(kept)
            return endotwin.Twin.load(kept)
        finally:
            locks.release(lock)

    return once


@pytest.fixture(scope="session")
def fused(example, once) -> Callable[[float], endotwin.Twin]:
    """The twin of the bundled example at a scale."""
    return lambda scale=1.0: once(f"fused-{scale}", lambda: endotwin.fuse_twin(example, scale=scale))


@pytest.fixture(scope="session")
def fitted(fused, once) -> endotwin.Twin:
    """The twin of the bundled example at half its size, fitted."""
    return once("fitted", lambda: endotwin.fit_twin(fused(0.5)))


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    """A folder with a sequence ``tube`` and its fitted twin ``twin``, of one test module alone."""
    folder = tmp_path_factory.mktemp("made")
    tube_sequence.write(folder / "tube", 4, 48, 36)
    endotwin.fit_twin(endotwin.fuse_twin(folder / "tube")).save(folder / "twin")
    return folder


@pytest.fixture(autouse=True)
def signals() -> Iterator[None]:
    """``main`` takes SIGINT and SIGTERM over; give them back to the test runner."""
    kept = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    yield
    for number, handler in kept.items():
        signal.signal(number, handler)
