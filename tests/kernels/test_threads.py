"""The numbers of threads of the kernels and of PyTorch."""

from __future__ import annotations

import multiprocessing
import os
import threading
from collections import Counter
from collections.abc import Iterator

import pytest
import torch

from enerf_ns.kernels.threads import kernels_alone, on_threads


@pytest.fixture
def three_threads() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    yield
    torch.set_num_threads(before)


@pytest.mark.parametrize("number", [0, 1, 2, 3, 50])
def test_each_task_is_done_once(three_threads, number: int):
    done: Counter[int] = Counter()
    on_threads(lambda index: done.update([index]), number)
    assert done == Counter(range(number))


def meeting(parties: int) -> int:
    """Returns how many threads do tasks at the same time: each task waits until all have started."""
    barrier, threads = threading.Barrier(parties), set()

    def task(index: int) -> None:
        barrier.wait(timeout=20.0)
        threads.add(threading.get_ident())

    on_threads(task, parties)
    return len(threads)


def test_tasks_are_done_at_once_the_calling_thread_s_among_them(three_threads):
    assert meeting(3) == 3
    tasks = []
    on_threads(lambda index: tasks.append(threading.get_ident()), 1)
    assert tasks == [threading.get_ident()]


def test_pytorch_has_one_thread_beside_as_many_of_kernels_as_it_had(three_threads):
    with kernels_alone():
        assert torch.get_num_threads() == 1
        with kernels_alone():
            assert meeting(3) == 3
        assert torch.get_num_threads() == 1
    assert torch.get_num_threads() == 3
    with pytest.raises(ZeroDivisionError), kernels_alone():
        raise ZeroDivisionError
    assert torch.get_num_threads() == 3


def test_what_a_task_raises_is_raised(three_threads):
    def task(index: int) -> None:
        if index == 2:
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        on_threads(task, 40)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no process can be forked here")
def test_a_forked_process_has_threads_of_its_own(three_threads):
    assert meeting(3) == 3
    process = multiprocessing.get_context("fork").Process(target=lambda: os._exit(meeting(3)))
    process.start()
    process.join(timeout=60.0)
    assert process.exitcode == 3
