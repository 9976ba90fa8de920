"""Noise of poses: told where there is some, and taken off; nothing is taken off what is smooth."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.interpolate import make_smoothing_spline
from scipy.spatial.transform import Rotation

from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.dataparsers.recording.pose_noise import pose_noise, smoothing_spline
from enerf_ns.dataparsers.recording.recording import EventRecording, Frames
from enerf_ns.dataparsers.recording.trajectory import Trajectory

CAMERA = Camera(24, 18, 20.0, 20.0, 12.0, 9.0)


def moving(noise: float, degrees: float, poses: int = 400, seed: int = 0) -> tuple[Trajectory, np.ndarray, Rotation]:
    """A camera that shakes at 3 Hz for two seconds, 200 poses a second; its poses with noise, and without."""
    random, seconds = np.random.default_rng(seed), np.arange(poses) / 200.0
    phase = 6.0 * np.pi * seconds
    positions = 0.05 * np.stack([np.sin(phase), np.cos(phase), np.sin(0.5 * phase)], axis=1)
    turns = Rotation.from_rotvec(0.1 * np.stack([np.cos(phase), np.sin(0.7 * phase), 20.0 * seconds], axis=1))
    noisy = turns * Rotation.from_rotvec(np.radians(degrees) * random.normal(size=(poses, 3)))
    quaternions = noisy.as_quat() * np.where(random.random(poses) < 0.5, -1.0, 1.0)[:, None]  # either is the same
    given = positions + noise * random.normal(size=(poses, 3))
    return Trajectory((seconds * 1e9).astype(np.int64), given, quaternions), positions, turns


def test_noise_is_told_and_halved():
    given, positions, turns = moving(1e-3, 0.1)
    noise = pose_noise(given)
    assert noise is not None
    assert noise.position == pytest.approx(1e-3, rel=0.25) and np.degrees(noise.rotation) == pytest.approx(0.1, rel=0.3)
    smooth = noise.smooth
    assert np.sqrt(((smooth.positions - positions) ** 2).mean()) < 0.5e-3
    off = (turns.inv() * Rotation.from_quat(smooth.quaternions)).as_rotvec()
    assert np.degrees(np.sqrt((off**2).mean())) < 0.05
    assert noise.pixels(500.0, 2.0) == pytest.approx(500 * np.hypot(noise.position / 2, noise.rotation))


def test_noise_of_rotations_is_estimated_as_well_as_that_of_positions():
    found = [pose_noise(moving(1e-3, 0.1, seed=seed)[0]) for seed in range(8)]
    shares = [(one.position / 1e-3, np.degrees(one.rotation) / 0.1) for one in found if one is not None]
    np.testing.assert_allclose(np.mean(shares, axis=0), 0.95, atol=0.05)


def test_what_is_smooth_stays():
    given, positions, turns = moving(0.0, 0.0)
    noise = pose_noise(given)
    assert noise is not None and noise.pixels(500.0, 1.0) < 0.01
    np.testing.assert_allclose(noise.smooth.positions, positions, atol=1e-5)
    off = (turns.inv() * Rotation.from_quat(noise.smooth.quaternions)).magnitude()
    assert off.max() < 1e-4


def test_a_camera_that_stands_still_does_not_move():
    times = np.arange(50) * 5_000_000
    given = Trajectory(times, np.tile([1.0, 2.0, 3.0], (50, 1)), np.tile([0.0, 0.0, 0.0, 1.0], (50, 1)))
    noise = pose_noise(given)
    assert noise is not None and noise.position < 1e-12
    np.testing.assert_allclose(noise.smooth.positions, given.positions, atol=1e-9)


def test_of_few_poses_nothing_is_told():
    given, _, _ = moving(1e-3, 0.1, poses=10)
    assert pose_noise(given) is None


def test_a_mounted_camera_stays_mounted():
    given, _, _ = moving(1e-3, 0.1)
    mount = np.eye(4)
    mount[:3, 3] = [0.1, 0.0, -0.2]
    noise = pose_noise(given.of_mounted(mount))
    assert noise is not None and noise.smooth.body is not None
    again = noise.smooth.body[0].of_mounted(mount)
    np.testing.assert_allclose(again.positions, noise.smooth.positions, atol=1e-9)


def test_a_camera_of_the_frames_stays_where_it_is_mounted():
    """On the camera of the events, whose poses are smoothed."""
    given, _, _ = moving(1e-3, 0.1)
    mount = np.eye(4)
    mount[:3] = np.column_stack([Rotation.from_rotvec([0.1, -0.2, 0.3]).as_matrix(), [0.05, -0.02, 0.01]])
    frames = Frames((Path("0.png"),), given.times[5:6], CAMERA, given.of_mounted(mount))
    recording = EventRecording(Path("memory"), "test", CAMERA, given, lambda: iter(()), (), frames=frames)
    smooth = recording.selected(None, False, smooth_poses=True)
    assert smooth.frames is not None and not np.array_equal(smooth.trajectory.positions, given.positions)
    expected, found = smooth.trajectory.of_mounted(mount), smooth.frames.trajectory
    np.testing.assert_allclose(found.positions, expected.positions, atol=1e-12)
    off = Rotation.from_quat(found.quaternions).inv() * Rotation.from_quat(expected.quaternions)
    assert off.magnitude().max() < 1e-9

    other, _, _ = moving(1e-3, 0.1, seed=1)  # tracked by itself, at the same times
    frames = replace(frames, trajectory=other)
    smooth = replace(recording, frames=frames).selected(None, False, smooth_poses=True)
    alone = pose_noise(other)
    assert smooth.frames is not None and alone is not None
    np.testing.assert_array_equal(smooth.frames.trajectory.positions, alone.smooth.positions)


@pytest.mark.parametrize("noise", [0.0, 1e-3, 0.1])
@pytest.mark.parametrize("number", [5, 6, 20, 60])
def test_smoothing_is_that_of_scipy(number: int, noise: float):
    """At uneven knots, also in how smooth it chooses to be."""
    random = np.random.default_rng(number)
    places = np.cumsum(random.uniform(0.5, 1.5, number))
    values = np.sin(9.0 * places / number) + noise * random.normal(size=number)
    expected = make_smoothing_spline(places, values)(places)
    np.testing.assert_allclose(smoothing_spline(places, values), expected, atol=1e-6)
