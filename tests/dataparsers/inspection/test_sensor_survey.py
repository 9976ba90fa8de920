"""What is stated of a sensor, beside what was found."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from waves import events_of_waves, recording_of

from enerf_ns.dataparsers.formats.registry import read_recording
from enerf_ns.dataparsers.inspection.sensor_survey import SensorSurvey
from enerf_ns.dataparsers.recording.recording import EventRecording

FRAMES = np.arange(1, 40) * 25_000_000


def found_of(recording: EventRecording) -> list[str]:
    return [problem.what for problem in SensorSurvey.of(recording).problems()]


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> EventRecording:
    return recording_of(events_of_waves((0.07, 0.05), 1.0), tmp_path_factory.mktemp("waves"))


def test_a_ratio_that_counts_contradict_is_a_problem(recording: EventRecording):
    assert found_of(recording) == [] == found_of(replace(recording, contrast_thresholds=(0.14, 0.1)))
    (problem,) = found_of(replace(recording, contrast_thresholds=(0.25, 0.25)))
    assert problem.startswith("The events of both polarities balance if C_on = 1.4")
    assert problem.endswith("C_off, but the recording states 0.25 and 0.25, which is 1.")


def test_a_mean_that_frames_contradict_is_a_problem(tmp_path: Path):
    recording = recording_of(events_of_waves((0.28, 0.2), 1.0), tmp_path, FRAMES)
    assert found_of(replace(recording, contrast_thresholds=(0.28, 0.2))) == []
    (problem,) = found_of(replace(recording, contrast_thresholds=(0.56, 0.4)))
    assert problem.startswith("Events explain the frames best with thresholds of 0.2")
    assert "± 0.0" in SensorSurvey.of(recording).rows()["thresholds"]


def test_a_refractory_period_that_events_contradict_is_a_problem(recording: EventRecording, tmp_path: Path):
    (problem,) = found_of(replace(recording, refractory_period=50_000_000))
    assert problem.startswith("The recording states a refractory period of 50 ms, but ")
    blind = recording_of(events_of_waves((0.003, 0.003), 1.0, 8_000_000), tmp_path)
    assert found_of(replace(blind, refractory_period=8_000_000)) == [] == found_of(blind)
    (problem,) = found_of(replace(blind, refractory_period=8_000))
    assert re.match(r"Events show a refractory period of (7.9|8)\d* ±", problem) and "states 0.008 ms" in problem
    rows = SensorSurvey.of(replace(blind, refractory_period=8_000_000)).rows()
    assert re.match(r"8 ms stated; (7.9|8)\d* ", rows["refractory"]) and "(assumed)" in rows["thresholds"]


@pytest.mark.slow
def test_slider_depth(shared_data: Path):
    """A DAVIS240C, whose frames disturb its events. Fields that learnt from them with thresholds of 0.54 and 0.35, as
    least squares had them, have half of the contrast of held-out frames."""
    survey = SensorSurvey.of(read_recording(shared_data / "slider_depth"))
    (on, off), bursts = survey.contrast_thresholds, survey.bursts
    assert survey.is_mean_measured and survey.problems() == [] and survey.refractory_period is None
    assert 0.7 < on.value < 1.0 and 0.5 < off.value < 0.8 and max(on.error, off.error) < 0.1
    assert bursts is not None and len(bursts.delays) == 2 and 0.08 < bursts.excess < 0.13
    assert bursts.delays[0, 0] < 0 < bursts.delays[1, 0] and bursts.ratio.max() > 10
