"""What events tell of their sensor: closed forms, a sensor in a slow loop, and simulated recordings of known truth."""

from __future__ import annotations

import copy
import json
import math
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from waves import HEIGHT, WIDTH, events_of_waves, recording_of

from enerf_ns.choices.resolver import resolve
from enerf_ns.dataparsers.formats.registry import read_recording
from enerf_ns.dataparsers.index.event_index import EventIndex
from enerf_ns.dataparsers.index.indexing import index_events
from enerf_ns.dataparsers.recording.recording import Events
from enerf_ns.dataparsers.sensor_estimates import estimates as sensor_estimates
from enerf_ns.dataparsers.sensor_estimates.estimates import (
    ASSUMED_THRESHOLD,
    FEWEST_SLOPE,
    contrast_thresholds,
    noise_per_event,
    refractory_period,
    share_closer,
    threshold_differences,
    threshold_spread,
)
from enerf_ns.method.config import enerf
from enerf_ns.method.pipeline import EnerfPipelineConfig
from enerf_ns.simulator.engine import simulate
from enerf_ns.simulator.event_sensor import SensorSettings
from enerf_ns.simulator.settings import SimulationSettings


def index_of(times: np.ndarray, is_on: np.ndarray) -> EventIndex:
    """Events of pixels, both [pixels, events]; times in ns, increasing within each."""
    pixel = np.repeat(np.arange(len(times)), times.shape[1])
    order = np.argsort(times.ravel(), kind="stable")
    polarity = np.where(is_on.ravel(), 1, -1)[order]
    return EventIndex.from_events(
        Events(pixel[order], np.zeros_like(pixel), times.ravel()[order], polarity), len(times), 1
    )


def poisson(dead_time: float, jitter: float = 0.0, pixels: int = 500, number: int = 100) -> EventIndex:
    """A Poisson process of 100 events a second at each pixel after each dead time, of either polarity at random."""
    generator = np.random.default_rng(2)
    times = np.cumsum(dead_time + generator.exponential(1e7, (pixels, number)), axis=1)
    times = np.sort(10**9 + times + jitter * generator.standard_normal(times.shape), axis=1).astype(np.int64)
    return index_of(times, generator.random(times.shape) < 0.5)


@pytest.mark.parametrize(("period", "jitter"), [(1e6, 0.0), (8e6, 0.0), (8e6, 1e5), (25e6, 3e5)])
def test_the_dead_time_of_a_poisson_process_is_its_refractory_period(period: float, jitter: float):
    found = refractory_period(poisson(period, jitter))
    assert found is not None and abs(found.value - period) < 3 * found.error
    assert found.value == pytest.approx(period, rel=0.04) and found.error < 0.1 * period


def test_processes_without_dead_time_show_none():
    assert refractory_period(poisson(0.0)) is None
    assert refractory_period(poisson(1e4)) is None, "10 µs, while 1 % of the intervals are shorter than 100 µs"


def test_a_ramp_shows_none():
    """All intervals are alike, as those of a blind sensor are, but brightness never turns back."""
    times = 10**9 + np.arange(100) * 5_000_000 + np.zeros((500, 1), np.int64)
    assert refractory_period(index_of(times, np.ones_like(times, bool))) is None


def test_smooth_brightness_shows_none_and_a_blind_sensor_its_period():
    camera = WIDTH, HEIGHT
    assert refractory_period(EventIndex.from_events(events_of_waves((0.05, 0.05), 1.0), *camera)) is None
    found = refractory_period(EventIndex.from_events(events_of_waves((0.003, 0.003), 1.0, 8_000_000), *camera))
    assert found is not None and abs(found.value - 8e6) < 3 * found.error < 3e6


@pytest.mark.sweep(1)
@pytest.mark.parametrize("threshold", [0.01, 0.02])
def test_a_period_is_told_of_brightness_that_takes_as_long_again_to_turn_back(threshold: float):
    """Turning back takes 1.3 and 1.6 times as long as going on, where it would take 12 and more without blindness."""
    camera, thresholds = (WIDTH, HEIGHT), (threshold, threshold)
    assert refractory_period(EventIndex.from_events(events_of_waves(thresholds, 3.0), *camera)) is None
    found = refractory_period(EventIndex.from_events(events_of_waves(thresholds, 3.0, 8_000_000), *camera))
    assert found is not None and found.value == pytest.approx(8e6, rel=0.1)
    assert abs(found.value - 8e6) < found.error < 3e6


def test_thresholds_are_those_of_a_blind_sensor_also_where_only_a_flag_says_that_it_is(tmp_path: Path):
    frames = np.arange(1, 100) * 10_000_000
    recording = recording_of(events_of_waves((0.06, 0.04), 1.0, 8_000_000), tmp_path, frames)
    assert refractory_period(index_events(recording)) is None and not recording.refractory_period
    on, off, is_measured = contrast_thresholds(recording, 8_000_000)
    assert is_measured and abs(on.value - 0.06) < 2 * on.error and abs(off.value - 0.04) < 2 * off.error
    taken_for_one_that_sees_all, _, _ = contrast_thresholds(recording, 0)
    assert abs(taken_for_one_that_sees_all.value - 0.06) > 2 * on.error


