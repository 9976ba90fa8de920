"""The sensor between brightness and events: response, contrast thresholds, refractory period, colour filter."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Optional, Tuple, Type  # noqa: UP035 - tyro reads these annotations on Python 3.10

import torch
import tyro
from jaxtyping import Float, Float64, Int64
from torch import Tensor, nn

from enerf_ns.events.batch import EventBatch
from enerf_ns.sensor.response import ColourFilter, LearnedResponse, pixel_brightness, response_named
from enerf_ns.sensor.threshold_map import ThresholdMap

LARGEST_LAG = 5.0
"""Most by which brightness is thought to be ahead of a pixel, log brightness; about what a field spans."""

GREY = "grey"
"""Name in place of a Bayer pattern for a sensor without a colour filter."""


@dataclass
class SensorModelConfig:
    """The sensor. What is None is chosen from the recording."""

    _target: Type[SensorModel] = field(default_factory=lambda: SensorModel)  # noqa: UP006
    contrast_thresholds: Optional[Tuple[float, float]] = None  # noqa: UP006, UP045
    """Contrast thresholds C_on and C_off. None: the recording's own, else from its frames, or from the counts of both
    polarities and an assumed mean."""
    response: Optional[str] = None  # noqa: UP045
    """What a pixel makes of brightness: linlog, or logarithm:OFFSET; or gamma:EXPONENT:OFFSET, whose field renders
    gamma-encoded brightness. None: the recording's own, else linlog."""
    learn_response: Optional[bool] = None  # noqa: UP045
    """Learn how pixels answer brightness, starting from the response. None: where the field learns from frames, too,
    and the recording states neither thresholds nor response."""
    refractory_period_ns: Optional[int] = None  # noqa: UP045
    """For how long (ns) a pixel is blind after an event. None: the recording's own, else what the shortest intervals
    between events tell."""
    learn_refractory_period: bool = False
    """Learn the refractory period, starting from it; each step takes longer, since rays then have gradients."""
    bayer_pattern: Optional[str] = None  # noqa: UP045
    """Colours of the pixels (0, 0), (1, 0), (0, 1) and (1, 1), such as RGGB; grey: none. None: the recording's own."""
    learn_threshold_ratio: Optional[bool] = None  # noqa: UP045
    """Learn C_on / C_off, whose mean stays. None: where the recording does not state the thresholds, and pixels are
    blind after events, so that counts mislead."""
    learn_mean_threshold: Optional[bool] = None  # noqa: UP045
    """Learn the mean of C_on and C_off, which only frames can tell. None: where the field learns from frames, too, and
    the recording does not state the thresholds."""
    learn_threshold_map: Optional[bool] = None  # noqa: UP045
    """Learn how far the thresholds of each pixel are from those of the sensor. None: where the recording does not state
    the thresholds, and its events show that they differ."""
    leak_rate: float = 0.0
    """On events a second of a pixel that sees nothing change."""
    learn_leak_rate: Optional[bool] = None  # noqa: UP045
    """Learn the leak rate, starting from it. None: where the recording does not state the thresholds, and is long
    enough to tell it."""
    cutoff_frequency: Optional[float] = None  # noqa: UP045
    """Cut-off frequency (Hz) of the photoreceptor at brightness 1; at brightness b it is (255 b + 20) / 275 of that.
    None: unlimited."""
    learn_cutoff_frequency: Optional[bool] = None  # noqa: UP045
    """Learn the cut-off frequency, starting from it. None: where the recording does not state the thresholds, and
    pixels are not blind after events, which misleads it."""
    least_delay: Optional[float] = None  # noqa: UP045
    """Delay (ms) of the photoreceptor that matters; one that is learned to be less after 200 steps is left out. 0: any
    matters. None: a twentieth of the median time between a pixel's events; 0 where a flag has the cut-off frequency
    learned."""
    second_cutoff_frequency: Optional[float] = None  # noqa: UP045
    """Cut-off frequency (Hz) of a second stage behind the photoreceptor, the same at any brightness. None: there is
    none."""
    width: tyro.conf.Suppress[Optional[int]] = None  # noqa: UP045
    """Width of the sensor, pixels."""
    height: tyro.conf.Suppress[Optional[int]] = None  # noqa: UP045
    """Height of the sensor, pixels."""

    def setup(self) -> SensorModel:
        """The sensor of this config, whose class is `_target`."""
        return self._target(self)


