"""Changes of brightness that pixels missed while they were blind, summed over the events of each pixel."""

from __future__ import annotations

import torch
from jaxtyping import Float32, Int64
from torch import Tensor

from enerf_ns.dataparsers.index.event_index import EventIndex
from enerf_ns.dataparsers.index.event_rates import missed_changes

PIXELS_AT_ONCE = 2**12
"""Pixels whose events are summed at once, which limits memory."""


class MissedChanges:
    """Changes that pixels missed while they were blind (`missed_changes`), in 8 bytes per event.

    The sum of a pixel's events is the change of its brightness, if the pixel is never blind. After each event, a blind
    pixel misses the change until it compares anew. With this change, which the rates of its events show about, the sum
    is that of a pixel that is never blind.

    Args:
        index: The events.
        refractory_ns: How long a pixel is blind after an event, at least 1.
    """

    def __init__(self, index: EventIndex, refractory_ns: int):
        self.index, self.refractory_ns = index, refractory_ns
        self.sums: Float32[Tensor, "events 2"] = torch.empty(len(index), 2, device=index.times.device)
        """Rise and fall that a pixel missed after its first event, up to and after each event, in thresholds."""
        for first in range(0, len(index.offsets) - 1, PIXELS_AT_ONCE):
            offsets = index.offsets[first : first + PIXELS_AT_ONCE + 1]
            events = torch.arange(int(offsets[0]), int(offsets[-1]), device=offsets.device)
            counts = offsets.diff()
            pixels = torch.repeat_interleave(torch.arange(len(counts), device=offsets.device), counts)
            missed = missed_changes(index, events, first + pixels, refractory_ns).double()
            total = torch.cat([missed.new_zeros(1, 2), missed.cumsum(0)])
            self.sums[events] = (total[1:] - total[offsets[:-1] - offsets[0]][pixels]).float()

    def seen_again(self, events: Int64[Tensor, " pairs"], until: Int64[Tensor, " pairs"]) -> Int64[Tensor, " pairs"]:
        """Time (ns) at which pixels see again after events, at least 1 ns before a later event.

        Args:
            events: Times of the events, ns.
            until: Times of the later events, ns.
        """
        return events + (until - 1 - events).clamp(max=self.refractory_ns)

    def until(
        self, pixels: Int64[Tensor, " pairs"], until: Int64[Tensor, " pairs"], times: Int64[Tensor, " pairs"]
    ) -> Float32[Tensor, "pairs 2"]:
        """Rise and fall that pixels missed up to some instants, in thresholds. While they are blind, they miss in
        proportion to the time that has passed.

        Args:
            pixels: Pixel of each instant.
            until: Number of the first event in the index after each instant, or of the first one of the next pixel.
            times: The instants, ns.
        """
        first = self.index.offsets[pixels]
        last, before = ((until - back).clamp(min=0) for back in (1, 2))
        passed = ((times - self.index.times[last]).double() / self.refractory_ns).clamp(0.0, 1.0).float()[:, None]
        earlier = torch.where((until - 1 > first)[:, None], self.sums[before], 0.0)
        return torch.where((until > first)[:, None], earlier + passed * (self.sums[last] - earlier), 0.0)
