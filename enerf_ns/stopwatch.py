"""Times the parts of a training step."""

from __future__ import annotations

import time

import torch


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
        self._last = self._now()

    def lap(self, part: str) -> None:
        """Ends a part, which began where the one before it ended."""
        if self._last is not None:
            now = self._now()
            self._parts[part] = self._parts.get(part, 0.0) + now - self._last
            self._last = now

    def stop(self) -> dict[str, float]:
        """The parts, in the order in which they first ended."""
        self._last = None
        return self._parts

    def _now(self) -> float:
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)
        return time.perf_counter()
