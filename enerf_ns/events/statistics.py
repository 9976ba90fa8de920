"""What a recording's events tell in numbers about how to learn from them."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from enerf_ns.dataparsers.index.event_index import EventIndex

BORDER = 1 / 16
"""Width of a sensor's border, as a share of its width and height."""

NUM_PIXELS = 4096
"""Pixels that are looked at, evenly over the sensor."""


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


def log_brightness_range(
    index: EventIndex, contrast_thresholds: tuple[float, float], share: float = 0.99, parts: int = 1
) -> float:
    """From the darkest to the brightest that a pixel saw, as its events add up: max less min of the running sum of
    C_on for each positive and -C_off for each negative event, and 0 before the first.

    What a scene spans is at least this; what lies beside it, no pixel saw with it. Noise, wrong thresholds and what
    pixels miss add to the sum as long as the recording goes on, so that halves of it span less than the whole.

    Args:
        index: With at least one event.
        contrast_thresholds: C_on and C_off, in units of log brightness.
        share: Of the pixels with events, those that stay below what is returned.
        parts: Equal parts of the time between the first and the last event, each with sums of its own; the largest of
            their ranges is returned.
    """
    on, off = contrast_thresholds
    counts = index.offsets.diff()
    active = counts.nonzero()[:, 0]
    pixels = active[:: -(-len(active) // NUM_PIXELS)]
    counts = counts[pixels]
    order = torch.repeat_interleave(torch.arange(len(pixels), device=pixels.device), counts)
    events = torch.arange(len(order), device=pixels.device) + (index.offsets[pixels] - counts.cumsum(0) + counts)[order]
    begin, end = index.times.min(), index.times.max()
    owner = order * parts + (index.times[events] - begin) * parts // (end - begin + 1)

    def sums(number: Tensor) -> Tensor:
        """After a number of events of the index, all pixels together."""
        positive = torch.where(number > 0, index.positives[(number - 1).clamp(min=0)], 0).double()
        return on * positive - off * (number - positive)

    around = torch.stack([sums(events), sums(events + 1)])
    none = torch.zeros(len(pixels) * parts, dtype=torch.float64, device=pixels.device)
    highest = none.scatter_reduce(0, owner, around.amax(0), "amax", include_self=False)
    lowest = none.scatter_reduce(0, owner, around.amin(0), "amin", include_self=False)
    return float((highest - lowest).view(-1, parts).quantile(share, dim=0).max())
