"""Reconstructs frames at given times: streams the events of a recording through a network or a filter."""

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
"""Events per pixel of the sensor in one window of a network, as the authors of E2VID suggest."""

NO_EVENTS = Events(*(np.zeros(0, np.int64) for _ in "xytp"))
"""A part of a stream without events."""


class Reconstruction(Protocol):
    """A method that reconstructs frames from events."""

    name: str
    """Name of the method in printed sentences."""

    def add(self, events: Events) -> None:
        """Adds the next events, in order of time."""

    def frame(self, time: int) -> Float32[np.ndarray, "height width"]:
        """Brightness, on any scale, at a time (ns) not before the last event."""
        ...


class NetworkReconstruction:
    """A recurrent network that reads the events window by window.

    Args:
        network: E2VID or FireNet.
        name: Name of the method in printed sentences.
        width, height: Size of the sensor, pixels.
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
        """The frame after all added events; the waiting events are read in windows of about equal size."""
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
        """Passes one window of events to the network, padded on the right and below with pixels without events."""
        right, below = (-size % self._network.size_multiple for size in (self._width, self._height))
        grid = normalised(voxel_grid(events, self._network.num_bins, self._width, self._height))
        grid = torch.nn.functional.pad(grid, (0, right, 0, below))[None].to(self._device)
        frame, self._states = self._network(grid, self._states)
        self._frame = frame[0, : self._height, : self._width].cpu().numpy()


def reconstruct_frames(
    recording: EventRecording, reconstruction: Reconstruction, times: Int64[np.ndarray, " frames"]
) -> Iterator[Float32[np.ndarray, "height width"]]:
    """Frames of the event camera at some times, from the events that training uses, which leaves out hot pixels.

    Args:
        recording: The recording.
        reconstruction: A method that has not seen any events.
        times: Times of the frames in increasing order, ns.

    Raises:
        RecordingError: `index_events` cannot read the events.
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
    """Splits a stream of events after each of some times.

    Args:
        stream: Events in order of time.
        times: Times in increasing order, ns.

    Yields:
        A part of the stream, and the time (ns) if the part is the last one up to and including this time, else None.
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
    """Consecutive parts of a stream, joined to one."""
    return Events(*(np.concatenate([getattr(piece, name) for piece in pieces]) for name in "xytp"))


def part(events: Events, first: int, stop: int) -> Events:
    """The events from index `first` up to but without index `stop`."""
    return Events(*(getattr(events, name)[first:stop] for name in "xytp"))
