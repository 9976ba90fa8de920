from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from enerf_ns.bench.numerics.points import (
    CAMERA,
    PHASE,
    TURNING,
    noisy,
    points_between,
    recording_of_points,
    shaking,
)
from enerf_ns.dataparsers.formats.registry import read_recording
from enerf_ns.dataparsers.index.indexing import index_events
from enerf_ns.dataparsers.inspection.problems import find_problems
from enerf_ns.dataparsers.recording.recording import EventRecording, Events
from enerf_ns.dataparsers.recording.trajectory import Trajectory
from enerf_ns.dataparsers.scene.depth_range import measure_parallax, measure_share_beyond, scene_depth_range

STILL = Rotation.from_rotvec(np.zeros((2000, 3)))


@pytest.mark.parametrize(
    ("near", "far", "positions", "rotations"),
    [
        pytest.param(1.0, 3.0, PHASE * [0.16, 0, 0], STILL, id="sideways"),
        pytest.param(1000.0, 3000.0, PHASE * [160, 0, 0], STILL, id="in other units"),
        pytest.param(2.0, 100.0, shaking(0.5), TURNING, id="shaking, deep scene"),
        pytest.param(1.0, 3.0, shaking(0.03), TURNING, id="shaking a little"),
    ],
)
def test_range_holds_the_depths_of_the_points(near, far, positions, rotations):
    events, trajectory, depths = recording_of_points(points_between(near, far), positions, rotations)
    parallax = measure_parallax(events, CAMERA, trajectory)
    estimated_near, estimated_far = parallax.depth_range
    assert parallax.is_shown and not parallax.is_ruled_out
    true_near, true_far = np.percentile(depths, [1, 99])
    assert 0.5 * true_near < estimated_near < true_near
    assert true_far < estimated_far < 2 * true_far
    assert measure_share_beyond(events, CAMERA, trajectory, parallax.depth_range) < 0.02


def test_the_clock_does_not_matter():
    events, trajectory, _ = recording_of_points(points_between(1, 3), shaking(0.03), TURNING)
    expected = measure_parallax(events, CAMERA, trajectory).depth_range
    for zero in (1_600_000_000_123_456_789, 2**62 - 10**10):
        later = Trajectory(trajectory.times + zero, trajectory.positions, trajectory.quaternions)
        moved = Events(events.x, events.y, events.t + zero, events.p)
        assert measure_parallax(moved, CAMERA, later).depth_range == expected


def test_events_in_a_gap_of_the_poses_do_not_count():
    """Nor does the way that the spline takes through the gap; where they do, the range is another."""
    events, trajectory, depths = recording_of_points(points_between(1, 3), shaking(0.1), TURNING)
    known = (trajectory.times <= 700_000_000) | (trajectory.times >= 1_300_000_000)
    cut = Trajectory(trajectory.times[known], trajectory.positions[known], trajectory.quaternions[known])
    recording = EventRecording(Path("memory"), "test", CAMERA, cut, lambda: iter([events]), ())
    near, far = scene_depth_range(recording)
    true_near, true_far = np.percentile(depths, [1, 99])
    assert 0.5 * true_near < near < true_near and true_far < far < 2 * true_far
    posed = known[events.t // 1_000_000]
    outside = Events(events.x[posed], events.y[posed], events.t[posed], events.p[posed])
    assert (near, far) == pytest.approx(measure_parallax(outside, CAMERA, trajectory).depth_range, rel=0.1)
    assert (near, far) != scene_depth_range(replace(recording, keep_pose_gaps=True))


def test_an_orbit_around_a_ball():
    generator = np.random.default_rng(2)
    points = generator.normal(size=(400, 3))
    points *= generator.uniform(0.2, 1.0, (400, 1)) / np.linalg.norm(points, axis=1, keepdims=True)
    angle = 0.9 * PHASE
    positions = 3 * np.concatenate([np.sin(angle), 0 * angle, -np.cos(angle)], axis=1)
    events, trajectory, depths = recording_of_points(points, positions, Rotation.from_euler("y", -angle))
    parallax = measure_parallax(events, CAMERA, trajectory)
    near, far = parallax.depth_range
    assert parallax.is_shown
    assert 1.0 < near < depths.min() and depths.max() < far < 8.0


@pytest.mark.parametrize("kind", ["white", "drift"])
@pytest.mark.parametrize("noise", [0.0, 1e-6, 1e-4, 1e-3, 1e-2])
def test_events_show_that_a_camera_only_turns(noise: float, kind: str):
    events, trajectory, _ = recording_of_points(points_between(1, 3), np.zeros((2000, 3)), TURNING)
    assert len(events) > 10_000
    positions = noisy(np.zeros((2000, 3)), noise, kind, seed=0)
    trajectory = Trajectory(trajectory.times, positions, trajectory.quaternions)
    parallax = measure_parallax(events, CAMERA, trajectory)
    assert not parallax.is_shown and parallax.is_ruled_out

    recording = EventRecording(Path("memory"), "test", CAMERA, trajectory, lambda: iter([events]), ())
    near, far = scene_depth_range(recording)
    assert CAMERA.fx * parallax.extent / near < 0.5 and far > near
    for stated in (None, (1e-3, 2e-3)):
        (problem,) = [found for found in find_problems(recording, stated) if "only turns" in found.what]
        assert "panorama" in problem.advice and "sideways" in problem.advice


@pytest.mark.parametrize("moved", [0.003, 0.005, 0.01, 0.02, 0.1])
@pytest.mark.parametrize("milliseconds", [150, 400, 2000])
def test_a_camera_only_turns_if_its_motion_moves_no_point_by_two_pixels_against_others(moved: float, milliseconds: int):
    """Points at 1 to 3 m. Its rotation moves all of them by 20 pixels and more."""
    positions = shaking(moved)[:milliseconds]
    events, trajectory, _ = recording_of_points(points_between(1, 3), positions, TURNING[:milliseconds])
    parallax = measure_parallax(events, CAMERA, trajectory)
    pixels = CAMERA.fx * float(np.linalg.norm(np.ptp(positions, axis=0))) * (1 - 1 / 3)
    assert parallax.is_ruled_out == (pixels < 2.0)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(1, 4))
