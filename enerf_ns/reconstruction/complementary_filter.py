"""The complementary filter of events alone, which makes frames without learning."""

from __future__ import annotations

import math

import cv2
import numpy as np
from jaxtyping import Float, Float32

from enerf_ns.dataparsers.compiled import compiled
from enerf_ns.dataparsers.recording.recording import Events


class ComplementaryFilter:
    """Log brightness by pixel, of which each event adds its threshold, and which decays to 0 between events.

    Scheerlinck, Barnes and Mahony, Continuous-time Intensity Estimation Using Event Cameras, ACCV 2018, without frames:
    a high-pass filter of log brightness, exact in time.

    Args:
        width, height: Of the sensor, pixels.
        contrast_thresholds: Of on and of off events, change of log brightness.
        cutoff_frequency: Hz; brightness that changes more slowly is forgotten. 0: nothing is.
        start: Time before all events, ns.
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
        """Takes in the next events in time order."""
        columns = events.x, events.y, events.t, events.p > 0
        compiled(_integrate)(*columns, *self._thresholds, self._decay, self._log_brightness, self._times)

    def log_brightness(self, time: int) -> Float[np.ndarray, "height width"]:
        """Of each pixel at an instant (ns) not before the last event, against its mean over the past."""
        return self._log_brightness * np.exp(-self._decay * (time - self._times))

    def frame(self, time: int) -> Float32[np.ndarray, "height width"]:
        """Brightness at an instant (ns) not before the last event, smoothed along edges."""
        smooth = cv2.bilateralFilter(self.log_brightness(time).astype(np.float32), *SMOOTHING)
        return np.exp(smooth)


SMOOTHING = (5, 1.0, 1.0)
"""OpenCV's bilateral filter: width of the neighbourhood in pixels, deviations of log brightness and of pixels."""


def _integrate(x, y, t, on, on_threshold, off_threshold, decay, log_brightness, times):
    for i in range(len(t)):
        row, column = y[i], x[i]
        left = math.exp(-decay * (t[i] - times[row, column]))
        log_brightness[row, column] = left * log_brightness[row, column] + (on_threshold if on[i] else -off_threshold)
        times[row, column] = t[i]
