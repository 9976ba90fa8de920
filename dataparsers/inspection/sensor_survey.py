"""Sensor parameters that a recording states, beside those that its events and frames show."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

from enerf_ns.dataparsers.index.indexing import index_events
from enerf_ns.dataparsers.inspection.frame_bursts import FrameBursts, frame_bursts
from enerf_ns.dataparsers.inspection.problems import Problem
from enerf_ns.dataparsers.recording.recording import EventRecording
from enerf_ns.dataparsers.sensor_estimates.estimates import (
    Estimate,
    contrast_thresholds,
    noise_per_event,
    refractory_period,
    share_closer,
    threshold_spread,
)

CONTRADICTED = 3.0
"""Standard errors by which a stated value must differ from the measured one to be a problem."""

HARMFUL_MEAN, HARMFUL_RATIO, HARMFUL_PERIOD = 0.2, 0.1, 0.1
"""Relative differences of the mean threshold, of the ratio of thresholds and of the refractory period, below which a
stated value is no problem."""

FASTER_EVENTS = 0.01
"""Largest share of intervals between events of a pixel that are shorter than the refractory period. Jitter causes
some."""


@dataclass(frozen=True)
class SensorSurvey:
    """Parameters of the sensor, measured from events and frames."""

    recording: EventRecording
    refractory_period: Estimate | None
    """Refractory period, ns. None if the events show none."""
    contrast_thresholds: tuple[Estimate, Estimate]
    """C_on and C_off."""
    is_mean_measured: bool
    """Whether the mean of the thresholds is measured, and not only their ratio."""
    threshold_spread: Estimate | None
    """Relative standard deviation of the thresholds over pixels. None if it does not differ significantly from 0."""
    noise_per_event: Estimate
    """Variance that each event adds, in squared mean thresholds."""
    bursts: FrameBursts | None
    """Bursts of events that come with frames."""

    @classmethod
    def of(cls, recording: EventRecording) -> SensorSurvey:
        """Measures the sensor from events, and from frames of the same camera. Takes seconds.

        Raises:
            RecordingError: The events or a frame cannot be used.
        """
        index = index_events(recording)
        period = refractory_period(index)
        blind_for = recording.refractory_period or (round(period.value) if period else 0)
        on, off, is_measured = contrast_thresholds(recording, blind_for)
        thresholds = on.value, off.value
        return cls(
            recording,
            period,
            (on, off),
            is_measured,
            threshold_spread(index, thresholds),
            noise_per_event(index, thresholds),
            frame_bursts(recording),
        )

    def rows(self) -> dict[str, str]:
        """Stated and measured parameters in words, by name."""
        recording, (on, off) = self.recording, self.contrast_thresholds
        stated = recording.contrast_thresholds
        measured = f"{_with_error(on)} on, {_with_error(off)} off: {on.why}"
        if not self.is_mean_measured and math.isfinite(on.error):
            measured = f"C_on = {on.value / off.value:.3g} ± {self._ratio_error:.1g} C_off: {on.why}"
        period, spread, noise = self.refractory_period, self.threshold_spread, self.noise_per_event
        rows = {"thresholds": ("{:.3g} on, {:.3g} off stated; ".format(*stated) if stated else "") + measured}
        rows["refractory"] = f"{recording.refractory_period * 1e-6:g} ms stated; " * bool(recording.refractory_period)
        rows["refractory"] += f"{_with_error(period, 1e-6)} ms: {period.why}" if period else "the events show none"
        rows["spread"] = (
            f"thresholds differ by {_with_error(spread, 100)} % from pixel to pixel: {spread.why}"
            if spread
            else "of thresholds from pixel to pixel: not significantly different from 0"
        )
        rows["noise"] = (
            f"{_with_error(noise)} squared thresholds per event: {noise.why}"
            if math.isfinite(noise.error)
            else f"unknown: {noise.why}"
        )
        if recording.has_frames:
            rows["frame bursts"] = self.bursts.words() if self.bursts else "none at the stamps of the frames"
        return rows

    def problems(self) -> list[Problem]:
        """Stated parameters that events or frames contradict."""
        return [*self._threshold_problems(), *self._period_problems()]

    @property
    def _ratio_error(self) -> float:
        on, off = self.contrast_thresholds
        relative = on.error / on.value + off.error / off.value
        if self.is_mean_measured:
            relative = math.hypot(on.error / on.value, off.error / off.value)
        return on.value / off.value * relative

    def _threshold_problems(self) -> Iterator[Problem]:
        if self.recording.contrast_thresholds is None:
            return
        (stated_on, stated_off), (on, off) = self.recording.contrast_thresholds, self.contrast_thresholds
        mean, stated_mean = (on.value + off.value) / 2, (stated_on + stated_off) / 2
        error = (on.error + off.error) / 2
        stated = f"the recording states {stated_on:.3g} and {stated_off:.3g}"
        if self.is_mean_measured and abs(mean - stated_mean) > max(CONTRADICTED * error, HARMFUL_MEAN * mean):
            yield Problem(
                f"Events explain the frames best with thresholds of {_with_error(on)} (on) and {_with_error(off)} "
                f"(off), but {stated}.",
                "Check the thresholds, whether the frames are linear in brightness and not gamma-encoded, and the "
                "response that is stated; otherwise frames and events contradict each other in training.",
            )
            return
        ratio, stated_ratio = on.value / off.value, stated_on / stated_off
        if abs(ratio - stated_ratio) > max(CONTRADICTED * self._ratio_error, HARMFUL_RATIO * ratio):
            yield Problem(
                f"The events of both polarities balance if C_on = {ratio:.3g} ± {self._ratio_error:.1g} C_off, but "
                f"{stated}, which is {stated_ratio:.3g}.",
                "Check the thresholds of on and off events, and that no light was switched or dimmed.",
            )

    def _period_problems(self) -> Iterator[Problem]:
        stated, found = self.recording.refractory_period, self.refractory_period
        if not stated:
            return
        if found is not None:
            if abs(found.value - stated) > max(CONTRADICTED * found.error, HARMFUL_PERIOD * stated):
                yield Problem(
                    f"Events show a refractory period of {_with_error(found, 1e-6)} ms, but the recording states "
                    f"{stated * 1e-6:g} ms.",
                    "Check the refractory period and its unit.",
                )
        elif (share := share_closer(index_events(self.recording), stated)) > FASTER_EVENTS:
            yield Problem(
                f"The recording states a refractory period of {stated * 1e-6:g} ms, but {100 * share:.0f} % of the "
                "intervals between events of a pixel are shorter.",
                "Check the refractory period and its unit.",
            )


def _with_error(estimate: Estimate, scale: float = 1.0) -> str:
    """A value and its standard error in words. An infinite error marks an assumed value."""
    if not math.isfinite(estimate.error):
        return f"{scale * estimate.value:.3g} (assumed)"
    return f"{scale * estimate.value:.3g} ± {scale * estimate.error:.1g}"
