"""Thresholds from frames, of waves with known ones."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from waves import CAMERA, events_of_waves, recording_of

from enerf_ns.dataparsers.recording.recording import EventRecording, Events
from enerf_ns.dataparsers.sensor_estimates.frame_contrast import (
    exposure_change,
    mean_brightness,
    thresholds_from_frames,
)

FRAMES = np.arange(1, 40) * 25_000_000


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> EventRecording:
    return recording_of(events_of_waves((0.28, 0.2), 1.0), tmp_path_factory.mktemp("waves"), FRAMES)


def test_both_thresholds_are_measured(recording: EventRecording):
    found = thresholds_from_frames(recording, 0)
    assert found is not None
    values, errors, _ = found
    np.testing.assert_allclose(values, (0.28, 0.2), rtol=0.04)
    assert np.all(np.abs(values - (0.28, 0.2)) < 2 * errors) and np.all(errors < 0.1 * values)


def test_exposure_that_changes_is_told_and_taken_off(recording: EventRecording, tmp_path: Path):
    """By pixels without events; thresholds are then those of frames that were exposed alike."""
    frames = recording.frames
    assert frames is not None
    steady = exposure_change(recording, frames)
    assert steady is not None and steady < 0.035  # of waves, whose crests all move alike
    gains = np.random.default_rng(1).uniform(0.7, 1.0, len(frames.times))
    names = tuple(tmp_path / name.name for name in frames.filenames)
    for file, name, gain in zip(frames.filenames, names, gains, strict=True):
        Image.fromarray((gain * np.asarray(Image.open(file)) + 0.5).astype(np.uint8)).save(name)
    changing = replace(recording, frames=replace(frames, filenames=names))
    assert changing.frames is not None
    change = exposure_change(changing, changing.frames)
    assert change == pytest.approx(np.sqrt(np.mean(np.diff(np.log(gains)) ** 2)), rel=0.3)
    found, right = (thresholds_from_frames(one, 0) for one in (changing, recording))
    assert found is not None and right is not None
    np.testing.assert_allclose(found[0], right[0], rtol=0.05)


def test_thresholds_are_in_the_units_of_the_stated_response(recording: EventRecording):
    """An offset of 0.5 makes log brightness vary less, by the same events."""
    plain = thresholds_from_frames(recording, 0)
    flat = thresholds_from_frames(replace(recording, response="logarithm:0.5"), 0)
    assert plain is not None and flat is not None and np.all(flat[0] < 0.6 * plain[0])


def test_intervals_between_frames_tell_the_thresholds_of_a_blind_sensor(tmp_path: Path):
    frames = np.arange(1, 100) * 10_000_000
    recording = recording_of(events_of_waves((0.28, 0.2), 1.0, 20_000_000), tmp_path, frames)
    found = thresholds_from_frames(recording, 20_000_000)
    assert found is not None
    values, errors, why = found
    assert np.all(np.abs(values - (0.28, 0.2)) < 2 * errors) and np.all(errors < 0.3 * values)
    assert "enclose" in why


def test_frames_of_another_camera_and_reconstructed_ones_tell_nothing(recording: EventRecording):
    frames = recording.frames
    assert frames is not None and thresholds_from_frames(replace(recording, frames=None), 0) is None
    other = replace(frames, camera=replace(CAMERA, cx=20.0))
    assert thresholds_from_frames(replace(recording, frames=other), 0) is None
    reconstructed = replace(recording, frames=None, blurred_frames=frames, reconstructed_by="E2VID")
    assert thresholds_from_frames(reconstructed, 0) is None
    assert thresholds_from_frames(replace(reconstructed, reconstructed_by=None), 0) is not None


def test_few_or_dark_frames_tell_nothing(recording: EventRecording, tmp_path: Path):
    assert recording.frames is not None
    for number in (0, 1, 2):
        few = replace(recording, frames=recording.frames.subset(np.arange(number)) if number else None)
        assert thresholds_from_frames(few, 0) is None
    events = events_of_waves((0.28, 0.2), 0.3)
    dark = recording_of(events, tmp_path, FRAMES[:10])
    assert dark.frames is not None
    for file in dark.frames.filenames:
        Image.fromarray((np.asarray(Image.open(file)) // 16).astype(np.uint8)).save(file)
    assert thresholds_from_frames(dark, 0) is None


def test_unrelated_frames_have_large_errors_or_tell_nothing(recording: EventRecording):
    frames = recording.frames
    assert frames is not None
    shuffled = np.random.default_rng(0).permutation(len(frames.times))
    mixed = replace(frames, filenames=tuple(frames.filenames[i] for i in shuffled))
    assert thresholds_from_frames(replace(recording, frames=mixed), 0) is None


def test_noise_of_the_events_does_not_make_them_worth_less(tmp_path: Path):
    """As many events of either polarity by chance as of the waves: by least squares, each were worth much less."""
    waves, rng = events_of_waves((0.28, 0.2), 1.0), np.random.default_rng(4)
    number = len(waves.t)
    chance = (
        rng.integers(0, CAMERA.width, number),
        rng.integers(0, CAMERA.height, number),
        rng.integers(waves.t[0], waves.t[-1], number),
        rng.choice([-1, 1], number),
    )
    columns = [np.concatenate(both) for both in zip((waves.x, waves.y, waves.t, waves.p), chance, strict=True)]
    x, y, t, p = (column[np.argsort(columns[2], kind="stable")] for column in columns)
    noisy = recording_of(Events(x, y, t, p.astype(np.int8)), tmp_path, FRAMES)
    found = thresholds_from_frames(noisy, 0)
    assert found is not None
    np.testing.assert_allclose(found[0], (0.28, 0.2), rtol=0.15)


@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_the_level_of_brightness_is_a_mean_over_pixels_and_their_events(recording: EventRecording, share: float):
    frames = recording.frames
    assert frames is not None
    events = events_of_waves((0.28, 0.2), 1.0)
    counts = np.bincount(events.y * CAMERA.width + events.x, minlength=CAMERA.width * CAMERA.height)
    logs = [np.log(np.maximum(frames.image(i)[..., 0].ravel() / 255, 0.01)) for i in range(len(frames.times))]
    expected = np.exp((1 - share) * np.mean(logs) + share * np.average(np.mean(logs, axis=0), weights=counts))
    assert mean_brightness(recording, frames, share) == pytest.approx(expected, rel=0.02)


def test_what_is_black_does_not_count_in_the_level(recording: EventRecording, tmp_path: Path):
    frames = recording.frames
    assert frames is not None
    half = np.zeros((CAMERA.height, CAMERA.width), np.uint8)
    half[:, : CAMERA.width // 2] = 102
    for name, picture in (("black", np.zeros_like(half)), ("half", half)):
        Image.fromarray(picture).save(tmp_path / f"{name}.png")
    of_half, of_black = (
        replace(frames, filenames=(tmp_path / f"{name}.png",) * len(frames.times)) for name in ("half", "black")
    )
    assert mean_brightness(recording, of_half, 0.5) == pytest.approx(0.4)
    assert mean_brightness(recording, of_black, 0.5) is None


def test_frames_of_another_camera_do_not_tell_the_level(recording: EventRecording):
    frames = recording.frames
    assert frames is not None
    other = replace(frames, camera=replace(frames.camera, fx=frames.camera.fx + 1.0))
    assert mean_brightness(recording, other, 0.5) is None
