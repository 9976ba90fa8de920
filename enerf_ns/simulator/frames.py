"""Frames of a simulated camera: sharp frames, motion-blurred frames, and their 8-bit grey levels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int64, UInt8

from enerf_ns.dataparsers.recording.errors import FlagError

MOST_LEVEL = 1e6
"""Brightness, in multiples of the saturation, above which shot noise no longer grows."""


@dataclass(frozen=True)
class FrameSettings:
    """The frame sensor.

    Raises:
        FlagError: A setting is out of its range.
    """

    saturation: float = 1.0
    """Brightness, above 0, from which on pixels are white (255)."""
    read_noise: float = 0.0
    """Standard deviation of the read noise, in grey levels of 255."""
    shot_noise: float = 0.0
    """Full well of a pixel, the number of electrons of a white pixel. Fewer electrons mean more noise; 0 means no
    noise."""
    hdr: bool = False
    """Write the linear brightness of frames too, without noise and saturation."""

    def __post_init__(self) -> None:
        for name, value, least, what in (
            ("saturation", self.saturation, 1e-9, "a brightness"),
            ("read-noise", self.read_noise, 0.0, "grey levels"),
            ("shot-noise", self.shot_noise, 0.0, "electrons"),
        ):
            if not least <= value <= 1e9:
                raise FlagError(f"--frame.{name} is {value:g}, but must be {what} from {least:g} to 1e9.")


@dataclass(frozen=True)
class Frame:
    """Linear brightness on the frame sensor, grey or R G B."""

    number: int
    """Number of the frame, from 0."""
    time: int
    """Time of the frame, ns: the middle of the exposure."""
    sharp: Float[np.ndarray, "height width *channels"]
    """Brightness at the time of the frame."""
    blurred: Float[np.ndarray, "height width *channels"] | None
    """Mean brightness during the exposure; None if the exposure is 0."""


class Exposures:
    """Makes frames from the pictures rendered during their exposures.

    Brightness is taken to change linearly from one picture to the next, so that the integral over the exposure is a sum
    of trapezoids.

    Args:
        times: Times of the frames (ns), increasing: the middles of their exposures.
        exposure: Duration of each exposure (ns); 0 for sharp frames only.

    Raises:
        FlagError: The exposure is negative, or longer than from one frame to the next.
    """

    def __init__(self, times: Int64[np.ndarray, " frames"], exposure: int):
        self.times, self.exposure = times, exposure
        self.opens = times - exposure // 2
        self.closes = self.opens + exposure
        interval = int(np.diff(times).min(initial=np.iinfo(np.int64).max))
        if not 0 <= exposure <= interval:
            raise FlagError(
                f"The exposure of {exposure * 1e-6:g} ms does not fit frames {interval * 1e-6:g} ms apart; give "
                "--exposure-ms from 0 up to that, or less --num-frames."
            )
        self._number = 0
        self._last: tuple[int, np.ndarray] | None = None
        self._begin()

    @property
    def stops(self) -> Int64[np.ndarray, " stops"]:
        """Times (ns, increasing) at which pictures are needed: beginning, middle and end of each exposure."""
        return np.unique(np.concatenate([self.opens, self.times, self.closes]))

    def add(self, time: int, brightness: Float[np.ndarray, "height width *channels"]) -> Frame | None:
        """Adds the next picture; outside exposures no picture is needed.

        Args:
            time: Time of the picture, ns, later than the picture before.
            brightness: Linear, at least 0. The caller must not change it afterwards.

        Returns:
            The frame whose exposure ends at this time, if there is one.

        Raises:
            ValueError: There is no picture at the beginning, middle or end of the exposure.
        """
        number = self._number
        if number == len(self.times):
            return None
        if self._last is not None and self._last[0] >= self.opens[number]:
            last_time, last = self._last
            if self._sum is None:
                self._sum = np.zeros(last.shape)
            self._sum += (last + brightness) * (0.5 * (time - last_time))
            self._exposed += time - last_time
        self._last = time, brightness
        if time == self.times[number]:
            self._sharp = brightness
        if time < self.closes[number]:
            return None
        if time > self.closes[number] or self._exposed != self.exposure or self._sharp is None:
            raise ValueError(
                f"Frame {number} needs pictures at {self.opens[number]}, {self.times[number]} and "
                f"{self.closes[number]} ns."
            )
        blurred = None if self._sum is None else self._sum / self.exposure
        frame = Frame(number, int(self.times[number]), self._sharp, blurred)
        self._number += 1
        self._begin()
        return frame

    def _begin(self) -> None:
        self._sum: np.ndarray | None = None
        self._exposed = 0
        self._sharp: np.ndarray | None = None


def develop(
    brightness: Float[np.ndarray, "height width *channels"],
    settings: FrameSettings,
    number: int,
    blurred: bool,
    seed: int = 0,
) -> UInt8[np.ndarray, "height width *channels"]:
    """The grey levels of a frame, rounded; 255 from the saturation on.

    The electrons of a pixel are Poisson distributed around its fraction of the full well. The read-out adds a Gaussian
    error.

    Args:
        brightness: Linear, at least 0.
        settings: Settings of the frame sensor.
        number: Number of the frame, from 0.
        blurred: Whether this is the blurred or the sharp frame of this number.
        seed: Seed of the noise, together with `number` and `blurred`; at least 0.
    """
    rng = np.random.default_rng([seed, number, int(blurred)])
    level = np.asarray(brightness, np.float64) / settings.saturation
    if settings.shot_noise:
        level = rng.poisson(level.clip(0, MOST_LEVEL) * settings.shot_noise) / settings.shot_noise
    grey = 255 * level
    if settings.read_noise:
        grey += rng.normal(0, settings.read_noise, grey.shape)
    return np.rint(grey).clip(0, 255).astype(np.uint8)
