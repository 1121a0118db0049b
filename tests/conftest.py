"""Fixtures shared by all tests."""

import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest


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


@pytest.fixture(autouse=True)
def signals() -> Iterator[None]:
    """``main`` takes SIGINT and SIGTERM over; give them back to the test runner."""
    kept = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    yield
    for number, handler in kept.items():
        signal.signal(number, handler)
