"""The per-pixel index of a recording's events, from which the samplers draw."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
import torch
from jaxtyping import Int32, Int64
from torch import Tensor

from enerf_ns.dataparsers.recording import Events


@dataclass(frozen=True)
class EventIndex:
    """Events sorted by pixel, then time; 12 bytes an event. Pixel (x, y) of a sensor is number y * width + x."""

    times: Int64[Tensor, " events"]
    """Nanoseconds; never decreasing within a pixel."""
    positives: Int32[Tensor, " events"]
    """Number of positive events up to and with this one, counted over the whole array: between two events i < j of one
    pixel, (i, j] holds positives[j] - positives[i] positive ones, and the other j - i - that many are negative."""
    offsets: Int64[Tensor, " pixels+1"]
    """The events of pixel p are offsets[p] to offsets[p + 1] - 1."""

    @classmethod
    def from_events(cls, events: Events, width: int, height: int) -> EventIndex:
        """Sorts events by pixel: a stable counting sort, linear in the number of events.

        Args:
            events: In time order.
            width, height: Of the sensor, pixels.

        Raises:
            ValueError: An event outside the sensor, or 2^31 events and more.
        """
        if len(events) and (events.x.max() >= width or events.y.max() >= height):
            raise ValueError(
                f"An event lies at x = {events.x.max()} or y = {events.y.max()}, outside the {width} x {height} sensor."
            )
        if len(events) >= 2**31:
            raise ValueError(
                f"The index holds fewer than 2^31 events, but the recording has {len(events)}: shorten it."
            )
        sort = _compiled_counting_sort()
        times, positives, offsets = sort(events.x, events.y, events.t, events.p, width, height)
        return cls(torch.from_numpy(times), torch.from_numpy(positives), torch.from_numpy(offsets))

    def to(self, device: torch.device | str) -> EventIndex:
        """The same index on another device."""
        return EventIndex(self.times.to(device), self.positives.to(device), self.offsets.to(device))


def _counting_sort(x, y, t, p, width, height):
    offsets = np.zeros(width * height + 1, np.int64)
    for i in range(len(t)):
        offsets[np.int64(y[i]) * width + x[i] + 1] += 1
    for pixel in range(width * height):
        offsets[pixel + 1] += offsets[pixel]
    free = offsets[:-1].copy()
    times = np.empty(len(t), np.int64)
    positives = np.empty(len(t), np.int32)
    for i in range(len(t)):
        pixel = np.int64(y[i]) * width + x[i]
        times[free[pixel]] = t[i]
        positives[free[pixel]] = p[i] > 0
        free[pixel] += 1
    for i in range(1, len(t)):
        positives[i] += positives[i - 1]
    return times, positives, offsets


@cache
def _compiled_counting_sort():
    import numba  # here, since importing it takes longer than reading a small recording

    return numba.njit(_counting_sort)
