"""Rates of the events of a pixel at any instant, and the changes that a pixel missed while it was blind."""

from __future__ import annotations

import torch
from jaxtyping import Float32, Int64
from torch import Tensor

from enerf_ns.dataparsers.index.event_index import EventIndex

MOST_MISSED = 2.0
"""Largest change (thresholds) that a pixel is taken to have missed after one event. Where an edge passes, the rate just
after the blind time is far above the mean rate during it."""


def rates_around(
    index: EventIndex, events: Int64[Tensor, " pairs"], pixels: Int64[Tensor, " pairs"], delay_ns: int, blind_ns: int
) -> Float32[Tensor, "pairs 2"]:
    """Rate of on and off events of a pixel (per second), at or shortly after one of its events.

    Each of the two intervals beside the event holds one event. Its rate is the rate in the middle of the part of the
    interval in which the pixel was not blind. The rate at the instant is interpolated between both middles, which is
    exact for a signal with a constant second derivative. If the signal turns before the next event, it has nearly come
    to rest, and the rate is half of the rate before. If pixels are blind after an event, the rate is interpolated in
    this case, too. If a pixel has no event before or after, the other interval alone gives the rate. An interval lasts
    at least as long as a step of the clock, so that equal stamps mean no endless rate.

    Args:
        index: The events.
        events: Numbers of the events in the index.
        pixels: Pixel of each event.
        delay_ns: Time from the event to the instant.
        blind_ns: How long a pixel is blind after an event.
    """
    times, positives = index.times, index.positives
    first, last = index.offsets[pixels], index.offsets[pixels + 1] - 1
    before, after = (events - 1).clamp(min=0), (events + 1).clamp(max=len(times) - 1)
    left = (times[events] - times[before] - blind_ns).clamp(min=index.resolution).double()
    right = (times[after] - times[events] - blind_ns).clamp(min=index.resolution).double()
    is_on = torch.stack([positives[events] > positives[before], positives[after] > positives[events]], dim=-1)
    is_on[:, 0] |= (events == 0) & (positives[events] > 0)
    share = (0.5 * left + delay_ns) / (0.5 * left + blind_ns + 0.5 * right)
    share = torch.where(events == last, 0.0, torch.where(events == first, 1.0, share.clamp(max=1.0)))
    of_left, of_right = 1e9 * (1.0 - share) / left, 1e9 * share / right
    if not blind_ns:
        turns = (is_on[:, 0] != is_on[:, 1]) & (events > first) & (events < last)
        of_left, of_right = torch.where(turns, 0.5e9 / left, of_left), torch.where(turns, 0.0, of_right)
    of_right, of_left = of_right * (events < last), of_left * (events > first)
    on = of_left * is_on[:, 0] + of_right * is_on[:, 1]
    return torch.stack([on, of_left + of_right - on], dim=-1).float()


def rates_between(
    index: EventIndex,
    until: Int64[Tensor, " pairs"],
    pixels: Int64[Tensor, " pairs"],
    times: Int64[Tensor, " pairs"],
    blind_ns: int,
) -> Float32[Tensor, "pairs 2"]:
    """Rate of on and off events of a pixel (per second) at any instants.

    As in `rates_around`, an interval between two events holds one event, and has its rate in the middle of the part in
    which the pixel was not blind. The rate is interpolated between the middle of the interval of an instant and that of
    the nearer interval beside it, if the pixel has one. Before the first and after the last event the rate is 0.

    Args:
        index: The events.
        until: Number of the first event in the index after each instant, or of the first one of the next pixel.
        pixels: Pixel of each instant.
        times: The instants, ns.
        blind_ns: How long a pixel is blind after an event.
    """
    first, stop = index.offsets[pixels], index.offsets[pixels + 1]

    def interval(end: Int64[Tensor, " pairs"]) -> tuple[Tensor, Tensor]:
        """Rates and middle of the interval before an event. Rates are 0 if it is none between events of the pixel."""
        exists = (end > first) & (end < stop)
        before, after = (number.clamp(0, len(index.times) - 1) for number in (end - 1, end))
        length = (index.times[after] - index.times[before] - blind_ns).clamp(min=index.resolution).double()
        is_on = index.positives[after] > index.positives[before]
        rates = torch.stack([is_on, ~is_on], dim=-1) * (1e9 / length * exists)[:, None]
        return rates, index.times[after] - 0.5 * length

    own, middle = interval(until)
    is_later = times > middle
    beside, other_middle = interval(torch.where(is_later, until + 1, until - 1))
    share = ((times - middle) / (other_middle - middle)).nan_to_num(0.0).clamp(0.0, 1.0)
    share = torch.where(own.any(dim=1) & beside.any(dim=1), share, 0.0)[:, None]
    return (own * (1.0 - share) + beside * share).float()


def missed_changes(
    index: EventIndex, events: Int64[Tensor, " events"], pixels: Int64[Tensor, " events"], blind_ns: int
) -> Float32[Tensor, "events 2"]:
    """Rise and fall of brightness that a pixel missed while it was blind after each event, in thresholds.

    Brightness changes while the pixel is blind at about the rate before and after it: the rate in the middle of that
    time (`rates_around`), times its length, at most `MOST_MISSED`.

    Args:
        index: The events.
        events: Numbers of the events in the index.
        pixels: Pixel of each event.
        blind_ns: How long a pixel is blind after an event.
    """
    missed = 1e-9 * blind_ns * rates_around(index, events, pixels, blind_ns // 2, blind_ns)
    return missed * (MOST_MISSED / missed.sum(dim=1, keepdim=True).clamp(min=MOST_MISSED))
