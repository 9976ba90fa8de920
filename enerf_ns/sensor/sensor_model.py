"""The sensor between rendered brightness and events: response, contrast thresholds, refractory period, colour filter."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int, Int64
from torch import Tensor, nn

from enerf_ns.sensor.response import Linlog, Response, pixel_brightness

DEFAULT_CONTRAST_THRESHOLD = 0.25
"""Mean threshold assumed where a recording does not state one. Events fix brightness only up to this factor."""


class SensorModel(nn.Module):
    """What an event camera reports of brightness (Klenk et al., E-NeRF, RA-L 2023, equations 1 to 3).

    A pixel compares log brightness at two instants, fires one event per contrast threshold crossed, and is then blind
    for the refractory period. Here all of this are fixed numbers. A subclass that learns one of them holds it as a
    parameter and overrides what uses it; nothing else needs to change, since a model trains the parameters that its
    sensor has, and nobody asks for the numbers themselves.

    Args:
        contrast_thresholds: (C_on, C_off), both positive, in units of log brightness.
        response: What a pixel makes of brightness.
        refractory_period: For how long a pixel is blind after an event, ns; 0 for not at all.
        channels: Colour channel 0, 1 or 2 that each pixel sees, by pixel number (`response.colour_channels`); None for
            a grey sensor.
    """

    channels: Tensor | None

    def __init__(
        self,
        contrast_thresholds: tuple[float, float],
        response: Response | None = None,
        refractory_period: int = 0,
        channels: Int64[Tensor, " pixels"] | None = None,
    ):
        super().__init__()
        self.contrast_thresholds = contrast_thresholds
        self.response = response or Linlog()
        self.refractory_period = refractory_period
        self.register_buffer("channels", channels, persistent=False)

    def log_brightness(
        self, rgb: Float[Tensor, "*batch channels"], pixels: Int64[Tensor, "*batch"]
    ) -> Float[Tensor, "*batch"]:
        """What pixels compare: the response to what each sees of one or three colour channels.

        Args:
            rgb: Linear brightness.
            pixels: Their numbers, y * width + x.
        """
        return self.response(pixel_brightness(rgb, None if self.channels is None else self.channels[pixels]))

    def measured_change(
        self, on: Int[Tensor, "*batch"], off: Int[Tensor, "*batch"], pixels: Int64[Tensor, "*batch"]
    ) -> Float[Tensor, "*batch"]:
        """Change of log brightness that pixels reported: C_on * (on events) - C_off * (off events).

        Args:
            on: Number of positive events after the first instant, up to and with the second.
            off: Number of negative events in the same interval.
            pixels: Their numbers, y * width + x.
        """
        return self.contrast_thresholds[0] * on - self.contrast_thresholds[1] * off

    def interval_start(self, first: Int64[Tensor, "*batch"], end: Int64[Tensor, "*batch"]) -> Int64[Tensor, "*batch"]:
        """When a pixel that fired can see again, and with it the interval that its next events measure begins (ns).

        After an event a pixel is blind for the refractory period, and then compares brightness with what it sees first
        (Robust e-NeRF, Low and Lee, ICCV 2023). The interval is at least 1 ns long.

        Args:
            first: Time of the event before the interval, ns.
            end: Time of the last event of the interval, ns.
        """
        return torch.minimum(first + self.refractory_period, end - 1)

    @property
    def mean_threshold(self) -> float | Float[Tensor, ""]:
        """The unit in which losses count changes of log brightness."""
        return 0.5 * sum(self.contrast_thresholds)


def thresholds_from_polarity(num_on: int, num_off: int) -> tuple[float, float]:
    """Contrast thresholds (C_on, C_off) under which a whole recording brightens as much as it darkens.

    Over a long recording every pixel's changes nearly cancel, so num_on * C_on = num_off * C_off; the mean of the two,
    which events cannot tell, is `DEFAULT_CONTRAST_THRESHOLD`. A recording without one of the polarities gives equal
    thresholds.
    """
    if num_on == 0 or num_off == 0:
        return DEFAULT_CONTRAST_THRESHOLD, DEFAULT_CONTRAST_THRESHOLD
    on = 2.0 * DEFAULT_CONTRAST_THRESHOLD * num_off / (num_on + num_off)
    return on, 2.0 * DEFAULT_CONTRAST_THRESHOLD - on


def measured_change(on: Tensor, off: Tensor, thresholds: tuple[float, float]) -> Tensor:
    """For what does not have a sensor yet."""
    return thresholds[0] * on - thresholds[1] * off
