from __future__ import annotations

import numpy as np
import pytest
import torch

from enerf_ns.dataparsers.recording.recording import Events
from enerf_ns.reconstruction.voxel_grid import normalised, voxel_grid


def events_of(number: int, zero: int = 0, off: int = -1) -> Events:
    rng = np.random.default_rng(number)
    t = zero + np.sort(rng.integers(0, 10**7, number))
    return Events(rng.integers(0, 7, number), rng.integers(0, 5, number), t, rng.choice([off, 1], number))


@pytest.mark.parametrize(
    ("events", "num_bins"),
    [
        (events_of(300), 5),
        (events_of(300, zero=1_700_000_000_123_456_789), 5),
        (events_of(50, off=0), 2),
        (events_of(1), 5),
        (Events(np.array([3, 3]), np.array([1, 1]), np.array([8, 8]), np.array([1, 1])), 5),
    ],
)
def test_against_a_slow_loop(events: Events, num_bins: int):
    expected = np.zeros((num_bins, 5, 7))
    duration = max(int(events.t[-1]) - int(events.t[0]), 1)
    for x, y, t, p in zip(events.x, events.y, events.t, events.p, strict=True):
        place = (int(t) - int(events.t[0])) / duration * (num_bins - 1)
        for b in range(num_bins):
            expected[b, y, x] += (1 if p > 0 else -1) * max(0.0, 1 - abs(b - place))
    np.testing.assert_allclose(voxel_grid(events, num_bins, 7, 5), expected, rtol=0, atol=1e-5)


def test_no_events_are_an_empty_grid():
    assert not voxel_grid(Events(*(np.zeros(0, np.int64) for _ in "xytp")), 5, 7, 5).any()


def test_what_is_not_0_has_mean_0_and_deviation_1():
    grid = voxel_grid(events_of(40), 5, 7, 5)
    found = normalised(grid)
    assert (found[grid == 0] == 0).all() and (grid == 0).any()
    values = found[grid != 0].double()
    assert abs(values.mean()) < 1e-6 and abs(values.square().mean() - 1) < 1e-5
    torch.testing.assert_close(found[grid != 0].argsort(), grid[grid != 0].argsort())


@pytest.mark.parametrize("number", [0, 1])
def test_what_has_no_deviation_stays(number: int):
    grid = voxel_grid(events_of(number), 5, 7, 5)
    torch.testing.assert_close(normalised(grid), grid)
