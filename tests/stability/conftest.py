"""Fixtures of the stability suite."""

import pytest
import torch


@pytest.fixture(scope="session", autouse=True)
def one_thread():
    """Small products finish sooner on one thread than on two that share their cores with other processes."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)
