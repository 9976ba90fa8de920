from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from recordings import HEIGHT, WIDTH

from enerf_ns.dataparsers.index.indexing import index_events
from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.dataparsers.recording.errors import RecordingError
from enerf_ns.dataparsers.recording.recording import EventRecording, Events, Frames, overlaps
from enerf_ns.dataparsers.recording.trajectory import Trajectory

CAMERA = Camera(WIDTH, HEIGHT, 20.0, 20.0, 12.0, 9.0)


def recording(columns: np.ndarray, start: int = 0, end: int = 100, frame_times: tuple[int, ...] = ()) -> EventRecording:
    """In memory, with poses from `start` to `end` ns and events of columns x y t p."""
    trajectory = Trajectory(np.array([start, end]), np.zeros((2, 3)), np.tile([0.0, 0.0, 0.0, 1.0], (2, 1)))
    names = tuple(Path(f"{time}.png") for time in frame_times)
    depth = tuple(Path(f"{time}.npy") for time in frame_times)
    frames = Frames(names, np.array(frame_times), CAMERA, trajectory, depth) if frame_times else None
    return EventRecording(Path("memory"), "test", CAMERA, trajectory, lambda: iter([Events(*columns.T)]), (), frames)


def test_frames_outside_the_poses_are_dropped_and_counted():
    rows = np.array([[1, 2, 5, 1], [1, 2, 6, 1]])
    clipped = recording(rows, start=10, frame_times=(9, 10, 100, 101))
    assert clipped.frames is not None and clipped.frames.times.tolist() == [10, 100]
    assert clipped.frames.filenames == (Path("10.png"), Path("100.png"))
    assert clipped.frames.depth_filenames == (Path("10.npy"), Path("100.npy"))
    assert clipped.notes == ("2 of 4 frames (50 %) lie outside the poses and are left out.",)
    assert recording(rows, start=10, frame_times=(1, 2)).frames is None


def test_nothing_is_noted_when_nothing_is_dropped():
    whole = recording(np.array([[1, 2, 0, 1], [1, 2, 100, 1]]), frame_times=(0, 100))
    assert len(index_events(whole).events()) == 2 and whole.notes == index_events(whole).notes == ()


def with_gaps(*pieces: tuple[int, int]) -> EventRecording:
    """A recording whose poses, ten milliseconds apart, lie within these pieces of time (ms) alone."""
    times = np.concatenate([np.arange(first, last + 1, 10) for first, last in pieces]) * 1_000_000
    still = np.zeros((len(times), 3)), np.tile([0.0, 0.0, 0.0, 1.0], (len(times), 1))
    return replace(recording(np.array([[1, 2, 0, 1], [1, 2, 10**9, 1]])), trajectory=Trajectory(times, *still))


PIECES = (0, 200), (400, 400), (600, 600), (800, 1000)


