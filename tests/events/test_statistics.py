"""Silence and the sensor's border, against slow loops and closed forms."""

from __future__ import annotations

import numpy as np
import pytest

from enerf_ns.dataparsers.event_index import EventIndex
from enerf_ns.dataparsers.recording import Events
from enerf_ns.events.statistics import border_rate, silent_share

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