class SensorModel(nn.Module):
    """What an event camera reports of brightness (Klenk et al., E-NeRF, RA-L 2023, equations 1 to 3).

    A pixel compares log brightness at two instants, fires one event per contrast threshold crossed, and is then blind
    for the refractory period. Its memory leaks, and its photoreceptor lags behind, where the config says so. Each of
    these is a number, or a parameter where it is learned (`get_param_groups`); what is not learned has none. A subclass
    that learns more holds a parameter and overrides the property or method that gives it; nothing else changes, since
    everybody asks these.

    Args:
        config: With nothing left open.

    Raises:
        ValueError: A response or colour filter that there is not.
    """

    def __init__(self, config: SensorModelConfig):
        super().__init__()
        assert config.contrast_thresholds is not None and config.response is not None
        assert config.refractory_period_ns is not None and config.bayer_pattern is not None
        on, off = config.contrast_thresholds
        self._contrast_thresholds = on, off
        self.log_mean = nn.Parameter(torch.tensor(math.log(0.5 * (on + off)))) if config.learn_mean_threshold else None
        self.log_ratio = nn.Parameter(torch.tensor(math.log(on / off))) if config.learn_threshold_ratio else None
        self.leak_rate: Tensor | float = config.leak_rate
        if config.learn_leak_rate:
            self.leak_rate = nn.Parameter(torch.tensor(float(config.leak_rate)))
        delay, self.second_delay = (
            1e3 / (2.0 * math.pi * cutoff) if cutoff else 0.0
            for cutoff in (config.cutoff_frequency, config.second_cutoff_frequency)
        )
        self.delay: Tensor | float = delay
        if config.learn_cutoff_frequency:
            self.delay = nn.Parameter(torch.tensor(delay))
            self.register_load_state_dict_post_hook(SensorModel._resume_lag)
        self.least_delay = config.least_delay or 0.0
        self._has_lag = True
        self.threshold_map = None
        if config.learn_threshold_map:
            assert config.width is not None and config.height is not None
            self.threshold_map = ThresholdMap(config.width * config.height)
        response = response_named(config.response)
        self.response = LearnedResponse(response) if config.learn_response else response
        self.refractory_period = config.refractory_period_ns
        """For how long (ns) a pixel is blind after an event, before anything is learned of it."""
        self.log_refractory_period = None
        if config.learn_refractory_period and config.refractory_period_ns:
            self.log_refractory_period = nn.Parameter(torch.tensor(math.log(config.refractory_period_ns)).double())
        self.colour_filter = None
        if config.bayer_pattern != GREY:
            assert config.width is not None
            self.colour_filter = ColourFilter(config.bayer_pattern, config.width)

    @property
    def contrast_thresholds(self) -> tuple[float | Tensor, float | Tensor]:
        """C_on and C_off of the sensor, in units of log brightness; numbers, or tensors where they are learned."""
        on, off = self._contrast_thresholds
        if self.log_ratio is None and self.log_mean is None:
            return on, off
        both = on + off if self.log_mean is None else 2.0 * self.log_mean.exp()
        if self.log_ratio is None:
            return both * (on / (on + off)), both * (off / (on + off))
        return both * torch.sigmoid(self.log_ratio), both * torch.sigmoid(-self.log_ratio)

    def log_brightness(
        self, rgb: Float[Tensor, "*batch channels"], pixels: Int64[Tensor, "*batch"]
    ) -> Float[Tensor, "*batch"]:
        """What pixels compare: the response to what each sees of one or three colour channels.

        Args:
            rgb: Linear brightness.
            pixels: Their numbers, y * width + x.
        """
        return self.response(self.brightness(rgb, pixels))

    def brightness(
        self, rgb: Float[Tensor, "*batch channels"], pixels: Int64[Tensor, "*batch"]
    ) -> Float[Tensor, "*batch"]:
        """What each of some pixels sees of one or three colour channels; arguments as of `log_brightness`."""
        channel = None if self.colour_filter is None else self.colour_filter.channels(pixels)
        return pixel_brightness(rgb, channel)

    def measured_change(self, batch: EventBatch) -> Float[Tensor, " pairs"]:
        """Change of log brightness that pixels reported: C_on * (on events) - C_off * (off events), with the thresholds
        of each pixel, less what leaked; of silent pixels, what leaked alone.

        Shot noise fires as many on as off events, which cancel where thresholds are equal; what is left of it
        elsewhere, its rate times C_on - C_off, is a leak.
        """
        c_on, c_off = self.contrast_thresholds
        on, off = c_on * batch.on, c_off * batch.off
        if self.threshold_map is not None:
            factors = self.threshold_map.factors(batch.pixels)
            on, off = on * factors[:, 0], off * factors[:, 1]
        change = on - off
        if batch.ahead is not None:
            change = change + 0.5 * (c_on + c_off) * batch.ahead
        if self.leaks:
            seconds = 1e-9 * (batch.end - batch.start).double()
            blind = self.blind_after(batch.start, batch.end) if batch.starts_at_events else None
            if blind is not None:
                seconds[batch.fired] -= 1e-9 * blind[batch.fired]
            change = change - self.leak_rate * c_on * seconds.to(change.dtype)
        return change

    @property
    def leaks(self) -> bool:
        """Whether the memory of a pixel changes by itself."""
        return isinstance(self.leak_rate, Tensor) or self.leak_rate != 0.0

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
        """Learns no delay from now on, and has none, where the one that is learned is less than `least_delay`.

        Returns:
            A sentence that says so; None where there is nothing to say.
        """
        if not (self.learns_lag and self.least_delay) or float(self.delay) >= self.least_delay:
            return None
        found = max(float(self.delay), 0.0)
        torch.as_tensor(self.delay).zero_()
        self._has_lag = False
        least = self.least_delay
        return (
            f"Pixels lag behind brightness by {found:.2g} ms, less than {least:.2g} ms: this is left out from here on."
        )

    def _resume_lag(self, _: object) -> None:
        """Of a checkpoint: 0 is what the delay is where it was left out, and nothing that is learned is ever 0."""
        self._has_lag = float(self.delay) != 0.0

    @property
    def cutoff_frequency(self) -> float:
        """Cut-off frequency (Hz) of the photoreceptor at brightness 1; infinite where pixels do not lag."""
        delay = float(self.delay)
        return 1e3 / (2.0 * math.pi * delay) if delay > 0.0 else math.inf

    def lag(
        self, start: Float[Tensor, "pairs channels"], end: Float[Tensor, "pairs channels"], batch: EventBatch
    ) -> Float[Tensor, " pairs"]:
        """By how much log brightness changed more between two instants than what the pixels compare.

        A photoreceptor of first order follows log brightness x as y' = w (x - y), so that x - y = y' / w. Of y, events
        tell the slope: the rates around the instants. The cut-off w grows with brightness as in v2e (Hu, Liu, Delbruck,
        CVPRW 2021): (255 b + 20) / 275 of that at brightness 1. The delay 1 / w of a second stage is added, which is
        exact as far as y' stays the same meanwhile: of y'', rates of events tell less than their noise.

        Where the delay is learned and the batch has `slopes`, these take the place of y' in its gradient. A field that
        learns from pixels with too short a delay is blurred, and hides the lag that it did not see; and noise of the
        rates speaks for shorter delays, which let less of it in. Rendered slopes are as blurred as the field and know
        nothing of that noise: they are the instrument, in the sense of statistics, of the rates.

        Args:
            start, end: Rendered at the instants.
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
                lag = (self.delay / share + self.second_delay) * slope
            else:
                delay = torch.as_tensor(self.delay)
                lag = (delay.detach() / share + self.second_delay) * slope
                lag = lag + (delay - delay.detach()) / share * batch.slopes[:, instant]  # 0, with a gradient
            lags.append((1e-3 * lag).clamp(-LARGEST_LAG, LARGEST_LAG))
        return lags[1] - lags[0]

    def cutoff_share(
        self, rgb: Float[Tensor, "*batch channels"], pixels: Int64[Tensor, "*batch"]
    ) -> Float[Tensor, "*batch"]:
        """Cut-off frequency of pixels, as a share of that at brightness 1; arguments as of `log_brightness`."""
        return (255.0 * self.brightness(rgb, pixels) + 20.0) / 275.0

    @torch.no_grad()
    def observe(self, change: Float[Tensor, " pairs"], batch: EventBatch) -> None:
        """Learns what is not learned by gradients from what a training step rendered of a batch.

        Args:
            change: Rendered change of log brightness of each pair.
            batch: What was measured.
        """
        if self.threshold_map is None:
            return
        fired, mean = batch.fired, self.mean_threshold
        on, off = batch.on[fired], batch.off[fired]
        c_on, c_off = (threshold / mean for threshold in self.contrast_thresholds)
        factors = self.threshold_map.factors(batch.pixels[fired]) - 1.0
        by_map = c_on * on * factors[:, 0] - c_off * off * factors[:, 1]
        residual = (change[fired] - self.measured_change(batch)[fired]) / mean + by_map
        self.threshold_map.observe(batch.pixels[fired], on, off, residual, (c_on, c_off))

    def learned(self) -> dict[str, float]:
        """What was learned, by name: thresholds on and off, refractory period (ms), leak rate (on events a second),
        cut-off frequency (Hz) and the relative spreads of the thresholds of pixels; empty where nothing was."""
        found: dict[str, float] = {}
        if self.log_ratio is not None or self.log_mean is not None:
            on, off = (float(torch.as_tensor(threshold)) for threshold in self.contrast_thresholds)
            found |= {"threshold_on": on, "threshold_off": off}
        if self.log_refractory_period is not None:
            found["refractory_period_ms"] = 1e-6 * float(self.log_refractory_period.exp())
        if isinstance(self.leak_rate, Tensor):
            found["leak_rate"] = float(self.leak_rate)
        if isinstance(self.delay, Tensor) and float(self.delay) > 0.0:
            found["cutoff_frequency"] = self.cutoff_frequency
        if self.threshold_map is not None:
            on, off = self.threshold_map.spread.tolist()
            found |= {"spread_on": on, "spread_off": off}
        return found

    def get_param_groups(self) -> dict[str, list[nn.Parameter]]:
        """Parameters by the name of their group, a group for each part that is learned; "sensor" has those that a
        subclass adds."""
        groups = {
            "threshold_ratio": self.log_ratio,
            "mean_threshold": self.log_mean,
            "refractory_period": self.log_refractory_period,
            "response": self.response.log_slopes if isinstance(self.response, LearnedResponse) else None,
            "bandwidth": self.delay,
            "leak_rate": self.leak_rate,
        }
        found = {name: [value] for name, value in groups.items() if isinstance(value, nn.Parameter)}
        own = {id(value) for values in found.values() for value in values}
        others = [value for value in self.parameters() if id(value) not in own]
        return found | {"sensor": others} if others else found

    @property
    def mean_threshold(self) -> float | Tensor:
        """Mean contrast threshold: the unit in which losses count changes of log brightness.

        Where it is learned, it is learned as that unit: rendered changes in thresholds are fitted to the events, not
        events times the threshold to rendered changes. Noise of the events is then an error of what is fitted to, and
        not of what is multiplied, which would draw the threshold to 0 (attenuation in a regression).
        """
        return 0.5 * sum(self._contrast_thresholds) if self.log_mean is None else self.log_mean.exp()

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
        longest = (until - 1 - event).double()
        if self.log_refractory_period is None:
            return longest.clamp(max=self.refractory_period)
        return torch.minimum(longest, self.log_refractory_period.exp())
