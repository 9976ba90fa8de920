"""Threads of the compiled kernels, and of PyTorch beside them.

PyTorch's threads spin for milliseconds after each of their tasks, on the cores that the next task needs: that of a
kernel, or of another process, which spins in turn. A training step leaves PyTorch one thread, and what takes long to
the kernels, whose threads wait asleep.
"""

from __future__ import annotations

import functools
import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any

import torch

_of_kernels: int | None = None  # where they are not as many as PyTorch's


@contextmanager
def kernels_alone() -> Iterator[None]:
    """Leaves PyTorch one thread, and the kernels as many as it had."""
    global _of_kernels
    before = torch.get_num_threads()
    if _of_kernels is not None or before == 1:
        yield
        return
    _of_kernels = before
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
        _of_kernels = None


@functools.cache
def _helpers(number: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(number, "kernels")


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_helpers.cache_clear)  # a forked process has none of its parent's threads


def on_threads(task: Callable[[int], Any], number: int) -> None:
    """Calls a task that releases the GIL with 0, 1, … number - 1, on as many threads as PyTorch uses, or did before
    `kernels_alone`; the calling thread is one of them."""
    num_threads = min(_of_kernels or torch.get_num_threads(), number)
    indices = iter(range(number))

    def work() -> None:
        for index in indices:
            task(index)

    if num_threads <= 1:
        return work()
    helpers = [_helpers(num_threads - 1).submit(work) for _ in range(num_threads - 1)]
    work()
    for helper in helpers:
        helper.result()
