"""Counting, checking and sorting of a recording's events."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Int, Int32, Int64
from torch import Tensor

from enerf_ns.dataparsers.compiled import compiled
from enerf_ns.dataparsers.recording.recording import Events

HOT_RATIO = 10
"""Factor by which a hot pixel fires more often than the median of its neighbourhood. Edges of scenes stay far below."""

HOT_FLOOR = 5
"""Least median of a neighbourhood, so that a few events in an untextured region make no pixel hot."""


@dataclass
class Survey:
    """Counts and faults of a recording's events, from one pass over them."""

    width: int
    start: int
    """First time (ns) whose events count."""
    end: int
    """Last time (ns) whose events count."""
    counts: Int32[np.ndarray, " pixels"]
    """Events of each pixel from start to end."""
    num_events: int = 0
    """Number of events of the whole recording. If there is a faulty event, of the pieces before it."""
    first: int = 0
    """Time of the first event of the recording, ns."""
    last: int = 0
    """Time of the last event of the recording, ns."""
    hot_pixels: Int64[np.ndarray, " hot"] = field(default_factory=lambda: np.zeros(0, np.int64))
    """Numbers of the hot pixels that `leave_out_hot_pixels` found. Their counts are 0."""
    num_hot_events: int = 0
    """Number of events of the hot pixels."""
    outside: int | None = None
    """Number of the first event outside the sensor. The survey ends there. None if there is none."""
    backwards: int | None = None
    """Number of the first event that is earlier than its predecessor. The survey ends there. None if there is none."""
    odd_polarity: int | None = None
    """Number of the first event of a third polarity. The survey ends there. None if there is none."""
    odd_event: tuple[int, int, int, int] = (0, 0, 0, 0)
    """x, y, t and p of the faulty event at which the survey ended."""

    @property
    def offsets(self) -> Int64[Tensor, " pixels+1"]:
        """The `EventIndex.offsets` of the events that count."""
        offsets = np.zeros(len(self.counts) + 1, np.int64)
        np.cumsum(self.counts, out=offsets[1:])
        return torch.from_numpy(offsets)

    def leave_out_hot_pixels(self, height: int) -> None:
        """Finds the pixels that fire far more often than their neighbourhood, and sets their counts to 0.

        The neighbourhood is 5 x 5 pixels. Beyond the border, the border's pixels are repeated.
        """
        hot = np.zeros(len(self.counts), bool)
        compiled(_find_hot)(self.counts, self.width, height, HOT_RATIO, HOT_FLOOR, hot)
        self.hot_pixels = np.flatnonzero(hot)
        self.num_hot_events = int(self.counts[self.hot_pixels].sum())
        self.counts[self.hot_pixels] = 0


EventStream = Callable[[], Iterator[Events]]
"""Function that yields the events in pieces, from the first event on at each call."""


def survey_events(stream: EventStream, width: int, height: int, start: int, end: int) -> Survey:
    """Counts and checks the events of a recording in one pass, which ends at the first faulty event.

    Args:
        stream: The events, with polarity {0, 1} or ±1.
        width, height: Of the sensor, pixels.
        start, end: First and last time (ns) whose events count.
    """
    survey = Survey(width, start, end, np.zeros(width * height, np.int32))
    state = np.zeros(3, np.int64)  # time of the latest event; whether polarity 0, and whether -1, was seen
    state[0] = -(2**63)
    scan = compiled(_scan)
    for events in stream():
        x, y, p = _narrow(events.x), _narrow(events.y), _narrow(events.p)
        fault, place = scan(x, y, events.t, p, width, height, start, end, survey.counts, state)
        if survey.num_events == 0 and len(events):
            survey.first = int(events.t[0])
        if fault:
            number = survey.num_events + place
            survey.outside, survey.backwards, survey.odd_polarity = (number if fault == i else None for i in (1, 2, 3))
            x, y, t, p = (int(column[place]) for column in (events.x, events.y, events.t, events.p))
            survey.odd_event = x, y, t, p
            break
        survey.num_events += len(events)
    survey.last = int(state[0])
    return survey


