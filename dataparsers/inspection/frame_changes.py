"""Polarity and orientation of the events, shown by how the brightness of frames changes."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Float32, Float64, Int64

from enerf_ns.dataparsers.index.indexing import index_events
from enerf_ns.dataparsers.inspection.frame_edges import correlation
from enerf_ns.dataparsers.recording.picture_depth import LUMA, brightness
from enerf_ns.dataparsers.recording.recording import EventRecording, Frames

NUM_PAIRS = 24
"""Most pairs of frames that are compared with the events between them."""

FEWEST_PAIRS = 4
"""Fewest pairs that tell something."""

SAMPLED_PIXELS = 2**14
"""Most pixels of the event camera that are compared, evenly taken."""

EVENTS_BETWEEN = 0.25
"""Smallest mean number of events of a pixel between the frames of a pair."""

SHIFTS = (0.0, -0.5, 0.5, -1.0, 1.0)
"""Delays of the frames that are tried, in units of the time between the frames of a pair. With a wrong clock, the
correlation has the wrong sign beside its peak."""

ORIENTATIONS = {
    "as they are": (1, 1),
    "mirrored left to right": (1, -1),
    "mirrored top to bottom": (-1, 1),
    "turned by half a turn": (-1, -1),
}
"""Orientations of the frames that are tried, with the steps through rows and columns."""

FAINTEST, SATURATED = 0.02, 0.96
"""Brightness that is added before the logarithm, so that noise of dark pixels is no change; and brightness from which a
pixel may be saturated."""

LEAST_CORRELATION = 0.2
"""Smallest correlation that tells something. It is 0.7 to 0.9 in slider_depth and in simulated recordings, and at most
0.17 with a wrong orientation."""

NONE = 0.1
"""Largest correlation, over orientations and delays, of frames that show something else than the events."""

CLEARLY = 5.0
"""Standard errors, over pairs, by which it must differ from 0."""


@dataclass(frozen=True)
class FrameChanges:
    """Correlation between sums of events and changes of log brightness of frames, over pixels.

    The sum of the signed events of a pixel between two frames grows with the change of its log brightness, whatever the
    gamma of the frames. A change that is common to all pixels is taken off, so that exposure has no influence. Shadows
    that move change both.
    """

    num_pairs: int
    """Number of pairs of frames that are compared."""
    correlation: float
    """The correlation that differs most from 0, over orientations and delays: below 0 if polarity is inverted."""
    error: float
    """Its standard error, over pairs."""
    is_own: bool
    """Whether one camera took frames and events, so that frames see what each pixel of the events sees."""
    orientation: str
    """Orientation of the frames at which it is found, one of `ORIENTATIONS`."""

    @property
    def tells(self) -> bool:
        """Whether the correlation is clear."""
        least = max(LEAST_CORRELATION, CLEARLY * self.error)
        return self.num_pairs >= FEWEST_PAIRS and abs(self.correlation) > least

    @property
    def contradicts(self) -> bool:
        """Whether the frames show something else than the events."""
        return self.num_pairs >= FEWEST_PAIRS and self.is_own and abs(self.correlation) < NONE

    @classmethod
    def of(cls, recording: EventRecording, frames: Frames, depth: float) -> FrameChanges:
        """Compares at most `NUM_PAIRS` pairs of frames with the events between them. Takes a second.

        Args:
            recording: Its index is made if it is not there yet.
            frames: Frames that a camera took.
            depth: Usual depth of the scene, metres, at which the camera of the frames sees the pixels of the event
                camera.

        Raises:
            RecordingError: The events or a frame cannot be used.
        """
        sums = _Sums(recording, frames, depth)
        pairs = [sums.correlations(first) for first in sums.firsts] if (sums.places >= 0).any() else []
        if not pairs:
            return cls(0, 0.0, 0.0, sums.is_own, "as they are")
        means, errors = np.mean(pairs, 0), np.std(pairs, 0) / np.sqrt(max(len(pairs) - 1, 1))
        best = np.unravel_index(np.abs(means).argmax(), means.shape)
        return cls(len(pairs), float(means[best]), float(errors[best]), sums.is_own, [*ORIENTATIONS][int(best[0])])


class _Sums:
    """Sums of events at some pixels, beside changes of frames where the camera of the frames sees these pixels."""

    def __init__(self, recording: EventRecording, frames: Frames, depth: float):
        self.frames, self.index, camera = frames, index_events(recording), recording.camera
        num_pixels = camera.width * camera.height
        self.pixels = torch.arange(0, num_pixels, -(-num_pixels // SAMPLED_PIXELS) | 1)
        self.is_own = frames.camera == camera and frames.trajectory is recording.trajectory
        self.places = self.pixels.numpy() if self.is_own else _places(recording, frames, depth)[self.pixels.numpy()]
        first, last = self.index.span
        steps = np.diff(frames.times)
        step = float(np.median(steps)) if len(steps) else 0.0
        rate = len(self.index) / num_pixels / max(last - first, 1)
        self.lag = int(np.ceil(EVENTS_BETWEEN / (rate * step))) if step * rate else len(frames.times)
        starts, ends = frames.times[: -self.lag], frames.times[self.lag :]
        during = np.flatnonzero((2 * starts - ends >= first) & (2 * ends - starts <= last))
        chosen = np.unique(np.linspace(0, len(during) - 1, NUM_PAIRS).round().astype(int)) if len(during) else []
        self.firsts: list[int] = during[chosen].tolist() if len(during) else []

    def correlations(self, first: int) -> Float64[np.ndarray, "orientations shifts"]:
        """Correlations of a pair of frames, which starts with frame number `first`."""
        start, end = self.frames.times[[first, first + self.lag]]
        change, shifts = self._change(first), [round(shift * (end - start)) for shift in SHIFTS]
        seen, found = self.places >= 0, np.zeros((len(ORIENTATIONS), len(SHIFTS)))
        for column, shift in enumerate(shifts):
            sums = (self._sums(end + shift) - self._sums(start + shift))[seen]
            for row, (down, right) in enumerate(ORIENTATIONS.values()):
                found[row, column] = correlation(sums, change[::down, ::right].ravel()[self.places[seen]])
        return found

    def _sums(self, time: int) -> Float64[np.ndarray, " pixels"]:
        """On events less off events of each pixel until a time (ns)."""
        index, first = self.index, self.index.offsets[self.pixels]
        number = index.count_until(self.pixels, torch.full_like(self.pixels, int(time)))
        rises = self._rises_before(first + number) - self._rises_before(first)
        return (2 * rises - number).numpy().astype(float)

    def _rises_before(self, event: torch.Tensor) -> torch.Tensor:
        return torch.where(event > 0, self.index.positives[(event - 1).clamp(min=0)], 0).long()

    def _change(self, first: int) -> Float32[np.ndarray, "rows columns"]:
        """Change of log brightness within a pair, less its median; 0 where a frame may be saturated."""
        one, other = self._level(first), self._level(first + self.lag)
        change, known = np.log((other + FAINTEST) / (one + FAINTEST)), np.maximum(one, other) < SATURATED
        change = np.where(known, change - (np.median(change[known]) if known.any() else 0.0), 0.0)
        return cv2.GaussianBlur(change.astype(np.float32), (0, 0), 0.7)

    def _level(self, number: int) -> Float32[np.ndarray, "rows columns"]:
        image = brightness(self.frames.image(number) if self.is_own else self.frames.picture(number))
        return image @ np.array(LUMA, np.float32) if image.shape[2] == 3 else image[..., 0]


def _places(recording: EventRecording, frames: Frames, depth: float) -> Int64[np.ndarray, " pixels"]:
    """Place (row * columns + column) in the pictures of frames of each pixel of the event camera; -1 beyond them."""
    time, seen = torch.as_tensor(frames.times[len(frames.times) // 2]), frames.picture_camera
    events, pictures = (owner.trajectory.poses(time).numpy() for owner in (recording, frames))
    rays = recording.camera.pixel_directions().reshape(-1, 3)
    points = (depth * rays @ events[:, :3].T + events[:, 3] - pictures[:, 3]) @ pictures[:, :3]
    ahead = np.where(points[:, 2] > 0, points[:, 2], np.nan)
    x, y = np.rint(seen.fx * points[:, 0] / ahead + seen.cx), np.rint(seen.fy * points[:, 1] / ahead + seen.cy)
    inside = (x >= 0) & (x < seen.width) & (y >= 0) & (y < seen.height)
    return np.where(inside, np.nan_to_num(y) * seen.width + np.nan_to_num(x), -1).astype(np.int64)
