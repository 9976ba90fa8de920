"""Times calls, and the parts of a training step, on a device whose work is waited for."""

from __future__ import annotations

import time
from collections.abc import Callable

import torch


def seconds_of(call: Callable[[], object], device: torch.device | str) -> float:
    """Wall time of a call, with its work on a device and without what that did before."""
    start = _now(torch.device(device))
    call()
    return _now(torch.device(device)) - start


def _now(device: torch.device) -> float:
    """A time in seconds at which the device has nothing left to do."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()


class Stopwatch:
    """Seconds of each part of what is timed; before it is started, and after it is stopped, it does nothing.

    Args:
        device: Whose work is waited for at the end of each part.
    """

    def __init__(self, device: torch.device | str):
        self.device = torch.device(device)
        self._last: float | None = None
        self._parts: dict[str, float] = {}

    def start(self) -> None:
        self._parts = {}
        self._last = _now(self.device)

    def lap(self, part: str) -> None:
        """Ends a part, which began where the one before it ended."""
        if self._last is not None:
            now = _now(self.device)
            self._parts[part] = self._parts.get(part, 0.0) + now - self._last
            self._last = now

    def stop(self) -> dict[str, float]:
        """The parts, in the order in which they first ended."""
        self._last = None
        return self._parts
