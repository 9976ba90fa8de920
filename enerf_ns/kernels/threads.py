"""Threads for the compiled kernels, and the number of threads of PyTorch.

PyTorch's threads spin for milliseconds after each task. So they hold cores that the kernels, or another process, need.
In a training step PyTorch therefore has one thread. The kernels do the long work, and their threads sleep while they
wait.
"""

from __future__ import annotations

import functools
import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any

import torch

_of_kernels: int | None = None  # number of threads of the kernels within `kernels_alone`


@contextmanager
def kernels_alone() -> Iterator[None]:
    """Limits PyTorch to one thread inside the context, and gives the kernels as many threads as PyTorch had."""
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
    os.register_at_fork(after_in_child=_helpers.cache_clear)  # a forked process does not have the threads of its parent


def on_threads(task: Callable[[int], Any], number: int) -> None:
    """Calls a task once with each index, on as many threads as PyTorch has, or had before `kernels_alone`.

    The calling thread is one of these threads. An exception of a task is raised here.

    Args:
        task: A function of the index; it should release the GIL.
        number: Indices go from 0 to number - 1.
    """
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
