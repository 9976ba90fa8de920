"""How far pictures move while they are taken, in closed form."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.dataparsers.recording.recording import Frames
from enerf_ns.dataparsers.recording.trajectory import Trajectory
from enerf_ns.poses.motion import exposure_motion

CAMERA = Camera(41, 31, 50.0, 60.0, 20.0, 15.0)
TIMES = np.arange(0, 1_000_000_001, 10_000_000)
SECONDS = TIMES * 1e-9
NEAR, FAR = 2.0, 8.0
STILL = Rotation.identity(len(TIMES))


def motion(positions: np.ndarray, rotations: Rotation, exposure: int | None, camera: Camera = CAMERA) -> np.ndarray:
    trajectory = Trajectory(TIMES, positions, rotations.as_quat())
    frames = Frames((Path("a.png"), Path("b.png")), np.array([300_000_000, 700_000_000]), camera, trajectory)
    return exposure_motion(frames.with_exposure(exposure), NEAR, FAR)


def along(axis: int, distances: np.ndarray) -> np.ndarray:
    return distances[:, None] * np.eye(3)[axis]


@pytest.mark.parametrize(("axis", "focal_length"), [(0, 50.0), (1, 60.0)])
def test_a_slide_moves_the_nearest_points_most(axis: int, focal_length: float):
    expected = 0.3 * 0.2 * focal_length / NEAR
    np.testing.assert_allclose(motion(along(axis, 0.3 * SECONDS), STILL, 200_000_000), expected, rtol=1e-9)


def test_motion_there_and_back_counts_twice():
    there_and_back = np.where(SECONDS < 0.3, SECONDS, 0.6 - SECONDS)
    trajectory = motion(along(0, there_and_back), STILL, 200_000_000)
    np.testing.assert_allclose(trajectory, 0.2 * 50.0 / NEAR, rtol=0.02)  # the spline rounds the corner


def test_a_roll_moves_the_corners_most():
    rolls = Rotation.from_rotvec(along(2, 0.5 * SECONDS))
    square = Camera(41, 41, 50.0, 50.0, 20.0, 20.0)
    expected = 0.5 * 0.2 * np.hypot(20, 20)
    np.testing.assert_allclose(motion(np.zeros((len(TIMES), 3)), rolls, 200_000_000, square), expected, rtol=1e-4)


@pytest.mark.parametrize("exposure", [0, None])
def test_an_instant_has_no_motion(exposure: int | None):
    assert (motion(along(0, SECONDS), STILL, exposure) == 0).all()


def test_points_that_the_camera_passes_have_finite_motion():
    assert np.isfinite(motion(along(2, 100 * SECONDS), STILL, 200_000_000)).all()
