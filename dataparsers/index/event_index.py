"""The index of a recording's events by pixel, through which all other modules read events."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Int32, Int64, UInt8
from torch import Tensor

from enerf_ns.dataparsers.index.event_survey import sorted_bands, survey_events
from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.dataparsers.recording.recording import Events

EVENTS_IN_PICTURE = 0.2
"""Most events in one picture, as a share of the sensor's pixels."""
EVENTS_AT_ONCE = 2**22
"""Events whose times are compared at once, which limits memory."""
STAMPS_COMPARED = 100_000
"""Stamps, evenly from all pixels, that tell the resolution of a clock."""
ON_COLOUR, OFF_COLOUR, NO_EVENT = (205, 50, 50), (50, 70, 205), (255, 255, 255)
"""Colours (red, green, blue) of on events, of off events, and of pixels without events."""


@dataclass(frozen=True)
class EventIndex:
    """Events sorted by pixel, then by time, in 12 bytes per event. Pixel (x, y) has the number y * width + x."""

    times: Int64[Tensor, " events"]
    """Time of each event, ns. Times never decrease within a pixel."""
    positives: Int32[Tensor, " events"]
    """Running count of positive events over the whole array, each event included. Of the j - i events of a pixel after
    event i, up to and with event j, positives[j] - positives[i] are positive, and the others are negative."""
    offsets: Int64[Tensor, " pixels+1"]
    """First event of each pixel: pixel p has the events offsets[p] to offsets[p + 1] - 1."""
    width: int
    """Width of the sensor, pixels."""
    hot_pixels: Int64[Tensor, " hot"] = field(default_factory=lambda: torch.zeros(0, dtype=torch.int64))
    """Numbers of the hot pixels, whose events are left out."""
    notes: tuple[str, ...] = ()
    """Sentences on events that were left out, or on an index that could not be stored."""
    share_outside_poses: float = 0.0
    """Share of the recording's events that are left out because they lie outside the poses."""
    num_in_gaps: int = 0
    """Number of events in gaps of the poses. They count, but no pair starts or ends with them unless gaps are kept."""

    def __len__(self) -> int:
        return len(self.times)

    @classmethod
    def from_events(cls, events: Events, width: int, height: int) -> EventIndex:
        """Sorts events by pixel: a stable counting sort, linear in the number of events.

        Args:
            events: In time order; polarity ±1 or {0, 1}.
            width, height: Of the sensor, pixels.

        Raises:
            ValueError: An event lies outside the sensor, or there are 2^31 events and more.
        """
        survey = survey_events(lambda: iter([events]), width, height, -(2**63), 2**63 - 1)
        if survey.outside is not None:
            x, y = events.x[survey.outside], events.y[survey.outside]
            raise ValueError(f"An event lies at x = {x}, y = {y}, outside the {width} x {height} sensor.")
        if len(events) >= 2**31:
            raise ValueError(
                f"The index holds fewer than 2^31 events, but the recording has {len(events)}: shorten it."
            )
        times, positives = next(sorted_bands(lambda: iter([events]), survey, max_events=2**31))
        return cls(torch.from_numpy(times), torch.from_numpy(positives), survey.offsets, width)

    def to(self, device: torch.device | str) -> EventIndex:
        """The index on another device."""
        times, positives, offsets = (column.to(device) for column in (self.times, self.positives, self.offsets))
        hot_pixels = self.hot_pixels.to(device)
        return replace(self, times=times, positives=positives, offsets=offsets, hot_pixels=hot_pixels)

    @property
    def span(self) -> tuple[int, int]:
        """Times of the first and the last event, ns."""
        active = self.offsets.diff() > 0
        first, last = self.offsets[:-1][active], self.offsets[1:][active] - 1
        return int(self.times[first].min()), int(self.times[last].max())

    @property
    def num_positive(self) -> int:
        """Number of positive events. The others are negative."""
        return int(self.positives[-1]) if len(self) else 0

    @cached_property
    def resolution(self) -> int:
        """Step of the clock, ns: the greatest common divisor of the times between stamps; 1 if all are equal."""
        stamps = self.times[:: max(1, len(self.times) // STAMPS_COMPARED)]
        return max(1, int(np.gcd.reduce((stamps - stamps[0]).cpu().numpy()))) if len(stamps) else 1

    @cached_property
    def _most_events(self) -> int:
        """Largest number of events of one pixel."""
        return int(self.offsets.diff().max())

    def count_until(self, pixels: Int64[Tensor, "*batch"], times: Int64[Tensor, "*batch"]) -> Int64[Tensor, "*batch"]:
        """Number of events that each pixel fired at or before a time (ns), by binary search within the pixel."""
        first, stop = self.offsets[pixels], self.offsets[pixels + 1]
        following = first
        for step in reversed(range(self._most_events.bit_length())):
            candidate = following + (1 << step)
            passed = (candidate <= stop) & (self.times[(candidate - 1).clamp(max=len(self.times) - 1)] <= times)
            following = torch.where(passed, candidate, following)
        return following - first

    def events(self, at_most: int | None = None) -> Events:
        """The events in time order, and by pixel number at equal times. Polarity is ±1.

        Args:
            at_most: If there are more events than this, every second, third, … event is taken. Default: all.
        """
        step = 1 if at_most is None else max(-(-len(self) // at_most), 1)
        return self._in_time_order(torch.arange(0, len(self), step, device=self.times.device))

    def events_within(self, spans: Int64[np.ndarray, "spans 2"]) -> Events:
        """The events in some spans of time (ns), ends included, in the order of `events`. Spans may overlap."""
        begins, ends = (torch.from_numpy(side.copy()).sort().values for side in (spans[:, 0], spans[:, 1]))
        chosen = []
        for first in range(0, len(self), EVENTS_AT_ONCE):
            times = self.times[first : first + EVENTS_AT_ONCE]
            open_spans = torch.searchsorted(begins, times, right=True) - torch.searchsorted(ends, times)
            chosen.append(first + torch.nonzero(open_spans)[:, 0])
        return self._in_time_order(torch.cat(chosen))

    def _in_time_order(self, chosen: Int64[Tensor, " chosen"]) -> Events:
        pixels = torch.searchsorted(self.offsets, chosen, right=True) - 1
        before = torch.where(chosen > 0, self.positives[chosen - 1], 0)
        order = torch.argsort(self.times[chosen], stable=True)
        p = (2 * (self.positives[chosen] - before) - 1)[order].to(torch.int8)
        pixels = pixels[order]
        x, y = pixels % self.width, pixels // self.width
        x, y, p, t = (column.cpu().numpy() for column in (x, y, p, self.times[chosen][order]))
        return Events(x.astype(np.uint16), y.astype(np.uint16), t, p)


def event_picture(index: EventIndex, camera: Camera, time: int) -> UInt8[np.ndarray, "height width 3"]:
    """An undistorted picture of the latest events up to an instant: on events in red, off events in blue, on white.

    It shows the pixels that fired last, at most a fifth of all (`EVENTS_IN_PICTURE`).

    Args:
        index: On the CPU.
        camera: Of the events.
        time: The instant, ns.
    """
    pixels = torch.arange(camera.width * camera.height)
    fired = index.count_until(pixels, torch.full_like(pixels, time))
    pixels = pixels[fired > 0]
    event = index.offsets[pixels] + fired[pixels] - 1
    latest = index.times[event].topk(min(int(EVENTS_IN_PICTURE * camera.width * camera.height), len(event))).indices
    pixels, event = pixels[latest], event[latest]
    positive = index.positives[event] > torch.where(event > 0, index.positives[event - 1], 0)
    picture = np.tile(np.array(NO_EVENT, np.uint8), (camera.height * camera.width, 1))
    picture[pixels] = np.where(positive[:, None], ON_COLOUR, OFF_COLOUR)
    return camera.undistort(picture.reshape(camera.height, camera.width, 3))
