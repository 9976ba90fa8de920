"""Frames of events at given instants: the events of a recording, streamed through a network or a filter."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import pairwise
from typing import Protocol

import numpy as np
import torch
from jaxtyping import Float32, Int64

from enerf_ns.dataparsers.index.indexing import index_events
from enerf_ns.dataparsers.recording.recording import EventRecording, Events
from enerf_ns.reconstruction.networks import Network, State
from enerf_ns.reconstruction.voxel_grid import normalised, voxel_grid

EVENTS_PER_PIXEL = 0.35
"""Events of a window that a network looks at, for each pixel of the sensor, as E2VID's authors suggest."""


NO_EVENTS = Events(*(np.zeros(0, np.int64) for _ in "xytp"))
"""A piece of a stream without events."""


class Reconstruction(Protocol):
    """Makes frames of events."""

    name: str
    """What it is, in words."""

    def add(self, events: Events) -> None:
        """Takes in the next events in time order."""

    def frame(self, time: int) -> Float32[np.ndarray, "height width"]:
        """Brightness, of any scale, at an instant (ns) not before the last event."""
        ...


class NetworkReconstruction:
    """A recurrent network that looks at one window of events after the other.

    Args:
        network: E2VID or FireNet.
        name: What it is, in words.
        width, height: Of the sensor, pixels.
    """

    def __init__(self, network: Network, name: str, width: int, height: int):
        self.name = name
        self._device = "cuda" if torch.cuda.is_available() else "cpu"
        self._network, self._width, self._height = network.to(self._device), width, height
        self._states: list[State] | None = None
        self._frame: Float32[np.ndarray, "height width"] | None = None
        self._window = max(round(EVENTS_PER_PIXEL * width * height), 1)
        self._waiting: list[Events] = []

    def add(self, events: Events) -> None:
        self._waiting.append(events)
        if sum(map(len, self._waiting)) >= 2 * self._window:
            waiting, first = joined(self._waiting), 0
            while len(waiting) - first >= 2 * self._window:
                self._look_at(part(waiting, first, first + self._window))
                first += self._window
            self._waiting = [part(waiting, first, len(waiting))]

    def frame(self, time: int) -> Float32[np.ndarray, "height width"]:
        """As the network shows it after all events up to now: what waits is looked at in windows of one size."""
        waiting = joined([NO_EVENTS, *self._waiting])
        self._waiting = []
        if len(waiting) or self._frame is None:
            edges = np.linspace(0, len(waiting), max(round(len(waiting) / self._window), 1) + 1).astype(int)
            for first, stop in pairwise(edges):
                self._look_at(part(waiting, first, stop))
        assert self._frame is not None
        return self._frame

    @torch.inference_mode()
    def _look_at(self, events: Events) -> None:
        """One window, padded on the right and below with places that have no events."""
        right, below = (-size % self._network.size_multiple for size in (self._width, self._height))
        grid = normalised(voxel_grid(events, self._network.num_bins, self._width, self._height))
        grid = torch.nn.functional.pad(grid, (0, right, 0, below))[None].to(self._device)
        frame, self._states = self._network(grid, self._states)
        self._frame = frame[0, : self._height, : self._width].cpu().numpy()


def reconstruct_frames(
    recording: EventRecording, reconstruction: Reconstruction, times: Int64[np.ndarray, " frames"]
) -> Iterator[Float32[np.ndarray, "height width"]]:
    """Frames of the event camera at some instants, from the events that training uses: without those of hot pixels.

    Args:
        recording: Whose events are streamed.
        reconstruction: New.
        times: In the order of time, ns.

    Raises:
        RecordingError: As of `index_events`.
    """
    camera, (start, end) = recording.camera, recording.span
    hot = np.zeros(camera.width * camera.height, bool)
    hot[index_events(recording).hot_pixels.numpy()] = True

    def used() -> Iterator[Events]:
        for events in recording.stream_events():
            pixels = events.y.astype(np.int64) * camera.width + events.x
            chosen = ~hot[pixels] & (events.t >= start) & (events.t <= end)
            yield Events(*(getattr(events, name)[chosen].astype(np.int64) for name in "xytp"))

    for events, time in split_at(used(), times):
        reconstruction.add(events)
        if time is not None:
            yield reconstruction.frame(time)


def split_at(stream: Iterable[Events], times: Int64[np.ndarray, " times"]) -> Iterator[tuple[Events, int | None]]:
    """The events of a stream in pieces, none of which reaches beyond the next of some instants.

    Args:
        stream: In time order.
        times: In order, ns.

    Yields:
        A piece, and the instant (ns) up to and with which it is the last one, or None.
    """
    number = 0
    for events in stream:
        first = 0
        while number < len(times) and (stop := int(np.searchsorted(events.t, times[number], "right"))) < len(events):
            yield part(events, first, stop), int(times[number])
            first, number = stop, number + 1
        if number == len(times):
            return
        yield part(events, first, len(events)), None
    for time in times[number:]:
        yield NO_EVENTS, int(time)


def joined(pieces: list[Events]) -> Events:
    """Pieces of a stream as one."""
    return Events(*(np.concatenate([getattr(piece, name) for piece in pieces]) for name in "xytp"))


def part(events: Events, first: int, stop: int) -> Events:
    """Some consecutive events."""
    return Events(*(getattr(events, name)[first:stop] for name in "xytp"))
