"""The complementary filter for events, which reconstructs frames without a network."""

from __future__ import annotations

import math

import cv2
import numpy as np
from jaxtyping import Float, Float32

from enerf_ns.dataparsers.compiled import compiled
from enerf_ns.dataparsers.recording.recording import Events


class ComplementaryFilter:
    """A high-pass filter of the log brightness of each pixel, exact in time.

    Each event adds its contrast threshold to the log brightness of its pixel, which decays to 0 between events. This is
    the filter of Scheerlinck, Barnes and Mahony, Continuous-time Intensity Estimation Using Event Cameras, ACCV 2018,
    without frames.

    Args:
        width, height: Size of the sensor, pixels.
        contrast_thresholds: Thresholds of on and off events, changes of log brightness.
        cutoff_frequency: Hz. The filter forgets slower changes of brightness; with 0 it forgets nothing.
        start: A time before all events, ns.
    """

    def __init__(
        self, width: int, height: int, contrast_thresholds: tuple[float, float], cutoff_frequency: float, start: int
    ):
        self.name = f"a complementary filter ({cutoff_frequency:g} Hz)"
        self._thresholds = contrast_thresholds
        self._decay = 2e-9 * math.pi * cutoff_frequency
        self._log_brightness = np.zeros((height, width))
        self._times = np.full((height, width), start)

    def add(self, events: Events) -> None:
        """Adds the next events, in order of time."""
        columns = events.x, events.y, events.t, events.p > 0
        compiled(_integrate)(*columns, *self._thresholds, self._decay, self._log_brightness, self._times)

    def log_brightness(self, time: int) -> Float[np.ndarray, "height width"]:
        """Log brightness of each pixel relative to its past mean, at a time (ns) not before the last event."""
        return self._log_brightness * np.exp(-self._decay * (time - self._times))

    def frame(self, time: int) -> Float32[np.ndarray, "height width"]:
        """Brightness at a time (ns) not before the last event, smoothed but for its edges."""
        log_brightness = self.log_brightness(time).astype(np.float32)
        return np.exp(cv2.bilateralFilter(log_brightness, d=5, sigmaColor=1.0, sigmaSpace=1.0))


def _integrate(x, y, t, on, on_threshold, off_threshold, decay, log_brightness, times):
    for i in range(len(t)):
        row, column = y[i], x[i]
        left = math.exp(-decay * (t[i] - times[row, column]))
        log_brightness[row, column] = left * log_brightness[row, column] + (on_threshold if on[i] else -off_threshold)
        times[row, column] = t[i]
