"""The refractory period: the time after an event in which a pixel sees nothing."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, Optional

import torch
from jaxtyping import Float64, Int64
from torch import Tensor, nn

from enerf_ns.dataparsers.recording.recording import LONGEST_REFRACTORY_PERIOD
from enerf_ns.dataparsers.sensor_estimates.estimates import refractory_period
from enerf_ns.sensor.part import SensorChoices, SensorPart, SensorPartConfig, Trained

SETTING = "model.sensor.refractory_period_ns"


@dataclass
class RefractoryPeriodConfig(SensorPartConfig):
    """Settings of the refractory period."""

    refractory_period_ns: Optional[int] = None  # noqa: UP045
    """Time (ns) for which a pixel is blind after an event. Default: the period that the recording states, else the one
    that the shortest intervals between events show."""
    learn_refractory_period: bool = False
    """Learn the refractory period, starting from refractory-period-ns. Each step then takes longer, since rays have
    gradients, and sums of events are not completed by what pixels missed, which would keep the starting period."""


class RefractoryPeriod(SensorPart):
    """Pixels that are blind for a while after each event (Robust e-NeRF, Low and Lee, ICCV 2023)."""

    trained: ClassVar = {"refractory_period": Trained("log_refractory_period", 3e-3)}
    setting_ranges: ClassVar = {"refractory_period_ns": (0, LONGEST_REFRACTORY_PERIOD)}

    def __init__(self, config: RefractoryPeriodConfig):
        super().__init__(config)
        assert config.refractory_period_ns is not None
        self.refractory_period = config.refractory_period_ns
        """Time (ns) for which a pixel is blind after an event, before anything is learned of it."""
        self.log_refractory_period = None
        if config.learn_refractory_period and config.refractory_period_ns:
            self.log_refractory_period = nn.Parameter(torch.tensor(math.log(config.refractory_period_ns)).double())

    @classmethod
    def choose(cls, scene: SensorChoices) -> None:
        """Adds the row of the refractory period, which `chosen_refractory_period` decides."""
        blind, found = scene.once(chosen_refractory_period)
        value = f"blind for {blind * 1e-6:.4g} ms after an event" if blind else ""
        why = found if blind else "the recording states none, and its events show none"
        scene.row("refractory period", scene.use_events and bool(blind), value, scene.why(SETTING, why), SETTING)

    def blind_after(
        self, event: Int64[Tensor, "*batch"], until: Int64[Tensor, "*batch"]
    ) -> Float64[Tensor, "*batch"] | None:
        """Time (ns) for which a pixel is blind after an event; None for a sensor that never is.

        After this time the pixel compares brightness with the first that it sees, so that the interval that its next
        events measure begins then. That interval lasts at least 1 ns.

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

    def learned(self) -> dict[str, float]:
        """Values of the sensor that were learned: with `refractory_period_ms`, milliseconds."""
        found = super().learned()
        if self.log_refractory_period is not None:
            found["refractory_period_ms"] = 1e-6 * self.log_refractory_period.exp().item()
        return found


def chosen_refractory_period(scene: SensorChoices) -> tuple[int, str]:
    """The refractory period (ns) of a scene, 0 for none, and the reason for it."""
    why = "the recording states it"

    def from_recording() -> int:
        nonlocal why
        if scene.recording.refractory_period or not scene.learns_sensor:
            return scene.recording.refractory_period
        found = refractory_period(scene.index)
        why = found.why if found else ""
        return round(found.value) if found else 0

    return scene.use(SETTING, from_recording), why
