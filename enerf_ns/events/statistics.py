"""Statistics of a recording's events that decide how to learn from them."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from enerf_ns.dataparsers.index.event_index import EventIndex

BORDER = 1 / 16
"""Width of a sensor's border, as a share of its width and height."""

NUM_PIXELS = 4096
"""About the number of pixels whose brightness range is measured, evenly over the sensor."""


def silent_share(index: EventIndex, silence_ns: int, at_most: int = 2**22) -> float:
    """Share of long silences in the time between the first and the last event of each pixel.

    Args:
        index: The events.
        silence_ns: Shortest silence that counts, ns.
        at_most: About the largest number of events that are used. Of more events, only some pixels count.
    """
    pixels = torch.arange(0, len(index.offsets) - 1, max(-(-len(index) // at_most), 1), device=index.times.device)
    counts = index.offsets.diff()[pixels]
    of_pixel = torch.repeat_interleave(pixels, counts)
    first = index.offsets[pixels] - counts.cumsum(0) + counts
    events = torch.arange(len(of_pixel), device=pixels.device) + torch.repeat_interleave(first, counts)
    intervals = index.times[events].diff()[of_pixel[1:] == of_pixel[:-1]]
    return float(intervals[intervals >= silence_ns].sum() / intervals.sum().clamp(min=1))


def border_rate(index: EventIndex, height: int) -> float:
    """Mean number of events per pixel at the sensor's border, relative to the other pixels; at most 1e9.

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
    """Range of log brightness that single pixels saw: maximum less minimum of the sum of a pixel's events.

    The sum starts at 0, gains C_on with each positive event and loses C_off with each negative one. The range of the
    scene is at least as large, since no pixel sees all of it. Noise, wrong thresholds and missing events add to the sum
    throughout the recording, so that parts of a recording have smaller ranges than the whole.

    Args:
        index: With at least one event.
        contrast_thresholds: C_on and C_off, in units of log brightness.
        share: Share of the pixels with events whose ranges lie below the returned one.
        parts: Number of equal parts of the time between the first and the last event, each with sums of its own. The
            largest of their ranges is returned.
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
        """Sum over the first `number` events of the index, all pixels together."""
        positive = torch.where(number > 0, index.positives[(number - 1).clamp(min=0)], 0).double()
        return on * positive - off * (number - positive)

    around = torch.stack([sums(events), sums(events + 1)])
    none = torch.zeros(len(pixels) * parts, dtype=torch.float64, device=pixels.device)
    highest = none.scatter_reduce(0, owner, around.amax(0), "amax", include_self=False)
    lowest = none.scatter_reduce(0, owner, around.amin(0), "amin", include_self=False)
    return float((highest - lowest).view(-1, parts).quantile(share, dim=0).max())
