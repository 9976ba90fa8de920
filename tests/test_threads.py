"""Threads beside other processes."""

from __future__ import annotations

import subprocess
import sys
import time

import psutil
import pytest
import torch

from enerf_ns import threads
from enerf_ns.threads import SharedCores, threads_beside


@pytest.mark.parametrize(
    ("others", "cores", "most", "expected"),
    [
        (0.0, 2, 2, 2),
        (0.3, 2, 2, 2),
        (1.0, 2, 2, 1),
        (2.0, 2, 2, 1),
        (30.0, 64, 16, 16),
        (60.0, 64, 16, 4),
        (9.0, 8, 8, 1),
    ],
)
def test_threads_are_as_many_as_cores_are_free(others: float, cores: int, most: int, expected: int):
    assert threads_beside(others, cores, most) == expected


@pytest.fixture
def as_many_threads_as_cores(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    monkeypatch.setattr(threads, "EVERY", 1.0)
    before = torch.get_num_threads()
    torch.set_num_threads(max(2, psutil.cpu_count() or 2))
    yield
    torch.set_num_threads(before)


def test_where_others_keep_all_cores_busy_one_thread_is_left(as_many_threads_as_cores):
    cores = SharedCores()
    most = torch.get_num_threads()
    busy = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(most)]
    try:
        assert cores.look() is None  # too soon
        time.sleep(2.0)
        told = cores.look()
    finally:
        for process in busy:
            process.kill()
            process.wait()
    assert torch.get_num_threads() < most
    assert told is not None and f" of {most} threads" in told
    cores.give_back()
    assert torch.get_num_threads() == most


def test_own_work_is_no_others(as_many_threads_as_cores):
    """What this process does itself is not taken for what others do."""
    idle = threads._now()
    until = time.process_time() + 1.0
    while time.process_time() < until:
        pass
    _, busy, own = (now - before for now, before in zip(threads._now(), idle, strict=True))
    assert own == pytest.approx(1.0, abs=0.1)
    assert busy >= own - 0.3


def test_a_number_that_is_set_stands(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    monkeypatch.setattr(threads, "EVERY", 0.0)
    assert SharedCores().look() is None