def test_a_short_recording_tells_nothing():
    few = poisson(8e6, pixels=50)
    assert len(few) == 5000 and refractory_period(few) is None
    one = index_of(np.array([[10**9]]), np.array([[True]]))
    assert refractory_period(one) is None and threshold_spread(one, (0.25, 0.25)) is None
    assert noise_per_event(one, (0.25, 0.25)).error == math.inf and share_closer(one, 10**9) == 0
    equal = index_of(np.full((500, 100), 10**9), np.random.default_rng(0).random((500, 100)) < 0.5)
    assert refractory_period(equal) is None


@pytest.mark.parametrize(("duration", "is_long"), [(0.03, False), (3.0, True)])
def test_a_recording_too_short_to_tell_a_parameter_keeps_what_it_starts_from(
    tmp_path: Path, duration: float, is_long: bool
):
    recording = recording_of(events_of_waves((0.25, 0.25), duration), tmp_path)
    config = copy.deepcopy(enerf.config.pipeline)
    assert isinstance(config, EnerfPipelineConfig)
    config.datamanager.dataparser.depth_range = (1.0, 4.0)
    config.model.sensor.refractory_period_ns = 1_000_000  # where pixels are never blind, counts tell the ratio
    found = resolve(config, recording)
    rows = {row.part: row for row in found.choices}
    assert rows["leak"].kept == found.values["model.sensor.learn_leak_rate"] == is_long
    assert f"{len(index_events(recording)):,} events determine it within" in rows["leak"].why
    assert found.values["model.sensor.learn_threshold_ratio"] == is_long
    for part in ("leak", "threshold per polarity"):
        assert ("too few" in rows[part].why) != is_long
    assert not rows["bandwidth"].kept and "blind" in rows["bandwidth"].why


def test_close_intervals_are_counted_as_in_a_loop():
    index = poisson(0.0, pixels=20, number=30)
    intervals = []
    for pixel in range(20):
        times = index.times[index.offsets[pixel] : index.offsets[pixel + 1]].tolist()
        intervals += [after - before for before, after in pairwise(times)]
    expected = sum(interval < 5_000_000 for interval in intervals) / len(intervals)
    assert 0.2 < expected < 0.6 and share_closer(index, 5_000_000) == pytest.approx(expected)


def test_the_noise_of_coins_is_one_squared_threshold_an_event():
    found = noise_per_event(poisson(0.0, pixels=2000), (0.25, 0.25))
    assert abs(found.value - 1) < 3 * found.error < 0.5
    assert threshold_spread(poisson(0.0, pixels=2000), (0.25, 0.25)) is None


def test_the_unit_of_noise_is_the_mean_threshold():
    """On events of 1.5 and off events of 0.5, at random: the variance of each is 1, about their mean of 0.5."""
    found = noise_per_event(poisson(0.0, pixels=2000), (0.3, 0.1))
    assert abs(found.value - 1) < 3 * found.error < 0.5


def test_alternating_events_have_no_noise():
    times = 10**9 + np.cumsum(np.random.default_rng(3).integers(10**6, 10**7, (500, 100)), axis=1)
    found = noise_per_event(index_of(times, (np.arange(100) % 2 + np.zeros((500, 1))) > 0), (0.25, 0.25))
    assert found.value < 0.01 and found.error < 0.01


def test_the_spread_of_thresholds_is_found_and_none_where_there_is_none():
    for spread in (0.0, 0.15):
        index = EventIndex.from_events(events_of_waves((0.14, 0.1), 2.0, spread=spread), WIDTH, HEIGHT)
        found = threshold_spread(index, (0.14, 0.1))
        if not spread:
            assert found is None
        else:
            assert found is not None and abs(found.value - spread) < 3 * found.error < 0.1


def test_the_difference_of_the_thresholds_of_a_pixel_is_the_slope_of_its_sum(monkeypatch: pytest.MonkeyPatch):
    """By NumPy's fits, but for what all pixels have in common; however many are looked at together."""
    generator = np.random.default_rng(6)
    numbers = generator.integers(3, 90, 23)
    pixel = np.repeat(np.arange(23), numbers)
    is_on = generator.random(len(pixel)) < 0.4
    times = 10**9 + np.arange(len(pixel))
    index = EventIndex.from_events(Events(pixel, np.zeros_like(pixel), times, np.where(is_on, 1, -1)), 23, 1)
    monkeypatch.setattr(sensor_estimates, "PIXELS_AT_ONCE", 7)
    difference, variance = (column.numpy() for column in threshold_differences(index, (0.24, 0.16), 0.1))
    told = numbers >= FEWEST_SLOPE
    assert (difference[~told] == 0.0).all() and np.isinf(variance[~told]).all() and (variance[told] < 1.0).all()
    slopes = []
    for number in np.flatnonzero(told):
        steps = np.where(is_on[pixel == number], 1.2, -0.8)
        slopes.append(np.polyfit(0.5 * np.abs(steps).cumsum(), steps.cumsum(), 1)[0])
    common = difference[told] + slopes
    columns = np.stack([np.ones(told.sum()), 1 / numbers[told]], axis=1)
    fitted = columns @ np.linalg.lstsq(columns, common, rcond=None)[0]
    np.testing.assert_allclose(common, fitted, atol=1e-6)


