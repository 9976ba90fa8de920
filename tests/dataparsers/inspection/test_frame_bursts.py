"""Bursts at frames, put into a Poisson process of known rate."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from waves import CAMERA, HEIGHT, WIDTH

from enerf_ns.dataparsers.inspection.frame_bursts import frame_bursts
from enerf_ns.dataparsers.recording.recording import EventRecording, Events, Frames
from enerf_ns.dataparsers.recording.trajectory import Trajectory

STAMPS = 50_000_000 + 40_000_000 * np.arange(48)


def recording_with(extra: np.ndarray, stamps: np.ndarray = STAMPS) -> EventRecording:
    """100,000 events over two seconds, and more at some times (ns)."""
    generator = np.random.default_rng(len(extra))
    times = np.sort(np.concatenate([generator.integers(0, 2 * 10**9, 100_000), extra]))
    number = len(times)
    x, y, p = (generator.integers(0, high, number) for high in (WIDTH, HEIGHT, 2))
    turn = np.tile([0.0, 0, 0, 1], (2, 1))
    trajectory = Trajectory(np.array([0, 2 * 10**9 + len(extra)]), np.array([[0.0, 0, 0], [1, 0, 0]]), turn)
    frames = Frames(tuple(Path(f"{i}.png") for i in range(len(stamps))), stamps, CAMERA, trajectory)
    events = Events(x, y, times, p)
    return EventRecording(Path("memory"), "test", CAMERA, trajectory, lambda: iter([events]), (), frames=frames)


def after_each(stamps: np.ndarray, begin: int, end: int, number: int) -> np.ndarray:
    return (stamps[:, None] + np.random.default_rng(5).integers(begin, end, (len(stamps), number))).ravel()


def test_no_bursts_are_found_in_a_steady_rate():
    assert frame_bursts(recording_with(np.zeros(0, np.int64))) is None


@pytest.mark.parametrize(("begin", "end"), [(1_000_000, 2_000_000), (-600_000, 200_000)])
def test_bursts_are_found_where_they_are(begin: int, end: int):
    extra = after_each(STAMPS, begin, end, 300)
    found = frame_bursts(recording_with(extra))
    assert found is not None
    np.testing.assert_allclose(found.delays, [[begin, end]], atol=150_000)
    assert found.excess == pytest.approx(len(extra) / (100_000 + len(extra)), rel=0.05)


def test_a_burst_at_one_frame_alone_does_not_come_with_frames():
    assert frame_bursts(recording_with(after_each(STAMPS[:1], 0, 10**6, 5000))) is None


def test_few_frames_tell_nothing():
    stamps = STAMPS[:6]
    assert frame_bursts(recording_with(after_each(stamps, 0, 10**6, 301), stamps)) is None
