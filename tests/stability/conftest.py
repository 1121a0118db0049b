"""Fixtures of the stability suite."""

from collections.abc import Iterator

import pytest
import torch


@pytest.fixture(scope="session", autouse=True)
def one_thread():
    """Small products finish sooner on one thread than on two that share their cores with other processes."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="module")
def monkeypatch_module() -> Iterator[pytest.MonkeyPatch]:
    """``monkeypatch`` of a whole test module."""
    with pytest.MonkeyPatch.context() as patch:
        yield patch
