"""Events from pictures of log brightness, by the algorithm of ESIM.

Rebecq, Gehrig, Scaramuzza: ESIM: an Open Event Camera Simulator, CoRL 2018, section 3.1.
"""

from __future__ import annotations

import numpy as np
from numba import njit


class EventGenerator:
    """The pixels of an ideal event camera, and the reference level that each remembers.

    Log brightness is taken to change linearly between two pictures. A pixel fires each time it has risen by the "on"
    threshold above its reference level or fallen by the "off" threshold below it, and that crossing is its new one.

    Args:
        log_brightness: float64 [H, W], natural logarithm; the reference levels at the start.
        time: of that picture, int nanoseconds.
        contrast_thresholds: on and off, both > 0.
    """

    def __init__(self, log_brightness: np.ndarray, time: int, contrast_thresholds: tuple[float, float]):
        self.log_brightness, self.time = log_brightness, time
        self.contrast_thresholds = contrast_thresholds
        self.reference = log_brightness.copy()

    def advance(self, log_brightness: np.ndarray, time: int) -> np.ndarray:
        """Events between the last picture and this one.

        Args:
            log_brightness: float64 [H, W].
            time: int nanoseconds, later than that of the last picture.

        Returns:
            int64 [N, 4]: x, y, time in nanoseconds (after the last picture, rounded up), polarity +1 or -1; in the
            order of time.
        """
        width = log_brightness.shape[1]
        pixel, times, polarity = _crossings(
            self.log_brightness.ravel(), log_brightness.ravel(), self.reference.ravel(), self.time, time,
            *self.contrast_thresholds,
        )  # fmt: skip
        self.log_brightness, self.time = log_brightness, time
        order = np.argsort(times, kind="stable")
        return np.stack([pixel % width, pixel // width, times, polarity], axis=1)[order]


@njit(cache=True, nogil=True)
def _crossings(before, after, reference, start, end, on, off):  # pragma: no cover
    """Pixels, times and polarities of all crossings, by pixel; moves `reference` on."""
    most = 0
    for i in range(len(before)):
        most += int(abs(after[i] - reference[i]) / min(on, off)) + 1
    pixel, times, polarity = np.empty(most, np.int64), np.empty(most, np.int64), np.empty(most, np.int64)
    count = 0
    for i in range(len(before)):
        rise = after[i] - before[i]
        sign = 1 if rise > 0 else -1
        step = on if rise > 0 else -off
        while sign * (after[i] - reference[i] - step) >= 0:
            reference[i] += step
            pixel[count] = i
            times[count] = start + min(int(np.ceil((reference[i] - before[i]) / rise * (end - start))), end - start)
            polarity[count] = sign
            count += 1
    return pixel[:count], times[:count], polarity[:count]
