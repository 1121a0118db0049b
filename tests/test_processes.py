"""Worker processes: what they give, and how they end."""

import os
import time

import psutil
import pytest

from endotwin.errors import OutputError
from endotwin.run.processes import Pool

pytestmark = pytest.mark.slow

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