def sorted_bands(
    stream: EventStream, survey: Survey, max_events: int
) -> Iterator[tuple[Int64[np.ndarray, " band"], Int32[np.ndarray, " band"]]]:
    """Times and running counts of positive events for an index, in bands of consecutive pixels, by a counting sort.

    Each band takes one pass over the events. Only one band is in memory.

    Args:
        stream: The events that were surveyed.
        survey: Without faults.
        max_events: Most events of a band, unless one pixel has more.

    Raises:
        ValueError: The events changed after the survey.
    """
    offsets = survey.offsets.numpy()
    keep = np.ones(len(survey.counts), bool)
    keep[survey.hot_pixels] = False
    place = compiled(_place)
    first, num_positive = 0, np.int32(0)
    while first < len(survey.counts):
        stop = max(int(np.searchsorted(offsets, offsets[first] + max_events, side="right")) - 1, first + 1)
        band = offsets[first : stop + 1]
        filled = np.zeros(stop - first, np.int32)
        times, positives = np.empty(band[-1] - band[0], np.int64), np.empty(band[-1] - band[0], np.int32)
        for events in stream():
            x, y, p = _narrow(events.x), _narrow(events.y), _narrow(events.p)
            limits = survey.width, survey.start, survey.end, first, stop
            if not place(x, y, events.t, p, *limits, keep, band, filled, times, positives):
                raise ValueError("changed while it was read")
        if filled.sum() != len(times):
            raise ValueError("changed while it was read")
        if len(positives):
            positives[0] += num_positive
            np.cumsum(positives, out=positives)
            num_positive = positives[-1]
        yield times, positives
        first = stop


def _narrow(column: Int[np.ndarray, " events"]) -> np.ndarray:
    """A column as int32, the one type of the compiled loops. Larger values become the largest int32, an error as
    before."""
    if column.dtype.itemsize < 4 or column.dtype == np.int32:
        return column.astype(np.int32, copy=False)
    limits = np.iinfo(np.int32)
    return np.clip(column, max(limits.min, np.iinfo(column.dtype).min), limits.max).astype(np.int32)


def _scan(x, y, t, p, width, height, start, end, counts, state):
    """Adds events to the counts. Returns the kind and the place of the first fault, or (0, 0)."""
    for i in range(len(t)):
        if x[i] < 0 or x[i] >= width or y[i] < 0 or y[i] >= height:
            return 1, i
        if t[i] < state[0]:
            return 2, i
        state[0] = t[i]
        if p[i] == 0:
            state[1] = 1
        elif p[i] == -1:
            state[2] = 1
        elif p[i] != 1:
            return 3, i
        if state[1] and state[2]:
            return 3, i
        if start <= t[i] <= end:
            counts[np.int64(y[i]) * width + x[i]] += 1
    return 0, 0


def _place(x, y, t, p, width, start, end, first, stop, keep, offsets, filled, times, positives):
    """Puts the events of a band of pixels at their places. Returns False if there are more than were counted."""
    for i in range(len(t)):
        pixel = np.int64(y[i]) * width + x[i]
        if first <= pixel < stop and keep[pixel] and start <= t[i] <= end:
            slot = offsets[pixel - first] + filled[pixel - first]
            if slot >= offsets[pixel - first + 1]:
                return False
            times[slot - offsets[0]] = t[i]
            positives[slot - offsets[0]] = p[i] > 0
            filled[pixel - first] += 1
    return True


def _find_hot(counts, width, height, ratio, floor, hot):
    """Marks pixels with more than `ratio` times the median of 5 x 5 pixels, and more than `ratio` times `floor`.

    The median lies below a bound if 13 of the 25 pixels do. SciPy's `median_filter` finds the same pixels, but takes 20
    to 120 times as long (0.4 s at 1280 x 720), since it also filters pixels that fire too seldom to be hot.
    """
    for pixel in range(width * height):
        if counts[pixel] > ratio * floor:
            below = 0
            for dy in range(-2, 3):
                for dx in range(-2, 3):
                    x = min(max(pixel % width + dx, 0), width - 1)
                    y = min(max(pixel // width + dy, 0), height - 1)
                    below += ratio * counts[y * width + x] < counts[pixel]
            hot[pixel] = below >= 13