@pytest.mark.parametrize("kind", ["white", "drift"])
def test_chance_shows_no_parallax_whatever_the_noise(kind: str, seed: int):
    """The noise's size changes nothing but the unit of length, so that seeds matter more."""
    events, trajectory, _ = recording_of_points(points_between(1, 3), np.zeros((2000, 3)), TURNING)
    positions = noisy(np.zeros((2000, 3)), 1e-3, kind, seed)
    parallax = measure_parallax(events, CAMERA, Trajectory(trajectory.times, positions, trajectory.quaternions))
    assert not parallax.is_shown and parallax.is_ruled_out


@pytest.mark.parametrize("unit", [1.0, 1000.0])
@pytest.mark.parametrize("far_points", [0, 80, 240])
def test_the_share_of_the_events_from_beyond_the_range(far_points: int, unit: float):
    """Of 400 points, some lie at 300 m and the others at 1 to 2 m."""
    generator = np.random.default_rng(4)
    depths = np.exp(generator.uniform(0.0, np.log(2.0), (400, 1)))
    depths[:far_points] = 300.0
    points = depths * np.append(generator.uniform(-0.6, 0.6, (400, 2)), np.ones((400, 1)), axis=1)
    events, trajectory, seen = recording_of_points(unit * points, unit * shaking(0.1), TURNING)
    parallax = measure_parallax(events, CAMERA, trajectory)
    assert parallax.is_shown
    for depth_range in (parallax.depth_range, (0.7 * unit, 2.9 * unit), (0.5 * unit, 20.0 * unit)):
        share = measure_share_beyond(events, CAMERA, trajectory, depth_range)
        assert share == pytest.approx(np.mean(seen > 100 * unit), abs=0.08)
        assert (share < 0.02) == (far_points == 0)


def test_no_events_lie_beyond_a_depth_that_the_motion_does_not_resolve():
    events, trajectory, _ = recording_of_points(points_between(1, 3), shaking(0.1), TURNING)
    assert measure_share_beyond(events, CAMERA, trajectory, (0.7, 1000.0)) == 0.0


def test_events_without_structure_are_refused():
    generator = np.random.default_rng(3)
    x, y = generator.integers(0, 160, 20_000), generator.integers(0, 120, 20_000)
    times = np.sort(generator.integers(0, 1_999_000_000, 20_000))
    events = Events(x.astype(np.uint16), y.astype(np.uint16), times, np.ones(20_000, np.int8))
    trajectory = Trajectory(np.arange(2000) * 1_000_000, PHASE * [0.16, 0, 0], STILL.as_quat())
    parallax = measure_parallax(events, CAMERA, trajectory)
    assert not parallax.is_shown and not parallax.is_ruled_out


@pytest.mark.slow
def test_slider_depth(shared_data: Path):
    """Its authors state depths of 0.45 to 2.07 m."""
    recording = read_recording(shared_data / "slider_depth")
    near, far = measure_parallax(index_events(recording).events(), recording.camera, recording.trajectory).depth_range
    assert 0.2 < near < 0.45 and 2.07 < far < 4.0
