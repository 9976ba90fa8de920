from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from recordings import HEIGHT, WIDTH

from enerf_ns.dataparsers.index.indexing import index_events
from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.dataparsers.recording.errors import RecordingError
from enerf_ns.dataparsers.recording.recording import EventRecording, Events
from enerf_ns.dataparsers.recording.trajectory import Trajectory


def recording(columns: np.ndarray, start: int = 0, end: int = 100) -> EventRecording:
    """In memory, with poses from `start` to `end` ns and events of columns x y t p."""
    trajectory = Trajectory(np.array([start, end]), np.zeros((2, 3)), np.tile([0.0, 0.0, 0.0, 1.0], (2, 1)))
    camera = Camera(WIDTH, HEIGHT, 20.0, 20.0, 12.0, 9.0)
    return EventRecording(Path("memory"), "test", camera, trajectory, lambda: iter([Events(*columns.T)]), ())


def test_events_have_the_types_that_everything_builds_on():
    events = index_events(recording(np.array([[1, 2, 5, 0], [1, 2, 6, 1], [23, 17, 7, 1]]))).events()
    assert [column.dtype for column in (events.x, events.y, events.t, events.p)] == [
        np.uint16, np.uint16, np.int64, np.int8,
    ]  # fmt: skip
    assert events.x.tolist() == [1, 1, 23] and events.y.tolist() == [2, 2, 17] and events.t.tolist() == [5, 6, 7]
    assert len(events) == 3


@pytest.mark.parametrize(
    ("off", "dtype"), [(0, bool), (0, np.uint8), (0, np.int8), (0, np.int64), (-1, np.int8), (-1, np.int64)]
)
def test_polarities_become_plus_and_minus_one(off: int, dtype: type):
    events = recording(np.array([[1, 2, 5, 0], [1, 2, 6, 1], [1, 2, 7, 1]]))
    (raw,) = events.stream_events()
    signed = Events(raw.x, raw.y, raw.t, np.array([off, 1, off]).astype(dtype))
    events = replace(events, stream_events=lambda: iter([signed]))
    assert index_events(events).events().p.tolist() == [-1, 1, -1]


def test_events_of_one_polarity_only_are_fine():
    assert index_events(recording(np.array([[1, 2, 5, 1], [1, 2, 6, 1]]))).events().p.tolist() == [1, 1]
    assert index_events(recording(np.array([[1, 2, 5, 0], [1, 2, 6, 0]]))).events().p.tolist() == [-1, -1]


def test_events_outside_the_poses_are_dropped_and_counted():
    times = np.array([9, 10, 10, 50, 100, 101])
    rows = np.column_stack([np.full_like(times, 3), np.full_like(times, 4), times, np.ones_like(times)])
    clipped = recording(rows, start=10)
    assert index_events(clipped).events().t.tolist() == [10, 10, 50, 100]
    assert index_events(clipped).notes == ("2 of 6 events (33 %) lie outside the poses and are left out.",)
    assert index_events(clipped) is index_events(clipped)


def test_one_selection_is_indexed_once_and_another_one_by_itself():
    rows = np.array([[1, 2, 5, 0], [1, 2, 6, 1], [1, 2, 70, 1], [1, 2, 80, 0]])
    whole = recording(rows)
    part = whole.selected((0.0, 5e-8), keep_hot_pixels=False)
    assert whole.selected(None, keep_hot_pixels=False) is whole
    assert whole.selected((0.0, 5e-8), keep_hot_pixels=False) is part
    assert part.selected((0.0, 5e-8), keep_hot_pixels=False) is part
    assert index_events(whole) is index_events(whole) and len(index_events(whole)) == 4
    assert index_events(part).events().t.tolist() == [5, 6] and index_events(part).notes == ()


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ([24, 2, 6, 1], r"memory, event 2 holds x = 24, which lies outside the sensor of 24 x 18 pixels"),
        ([1, 18, 6, 1], r"memory, event 2 holds y = 18, which lies outside the sensor"),
        ([1, 2, 4, 1], r"memory, event 2 goes back in time from 0\.000000 s to 0\.000000 s"),
        ([1, 2, 6, 7], r"memory, event 2 holds polarity 7, but"),
    ],
)
def test_an_error_of_an_event_names_its_number(row: list[int], message: str):
    with pytest.raises(RecordingError, match=message):
        index_events(recording(np.array([[1, 2, 5, 1], row, [1, 2, 9, 1]])))


@pytest.mark.parametrize(
    ("largest", "centre", "said"),
    [
        ((17, 23), (11.5, 8.5), "x and y of the events seem to be swapped: exchange the two columns"),
        ((17, 23), (8.5, 11.5), "width and height of the calibration seem to be swapped: exchange them"),
        ((24, 18), (11.5, 8.5), "coordinates seem to start at 1: subtract 1 from both"),
        ((47, 35), (11.5, 8.5), "give the calibration of this resolution of the sensor"),
    ],
)
def test_why_events_lie_outside_is_named(largest: tuple[int, int], centre: tuple[float, float], said: str):
    times = np.arange(3000)
    x, y = (times // (top + 1) % (top + 1) if i else times % (top + 1) for i, top in enumerate(largest))
    read = recording(np.column_stack([x, y, times, times % 2]), end=10**9)
    camera = Camera(WIDTH, HEIGHT, 20.0, 20.0, *centre)
    with pytest.raises(RecordingError) as error:
        index_events(replace(read, camera=camera))
    assert f"; all x lie below {largest[0] + 1} and all y below {largest[1] + 1}" in str(error.value)
    assert str(error.value).endswith(f" {said}.")


def test_events_that_make_no_pair_are_refused():
    with pytest.raises(RecordingError, match="never two at one pixel"):
        index_events(recording(np.array([[1, 2, 5, 1], [2, 2, 6, 1]])))
    with pytest.raises(RecordingError, match="holds no events"):
        index_events(recording(np.zeros((0, 4), np.int64)))
    with pytest.raises(RecordingError, match="do not cover the events"):
        index_events(recording(np.array([[1, 2, 205, 1], [1, 2, 206, 1]])))
