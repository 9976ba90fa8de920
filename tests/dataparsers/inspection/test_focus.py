"""Motion-compensated events, compared with points in known places."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from enerf_ns.bench.numerics.points import CAMERA, TURNING, points_between, recording_of_points, shaking
from enerf_ns.dataparsers.inspection.focus import AS_STATED, FEWEST_EVENTS, INVERSE, EventFocus, Hypothesis
from enerf_ns.dataparsers.recording.recording import EventRecording, Events
from enerf_ns.dataparsers.recording.trajectory import Trajectory
from enerf_ns.dataparsers.scene.depth_range import TILE

POINTS = points_between(1.0, 3.0)


@pytest.fixture(scope="module")
def focus() -> EventFocus:
    events, trajectory, _ = recording_of_points(POINTS, shaking(0.1), TURNING)
    return EventFocus(EventRecording(Path("memory"), "test", CAMERA, trajectory, lambda: iter([events]), ()), 1.7)


def test_windows_hold_the_events_of_their_time_and_poses_for_every_delay(focus: EventFocus):
    assert 4 <= len(focus.windows) <= 8
    for window in focus.windows:
        assert len(window.events) >= FEWEST_EVENTS and window.start < window.instant < window.end
        assert window.start <= window.events.t[0] and window.events.t[-1] <= window.end
        assert window.start - focus.largest_delay >= 0 and window.end + focus.largest_delay <= 1_999_000_000


def test_compensated_events_lie_where_the_camera_saw_the_points(focus: EventFocus):
    """At the places to which the points are projected in closed form, and hardly elsewhere."""
    for window in focus.windows:
        picture, _ = focus.picture(window)
        as_fired, _ = focus.picture(window, None)
        pose = focus.recording.trajectory.poses(torch.as_tensor(window.instant)).numpy()
        seen = (POINTS - pose[:, 3]) @ pose[:, :3]
        at = np.rint(150 * seen[:, :2] / seen[:, 2:] + [79.5, 59.5]).astype(int)
        rows, columns = picture.shape
        inside = (seen[:, 2] > 0) & (at > 1).all(1) & (at < [columns - 2, rows - 2]).all(1)
        near = np.zeros(picture.shape, bool)
        for x, y in at[inside]:
            near[y - 1 : y + 2, x - 1 : x + 2] = True
        assert picture[near].sum() / picture.sum() > 0.6 > 1.5 * as_fired[near].sum() / as_fired.sum()


def test_sharpness_is_the_variance_of_the_picture_for_each_event(focus: EventFocus):
    sharpness = focus.sharpness().reshape(len(focus.windows), -1).sum(1)
    for window, expected in zip(focus.windows, sharpness, strict=True):
        picture, measured = focus.picture(window)
        rows, columns = picture.shape
        tiles = [
            picture[row : row + TILE, column : column + TILE].var() * TILE**2
            for row in range(0, rows, TILE)
            for column in range(0, columns, TILE)
        ]
        assert measured == pytest.approx(sum(tiles) / len(window.events)) == pytest.approx(expected)


def test_wrong_clocks_and_focal_lengths_are_less_sharp(focus: EventFocus):
    right = focus.sharpness().sum()
    for delay in (-40, -20, 20, 40):
        assert focus.sharpness(Hypothesis(delay * 1_000_000)).sum() < 0.97 * right
    for scale in (0.8, 1.25):
        assert focus.allows(scale) and focus.sharpness(Hypothesis(0, scale)).sum() < 0.99 * right


def test_right_poses_are_as_sharp_as_any_motion_and_wrong_ones_are_not(focus: EventFocus):
    assert focus.free_sharpness < focus.sharpness().sum()
    assert focus.free_sharpness > 1.1 * focus.sharpness(Hypothesis(reading=INVERSE)).sum()


def test_an_edge_that_fires_more_events_at_a_time_is_a_strong_one(focus: EventFocus):
    stated = focus.recording
    events = next(iter(stated.stream_events()))
    several = Events(*(np.repeat(values, 10) for values in (events.x, events.y, events.t, events.p)))
    strong = EventFocus(replace(stated, stream_events=lambda: iter([several])), 1.7)
    assert 1.0 <= focus.events_an_edge < 2.0 and not focus.has_strong_edges
    assert strong.has_strong_edges  # and windows that had too few events join in
    assert strong.events_an_edge == pytest.approx(10.0 * focus.events_an_edge, rel=0.01)


def test_neither_the_unit_of_length_nor_the_clock_matters(focus: EventFocus):
    stated = focus.recording
    read = stated.trajectory
    zero = 1_600_000_000_123_456_789
    events = next(iter(stated.stream_events()))
    moved = replace(events, t=events.t + zero)
    trajectory = Trajectory(read.times + zero, 1000 * read.positions, read.quaternions)
    other = EventRecording(Path("memory"), "test", CAMERA, trajectory, lambda: iter([moved]), ())
    again = EventFocus(other, 1700.0)
    for hypothesis in (AS_STATED, Hypothesis(7_000_000)):
        np.testing.assert_allclose(again.sharpness(hypothesis), focus.sharpness(hypothesis), rtol=1e-3)


def test_what_a_hypothesis_says():
    assert AS_STATED.words == "as stated"
    assert Hypothesis(-5_000_000).words == "poses -5 ms"
    assert Hypothesis(20_000_000, 1.1).words == "poses +20 ms, focal length +10 %"
