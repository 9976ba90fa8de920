"""The sensor between brightness and events: response, contrast thresholds, refractory period, colour filter."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Optional, Tuple, Type  # noqa: UP035 - tyro reads these annotations on Python 3.10

import tyro
from jaxtyping import Float, Float64, Int, Int64
from torch import Tensor, nn

from enerf_ns.dataparsers.recording import CONTRAST_THRESHOLD_LIMITS
from enerf_ns.sensor.response import ColourFilter, pixel_brightness, response_named

DEFAULT_CONTRAST_THRESHOLD = 0.25
"""Mean threshold assumed where a recording does not state one. Events fix brightness only up to this factor."""

GREY = "grey"
"""Name in place of a Bayer pattern for a sensor without a colour filter."""


@dataclass
class SensorModelConfig:
    """The sensor. What is None is chosen from the recording."""

    _target: Type[SensorModel] = field(default_factory=lambda: SensorModel)  # noqa: UP006
    contrast_thresholds: Optional[Tuple[float, float]] = None  # noqa: UP006, UP045
    """Contrast thresholds C_on and C_off. None: the recording's own, else from the counts of both polarities."""
    response: Optional[str] = None  # noqa: UP045
    """What a pixel makes of brightness: linlog, or logarithm:OFFSET; or gamma:EXPONENT:OFFSET, whose field renders
    gamma-encoded brightness. None: the recording's own, else linlog."""
    refractory_period_ns: Optional[int] = None  # noqa: UP045
    """For how long (ns) a pixel is blind after an event. None: the recording's own."""
    bayer_pattern: Optional[str] = None  # noqa: UP045
    """Colours of the pixels (0, 0), (1, 0), (0, 1) and (1, 1), such as RGGB; grey: none. None: the recording's own."""
    width: tyro.conf.Suppress[Optional[int]] = None  # noqa: UP045
    """Width of the sensor, pixels."""

    def setup(self) -> SensorModel:
        """The sensor of this config, whose class is `_target`."""
        return self._target(self)


class SensorModel(nn.Module):
    """What an event camera reports of brightness (Klenk et al., E-NeRF, RA-L 2023, equations 1 to 3).

    A pixel compares log brightness at two instants, fires one event per contrast threshold crossed, and is then blind
    for the refractory period. Here all of this are fixed numbers. A subclass that learns one of them holds it as a
    parameter and overrides the property or method that gives it; nothing else changes, since everybody asks these, and
    whatever parameters a sensor has are trained as the group "sensor" and stored with the run.

    Args:
        config: With nothing left open.

    Raises:
        ValueError: A response or colour filter that there is not.
    """

    def __init__(self, config: SensorModelConfig):
        super().__init__()
        assert config.contrast_thresholds is not None and config.response is not None
        assert config.refractory_period_ns is not None and config.bayer_pattern is not None
        self._contrast_thresholds = config.contrast_thresholds
        self.response = response_named(config.response)
        self.refractory_period = config.refractory_period_ns
        self.colour_filter = None
        if config.bayer_pattern != GREY:
            assert config.width is not None
            self.colour_filter = ColourFilter(config.bayer_pattern, config.width)

    @property
    def contrast_thresholds(self) -> tuple[float | Tensor, float | Tensor]:
        """C_on and C_off, in units of log brightness; numbers, or tensors where they are learned."""
        return self._contrast_thresholds

    def log_brightness(
        self, rgb: Float[Tensor, "*batch channels"], pixels: Int64[Tensor, "*batch"]
    ) -> Float[Tensor, "*batch"]:
        """What pixels compare: the response to what each sees of one or three colour channels.

        Args:
            rgb: Linear brightness.
            pixels: Their numbers, y * width + x.
        """
        channel = None if self.colour_filter is None else self.colour_filter.channels(pixels)
        return self.response(pixel_brightness(rgb, channel))

    def measured_change(
        self, on: Int[Tensor, "*batch"], off: Int[Tensor, "*batch"], pixels: Int64[Tensor, "*batch"]
    ) -> Float[Tensor, "*batch"]:
        """Change of log brightness that pixels reported: C_on * (on events) - C_off * (off events).

        Args:
            on: Number of positive events after the first instant, up to and with the second.
            off: Number of negative events in the same interval.
            pixels: Their numbers, y * width + x.
        """
        c_on, c_off = self.contrast_thresholds
        return c_on * on - c_off * off

    @property
    def mean_threshold(self) -> float | Tensor:
        """Mean contrast threshold: the unit in which losses count changes of log brightness."""
        c_on, c_off = self.contrast_thresholds
        return 0.5 * (c_on + c_off)

    def blind_after(
        self, event: Int64[Tensor, "*batch"], until: Int64[Tensor, "*batch"]
    ) -> Float64[Tensor, "*batch"] | None:
        """For how long (ns) a pixel is blind after an event; None where it never is.

        Afterwards it compares brightness with what it sees first (Robust e-NeRF, Low and Lee, ICCV 2023), so that the
        interval that its next events measure begins then. It lasts at least 1 ns.

        Args:
            event: Time of the event before the interval, ns.
            until: Time of the last event of the interval, ns.
        """
        if not self.refractory_period:
            return None
        return (until - 1 - event).clamp(max=self.refractory_period).double()


def thresholds_from_polarity(num_on: int, num_off: int) -> tuple[float, float]:
    """Contrast thresholds (C_on, C_off) under which a whole recording brightens as much as it darkens.

    Over a long recording every pixel's changes nearly cancel, so num_on * C_on = num_off * C_off; the mean of the two,
    which events cannot tell, is `DEFAULT_CONTRAST_THRESHOLD`. A recording without one of the polarities gives equal
    thresholds, and one with hardly any events of it the least threshold, of `CONTRAST_THRESHOLD_LIMITS`, for the other.
    """
    if num_on == 0 or num_off == 0:
        return DEFAULT_CONTRAST_THRESHOLD, DEFAULT_CONTRAST_THRESHOLD
    both, least = 2.0 * DEFAULT_CONTRAST_THRESHOLD, CONTRAST_THRESHOLD_LIMITS[0]
    on = min(max(both * num_off / (num_on + num_off), least), both - least)
    return on, both - on
