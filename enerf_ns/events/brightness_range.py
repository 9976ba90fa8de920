"""How far log brightness goes, by the events alone."""

from __future__ import annotations

import torch

from enerf_ns.dataparsers.event_index import EventIndex

NUM_PIXELS = 4096
"""Pixels that are looked at, evenly over the sensor."""


def log_brightness_range(index: EventIndex, contrast_thresholds: tuple[float, float], share: float = 0.99) -> float:
    """From the darkest to the brightest that a pixel saw, as its events add up: max less min of the running sum of
    C_on for each positive and -C_off for each negative event, and 0 before the first.

    What a scene spans is at least this; what lies beside it, no pixel saw with it. Noise and wrong thresholds add to
    the sum as long as the recording goes on.

    Args:
        index: With at least one event.
        contrast_thresholds: C_on and C_off, in units of log brightness.
        share: Of the pixels with events, those that stay below what is returned.
    """
    on, off = contrast_thresholds
    counts = index.offsets.diff()
    active = counts.nonzero()[:, 0]
    pixels = active[:: -(-len(active) // NUM_PIXELS)]
    counts = counts[pixels]
    owner = torch.repeat_interleave(torch.arange(len(pixels), device=pixels.device), counts)
    first = index.offsets[pixels]
    number = torch.arange(len(owner), device=pixels.device) - (counts.cumsum(0) - counts)[owner]
    before = torch.where(first > 0, index.positives[(first - 1).clamp(min=0)], 0)
    positive = index.positives[first[owner] + number] - before[owner]
    sums = on * positive.double() - off * (number + 1 - positive).double()
    highest = torch.zeros(len(pixels), dtype=torch.float64, device=pixels.device)
    lowest = highest.clone()
    highest.scatter_reduce_(0, owner, sums, "amax")
    lowest.scatter_reduce_(0, owner, sums, "amin")
    return float((highest - lowest).quantile(share))