def test_the_counts_of_both_polarities_tell_the_ratio_and_the_mean_is_assumed(tmp_path: Path):
    recording = recording_of(events_of_waves((0.14, 0.1), 2.0), tmp_path)
    on, off, is_measured = contrast_thresholds(recording, blind_for=0)
    assert not is_measured and (on.value + off.value) / 2 == pytest.approx(ASSUMED_THRESHOLD)
    assert on.value / off.value == pytest.approx(1.4, rel=0.03) and abs(on.value - 0.25 * 2.8 / 2.4) < 3 * on.error
    assert 0 < on.error < 0.02 and 0 < off.error < 0.02


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("polarity", [True, False])
def test_events_of_one_polarity_show_no_spread_of_thresholds(polarity: bool):
    """All sums of as many events are equal, so that there is no variance to divide by."""
    times = 10**9 + np.cumsum(np.random.default_rng(3).integers(10**6, 10**7, (500, 100)), axis=1)
    index = index_of(times, np.full(times.shape, polarity))
    assert refractory_period(index) is None and threshold_spread(index, (0.25, 0.25)) is None


def test_counts_of_a_blind_sensor_tell_nothing(tmp_path: Path):
    recording = recording_of(events_of_waves((0.14, 0.1), 1.0, 20_000_000), tmp_path)
    on, off, is_measured = contrast_thresholds(recording, blind_for=8_000_000)
    assert (on.value, off.value, on.error, off.error, is_measured) == (0.25, 0.25, math.inf, math.inf, False)


def test_events_of_one_polarity_tell_nothing(tmp_path: Path):
    times, pixels = np.repeat(np.arange(1, 100) * 10**7, 64), np.tile(np.arange(64), 99)
    events = Events(pixels % 8, pixels // 8, times, np.ones(len(times), int))
    on, off, is_measured = contrast_thresholds(recording_of(events, tmp_path), blind_for=0)
    assert (on.value, off.value, on.error, off.error, is_measured) == (0.25, 0.25, math.inf, math.inf, False)


@pytest.mark.sweep(1)
@pytest.mark.slow
@pytest.mark.parametrize(
    ("sensor", "noise"),
    [
        (SensorSettings(), (0.0, 0.02)),
        (SensorSettings(contrast_thresholds=(0.28, 0.2), threshold_spread=0.06), (0.0, 0.04)),
        (SensorSettings(shot_noise_rate=20.0), (0.03, 0.2)),
        (SensorSettings(contrast_thresholds=(0.28, 0.2), refractory_period=8_000_000), (0.2, 2.0)),
        (SensorSettings(refractory_period=1_000_000), (0.0, 1.0)),
    ],
    ids=["ideal", "spread", "noisy", "blind", "blind for a millisecond"],
)
def test_simulated_sensors_are_told(tmp_path: Path, sensor: SensorSettings, noise: tuple[float, float]):
    folder = tmp_path / "recording"
    simulate(SimulationSettings("shapes", duration=1.0, num_frames=41, width=120, height=90, sensor=sensor), folder)
    recording = read_recording(folder)
    truth = json.loads((folder / "simulation.json").read_text())["sensor"]
    index, (true_on, true_off) = index_events(recording), truth["contrast_thresholds"]
    period = refractory_period(index)
    if truth["refractory_period"] == 8_000_000:
        assert period is not None and abs(period.value - 8e6) < 3 * period.error < 1e6
    elif truth["refractory_period"]:
        assert period is None or abs(period.value - 1e6) < 3 * period.error
    else:
        assert period is None
    on, off, is_measured = contrast_thresholds(recording, blind_for=truth["refractory_period"])
    if is_measured:
        assert abs(on.value - true_on) < 3 * on.error and abs(off.value - true_off) < 3 * off.error
    assert is_measured or truth["refractory_period"]
    spread = threshold_spread(index, (true_on, true_off))
    if truth["threshold_spread"]:
        assert spread is not None and abs(spread.value - truth["threshold_spread"]) < 3 * spread.error < 0.03
    else:
        assert spread is None
    found = noise_per_event(index, (true_on, true_off))
    assert noise[0] < found.value + 1e-9 and found.value < noise[1]
