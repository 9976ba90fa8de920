"""Corrections of a recording against SciPy's rotations and splines, and against trajectories that are right."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.integrate import trapezoid
from scipy.interpolate import BSpline
from scipy.spatial.transform import Rotation

from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.dataparsers.recording.recording import EventRecording, Frames
from enerf_ns.dataparsers.recording.trajectory import Trajectory
from enerf_ns.poses.corrections import Corrections, Drift, DriftBasis, poses_at

CAMERA = Camera(24, 18, 20.0, 22.0, 11.0, 9.5)
OTHER = Camera(30, 20, 25.0, 25.0, 15.0, 10.0)
MILLISECOND = 1_000_000
SPAN = 1000 * MILLISECOND
MOUNT = np.eye(4)
MOUNT[:3, :3] = Rotation.from_rotvec([0.1, -0.2, 0.3]).as_matrix()
MOUNT[:3, 3] = [0.05, -0.02, 0.01]


def trajectory(step: int = 5 * MILLISECOND) -> Trajectory:
    """Smooth, over a second."""
    times = np.arange(0, SPAN + step, step)
    phase = 2.0 * np.pi * times / SPAN
    positions = np.stack([np.sin(phase), np.cos(2 * phase), 0.3 * phase], axis=1)
    turns = 0.4 * np.stack([np.cos(phase), np.sin(phase), np.sin(3 * phase)], axis=1)
    return Trajectory(times, positions, Rotation.from_rotvec(turns).as_quat())


def made(path: Path, own_frames: bool = False) -> EventRecording:
    moving = trajectory()
    of_frames = moving.of_mounted(MOUNT) if own_frames else moving
    times = np.arange(50, 951, 100) * MILLISECOND
    names = tuple(path / f"{number}.png" for number in range(len(times)))
    frames = Frames(names, times, OTHER if own_frames else CAMERA, of_frames)
    return EventRecording(path, "made", CAMERA, moving, lambda: iter(()), (), frames=frames)


def test_a_basis_has_no_mean_and_spans_all_other_splines():
    basis = DriftBasis(100, 100 + SPAN, 6)
    times = 100 + np.linspace(0, SPAN, 20001).astype(np.int64)
    values = basis.at(times)
    assert values.shape == (20001, basis.size) and basis.size == 8
    assert np.abs(trapezoid(values, times / SPAN, axis=0)).max() < 1e-6
    knots = np.pad(np.linspace(0, 1, 7), 3, mode="edge")
    spline = BSpline(knots, np.random.default_rng(0).normal(size=9), 3)((times - 100) / SPAN)
    wanted = spline - trapezoid(spline, times / SPAN)
    found = values @ np.linalg.lstsq(values, wanted, rcond=None)[0]
    assert np.abs(found - wanted).max() < 1e-4
    np.testing.assert_array_equal(basis.at(np.array([0, 200 + SPAN])), basis.at(np.array([100, 100 + SPAN])))


def test_roughness_is_that_of_the_splines_coefficients():
    basis = DriftBasis(0, SPAN, 7)
    coefficients = np.random.default_rng(0).normal(size=basis.size)
    times = np.linspace(0, SPAN, 4001).astype(np.int64)
    knots = np.pad(np.linspace(0, 1, 8), 3, mode="edge")
    design = BSpline.design_matrix((times / SPAN).clip(0, 1 - 1e-12), knots, 3).toarray()
    splines = np.linalg.lstsq(design, basis.at(times) @ coefficients, rcond=None)[0]
    assert coefficients @ basis.roughness @ coefficients == pytest.approx((np.diff(splines, n=2) ** 2).sum(), rel=1e-4)


def test_poses_are_shifted_in_time_then_mounted_then_drift():
    given, basis = trajectory(), DriftBasis(0, SPAN, 6)
    drift = 0.01 * np.random.default_rng(0).normal(size=(basis.size, 6))
    turn, shift = (0.01, -0.02, 0.03), (0.002, 0.004, -0.001)
    corrections = Corrections(5.0, 0.0, turn, shift, drift=Drift(basis, drift))
    times = np.array([100, 333, 800]) * MILLISECOND
    pose = np.tile(np.eye(4), (3, 1, 1))
    pose[:, :3] = given.poses(torch.from_numpy(times + 5 * MILLISECOND)).numpy()
    mount = np.eye(4)
    mount[:3, :3], mount[:3, 3] = Rotation.from_rotvec(turn).as_matrix(), shift
    values, moved = basis.at(times) @ drift, np.tile(np.eye(4), (3, 1, 1))
    moved[:, :3, :3], moved[:, :3, 3] = Rotation.from_rotvec(values[:, 3:]).as_matrix(), values[:, :3]
    expected = pose @ mount @ moved
    np.testing.assert_allclose(corrections.poses(given, times), expected[:, :3], atol=1e-12)
    refined = corrections.trajectory(given)
    np.testing.assert_allclose(refined.poses(torch.from_numpy(times)).numpy(), expected[:, :3], atol=2e-5)
    assert (refined.start, refined.end) == (given.start, given.end)


@pytest.mark.parametrize(("delay", "rate"), [(-20.0, 0.0), (3.5, 0.0), (20.0, 0.0), (5.0, 8.0), (0.0, -8.0)])
def test_a_clock_that_is_set_back_gives_the_right_trajectory(delay: float, rate: float):
    """Of a rate, too, by which the delay grows from the middle of the poses on."""
    right = trajectory()
    shifts = delay * MILLISECOND + 1e-3 * rate * (right.times - SPAN / 2)
    late = Trajectory(right.times + shifts.round().astype(np.int64), right.positions, right.quaternions)
    since = 1e-6 * ((late.start + late.end) // 2 - SPAN / 2)  # by which the middle of the late poses is later
    corrections = Corrections(delay + 1e-3 * rate * since, delay_rate=rate)
    refined, shift = corrections.trajectory(late), round(1e6 * (abs(delay) + abs(rate)))
    first, last = max(late.start, right.start), min(late.end, right.end) - shift
    inside = np.linspace(first + 20 * MILLISECOND, last - 20 * MILLISECOND, 200).astype(np.int64)
    found, wanted = (one.poses(torch.from_numpy(inside)).numpy() for one in (refined, right))
    np.testing.assert_allclose(found, wanted, atol=5e-5)
    assert (refined.start, refined.end) == (late.start, late.end)
    own = right.times[20:-20]
    assert np.abs(corrections.stamped(late, own) - late.times[20:-20]).max() <= 2


def test_beyond_its_ends_a_trajectory_goes_on_at_its_last_speed():
    """A camera at constant speed, that turns at a constant rate, goes on exactly."""
    times = np.arange(5) * 10 * MILLISECOND
    seconds = times * 1e-9
    turns = Rotation.from_rotvec(np.outer(seconds, [0.5, 0.2, -0.3]))
    given = Trajectory(times, np.outer(seconds, [1.0, -2.0, 0.5]), turns.as_quat())
    beyond = np.array([-25, -1, 41, 70]) * MILLISECOND
    found = poses_at(given, beyond)
    np.testing.assert_allclose(found[:, :, 3], np.outer(beyond * 1e-9, [1.0, -2.0, 0.5]), atol=1e-12)
    expected = Rotation.from_rotvec(np.outer(beyond * 1e-9, [0.5, 0.2, -0.3])).as_matrix()
    np.testing.assert_allclose(found[:, :, :3], expected, atol=1e-9)


def test_frames_of_the_events_camera_share_its_trajectory_and_lens(tmp_path: Path):
    given = made(tmp_path)
    refined = Corrections(5.0, focal_scale=1.1).recording(given)
    assert refined.frames is not None and refined.frames.trajectory is refined.trajectory
    assert refined.frames.camera == refined.camera and refined.camera.fx == pytest.approx(22.0)
    assert refined.as_read is given


def test_a_camera_of_their_own_stays_where_it_is_mounted(tmp_path: Path):
    given = made(tmp_path, own_frames=True)
    refined = Corrections(5.0, 3.0, (0.01, 0.02, 0.0), (0.0, 0.003, 0.0), focal_scale=1.1).recording(given)
    assert given.frames is not None and refined.frames is not None and refined.frames.camera == OTHER
    np.testing.assert_array_equal(refined.frames.times, given.frames.times - 3 * MILLISECOND)
    times = torch.from_numpy(refined.frames.times)
    events, frames = (
        np.concatenate([one.poses(times).numpy(), np.tile([[[0.0, 0.0, 0.0, 1.0]]], (len(times), 1, 1))], axis=1)
        for one in (refined.trajectory, refined.frames.trajectory)
    )
    np.testing.assert_allclose(np.linalg.inv(events) @ frames, np.tile(MOUNT, (len(times), 1, 1)), atol=1e-4)


@pytest.mark.parametrize("delay", [3.0, -4.0])
@pytest.mark.parametrize("step", [10, 50])
def test_the_mount_of_a_camera_is_the_same_at_each_corrected_pose(delay: float, step: int):
    """Also at both ends, which lie between given poses, where two splines through them differ."""
    moving = trajectory(step * MILLISECOND)
    times = np.arange(50, 951, 100) * MILLISECOND
    frames = Frames(tuple(map(Path, times.astype(str))), times, OTHER, moving.of_mounted(MOUNT))
    given = EventRecording(Path("made"), "made", CAMERA, moving, lambda: iter(()), (), frames=frames)
    refined = Corrections(delay).recording(given)
    assert refined.frames is not None
    np.testing.assert_array_equal(refined.frames.trajectory.times, refined.trajectory.times)
    expected = refined.trajectory.of_mounted(MOUNT)
    np.testing.assert_allclose(refined.frames.trajectory.positions, expected.positions, atol=1e-7)
    turns = Rotation.from_quat(refined.frames.trajectory.quaternions).inv() * Rotation.from_quat(expected.quaternions)
    assert turns.magnitude().max() < 1e-7


@pytest.mark.parametrize("own_frames", [False, True])
@pytest.mark.parametrize("frame_delay", [30.0, -30.0])
def test_frames_keep_their_exposures_when_they_are_corrected_to_beyond_the_poses(own_frames: bool, frame_delay: float):
    """At each instant of an exposure, the camera is where it is at that time."""
    moving = trajectory()
    of_frames = moving.of_mounted(MOUNT) if own_frames else moving
    times = np.arange(10, 991, 35) * MILLISECOND
    exposures = np.full(len(times), 18 * MILLISECOND)
    names = tuple(map(Path, times.astype(str)))
    frames = Frames(names, times, OTHER if own_frames else CAMERA, of_frames, exposures=exposures)
    given = EventRecording(Path("made"), "made", CAMERA, moving, lambda: iter(()), (), frames=frames)
    corrections = Corrections(frame_delay=frame_delay)
    found = corrections.frames(frames, given)
    shift = round(frame_delay) * MILLISECOND
    np.testing.assert_array_equal(found.exposed, frames.exposed - shift)
    poses = found.trajectory.poses(torch.from_numpy(found.exposed)).numpy()
    expected = poses_at(of_frames, found.exposed.flatten()).reshape(poses.shape)
    np.testing.assert_allclose(poses, expected, atol=0.01)  # after 30 ms at 6 m/s
    inside = of_frames.covers(found.exposed)
    np.testing.assert_allclose(poses[inside], expected[inside], atol=1e-3)
    kept = corrections.recording(given).frames
    assert kept is not None and kept.trajectory is of_frames
    np.testing.assert_array_equal(kept.times, found.times[of_frames.covers(found.times)])
    assert len(kept.times) == len(times) - 1


def test_a_camera_moves_on_evenly_beyond_poses_with_noise():
    """A spline through the last poses and one that is far away would swing."""
    times, random = np.arange(0, 1001, 5) * MILLISECOND, np.random.default_rng(0)
    positions = 1e-9 * times[:, None] * [1.0, 0.0, 0.0] + 2e-4 * random.normal(size=(len(times), 3))
    noisy = Trajectory(times, positions, np.tile([0.0, 0.0, 0.0, 1.0], (len(times), 1)))
    instants = np.arange(10, 991, 35) * MILLISECOND
    frames = Frames(tuple(map(Path, instants.astype(str))), instants, CAMERA, noisy)
    given = EventRecording(Path("made"), "made", CAMERA, noisy, lambda: iter(()), (), frames=frames)
    found = Corrections(frame_delay=-100.0).frames(frames, given)
    poses = found.trajectory.poses(torch.from_numpy(found.times)).numpy()
    np.testing.assert_allclose(poses[:, :, 3], poses_at(noisy, found.times)[:, :, 3], atol=5e-4)


def test_nothing_wrong_is_the_recording_itself(tmp_path: Path):
    given = made(tmp_path)
    nothing = Corrections()
    assert nothing.recording(given) is given and nothing.trajectory(given.trajectory) is given.trajectory
    assert nothing.words == []


def test_a_lens_without_distortion_gets_some():
    camera = Corrections(distortion=-0.05).camera(CAMERA)
    assert (camera.model, camera.distortion[0]) == ("radtan", -0.05)
    twice = Corrections(distortion=0.02).camera(camera)
    assert twice.distortion[0] == pytest.approx(-0.03)


def test_words_say_each_correction():
    drift = Drift(DriftBasis(0, SPAN, 6), np.zeros((8, 6)))
    some = Corrections(5.0, -7.0, (np.radians(1.0), 0, 0), (0.003, 0, 0.004), 1.03, 0.01, 0.1, drift, drift)
    assert some.words == [
        "poses stamped +5.00 ms late",
        "clock rate of the poses +0.100 ms per second off",
        "frames stamped -7.00 ms late",
        "mount turned by 1.00 degrees",
        "mount shifted by 5.0 mm",
        "focal length 1.0300 of the stated one",
        "distortion +0.0100",
        "a drift of the poses",
        "noise of the poses",
    ]
