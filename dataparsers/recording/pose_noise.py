"""Estimates white noise of poses, and smooths trajectories."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64
from scipy.interpolate import make_smoothing_spline

from enerf_ns.dataparsers.recording.trajectory import Trajectory

FEWEST_POSES = 20
"""Least number of poses for an estimate of the noise."""

MOST_POSES = 200_000
"""Largest number of poses that are smoothed. More poses, as at the rate of an inertial sensor, have filtered noise."""


@dataclass(frozen=True, eq=False)
class PoseNoise:
    """Noise that is independent from pose to pose."""

    position: float
    """Standard deviation along an axis, metres. It is a lower bound, since part of the noise looks like motion."""
    rotation: float
    """Standard deviation about an axis, radians."""
    smooth: Trajectory
    """The trajectory without the estimated noise."""

    def pixels(self, focal_length: float, depth: float) -> float:
        """Returns the standard deviation of the shift of the image along an axis, pixels.

        Args:
            focal_length: Pixels.
            depth: Typical depth of the scene, metres.
        """
        return float(focal_length * np.hypot(self.position / depth, self.rotation))


def pose_noise(given: Trajectory) -> PoseNoise | None:
    """Returns the noise of a trajectory, and the smooth trajectory.

    Positions and quaternions are smoothed by cubic smoothing splines, whose smoothness is chosen by generalised
    cross-validation (Craven and Wahba, Numerische Mathematik 1979; SciPy's `make_smoothing_spline`).

    Returns:
        None if there are fewer than `FEWEST_POSES` or more than `MOST_POSES` poses.
    """
    times = given.times
    if not FEWEST_POSES <= len(times) <= MOST_POSES:
        return None
    quaternions = given.quaternions / np.linalg.norm(given.quaternions, axis=1, keepdims=True)
    turned = np.sum(quaternions[1:] * quaternions[:-1], axis=1) < 0.0
    quaternions = quaternions * np.where(np.cumsum(np.append(False, turned)) % 2, -1.0, 1.0)[:, None]
    positions, position = _smoothed(times, given.positions)
    rotations, rotation = _smoothed(times, quaternions)
    smooth = Trajectory(times, positions, rotations)
    if given.body is not None:
        body, mount = given.body
        camera_from_body = np.linalg.inv(mount)
        smooth_body = smooth.of_mounted(camera_from_body)
        smooth.body = Trajectory(body.times, smooth_body.positions, smooth_body.quaternions), mount
    return PoseNoise(position, 2.0 * rotation, smooth)


def _smoothed(
    times: Int64[np.ndarray, " poses"], values: Float64[np.ndarray, "poses columns"]
) -> tuple[Float64[np.ndarray, "poses columns"], float]:
    """Returns smooth columns, and the standard deviation of the noise that was removed."""
    seconds = 1e-9 * (times - times[0])
    places = seconds / np.median(np.diff(seconds))  # so that the smoothness is of the order of 1
    found, taken = np.empty_like(values), 0.0
    for column, value in enumerate(values.T):
        middle, size = value.mean(), float(np.ptp(value)) or 1.0
        scaled = (value - middle) / size
        smooth = make_smoothing_spline(places, scaled)(places)
        found[:, column] = middle + size * smooth
        taken += float(np.sum((value - found[:, column]) ** 2))
    return found, float(np.sqrt(taken / values.size))
