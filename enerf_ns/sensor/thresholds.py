"""The contrast thresholds of the sensor, C_on and C_off."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, NamedTuple, Optional, Tuple  # noqa: UP035 - tyro reads these annotations on Python 3.10

import torch
from torch import Tensor, nn

from enerf_ns.dataparsers.index.event_index import EventIndex
from enerf_ns.dataparsers.recording.recording import CONTRAST_THRESHOLD_LIMITS
from enerf_ns.dataparsers.sensor_estimates.estimates import Estimate, contrast_thresholds
from enerf_ns.events.batch import EventBatch
from enerf_ns.sensor.part import SensorChoices, SensorPart, SensorPartConfig, Trained
from enerf_ns.sensor.refractory_period import chosen_refractory_period

LARGEST_RATIO_ERROR = 0.05
"""Largest relative standard error with which events may determine C_on / C_off for it to be learned."""

SETTING = "model.sensor.contrast_thresholds"


@dataclass
class ThresholdsConfig(SensorPartConfig):
    """Settings of the contrast thresholds."""

    contrast_thresholds: Optional[Tuple[float, float]] = None  # noqa: UP006, UP045
    """Contrast thresholds C_on and C_off, in units of log brightness. Default: the thresholds that the recording
    states, else an estimate from its frames, else one from the counts of both polarities and an assumed mean."""
    learn_threshold_ratio: Optional[bool] = None  # noqa: UP045
    """Learn C_on / C_off, and keep their mean. Default: yes if the recording does not state the thresholds, and pixels
    are blind after events, so that the counts of both polarities mislead."""
    learn_mean_threshold: Optional[bool] = None  # noqa: UP045
    """Learn the mean of C_on and C_off, which only frames determine. Default: yes if the field learns from frames as
    well, and the recording does not state the thresholds."""


class Thresholds(SensorPart):
    """Pixels that fire one event for each contrast threshold by which log brightness rises or falls."""

    trained: ClassVar = {
        "threshold_ratio": Trained("log_ratio", 1e-2),
        "mean_threshold": Trained("log_mean", 3e-3),
    }
    setting_ranges: ClassVar = {"contrast_thresholds": CONTRAST_THRESHOLD_LIMITS}

    def __init__(self, config: ThresholdsConfig):
        super().__init__(config)
        assert config.contrast_thresholds is not None
        on, off = config.contrast_thresholds
        self._contrast_thresholds = on, off
        self.log_mean = nn.Parameter(torch.tensor(math.log(0.5 * (on + off)))) if config.learn_mean_threshold else None
        self.log_ratio = nn.Parameter(torch.tensor(math.log(on / off))) if config.learn_threshold_ratio else None

    @classmethod
    def choose(cls, scene: SensorChoices) -> None:
        """Decides the thresholds, and whether their ratio and their mean are learned."""
        (on, off), estimate, _ = scene.once(chosen_thresholds)
        index, enough = scene.once(unknown_events), scene.once(enough_for_thresholds)
        blind, _ = scene.once(chosen_refractory_period)
        # where pixels are never blind, counts determine it better: on slider_depth what was learned drifted by a fifth
        ratio = scene.use("model.sensor.learn_threshold_ratio", lambda: enough and bool(blind))
        mean = scene.use("model.sensor.learn_mean_threshold", lambda: enough and scene.use_frames)
        why = scene.why(SETTING, "the recording states them" if estimate is None else estimate.why)
        if index is not None and not enough:
            why += f"; {len(index):,} events are too few to learn more"
        learned = " and ".join(["their ratio"] * ratio + ["their mean"] * mean)
        value = f"on {on:.3f}, off {off:.3f}" if on != off else f"{on:.3f} for both"
        value += f"; {learned} {'are' if ratio and mean else 'is'} learned" if learned else ""
        scene.row("threshold per polarity", scene.use_events and (on != off or ratio), value, why, SETTING)

    @property
    def contrast_thresholds(self) -> tuple[float | Tensor, float | Tensor]:
        """C_on and C_off of the sensor, in units of log brightness: numbers, or tensors if they are learned."""
        on, off = self._contrast_thresholds
        if self.log_ratio is None and self.log_mean is None:
            return on, off
        both = on + off if self.log_mean is None else 2.0 * self.log_mean.exp()
        if self.log_ratio is None:
            return both * (on / (on + off)), both * (off / (on + off))
        return both * torch.sigmoid(self.log_ratio), both * torch.sigmoid(-self.log_ratio)

    @property
    def mean_threshold(self) -> float | Tensor:
        """Mean contrast threshold: the unit in which losses count changes of log brightness.

        A mean that is learned is learned as that unit: rendered changes in thresholds are fitted to the events, and not
        events times the threshold to rendered changes. The noise of the events is then an error of the regressand. As
        an error of the regressor it would draw the threshold to 0 (attenuation).
        """
        return 0.5 * sum(self._contrast_thresholds) if self.log_mean is None else self.log_mean.exp()

    def steps(self, batch: EventBatch) -> tuple[Tensor, Tensor]:
        """Log brightness by which the on events of each pair rise, and by which its off events fall; shape (pairs)."""
        c_on, c_off = self.contrast_thresholds
        return c_on * batch.on, c_off * batch.off

    def measured_change(self, batch: EventBatch) -> Tensor:
        """Change of log brightness that the pixels of each pair reported, shape (pairs): C_on times on events less
        C_off times off events, and what the batch states that brightness is ahead of the last event."""
        on, off = self.steps(batch)
        change = on - off
        if batch.ahead is not None:
            c_on, c_off = self.contrast_thresholds
            change = change + 0.5 * (c_on + c_off) * batch.ahead
        return change

    def learned(self) -> dict[str, float]:
        """Values of the sensor that were learned: with `threshold_on` and `threshold_off`."""
        found = super().learned()
        if self.log_ratio is not None or self.log_mean is not None:
            on, off = (torch.as_tensor(threshold).item() for threshold in self.contrast_thresholds)
            found |= {"threshold_on": on, "threshold_off": off}
        return found


def ratio_error(index: EventIndex) -> float:
    """Relative standard error with which events determine C_on / C_off when all else is known.

    Each event determines the change of brightness to about one threshold, independently of the others.
    """
    return 2.0 / math.sqrt(len(index))


class ChosenThresholds(NamedTuple):
    """The thresholds of a scene."""

    values: tuple[float, float]
    """C_on and C_off."""
    estimate: Estimate | None
    """The estimate of C_on if they are estimated."""
    is_assumed: bool
    """Whether their mean is assumed, since neither the recording nor a flag nor frames state it."""


def chosen_thresholds(scene: SensorChoices) -> ChosenThresholds:
    """The thresholds of a scene, and where they are from."""
    estimate, is_measured = None, True

    def from_recording() -> tuple[float, float]:
        nonlocal estimate, is_measured
        if scene.recording.contrast_thresholds is not None:
            return scene.recording.contrast_thresholds
        blind, _ = scene.once(chosen_refractory_period)
        estimate, off, is_measured = contrast_thresholds(scene.recording, blind)
        return estimate.value, off.value

    return ChosenThresholds(scene.use(SETTING, from_recording), estimate, not is_measured)


def unknown_events(scene: SensorChoices) -> EventIndex | None:
    """The events of a sensor whose thresholds nobody states, which is then measured and learned; None for others."""
    estimate = scene.once(chosen_thresholds).estimate
    return scene.index if scene.learns_sensor and estimate is not None else None


def enough_for_thresholds(scene: SensorChoices) -> bool:
    """Whether the events of an unknown sensor determine the ratio of its thresholds well enough to learn it."""
    index = scene.once(unknown_events)
    return index is not None and ratio_error(index) <= LARGEST_RATIO_ERROR


def balanced_thresholds(index: EventIndex) -> tuple[float, float]:
    """C_on and C_off with a mean of 1 under which all events together cancel."""
    num_on = max(index.num_positive, 1)
    num_off = max(len(index) - index.num_positive, 1)
    return 2.0 * num_off / (num_on + num_off), 2.0 * num_on / (num_on + num_off)
