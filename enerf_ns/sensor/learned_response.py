"""The response of the sensor's pixels, which may be learned."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Optional

import torch
from jaxtyping import Float, Int64
from torch import Tensor, nn

from enerf_ns.dataparsers.recording.errors import FlagError
from enerf_ns.events.statistics import log_brightness_range
from enerf_ns.sensor.part import SensorChoices, SensorPart, SensorPartConfig, Trained
from enerf_ns.sensor.refractory_period import chosen_refractory_period
from enerf_ns.sensor.response import Response, response_named
from enerf_ns.sensor.thresholds import (
    balanced_thresholds,
    chosen_thresholds,
    enough_for_thresholds,
    unknown_events,
)

USUAL_RESPONSE = "logarithm:0.01"
"""Response of a sensor that states none, if the field learns from events alone. With linlog, which is linear up to 8 %
of full brightness, slider_depth comes out 1.2 dB worse, and its contrast 1.36 times too small in place of 1.06
times."""

KNOTS = 17
"""Number of knots of a learned response, evenly spaced in the log brightness of the response that it starts from."""

KNOTS_FROM_TO = (1e-3, 1.0)
"""Brightness at the first and at the last knot."""


class LearnedResponse(nn.Module):
    """A monotone response that starts as a known one: a piecewise linear function of the log brightness of that one.

    Its slopes are positive and 1 on average, since the contrast threshold of the sensor sets their mean.

    Args:
        start: The response before training.
    """

    def __init__(self, start: Response):
        super().__init__()
        self.start = start
        self.name = f"learned:{start.name}"
        first, last = (float(start(torch.tensor(b, dtype=torch.float64))) for b in KNOTS_FROM_TO)
        self._first, self._step = first, (last - first) / (KNOTS - 1)
        self.log_slopes = nn.Parameter(torch.zeros(KNOTS - 1))

    def forward(self, brightness: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
        """Log brightness; beyond the knots the first and the last slope continue."""
        place = (self.start(brightness) - self._first) / self._step
        slopes = torch.softmax(self.log_slopes, dim=0) * (KNOTS - 1)
        values = torch.cat([slopes.new_zeros(1), slopes.cumsum(dim=0)])
        knot = place.detach().floor().long().clamp(0, KNOTS - 2)
        return self._first + self._step * (values[knot] + slopes[knot] * (place - knot))

    def inverse(self, log_brightness: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
        """Linear brightness whose log brightness is the argument."""
        place = (log_brightness - self._first) / self._step
        slopes = torch.softmax(self.log_slopes, dim=0) * (KNOTS - 1)
        values = torch.cat([slopes.new_zeros(1), slopes.cumsum(dim=0)])
        knot = (torch.searchsorted(values, place.detach().contiguous(), right=True) - 1).clamp(0, KNOTS - 2)
        return self.start.inverse(self._first + self._step * (knot + (place - values[knot]) / slopes[knot]))


@dataclass
class PixelResponseConfig(SensorPartConfig):
    """Settings of the response."""

    response: Optional[str] = None  # noqa: UP045
    """Log brightness that a pixel compares: linlog, logarithm:OFFSET, or gamma:EXPONENT:OFFSET, whose field renders
    gamma-encoded brightness. Default: the response that the recording states, else linlog; for events alone a
    logarithm, or linlog if pixels see a high dynamic range."""
    learn_response: Optional[bool] = None  # noqa: UP045
    """Learn the response, starting from response. Default: yes if the field learns from frames as well, and the
    recording states neither thresholds nor response."""


class PixelResponse(SensorPart):
    """Pixels that compare a function of brightness, about its logarithm.

    Raises:
        ValueError: The response does not exist.
    """

    trained: ClassVar = {"response": Trained("response.log_slopes", 1e-2)}

    def __init__(self, config: PixelResponseConfig):
        super().__init__(config)
        assert config.response is not None
        response = response_named(config.response)
        self.response = LearnedResponse(response) if config.learn_response else response

    @classmethod
    def choose(cls, scene: SensorChoices) -> None:
        """Decides the response, and whether it is learned.

        Raises:
            FlagError: The response does not exist.
        """
        name, stated = "model.sensor.response", scene.recording.response
        usual, why, followed = "linlog", "the response of E-NeRF", scene.use_frames
        if scene.learns_sensor and not scene.use_frames:
            if scene.once(seen_range)[0] > scene.limited_range:
                # worth 1.1 dB on statue beside the response that it states
                why = f"pixels see more than {scene.limited_range:g} of log brightness; linlog bounds its darkest part"
            else:
                usual, why, followed = USUAL_RESPONSE, "pixels see the logarithm of brightness", True
        followed = followed and bool(stated)
        response = scene.use(name, lambda: stated if followed else usual)
        try:
            response_named(response)
        except ValueError as error:
            raise FlagError(f"--pipeline.model.response is {error}") from error
        if followed:
            why = "the recording states it"
        elif stated and not scene.learns_sensor:
            why += f"; the recording states {stated}, which matters if the field learns from frames"
        unknown = scene.once(unknown_events) is not None and scene.given(name) is None and not followed
        enough = scene.once(enough_for_thresholds)
        learned = scene.use("model.sensor.learn_response", lambda: unknown and enough and scene.use_frames)
        value = f"learned, starting from {response}" if learned else response
        why += "; frames determine it better" if learned else ""
        scene.row("response", scene.use_events, value, scene.why(name, why), name)

    def log_brightness(
        self, rgb: Float[Tensor, "*batch channels"], pixels: Int64[Tensor, "*batch"]
    ) -> Float[Tensor, "*batch"]:
        """Log brightness that pixels compare, of one or three colour channels.

        Args:
            rgb: Linear brightness.
            pixels: Numbers of the pixels, y * width + x.
        """
        return self.response(self.brightness(rgb, pixels))


def seen_range(scene: SensorChoices) -> tuple[float, str]:
    """The range of log brightness that a pixel sees according to its events, and the reason for it."""
    thresholds = scene.once(chosen_thresholds).values
    if scene.learns_sensor and scene.once(chosen_refractory_period)[0]:
        # blind pixels seldom miss as many changes of either polarity
        on, off = balanced_thresholds(scene.index)
        thresholds = 0.5 * sum(thresholds) * on, 0.5 * sum(thresholds) * off
    sums = span = log_brightness_range(scene.index, thresholds)
    why = f"events of a pixel span {sums:.2g} of log brightness"
    if scene.learns_sensor:
        half = log_brightness_range(scene.index, thresholds, parts=2)
        span = max(2.0 * half - sums, 0.0)
        why += f", {half:.2g} in half of the time: {span:.2g} without drift"
    return span, why
