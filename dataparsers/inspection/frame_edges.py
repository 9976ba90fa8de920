"""Edges of events on edges of frames, which meet if both are on one clock."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
import torch
from jaxtyping import Float32, Float64, Int64, Shaped, UInt8

from enerf_ns.dataparsers.index.event_index import OFF_COLOUR, ON_COLOUR
from enerf_ns.dataparsers.index.indexing import index_events
from enerf_ns.dataparsers.recording.picture_depth import brightness, in_8_bits
from enerf_ns.dataparsers.recording.recording import EventRecording, Events, Frames

EVENTS_OF_EDGES = 0.05
"""Number of events that are drawn onto a frame, as a share of the sensor's pixels. They are the nearest ones in
time."""

MAX_FRAMES = 24
"""Most frames that are compared with events."""

PICTURE_WIDTH = 320
"""Largest width (pixels) of the pictures that are compared and shown."""

DARKEST = 10.0
"""Grey levels that are added before the logarithm, so that the noise of dark pixels makes no edges."""

NUM_PLANES = 12
"""Number of depths that are tried if frames and events come from two cameras."""


@dataclass(frozen=True, eq=False)
class FrameEdges:
    """Frames of a recording and the events around them, in the undistorted picture of the frames' camera.

    If frames and events come from two cameras, all events are drawn at one depth, since their own depths are unknown.
    """

    recording: EventRecording
    frames: Frames
    """Some of the frames that have events before and after."""
    events: Events
    """Events around these frames, in time order."""
    planes: Float64[np.ndarray, " planes"]
    """Depths (metres) at which events may be drawn. Only infinity if one camera took frames and events."""

    @classmethod
    def of(cls, recording: EventRecording, depth_range: tuple[float, float], largest_delay: int) -> FrameEdges | None:
        """Selects the frames that can be compared with events. None if there are none.

        Args:
            recording: Its sharp frames are taken, else the blurred ones.
            depth_range: Nearest and farthest depth, metres.
            largest_delay: Largest delay between a frame and its events, ns.
        """
        frames = recording.camera_frames
        if frames is None:
            return None
        index = index_events(recording)
        first, last = index.span
        length = int(EVENTS_OF_EDGES * recording.camera.width * recording.camera.height / len(index) * (last - first))
        margin = largest_delay + length
        during = np.flatnonzero(
            (frames.times >= first + margin) & (frames.times <= last - margin) & recording.knows_poses(frames)
        )
        if not len(during):
            return None
        chosen = during[np.unique(np.linspace(0, len(during) - 1, MAX_FRAMES).round().astype(int))]
        frames = frames.subset(chosen)
        events = index.events_within(frames.times[:, None] + margin * np.array([-1, 1]))
        near, far = depth_range
        own = frames.camera == recording.camera and frames.trajectory is recording.trajectory
        planes = np.array([np.inf]) if own else 1 / np.linspace(1 / far, 1 / near, NUM_PLANES)
        return cls(recording, frames, events, planes)

    def likeness(
        self, delays: Int64[np.ndarray, " delays"], plane: int, every: int = 1
    ) -> Float64[np.ndarray, "delays frames"]:
        """Correlation between the gradient of each frame and the density of the events around it, for some delays.

        Args:
            delays: Delays of the events against the frames, ns.
            plane: Number of the depth at which events are drawn.
            every: 2 takes every second frame, and so on.
        """
        numbers = range(0, len(self.frames.times), every)
        found = np.zeros((len(delays), len(numbers)))
        for column, number in enumerate(numbers):
            gradient = self._gradient(number)
            for row, time in enumerate((self.frames.times[number] + delays).tolist()):
                found[row, column] = correlation(gradient, _smooth(np.minimum(self._density(time, plane), 3)))
        return found

    def best_plane(self, delays: Int64[np.ndarray, " delays"]) -> int:
        """Number of the depth with the highest correlation, over every fourth frame and the best of some delays
        (ns)."""
        if len(self.planes) == 1:
            return 0
        return int(np.argmax([self.likeness(delays, i, 4).mean(1).max() for i in range(len(self.planes))]))

    def picture(self, number: int) -> UInt8[np.ndarray, "rows columns channels"]:
        """An undistorted frame, at most `PICTURE_WIDTH` pixels wide."""
        return in_8_bits(self._picture(number))

    def _picture(self, number: int) -> Shaped[np.ndarray, "rows columns channels"]:
        frame = self.frames.camera.undistort(self.frames.image(number))
        return cv2.resize(frame, self._size, interpolation=cv2.INTER_AREA).reshape(*self._size[::-1], -1)

    def events_at(self, time: int, plane: int) -> UInt8[np.ndarray, "rows columns 4"]:
        """Events around a time (ns) in the colours of their polarity, on a transparent picture to lay over a frame."""
        chosen = self._nearest(time)
        at, on = self._places(chosen, plane), self.events.p[chosen] > 0
        at, on = at[at >= 0], on[at >= 0]
        picture = np.zeros((self._size[1] * self._size[0], 4), np.uint8)
        picture[at[~on]], picture[at[on]] = (*OFF_COLOUR, 255), (*ON_COLOUR, 255)
        return picture.reshape(*self._size[::-1], 4)

    @cached_property
    def _size(self) -> tuple[int, int]:
        """Width and height of the pictures."""
        camera = self.frames.camera
        scale = min(PICTURE_WIDTH / camera.width, 1.0)
        return round(scale * camera.width), round(scale * camera.height)

    @cached_property
    def _tables(self) -> list[Int64[np.ndarray, "height width"]]:
        """For each plane, the place of each pixel of the event camera in the pictures: row * columns + column, or
        -1."""
        (columns, rows), seen = self._size, self.frames.camera.undistorted()
        time = torch.as_tensor(self.frames.times[0])
        events, frames = (owner.trajectory.poses(time).numpy() for owner in (self.recording, self.frames))
        rays = self.recording.camera.pixel_directions() @ events[:, :3].T @ frames[:, :3]
        offset = (events[:, 3] - frames[:, 3]) @ frames[:, :3]
        tables = []
        for depth in self.planes:
            points = rays + offset / depth
            ahead = points[..., 2] > 0.1
            x, y = np.moveaxis(points[..., :2] / np.where(ahead, points[..., 2], 1.0)[..., None], -1, 0)
            x = np.rint((seen.fx * x + seen.cx + 0.5) * columns / seen.width - 0.5)
            y = np.rint((seen.fy * y + seen.cy + 0.5) * rows / seen.height - 0.5)
            inside = ahead & (x >= 0) & (x < columns) & (y >= 0) & (y < rows)
            tables.append(np.where(inside, y * columns + x, -1).astype(np.int64))
        return tables

    def _nearest(self, time: int) -> slice:
        number = int(EVENTS_OF_EDGES * self.recording.camera.width * self.recording.camera.height)
        middle = int(np.searchsorted(self.events.t, time))
        return slice(max(middle - number // 2, 0), middle + number // 2)

    def _places(self, chosen: slice, plane: int) -> Int64[np.ndarray, " events"]:
        return self._tables[plane][self.events.y[chosen], self.events.x[chosen]]

    def _density(self, time: int, plane: int) -> Float32[np.ndarray, "rows columns"]:
        places = self._places(self._nearest(time), plane)
        columns, rows = self._size
        return np.bincount(places[places >= 0], minlength=rows * columns).reshape(rows, columns).astype(np.float32)

    def _gradient(self, number: int) -> Float32[np.ndarray, "rows columns"]:
        level = 255 * brightness(self._picture(number)).mean(2)
        logarithm = _smooth(np.log(level + DARKEST))
        return np.hypot(cv2.Sobel(logarithm, cv2.CV_32F, 1, 0), cv2.Sobel(logarithm, cv2.CV_32F, 0, 1))


def _smooth(picture: Float32[np.ndarray, "rows columns"]) -> Float32[np.ndarray, "rows columns"]:
    return cv2.GaussianBlur(picture, (0, 0), 0.7)


def correlation(one: np.ndarray, other: np.ndarray) -> float:
    """The correlation of two arrays of one shape, from -1 to 1; 0 if one of them is constant."""
    one, other = one - one.mean(), other - other.mean()
    norm = float(np.sqrt((one**2).sum() * (other**2).sum()))
    return float((one * other).sum()) / norm if norm else 0.0
