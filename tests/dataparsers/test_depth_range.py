from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from enerf_ns.dataparsers.camera import Camera
from enerf_ns.dataparsers.depth_range import measure_parallax, measure_share_beyond, scene_depth_range
from enerf_ns.dataparsers.errors import RecordingError
from enerf_ns.dataparsers.formats.registry import read_recording
from enerf_ns.dataparsers.indexing import index_events
from enerf_ns.dataparsers.problems import find_problems
from enerf_ns.dataparsers.recording import EventRecording, Events
from enerf_ns.dataparsers.trajectory import Trajectory

CAMERA = Camera(width=160, height=120, fx=150.0, fy=150.0, cx=79.5, cy=59.5)
PHASE = 2 * np.pi * np.linspace(0, 1, 2000)[:, None]


def recording_of_points(points: np.ndarray, positions: np.ndarray, rotations: Rotation):
    """Events of points (world, metres), one whenever a point enters a pixel, and the depths at which they were seen.

    A tenth as many events are added at random. A pose is given each millisecond.
    """
    times = np.arange(len(positions)) * 1_000_000
    seen = np.einsum("tji,tnj->tni", rotations.as_matrix(), points - positions[:, None])
    x, y = np.rint(150 * seen[..., 0] / seen[..., 2] + 79.5), np.rint(150 * seen[..., 1] / seen[..., 2] + 59.5)
    moved = np.zeros(x.shape, bool)
    moved[1:] = (np.diff(x, axis=0) != 0) | (np.diff(y, axis=0) != 0)
    step, point = np.nonzero(moved & (x >= 0) & (x < 160) & (y >= 0) & (y < 120) & (seen[..., 2] > 0.05))
    x, y, depths = x[step, point], y[step, point], seen[step, point, 2]

    generator = np.random.default_rng(0)
    noise = len(step) // 10
    step = np.append(step, generator.integers(0, len(times), noise))
    x = np.append(x, generator.integers(0, 160, noise)).astype(np.uint16)
    y = np.append(y, generator.integers(0, 120, noise)).astype(np.uint16)
    order = np.argsort(step, kind="stable")
    events = Events(x[order], y[order], times[step[order]], np.ones(len(step), np.int8))
    return events, Trajectory(times, positions, rotations.as_quat()), depths


def points_between(near: float, far: float) -> np.ndarray:
    """250 points in front of the origin, their depths evenly spread over the octaves."""
    generator = np.random.default_rng(1)
    depths = np.exp(generator.uniform(np.log(near), np.log(far), (250, 1)))
    return depths * np.append(generator.uniform(-0.6, 0.6, (250, 2)), np.ones((250, 1)), axis=1)


def shaking(amplitude: float) -> np.ndarray:
    return amplitude * np.concatenate([np.sin(3 * PHASE), np.sin(2 * PHASE + 1), np.sin(2.5 * PHASE + 3)], axis=1)


STILL = Rotation.from_rotvec(np.zeros((2000, 3)))
TURNING = Rotation.from_rotvec(
    0.06 * np.concatenate([np.sin(2 * PHASE), np.sin(3 * PHASE + 2), np.sin(PHASE + 4)], axis=1)
)


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


def noisy(positions: np.ndarray, noise: float, kind: str, seed: int) -> np.ndarray:
    """Positions with noise of a standard deviation in metres: white, or drifting over a fifth of the recording."""
    errors = np.random.default_rng(seed).normal(size=positions.shape)
    if kind == "drift":
        errors = gaussian_filter1d(errors, len(errors) / 5, axis=0)
    return positions + noise * errors / errors.std()


@pytest.mark.parametrize("kind", ["white", "drift"])
@pytest.mark.parametrize("noise", [0.0, 1e-6, 1e-4, 1e-3, 1e-2])
def test_a_camera_that_only_turns_is_told_by_its_events(noise: float, kind: str):
    events, trajectory, _ = recording_of_points(points_between(1, 3), np.zeros((2000, 3)), TURNING)
    assert len(events) > 10_000
    positions = noisy(np.zeros((2000, 3)), noise, kind, seed=0)
    trajectory = Trajectory(trajectory.times, positions, trajectory.quaternions)
    parallax = measure_parallax(events, CAMERA, trajectory)
    assert not parallax.is_shown and parallax.is_ruled_out

    recording = EventRecording(Path("memory"), "test", CAMERA, trajectory, lambda: iter([events]), ())
    with pytest.raises(RecordingError, match=r"the camera only turns: its path spans .* no parallax; .* --depth-range"):
        scene_depth_range(recording)
    for stated in (None, (1e-3, 2e-3)):
        (problem,) = [found for found in find_problems(recording, stated) if "only turns" in found.what]
        assert "sideways" in problem.advice


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


def test_nothing_is_said_to_lie_beyond_what_the_motion_can_tell():
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