@pytest.mark.parametrize("time_range", [None, (0.1, 0.9), (0.15, 0.5), (0.3, 0.4), (0.21, 0.61)])
def test_stretches_are_what_the_gaps_leave_of_the_span(time_range: tuple[float, float] | None):
    """By looking at every millisecond."""
    whole = with_gaps(*PIECES)
    chosen = whole.selected(time_range, keep_hot_pixels=False)
    start, end = (0, 1000) if time_range is None else (round(1000 * time_range[0]), round(1000 * time_range[1]))
    used = [m for m in range(start, end + 1) if any(first <= m <= last for first, last in PIECES)]
    milliseconds = chosen.stretches // 1_000_000
    assert [m for first, last in milliseconds.tolist() for m in range(first, last + 1)] == used
    gaps = [(a, b) for (_, a), (b, _) in pairwise(PIECES) if a < end and b > start]
    assert (chosen.pose_gaps // 1_000_000).tolist() == [[*gap] for gap in gaps]

    instants = chosen.instants(500)
    assert {t // 1_000_000 for t in instants.tolist()} <= set(used) and not chosen.in_left_out_gaps(instants).any()
    assert (instants[0], instants[-1]) == (used[0] * 1_000_000, used[-1] * 1_000_000)
    assert len(np.unique(instants)) == min(500, sum(last - first + 1 for first, last in chosen.stretches.tolist()))
    kept = whole.selected(time_range, keep_hot_pixels=False, keep_pose_gaps=True)
    assert kept.stretches.tolist() == [[start * 1_000_000, end * 1_000_000]] and kept.span == chosen.span
    assert (kept.pose_gaps == chosen.pose_gaps).all() and not kept.in_left_out_gaps(np.arange(0, 10**9, 10**6)).any()
    assert kept is whole.selected(time_range, False, True) is chosen.selected(time_range, False, True) or time_range


@pytest.mark.parametrize("share", [1e-7, 0.05, 0.5])
def test_spans_are_equal_and_evenly_spread_over_the_stretches(share: float):
    """Also where one reaches over a gap; by the time that is used within each and before each."""
    whole = with_gaps(*PIECES)
    spans = whole.spans(8, share)
    total = sum(last + 1 - first for first, last in whole.stretches.tolist())
    assert (spans[1:, 0] > spans[:-1, 1]).all() and not whole.in_left_out_gaps(spans.flatten()).any()

    def used(first: int, last: int) -> int:
        return sum(max(min(last, b) + 1 - max(first, a), 0) for a, b in whole.stretches.tolist())

    for i, (first, last) in enumerate(spans.tolist()):
        assert used(first, last) == int(share * total) // 8
        middle = used(0, first - 1) + used(first, last) / 2
        assert middle == pytest.approx((i + 0.5) / 8 * total, abs=1)


def test_what_lies_in_both():
    """By looking at every instant."""
    one, other = [(0, 3), (5, 5), (7, 20), (25, 30)], [(2, 8), (10, 10), (12, 26), (31, 40)]
    inside = [{t for a, b in parts for t in range(a, b + 1)} for parts in (one, other)]
    found = overlaps(np.array(one), np.array(other))
    assert [t for a, b in found.tolist() for t in range(a, b + 1)] == sorted(inside[0] & inside[1])
    assert overlaps(np.array(one), np.zeros((0, 2), np.int64)).shape == (0, 2)


@pytest.mark.parametrize(
    ("stated", "message"),
    [
        (dict(contrast_thresholds=(0.2, 0.0)), r"contrast thresholds 0\.2 \(of on events\) and 0"),
        (dict(contrast_thresholds=(float("nan"), 0.2)), "both must be from 0.001 to 10"),
        (dict(contrast_thresholds=(1e-45, 1e-45)), r"contrast thresholds 1e-45 \(of on events\) and 1e-45"),
        (dict(contrast_thresholds=(0.2, 10.1)), r"0\.2 \(of on events\) and 10\.1"),
        (dict(depth_range=(1e-7, 1.0)), "range of depth 1e-07 m to 1 m"),
        (dict(depth_range=(1.0, 1.1e9)), "both from 1e-06 m to 1e.09 m"),
        (dict(refractory_period=-1), "refractory period -1 ns"),
        (dict(refractory_period=10**13), "refractory period 1e.13 ns"),
        (dict(bayer_pattern="RGB"), "Bayer pattern 'RGB'"),
        (dict(bayer_pattern="RGBX"), "Bayer pattern 'RGBX'"),
        (dict(response="log"), "response 'log'"),
        (dict(response="logarithm:"), "response 'logarithm:'"),
        (dict(response="logarithm:0"), "response 'logarithm:0'"),
        (dict(depth_range=(2.0, 1.0)), "range of depth 2 m to 1 m"),
        (dict(depth_range=(0.0, 1.0)), "range of depth 0 m to 1 m"),
    ],
)
def test_what_a_recording_states_is_checked_where_it_is_made(stated: dict, message: str):
    whole = recording(np.array([[1, 2, 0, 1], [1, 2, 100, 1]]))
    with pytest.raises(ValueError, match=message) as error:
        replace(whole, **stated)
    assert not isinstance(error.value, RecordingError) and "\n" not in str(error.value)


@pytest.mark.parametrize("response", ["linlog", "logarithm:0.001", "logarithm:1e-05", None])
def test_responses(response: str | None):
    assert replace(recording(np.array([[1, 2, 0, 1]])), response=response).response == response


def test_a_recording_error_is_a_value_error():
    assert issubclass(RecordingError, ValueError)
