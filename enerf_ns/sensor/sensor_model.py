"""The sensor between brightness and events, made of its parts."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Type  # noqa: UP035 - tyro reads these annotations on Python 3.10

from enerf_ns.sensor.lag import Lag, LagConfig
from enerf_ns.sensor.leak import Leak, LeakConfig
from enerf_ns.sensor.learned_response import PixelResponse, PixelResponseConfig
from enerf_ns.sensor.refractory_period import RefractoryPeriod, RefractoryPeriodConfig
from enerf_ns.sensor.threshold_map import PixelThresholds, PixelThresholdsConfig
from enerf_ns.sensor.thresholds import Thresholds, ThresholdsConfig


class SensorModel(PixelResponse, Lag, Leak, PixelThresholds, Thresholds, RefractoryPeriod):
    """An event camera, as it reports brightness (Klenk et al., E-NeRF, RA-L 2023, equations 1 to 3).

    A pixel compares log brightness at two instants, fires one event per contrast threshold crossed, and is then blind
    for the refractory period. Its memory leaks, and its photoreceptor lags behind brightness, if the config says so.
    Each of these is a part. It is a number, or a parameter if it is learned (`get_param_groups`); a part that is not
    learned has no parameters. A subclass, or one more part in the list of bases, holds a parameter of its own and
    overrides the property or method that the parameter changes.

    Args:
        config: Without a setting that is still open.

    Raises:
        ValueError: The response or the colour filter does not exist.
    """


@dataclass
class SensorModelConfig(
    PixelResponseConfig, LagConfig, LeakConfig, PixelThresholdsConfig, ThresholdsConfig, RefractoryPeriodConfig
):
    """The sensor. Settings that are None are chosen from the recording."""

    _target: Type[SensorModel] = field(default_factory=lambda: SensorModel)  # noqa: UP006

    def setup(self) -> SensorModel:
        """The sensor of these settings.

        Raises:
            ValueError: The response or the colour filter does not exist.
        """
        return self._target(self)
