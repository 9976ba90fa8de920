"""Threads on a machine that others use, too.

PyTorch's threads spin while they wait for each other. Where another process has one of their cores, the rest spin for
as long as it is away, and a step takes ten times as long, for both.
"""

from __future__ import annotations

import os
import time

import psutil
import torch

EVERY = 3.0
"""Seconds between two looks at what others do."""


def threads_beside(others: float, cores: int, most: int) -> int:
    """Threads that have a core of their own, at least 1.

    Args:
        others: Cores that other processes keep busy, on average.
        cores: Of the machine.
        most: Threads at most.
    """
    return max(1, min(most, round(cores - others)))


class SharedCores:
    """Gives PyTorch as many threads as there are cores that others leave free, up to the number that it began with;
    where OMP_NUM_THREADS says how many, that stands."""

    def __init__(self) -> None:
        self.most = torch.get_num_threads()
        self._fixed = self.most == 1 or "OMP_NUM_THREADS" in os.environ
        self._last = _now()

    def look(self) -> str | None:
        """Has PyTorch use more or fewer threads, every few seconds; says so in words where that changes something."""
        if self._fixed or time.perf_counter() - self._last[0] < EVERY:
            return None
        before, self._last = self._last, _now()
        seconds, busy, own = (now - then for now, then in zip(self._last, before, strict=True))
        others = max(0.0, (busy - own) / seconds)
        cores = psutil.cpu_count() or self.most
        threads = threads_beside(others, cores, self.most)
        if threads == torch.get_num_threads():
            return None
        torch.set_num_threads(threads)
        return f"Others keep {others:.1f} of {cores} cores busy: {threads} of {self.most} threads from now on."

    def give_back(self) -> None:
        """Has PyTorch use as many threads as it began with."""
        torch.set_num_threads(self.most)


def _now() -> tuple[float, float, float]:
    """A time, the time for which all cores together have been busy by then, and that of this process, in seconds."""
    machine, own = psutil.cpu_times(), time.process_time()
    idle = machine.idle + getattr(machine, "iowait", 0.0)
    counted_twice = getattr(machine, "guest", 0.0) + getattr(machine, "guest_nice", 0.0)
    return time.perf_counter(), sum(machine) - idle - counted_twice, own
