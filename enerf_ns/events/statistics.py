"""What a recording's events tell in numbers about how to learn from them."""

from __future__ import annotations

import math

import torch

from enerf_ns.dataparsers.event_index import EventIndex

BORDER = 1 / 16
"""Width of a sensor's border, as a share of its width and height."""


def silent_share(index: EventIndex, silence_ns: int, at_most: int = 2**22) -> float:
    """Share of the time between their first and last events that pixels are silent for at least so long.

    Args:
        index: The events.
        silence_ns: Shortest silence that counts, ns.
        at_most: Events that are looked at, about: those of every so many pixels.
    """
    pixels = torch.arange(0, len(index.offsets) - 1, max(-(-len(index) // at_most), 1), device=index.times.device)
    counts = index.offsets.diff()[pixels]
    of_pixel = torch.repeat_interleave(pixels, counts)
    first = index.offsets[pixels] - counts.cumsum(0) + counts
    events = torch.arange(len(of_pixel), device=pixels.device) + torch.repeat_interleave(first, counts)
    intervals = index.times[events].diff()[of_pixel[1:] == of_pixel[:-1]]
    return float(intervals[intervals >= silence_ns].sum() / intervals.sum().clamp(min=1))


def border_rate(index: EventIndex, height: int) -> float:
    """Mean events of a pixel at the sensor's border, as a share of those of a pixel elsewhere; at most 1e9.

    Args:
        index: The events.
        height: Of the sensor, pixels.
    """
    counts = index.offsets.diff().double().reshape(height, index.width)
    rows, columns = math.ceil(BORDER * height), math.ceil(BORDER * index.width)
    inner = counts[rows : height - rows, columns : index.width - columns]
    border = (counts.sum() - inner.sum()) / (counts.numel() - inner.numel())
    return min(float(border / inner.mean()), 1e9) if inner.sum() else 1e9
