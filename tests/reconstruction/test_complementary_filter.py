from __future__ import annotations

import math

import numpy as np
import pytest

from enerf_ns.dataparsers.recording.recording import Events
from enerf_ns.reconstruction.complementary_filter import ComplementaryFilter

ZERO = 1_700_000_000_123_456_789


def one_pixel(times: list[int], polarities: list[int]) -> Events:
    place = np.zeros(len(times), np.int64)
    return Events(place + 2, place + 1, ZERO + np.array(times), np.array(polarities))


@pytest.mark.parametrize("cutoff", [0.0, 0.5, 20.0])
def test_a_step_decays_exponentially(cutoff: float):
    """n events at one instant: n thresholds, times exp(-2 pi f t) after t."""
    filter = ComplementaryFilter(4, 3, (0.2, 0.3), cutoff, ZERO)
    filter.add(one_pixel([10**8] * 5, [1] * 5))
    for after in (0, 10**6, 10**8, 3 * 10**9):
        expected = np.zeros((3, 4))
        expected[1, 2] = 5 * 0.2 * math.exp(-2 * math.pi * cutoff * after * 1e-9)
        np.testing.assert_allclose(filter.log_brightness(ZERO + 10**8 + after), expected, rtol=1e-12)


@pytest.mark.parametrize("off", [-1, 0])
@pytest.mark.parametrize("size", [1, 7, 500])
def test_against_a_slow_sum(off: int, size: int):
    """Each event by itself: its threshold times its decay up to the end, whatever pieces the events come in."""
    rng = np.random.default_rng(0)
    t = ZERO + np.sort(rng.integers(0, 2 * 10**9, 500))
    x, y, p = rng.integers(0, 4, 500), rng.integers(0, 3, 500), rng.choice([off, 1], 500)
    filter, end = ComplementaryFilter(4, 3, (0.2, 0.3), 0.7, ZERO), int(t[-1]) + 10**8
    for first in range(0, 500, size):
        filter.add(Events(*(column[first : first + size] for column in (x, y, t, p))))
    expected = np.zeros((3, 4))
    for i in range(500):
        change = 0.2 if p[i] > 0 else -0.3
        expected[y[i], x[i]] += change * math.exp(-2 * math.pi * 0.7 * (end - int(t[i])) * 1e-9)
    np.testing.assert_allclose(filter.log_brightness(end), expected, rtol=0, atol=1e-12)


def test_frames_are_brightness_smoothed_along_edges():
    """Half of the picture brightens by 8 thresholds: it shows exp of that, the edge stays, one odd pixel does not."""
    filter = ComplementaryFilter(12, 8, (0.5, 0.5), 0.0, 0)
    rows, columns = (places.ravel() for places in np.mgrid[:8, 6:12])
    place = np.repeat(rows, 8), np.repeat(columns, 8)
    filter.add(Events(place[1], place[0], np.zeros(len(place[0]), np.int64), np.ones(len(place[0]), np.int64)))
    filter.add(Events(np.array([2]), np.array([3]), np.array([0]), np.array([1])))
    frame = filter.frame(0)
    np.testing.assert_allclose(np.log(frame[:, 6:]), 4.0, atol=0.01)
    np.testing.assert_allclose(np.log(frame[:, 5]), 0.0, atol=0.01)
    assert 0 < np.log(frame[3, 2]) < 0.3
