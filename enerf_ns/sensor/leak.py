"""The leak of a pixel's memory, which causes on events at a constant rate."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, Optional

import torch
from torch import Tensor, nn

from enerf_ns.dataparsers.index.event_index import EventIndex
from enerf_ns.events.batch import EventBatch
from enerf_ns.sensor.part import SensorChoices, Trained, choose_number
from enerf_ns.sensor.refractory_period import RefractoryPeriod, RefractoryPeriodConfig
from enerf_ns.sensor.thresholds import Thresholds, ThresholdsConfig, unknown_events

LARGEST_ERROR = 0.5
"""Largest standard error (on events a second) with which events may determine the leak rate for it to be learned."""


@dataclass
class LeakConfig(ThresholdsConfig, RefractoryPeriodConfig):
    """Settings of the leak."""

    leak_rate: float = 0.0
    """On events a second of a pixel that sees no change."""
    learn_leak_rate: Optional[bool] = None  # noqa: UP045
    """Learn the leak rate, starting from leak-rate. Default: yes if the recording does not state the thresholds, and is
    long enough to determine it."""


class Leak(Thresholds, RefractoryPeriod):
    """Pixels whose memory leaks, so that they fire on events without a change of brightness.

    Shot noise fires as many on as off events, which cancel where thresholds are equal. Elsewhere its rate times
    C_on - C_off remains, which is a leak as well.
    """

    trained: ClassVar = {"leak_rate": Trained("leak_rate", 3e-2)}
    setting_ranges: ClassVar = {"leak_rate": (0.0, 1e6)}

    def __init__(self, config: LeakConfig):
        super().__init__(config)
        self.leak_rate: Tensor | float = config.leak_rate
        if config.learn_leak_rate:
            self.leak_rate = nn.Parameter(torch.tensor(float(config.leak_rate)))

    @classmethod
    def choose(cls, scene: SensorChoices) -> None:
        """Decides whether the leak rate is learned."""
        index = scene.once(unknown_events)
        error = math.inf if index is None else leak_rate_error(index)
        choose_number(
            scene,
            "leak",
            "leak_rate",
            ("the leak of the memory of pixels", "{:g} on events a second"),
            index is not None,
            (error, LARGEST_ERROR, "on events a second"),
        )

    @property
    def leaks(self) -> bool:
        """Whether the memory of a pixel changes by itself."""
        return isinstance(self.leak_rate, Tensor) or self.leak_rate != 0.0

    def measured_change(self, batch: EventBatch) -> Tensor:
        """Change of log brightness that the pixels of each pair reported, shape (pairs), without the leak. For silent
        pairs this is the leak alone, with a minus."""
        change = super().measured_change(batch)
        if self.leaks:
            c_on, _ = self.contrast_thresholds
            seconds = 1e-9 * (batch.end - batch.start).double()
            blind = self.blind_after(batch.start, batch.end) if batch.starts_at_events else None
            if blind is not None:
                seconds[batch.of_events] -= 1e-9 * blind[batch.of_events]
            change = change - self.leak_rate * c_on * seconds.to(change.dtype)
        return change

    def learned(self) -> dict[str, float]:
        """Values of the sensor that were learned: with `leak_rate`, on events a second."""
        found = super().learned()
        if isinstance(self.leak_rate, Tensor):
            found["leak_rate"] = self.leak_rate.item()
        return found


def leak_rate_error(index: EventIndex) -> float:
    """Standard error (on events a second) with which events determine the leak rate when all else is known: as for any
    rate, the square root of the number of events over the time for which all pixels were watched."""
    watched = 1e-9 * int((index.offsets.diff() > 0).sum()) * int(index.times.max() - index.times.min())
    return math.sqrt(len(index)) / watched if watched else math.inf
