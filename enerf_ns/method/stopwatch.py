"""Timing of calls, and of the parts of a training step. It waits until the device has finished."""

from __future__ import annotations

import time
from collections.abc import Callable

import torch


def seconds_of(call: Callable[[], object], device: torch.device | str) -> float:
    """Wall time of a call in seconds, with its work on a device, but without earlier work of the device."""
    start = _now(torch.device(device))
    call()
    return _now(torch.device(device)) - start


def _now(device: torch.device) -> float:
    """The time in seconds, after the device has finished its work."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()


class Stopwatch:
    """Measures the seconds of each part of a step. It does nothing before `start` and after `stop`.

    Args:
        device: Device whose work belongs to the parts.
    """

    def __init__(self, device: torch.device | str):
        self.device = torch.device(device)
        self._last: float | None = None
        self._parts: dict[str, float] = {}

    def start(self) -> None:
        self._parts = {}
        self._last = _now(self.device)

    def lap(self, part: str) -> None:
        """Ends a part, which began at the end of the part before it."""
        if self._last is not None:
            now = _now(self.device)
            self._parts[part] = self._parts.get(part, 0.0) + now - self._last
            self._last = now

    def stop(self) -> dict[str, float]:
        """Seconds of the parts by name, in the order in which they first ended."""
        self._last = None
        return self._parts
