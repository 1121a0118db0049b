"""Long jobs at the same time: counted as one, and stopped as one."""

import threading

import pytest
import torch

from endotwin.run.ahead import on_all_cores
from endotwin.run.together import together


def test_what_all_jobs_have_done_is_told_and_ends_at_their_sum():
    told, met = [], threading.Barrier(2, timeout=20)

    def work(job: int, count) -> None:
        met.wait()  # which fewer than two at a time never pass
        for amount in range(1, job + 1):
            count(amount)

    together(work, [3, 5], 2, told.append)
    assert told == list(range(1, 9))


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_the_first_error_stops_the_others_at_their_next_count(error):
    ended, failed = [], threading.Event()

    def work(job: str, count) -> None:
        if job == "fails":
            failed.set()
            raise error("first")
        failed.wait(20)
        while True:
            count(1)

    def forever(job: str, count) -> None:
        try:
            work(job, count)
        finally:
            ended.append(job)

    with pytest.raises(error, match="first"):
        together(forever, ["goes on", "fails", "waits", "waits too"], 2, lambda _: None)
    assert set(ended) >= {"goes on", "fails"}


@pytest.mark.parametrize(
    ("jobs", "at_a_time", "cores_each"),
    [(2, 1, [3, 3]), (2, 2, [1, 1]), (3, 2, [1, 1, 3]), (1, 2, [3]), (6, 4, [1, 1, 1, 1, 1, 1])],
)
def test_jobs_keep_to_one_core_each_one_alone_has_all_and_the_caller_gets_its_threads_back(
    jobs, at_a_time, cores_each
):
    before, seen = torch.get_num_threads(), {}

    def work(job: int, count) -> None:
        seen[job] = torch.get_num_threads()

    torch.set_num_threads(3)
    try:
        together(work, range(jobs), at_a_time, lambda _: None)
        assert [seen[job] for job in range(jobs)] == cores_each
        assert torch.get_num_threads() == 3
    finally:
        torch.set_num_threads(before)


def test_what_is_made_on_all_cores_comes_in_order_each_on_one():
    before = torch.get_num_threads()
    made = list(on_all_cores(lambda item: (item, torch.get_num_threads()), range(40)))
    assert made == [(item, 1) for item in range(40)]
    assert torch.get_num_threads() == before
