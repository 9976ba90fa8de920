"""Silence, the sensor's border and the range of brightness, against slow loops and closed forms."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
import torch

from enerf_ns.dataparsers.formats.registry import read_recording
from enerf_ns.dataparsers.index.event_index import EventIndex
from enerf_ns.dataparsers.index.indexing import index_events
from enerf_ns.dataparsers.recording.files import load_image
from enerf_ns.dataparsers.recording.recording import Events
from enerf_ns.events.statistics import border_rate, log_brightness_range, silent_share
from enerf_ns.sensor.response import Linlog

WIDTH, HEIGHT = 32, 16


def index_of(x: np.ndarray, y: np.ndarray, t: np.ndarray) -> EventIndex:
    return EventIndex.from_events(Events(x, y, t, np.ones(len(t), np.int8)), WIDTH, HEIGHT)


@pytest.mark.parametrize("silence", [1, 1000, 40_000, 10**7])
@pytest.mark.parametrize("zero", [0, 16 * 10**17])
def test_the_silent_share_is_that_of_a_loop(silence: int, zero: int):
    generator = np.random.default_rng(3)
    t = np.sort(generator.integers(0, 10**6, 3000))
    x, y = generator.integers(0, WIDTH, 3000), generator.integers(0, HEIGHT // 2, 3000)
    silent = total = 0
    for pixel in {(int(a), int(b)) for a, b in zip(x, y, strict=True)}:
        steps = np.diff(t[(x == pixel[0]) & (y == pixel[1])])
        silent, total = silent + steps[steps >= silence].sum(), total + steps.sum()
    index = index_of(x, y, t + zero)
    assert silent_share(index, silence) == pytest.approx(silent / total)
    assert silent_share(index, silence, at_most=1500) == pytest.approx(silent / total, abs=0.05)


def test_a_sensor_whose_pixels_fire_once_is_never_silent_between_events():
    assert silent_share(index_of(np.arange(8), np.zeros(8, int), np.arange(8)), 1) == 0.0


@pytest.mark.parametrize(("at_border", "elsewhere"), [(0, 3), (1, 2), (4, 4), (2, 0)])
def test_events_at_the_border_are_counted_against_the_others(at_border: int, elsewhere: int):
    x, y = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    border = (x < 2) | (x >= WIDTH - 2) | (y < 1) | (y >= HEIGHT - 1)
    times = np.where(border, at_border, elsewhere).ravel()
    x, y = np.repeat(x.ravel(), times), np.repeat(y.ravel(), times)
    rate = border_rate(index_of(x, y, np.arange(len(x))), HEIGHT)
    assert rate == pytest.approx(at_border / elsewhere if elsewhere else 1e9)


MANY_COLUMNS, MANY_ROWS = 100, 70  # more pixels than are looked at
THRESHOLDS = (0.2, 0.3)


def random_events() -> Events:
    generator = np.random.default_rng(0)
    number = 60_000
    x = generator.integers(0, MANY_COLUMNS, number).astype(np.uint16)
    y = generator.integers(0, MANY_ROWS - 10, number).astype(np.uint16)  # the last rows are silent
    polarity = (2 * (generator.random(number) < 0.6) - 1).astype(np.int8)
    return Events(x, y, np.sort(generator.integers(0, 10**9, number)), polarity)


def ranges_by_a_loop(events: Events, begin: float = 0, end: float = 10**9) -> list[float]:
    """Of each pixel with events, in the order of the pixels, from one time to another."""
    sums: dict[int, list[float]] = {}
    for x, y, p, t in zip(*(column.tolist() for column in (events.x, events.y, events.p, events.t)), strict=True):
        running = sums.setdefault(y * MANY_COLUMNS + x, [0.0])
        if begin <= t < end:
            running.append(running[-1] + (THRESHOLDS[0] if p > 0 else -THRESHOLDS[1]))
    return [max(running) - min(running) for _, running in sorted(sums.items())]


@pytest.mark.parametrize("share", [0.0, 0.5, 0.99, 1.0])
def test_it_is_the_quantile_over_pixels_of_how_far_their_sums_go(share: float):
    events = random_events()
    found = log_brightness_range(EventIndex.from_events(events, MANY_COLUMNS, MANY_ROWS), THRESHOLDS, share)
    assert found == pytest.approx(np.quantile(ranges_by_a_loop(events)[::2], share))


@pytest.mark.parametrize("share", [0.5, 0.99])
def test_of_parts_of_the_time_it_is_the_largest(share: float):
    events = random_events()
    first, last = int(events.t[0]), int(events.t[-1]) + 1
    ends = [first + (last - first) * part / 3 for part in range(4)]
    index = EventIndex.from_events(events, MANY_COLUMNS, MANY_ROWS)
    found = log_brightness_range(index, THRESHOLDS, share, parts=3)
    parts = [np.quantile(ranges_by_a_loop(events, *between)[::2], share) for between in pairwise(ends)]
    assert found == pytest.approx(max(parts))


def test_a_pixel_that_only_brightens_spans_its_events():
    events = Events(np.zeros(7, np.uint16), np.zeros(7, np.uint16), np.arange(7), np.ones(7, np.int8))
    assert log_brightness_range(EventIndex.from_events(events, 3, 2), (0.25, 0.1)) == pytest.approx(7 * 0.25)


def test_of_a_simulated_recording_it_is_what_its_frames_span(recording):
    """But for what is left over of a threshold at both ends."""
    read = read_recording(recording)
    assert read.frames is not None
    pictures = np.stack([load_image(file)[..., 0] for file in read.frames.filenames]) / 255.0
    levels = Linlog()(torch.from_numpy(pictures))
    spanned = float((levels.amax(0) - levels.amin(0)).quantile(0.99))
    found = log_brightness_range(index_events(read), (0.25, 0.25))
    assert spanned - 0.5 <= found <= spanned + 0.5
