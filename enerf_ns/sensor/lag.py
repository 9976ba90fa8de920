"""The lag of a pixel's photoreceptor behind brightness."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, Optional

import torch
from jaxtyping import Float, Int64
from torch import Tensor, nn

from enerf_ns.dataparsers.index.event_index import EventIndex
from enerf_ns.dataparsers.sensor_estimates.estimates import median_interval
from enerf_ns.events.batch import EventBatch
from enerf_ns.sensor.part import SensorChoices, Trained, choose_number
from enerf_ns.sensor.refractory_period import chosen_refractory_period
from enerf_ns.sensor.thresholds import Thresholds, ThresholdsConfig, unknown_events

LARGEST_LAG = 5.0
"""Largest log brightness by which brightness may be ahead of a pixel; about the range of a field."""

LARGEST_ERROR = 1.0
"""Largest standard error (ms of delay) with which events may determine the cut-off frequency for it to be learned."""

LEAST_LAG = 0.05
"""Smallest delay of pixels that is worth a lag in the model, as a share of the median interval between the events of a
pixel: a twentieth of a threshold."""

SHARE_IN_THE_DARK = 20.0 / 275.0
"""Cut-off frequency of a pixel that sees nothing, as a share of that at brightness 1."""


@dataclass
class LagConfig(ThresholdsConfig):
    """Settings of the lag."""

    cutoff_frequency: Optional[float] = None  # noqa: UP045
    """Cut-off frequency (Hz) of the photoreceptor at brightness 1. At brightness b it is (255 b + 20) / 275 of that.
    Default: unlimited."""
    learn_cutoff_frequency: Optional[bool] = None  # noqa: UP045
    """Learn the cut-off frequency, starting from cutoff-frequency. Default: yes if the recording does not state the
    thresholds, and pixels are not blind after events, which misleads it."""
    least_delay: Optional[float] = None  # noqa: UP045
    """Smallest delay (ms) of the photoreceptor that matters. A learned delay that is smaller after 200 steps is left
    out; 0 keeps any. Default: a twentieth of the median time between the events of a pixel, or 0 if
    learn-cutoff-frequency is set by flag."""
    second_cutoff_frequency: Optional[float] = None  # noqa: UP045
    """Cut-off frequency (Hz) of a second stage behind the photoreceptor, the same at any brightness. Default: no second
    stage."""


class Lag(Thresholds):
    """Pixels that follow brightness with a delay, as a low pass of first order does."""

    trained: ClassVar = {"bandwidth": Trained("delay", 3e-2)}
    setting_ranges: ClassVar = {
        "cutoff_frequency": (1e-3, 1e9),
        "least_delay": (0.0, 1e9),
        "second_cutoff_frequency": (1e-3, 1e9),
    }

    def __init__(self, config: LagConfig):
        super().__init__(config)
        delay, self.second_delay = delay_of(config.cutoff_frequency), delay_of(config.second_cutoff_frequency)
        self.delay: Tensor | float = delay
        """Delay (ms) of the photoreceptor at brightness 1."""
        if config.learn_cutoff_frequency:
            self.delay = nn.Parameter(torch.tensor(delay))
            self.register_load_state_dict_post_hook(Lag._resume)
        self.least_delay = config.least_delay or 0.0
        self._has_lag = True

    @classmethod
    def choose(cls, scene: SensorChoices) -> None:
        """Decides whether the cut-off frequency is learned, and which delay is too small to matter."""
        index = scene.once(unknown_events)
        blind, _ = scene.once(chosen_refractory_period)

        interval = math.inf if index is None else median_interval(index)

        def least_delay() -> str:
            if index is None or scene.given("model.sensor.learn_cutoff_frequency") is not None:
                return ""
            least = scene.use("model.sensor.least_delay", lambda: LEAST_LAG * interval)
            return f", and left out if it is less than {least:.2g} ms" if least else ""

        choose_number(
            scene,
            "bandwidth",
            "cutoff_frequency",
            ("the lag of pixels behind brightness", "cut off at {:g} Hz"),
            index is not None,
            (math.inf if index is None else delay_error(index), LARGEST_ERROR, "ms"),
            "pixels are blind after events, and miss the events that show a lag" if blind else "",
            least_delay,
        )
        name = "model.sensor.second_cutoff_frequency"
        second = scene.given(name)
        if second:
            value = f"pixels lag by {delay_of(second):.3g} ms more"
            scene.row("second stage", scene.use_events, value, "set by flag", name)

    @property
    def lags(self) -> bool:
        """Whether pixels follow brightness with a delay."""
        stated = 0.0 if isinstance(self.delay, Tensor) else self.delay
        return self.learns_lag or stated + self.second_delay != 0.0

    @property
    def learns_lag(self) -> bool:
        """Whether the delay of the photoreceptor is learned, best from batches with `slopes`."""
        return isinstance(self.delay, nn.Parameter) and self._has_lag

    @torch.no_grad()
    def leave_out_small_lag(self) -> str | None:
        """Sets a learned delay that is less than `least_delay` to 0, and stops learning it.

        Returns:
            A sentence for the user; None if nothing was left out.
        """
        if not (self.learns_lag and self.least_delay) or torch.as_tensor(self.delay).item() >= self.least_delay:
            return None
        found = max(torch.as_tensor(self.delay).item(), 0.0)
        torch.as_tensor(self.delay).zero_()
        self._has_lag = False
        return (
            f"Pixels lag behind brightness by {found:.2g} ms, less than {self.least_delay:.2g} ms: this is left out "
            "from here on."
        )

    def _resume(self, _: object) -> None:
        """Finds out of a checkpoint whether the lag was left out: a delay is then exactly 0, and a learned one never
        is."""
        self._has_lag = torch.as_tensor(self.delay).item() != 0.0

    @property
    def cutoff_frequency(self) -> float:
        """Cut-off frequency (Hz) of the photoreceptor at brightness 1; infinite for pixels that do not lag."""
        delay = torch.as_tensor(self.delay).item()
        return 1e3 / (2.0 * math.pi * delay) if delay > 0.0 else math.inf

    def lag(
        self, start: Float[Tensor, "pairs channels"], end: Float[Tensor, "pairs channels"], batch: EventBatch
    ) -> Float[Tensor, " pairs"]:
        """Change of log brightness between two instants, less the change that the pixels compare.

        A photoreceptor of first order follows log brightness x as y' = w (x - y), so that x - y = y' / w. The rates of
        events around the instants give the slope y'. The cut-off w grows with brightness as in v2e (Hu, Liu, Delbruck,
        CVPRW 2021): it is (255 b + 20) / 275 of the cut-off at brightness 1. The delay 1 / w of a second stage is
        added, which is exact while y' is constant: of y'', the rates of events show less than their noise.

        If the delay is learned and the batch has `slopes`, these take the place of y' in its gradient. A field that
        learns from pixels with too short a delay is blurred, and hides the lag that the model lacks; and the noise of
        the rates favours shorter delays, which let less of it in. Rendered slopes are as blurred as the field, and
        independent of that noise: they are instrumental variables for the rates.

        Args:
            start, end: Linear brightness rendered at the instants.
            batch: With `rates`.
        """
        assert batch.rates is not None
        c_on, c_off = self.contrast_thresholds
        slopes = c_on * batch.rates[..., 0] - c_off * batch.rates[..., 1]
        lags = []
        for instant, rgb in enumerate((start, end)):
            slope = slopes[:, instant]
            share = self.cutoff_share(rgb.detach(), batch.pixels)
            if batch.slopes is None or not self.learns_lag:
                delay = self.delay if self._has_lag else torch.as_tensor(self.delay).detach()
                lag = (delay / share + self.second_delay) * slope
            else:
                delay = torch.as_tensor(self.delay)
                lag = (delay.detach() / share + self.second_delay) * slope
                lag = lag + (delay - delay.detach()) / share * batch.slopes[:, instant]  # 0, with a gradient
            lags.append((1e-3 * lag).clamp(-LARGEST_LAG, LARGEST_LAG))
        return lags[1] - lags[0]

    def cutoff_share(
        self, rgb: Float[Tensor, "*batch channels"], pixels: Int64[Tensor, "*batch"]
    ) -> Float[Tensor, "*batch"]:
        """Cut-off frequency of pixels (y * width + x) that see linear brightness, as a share of that at brightness
        1."""
        return SHARE_IN_THE_DARK + (1.0 - SHARE_IN_THE_DARK) * self.brightness(rgb, pixels)

    def learned(self) -> dict[str, float]:
        """Values of the sensor that were learned: with `cutoff_frequency`, Hz."""
        found = super().learned()
        if isinstance(self.delay, Tensor) and self.delay.item() > 0.0:
            found["cutoff_frequency"] = self.cutoff_frequency
        return found


def delay_of(cutoff_frequency: float | None) -> float:
    """Delay (ms) of a low pass of first order with a cut-off frequency (Hz); 0 without one."""
    return 1e3 / (2.0 * math.pi * cutoff_frequency) if cutoff_frequency else 0.0


def delay_error(index: EventIndex) -> float:
    """Standard error (ms) with which events determine the delay when all else is known: each event determines a shift
    by a threshold within the median interval between the events of a pixel."""
    return median_interval(index) / math.sqrt(len(index))
