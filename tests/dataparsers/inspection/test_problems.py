"""Each problem is found in a recording made to have it, and none in a good one; numbers against slow loops."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from enerf_ns.dataparsers.index.indexing import index_events
from enerf_ns.dataparsers.inspection import problems as inspection
from enerf_ns.dataparsers.inspection.problems import event_statistics, find_problems, pose_gaps, unusual_rates
from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.dataparsers.recording.recording import EventRecording, Events, Frames
from enerf_ns.dataparsers.recording.trajectory import Trajectory

SECOND = 10**9
CAMERA = Camera(32, 24, 30.0, 30.0, 15.5, 11.5)
NUM_EVENTS = 30 * CAMERA.width * CAMERA.height


def good_events(generator: np.random.Generator, number: int = NUM_EVENTS) -> np.ndarray:
    """Columns x, y, t, p: at every pixel, at any time from 0 to 2 s, as often on as off."""
    return np.column_stack(
        [
            generator.integers(0, CAMERA.width, number),
            generator.integers(0, CAMERA.height, number),
            np.sort(generator.integers(0, 2 * SECOND, number)),
            generator.integers(0, 2, number),
        ]
    )


def good_poses() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times, positions and rotation vectors at 200 Hz: to and fro along x at a steady speed, turning a little."""
    times = np.arange(401) * (SECOND // 200)
    seconds = times * 1e-9
    positions = np.stack([0.5 * np.abs(seconds - 1), 0 * seconds, 0 * seconds], axis=1)
    return times, positions, np.stack([0 * seconds, 0.3 * seconds, 0 * seconds], axis=1)


FRAME_TIMES = np.arange(1, 40) * (SECOND // 20)


def made(
    events: np.ndarray | None = None,
    poses: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None,
    frame_times: np.ndarray = FRAME_TIMES,
    camera: Camera = CAMERA,
    **known: Any,
) -> EventRecording:
    """A recording that is good but for what is given; events may be in any order."""
    columns = good_events(np.random.default_rng(0)) if events is None else events
    columns = columns[np.argsort(columns[:, 2], kind="stable")]
    times, positions, rotation_vectors = poses or good_poses()
    trajectory = Trajectory(times, positions, Rotation.from_rotvec(rotation_vectors).as_quat())
    names = tuple(Path(f"{time}.png") for time in frame_times)
    return EventRecording(
        Path("memory"), "test", camera, trajectory, lambda: iter([Events(*columns.T)]), (),
        frames=Frames(names, frame_times, camera, trajectory) if len(frame_times) else None,
        **known,
    )  # fmt: skip


def changed_events(change: str) -> np.ndarray:
    generator = np.random.default_rng(1)
    events = good_events(generator)
    seconds = events[:, 2] * 1e-9
    if change == "silence":
        return events[(seconds < 0.5) | (seconds > 0.7)]
    if change == "burst":
        burst = good_events(generator)
        burst[:, 2] = SECOND + generator.integers(0, 5_000_000, len(burst))
        return np.concatenate([events, burst])
    if change == "one polarity":
        events[:, 3] = 0
    if change == "unequal polarities":
        events[:, 3] = generator.random(len(events)) < 0.8
    if change == "unused pixels":
        events[:, 0] = events[:, 0] * (30 - events[:, 1]) // 45
    if change == "cropped":
        events = events[events[:, 0] < 28]
    if change == "exchanged":
        events = events[events[:, 0] < CAMERA.height]
    if change == "few events":
        return events[::6]
    if change == "hot pixel":
        hot = np.tile([7, 5, 0, 1], (2000, 1))
        hot[:, 2] = generator.integers(0, 2 * SECOND, len(hot))
        return np.concatenate([events, hot])
    return events


def changed_poses(change: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    times, positions, rotation_vectors = good_poses()
    seconds = times * 1e-9
    if change == "late":
        keep = seconds > 0.2
    elif change == "gap":
        keep = (seconds < 0.601) | (seconds > 0.899)
    elif change == "rare":
        keep = np.arange(len(times)) % 40 == 0
        rotation_vectors = np.stack([0 * seconds, np.sin(4 * seconds), 0 * seconds], axis=1)
    else:
        keep = np.ones(len(times), bool)
    if change == "wrong pose":
        positions[300] += [0.0, 0.4, 0.0]
    if change == "switched markers":
        positions[250:] += [0.0, 0.0, 0.3]
    if change == "stamps of arrival":
        times[300] = times[301] - 20_000
    if change == "turning":
        positions *= 0.001
    if change == "millimetres":
        positions *= 1000
    return times[keep], positions[keep], rotation_vectors[keep]


PROBLEMS = {
    "events without poses": (
        dict(poses=changed_poses("late"), frame_times=FRAME_TIMES[5:]), r"\d+ % of the events lie outside", "one clock",
    ),
    "frames without poses": (
        dict(frame_times=np.arange(1, 50) * (SECOND // 20)), r"18 % of the frames lie outside", "one clock",
    ),
    "gap between poses": (
        dict(poses=changed_poses("gap")), r"no poses for 0.3 s from 0.60 s on, while .* every 5 ms", "0.9 1.999",
    ),
    "too few poses": (dict(poses=changed_poses("rare")), r"turns by up to 4\d degrees from one", "every 200 ms"),
    "wrong pose": (dict(poses=changed_poses("wrong pose")), r"2 jumps; the largest is by 0.4 m and", "0.001 1.495"),
    "stamps of arrival": (
        dict(poses=changed_poses("stamps of arrival")), r"swings by 0.184 m at 1.50 s", "0.001 1.495",
    ),
    "switched markers": (
        dict(poses=changed_poses("switched markers")), r"1 jump; .* by 0.3 m and .* at 1.25 s", "0.001 1.245",
    ),
    "turning": (dict(poses=changed_poses("turning")), r"hardly moves: its path spans 0.0005 m", "move the camera"),
    "millimetres": (dict(poses=changed_poses("millimetres")), r"spans 500 m", "millimetres"),
    "deep scene": (dict(depth_range=(0.01, 50.0)), r"from 0.01 m to 50 m", "--depth-range NEAR FAR"),
    "silence": (dict(events=changed_events("silence")), r"silent once .* lasts 0.\d+ s from 0.5\d s", "range 0.7"),
    "burst": (dict(events=changed_events("burst")), r"bursts once, first at (1.00|0.99) s", "--time-range"),
    "one polarity": (dict(events=changed_events("one polarity")), "All events are off events", "0 and 1, or -1 and 1"),
    "unequal polarities": (
        dict(events=changed_events("unequal polarities")), r"4.\d on events for every off", "threshold of on events",
    ),
    "unused pixels": (dict(events=changed_events("unused pixels")), r"[56]\d % of the pixels have fewer", "two events"),
    "cropped": (
        dict(events=changed_events("cropped")),
        r"No event has x above 27, though .*: the sensor seems to be cropped", "cx and cy less its first column",
    ),
    "exchanged": (
        dict(events=changed_events("exchanged")),
        r"has x above 23, though the sensor has 32 .*: x and y seem to be exchanged", "the row as y",
    ),
    "microseconds": (
        dict(
            events=good_events(np.random.default_rng(0)) // [1, 1, 1000, 1],
            poses=(good_poses()[0] // 1000, *good_poses()[1:]),
            frame_times=FRAME_TIMES // 1000,
        ),
        r"23,040 events within 0.00199\d+ s .* the times of events .* look like microseconds", "multiply them by 1,000",
    ),
    "few events": (dict(events=changed_events("few events")), "only 5 events per pixel", "10 and more"),
    "hot pixel": (dict(events=changed_events("hot pixel")), r"1 hot pixel \(0.13 %\), left", "--keep-hot-pixels True"),
    "few frames": (dict(frame_times=FRAME_TIMES[::8]), "only 5 frames", "events alone"),
    "lost frames": (
        dict(frame_times=np.delete(FRAME_TIMES, slice(10, 15))), r"5 frames .* every 50 ms, but after 0.50 s", "0.3 s",
    ),
}  # fmt: skip


def test_a_good_recording_has_no_problems():
    assert find_problems(made()) == []


@pytest.mark.parametrize("name", PROBLEMS)
def test_each_problem_is_found_alone(name: str):
    changes, what, advice = PROBLEMS[name]
    (problem,) = find_problems(made(**changes))
    assert re.search(what, problem.what), problem.what
    assert advice in problem.what + problem.advice, problem
    assert problem.what.endswith(".") and problem.advice.endswith(".")


@pytest.mark.sweep(8)
@pytest.mark.parametrize("zero", [3600 * SECOND, 1_600_000_000 * SECOND, 4_611_686_010 * SECOND])
@pytest.mark.parametrize("name", [None, *PROBLEMS])
def test_problems_are_the_same_on_every_clock(name: str | None, zero: int):
    """But for the seconds that the clock shows; and a range of time that is advised avoids what it should."""
    changes = PROBLEMS[name][0] if name else {}
    events, poses = changes.get("events"), changes.get("poses") or good_poses()
    events = (good_events(np.random.default_rng(0)) if events is None else events) + [0, 0, zero, 0]
    frame_times = changes.get("frame_times", FRAME_TIMES) + zero
    later = made(**{**changes, "events": events, "poses": (poses[0] + zero, *poses[1:]), "frame_times": frame_times})
    problems, expected = find_problems(later), find_problems(made(**changes))
    assert len(problems) == len(expected) == (name is not None)
    for problem, usual in zip(problems, expected, strict=True):
        shown = re.sub(r"\d{4,}\.\d+ s", lambda match: f"{float(match[0][:-2]) - zero / SECOND:.2f} s", problem.what)
        assert shown == usual.what
        statistics = event_statistics(later)
        spans = np.concatenate([pose_gaps(later, statistics), *unusual_rates(later, statistics, None)])
        for first, last in re.findall(r"--time-range (\S+?) ([\d.]+\d)", problem.advice):
            start, end = later.selected((float(first), float(last)), keep_hot_pixels=False).time_range or (0, 0)
            assert start < end and not ((spans[:, 0] < end) & (spans[:, 1] > start)).any()
            assert statistics.edges[0] <= start and end <= statistics.edges[-1]


def test_frames_that_are_held_out_between_others_are_not_missing():
    """As the sharp pictures between blurred ones."""
    recording = made()
    assert recording.frames is not None
    kept = np.delete(np.arange(len(FRAME_TIMES)), slice(3, None, 4))
    without = made(frame_times=FRAME_TIMES[kept])
    assert any("seem to be missing" in problem.what for problem in find_problems(without))
    assert find_problems(replace(recording, frames=recording.frames.subset(kept))) == []


def test_no_part_is_advised_where_poses_come_in_short_bursts():
    """As those of the exposures of E2NeRF, each of which is no recording by itself."""
    times, positions, rotation_vectors = good_poses()
    keep = np.arange(len(times)) % 40 < 10
    (problem,) = find_problems(made(poses=(times[keep], positions[keep], rotation_vectors[keep])))
    assert "in 9 other gaps" in problem.what and problem.advice == "Add the poses that are missing."


def test_a_recording_without_frames_needs_none():
    assert find_problems(made(frame_times=FRAME_TIMES[:0])) == []


def test_events_of_one_instant_alone_are_counted():
    """There are too few events to find that the times are in another unit."""
    events = good_events(np.random.default_rng(0), 900)
    events[:, 2] = SECOND
    recording = made(events)
    statistics = event_statistics(recording)
    assert statistics.num_events == 900 and statistics.edges[0] == statistics.edges[-1] == SECOND
    assert (statistics.rate * 1e-9).sum() == 900  # in the nanosecond that an instant is taken to last
    assert any("events per pixel" in problem.what for problem in find_problems(recording))


def test_what_the_events_do_not_need_is_no_problem():
    """Neither a gap between poses after the last event, nor a wrong pose before the first one."""
    events = good_events(np.random.default_rng(2))
    events = events[(events[:, 2] > 1 * SECOND) & (events[:, 2] < 1.9 * SECOND)]
    times, positions, rotation_vectors = good_poses()
    positions[50] += 1.0
    keep = (times < 1.92 * SECOND) | (times > 3 * SECOND)
    late = [np.append(column[keep], column[-1:], axis=0) for column in (times, positions, rotation_vectors)]
    late[0][-1] = 9 * SECOND
    poses = late[0], late[1], late[2]
    assert find_problems(made(events, poses)) == []


def test_the_motion_explains_silence_at_rest_and_many_events_of_a_quick_turn():
    """Events in proportion to the speed of a camera that rests for half of the time and turns quickly for a moment."""
    generator = np.random.default_rng(3)
    times, positions, rotation_vectors = good_poses()
    seconds = times * 1e-9
    speed = np.where(seconds < 1, 0.0, np.where((seconds > 1.5) & (seconds < 1.55), 40.0, 1.0))
    angle = 0.1 * np.concatenate([[0], np.cumsum(speed[:-1]) * 0.005])
    rotation_vectors[:, 1] = angle
    positions = np.stack([0.3 * np.clip(seconds - 1, 0, None), 0 * seconds, 0 * seconds], axis=1)
    events = good_events(generator, 60_000)
    events[:, 2] = np.interp(generator.uniform(0, angle[-1], len(events)), angle[200:], times[200:])
    recording = made(events, (times, positions, rotation_vectors))
    statistics = event_statistics(recording)
    assert statistics.rate.max() > 20 * np.median(statistics.rate)
    silences, bursts = unusual_rates(recording, statistics, None)
    assert len(silences) == 0 and len(bursts) == 0


def test_one_time_range_avoids_all_that_can_be_avoided():
    """The longest part, to the millisecond, found by looking at each of them."""
    times, positions, rotation_vectors = good_poses()
    keep = (times <= 0.3 * SECOND) | (times >= 0.5 * SECOND)
    positions[330:] += [0.0, 0.3, 0.0]
    poses = times[keep], positions[keep], rotation_vectors[keep]
    events = changed_events("silence")
    events = events[(events[:, 2] < 1.1 * SECOND) | (events[:, 2] > 1.3 * SECOND)]
    recording = made(events, poses)
    problems = find_problems(recording)
    assert len(problems) == 3
    ranges = {re.findall(r"--time-range (\S+?) ([\d.]+\d)", problem.advice)[0] for problem in problems}
    ((first, last),) = ranges

    statistics = event_statistics(recording)
    silences, _ = unusual_rates(recording, statistics, None)
    spans = [*pose_gaps(recording, statistics), *silences, np.array([times[329], times[330]])]
    milliseconds = np.arange(2000)
    fine = [not any(begin < m * 10**6 < end for begin, end in spans) for m in milliseconds]
    runs = "".join("x" if good else " " for good in fine).split()
    assert math.isclose(1000 * (float(last) - float(first)), max(map(len, runs)) - 1, abs_tol=2)
    assert all(fine[round(1000 * float(first)) : round(1000 * float(last)) + 1])


@pytest.mark.parametrize("at_once", [100, 2**24])
def test_statistics_against_slow_loops(at_once: int, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(inspection, "EVENTS_AT_ONCE", at_once)
    events = changed_events("unequal polarities")[:20_000]
    events[:3, :2] = 0  # three events at a pixel that has none else
    events = events[(events[:, 0] > 2) | (np.arange(len(events)) < 3)]
    recording = made(events)
    statistics = event_statistics(recording)

    counts: dict[tuple[int, int], int] = {}
    on = 0
    for x, y, _, p in events.tolist():
        counts[y, x] = counts.get((y, x), 0) + 1
        on += p
    assert statistics.num_on == on and statistics.num_off == len(events) - on
    assert statistics.num_events == len(events)
    for y in range(CAMERA.height):
        for x in range(CAMERA.width):
            assert statistics.counts[y, x] == counts.get((y, x), 0)
    few = sum(counts.get((y, x), 0) < 2 for y in range(CAMERA.height) for x in range(CAMERA.width))
    assert few > 24 and statistics.share_below_two == few / (CAMERA.width * CAMERA.height)
    assert statistics.events_per_pixel == len(events) / (32 * 24)
    assert statistics.edges[0] == events[0, 2] and statistics.edges[-1] == events[-1, 2]
    assert statistics.seconds == pytest.approx((events[-1, 2] - events[0, 2]) * 1e-9, rel=1e-12)
    expected = np.histogram(events[:, 2], statistics.edges)[0]
    np.testing.assert_allclose(statistics.rate * np.diff(statistics.edges) * 1e-9, expected, rtol=1e-9)


def test_a_sample_of_the_events_gives_their_rate():
    recording = made()
    sampled = event_statistics(recording, at_most=5000)
    taken = index_events(recording).times[::5].numpy()  # 23,040 events
    expected = 5 * np.histogram(taken, sampled.edges)[0] / (np.diff(sampled.edges) * 1e-9)
    np.testing.assert_allclose(sampled.rate, expected, rtol=1e-9)
    assert len(sampled.rate) == len(taken) // 200
    whole = event_statistics(recording)
    np.testing.assert_array_equal(sampled.counts, whole.counts)
    assert sampled.num_on == whole.num_on


def real_trajectory(file: Path, unit: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rows = np.loadtxt(file)
    times = np.rint(rows[:, 0] * unit).astype(np.int64)
    return times - times[0], rows[:, 1:4], Rotation.from_quat(rows[:, 4:]).as_rotvec()


def test_real_ground_truth_of_tum_vie_is_clean(shared_data: Path):
    times, positions, rotation_vectors = real_trajectory(
        shared_data / "tum_vie" / "groundtruth_left_event_camera.txt", SECOND
    )
    events = good_events(np.random.default_rng(4))
    events[:, 2] *= times[-1] // (2 * SECOND)
    assert find_problems(made(events, (times, positions, rotation_vectors))) == []


def test_the_jumps_in_real_ground_truth_of_eds_are_found(shared_data: Path):
    """At 15.79 s of 01_peanuts_light a single pose is turned by 2.7 degrees, between neighbours that turn by 0.2."""
    times, positions, rotation_vectors = real_trajectory(
        shared_data / "eds" / "stamped_groundtruth_us_01_peanuts_light.txt", 1000
    )
    events = good_events(np.random.default_rng(5))
    events[:, 2] *= times[-1] // (2 * SECOND)
    (problem,) = find_problems(
        made(events, (times, positions, rotation_vectors), camera=Camera(32, 24, 560.0, 560.0, 15.5, 11.5))
    )
    assert re.search(r"jumps?; the largest is by 0.0116 m and 2.8 degrees at 15.79 s", problem.what), problem.what
