"""Worker processes: what they give, and how they end."""

import ctypes
import os
import time
from pathlib import Path

import psutil
import pytest

from endotwin.errors import OutputError
from endotwin.run.processes import Pool

pytestmark = pytest.mark.slow

ROLLUP, LARGE = Path("/proc/self/smaps_rollup"), Path("/sys/kernel/mm/transparent_hugepage/enabled")

_greeting = ""


def greet(word: str) -> None:
    global _greeting
    _greeting = word


def greeting(number: int) -> str:
    return f"{_greeting} {number}"


def test_workers_are_begun_and_answer():
    with Pool(1, greet, "hello") as pool:
        assert [task.result() for task in [pool.submit(greeting, k) for k in range(3)]] == [
            "hello 0",
            "hello 1",
            "hello 2",
        ]


def in_large_pages_mb() -> float:
    """Of 64 MB of memory that malloc gave."""
    memory = ctypes.create_string_buffer(1 << 26)
    ctypes.memset(memory, 1, 1 << 26)
    (line,) = (line for line in ROLLUP.read_text().splitlines() if line.startswith("AnonHugePages"))
    return int(line.split()[1]) / 1e3


@pytest.mark.skipif(
    not (ROLLUP.exists() and LARGE.exists() and "[never]" not in LARGE.read_text()),
    reason="the system has no large pages",
)
def test_workers_have_large_pages_and_this_process_keeps_its_settings():
    before = dict(os.environ)
    with Pool(1) as pool:
        assert pool.submit(in_large_pages_mb).result() > 50
    assert dict(os.environ) == before


def test_a_worker_that_dies_is_told_in_one_sentence():
    with pytest.raises(OutputError, match="a worker process died"), Pool(1) as pool:
        pool.submit(os._exit, 1).result()


def test_a_block_that_an_error_leaves_waits_for_no_worker():
    with pytest.raises(ZeroDivisionError), Pool(1) as pool:
        number = pool.submit(os.getpid).result()
        task = pool.submit(time.sleep, 600)
        while not task.running():
            time.sleep(0.01)
        raise ZeroDivisionError
    assert not psutil.pid_exists(number) or psutil.Process(number).status() == psutil.STATUS_ZOMBIE
