"""Estimates white noise of poses, and smooths trajectories."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64
from scipy.optimize import minimize_scalar

from enerf_ns.dataparsers.compiled import compiled
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
    cross-validation (Craven and Wahba, Numerische Mathematik 1979).

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
    rotations, quaternion = _smoothed(times, quaternions)
    rotation = 2.0 * float(np.sqrt(4.0 / 3.0)) * quaternion  # noise moves a quaternion in three of four directions
    smooth = Trajectory(times, positions, rotations)
    if given.body is not None:
        body, mount = given.body
        camera_from_body = np.linalg.inv(mount)
        smooth_body = smooth.of_mounted(camera_from_body)
        smooth.body = Trajectory(body.times, smooth_body.positions, smooth_body.quaternions), mount
    return PoseNoise(position, rotation, smooth)


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
        found[:, column] = middle + size * smoothing_spline(places, scaled)
        taken += float(np.sum((value - found[:, column]) ** 2))
    return found, float(np.sqrt(taken / values.size))


def smoothing_spline(
    places: Float64[np.ndarray, " places"], values: Float64[np.ndarray, " places"]
) -> Float64[np.ndarray, " places"]:
    """Returns the smoothing spline at its knots, as SciPy's `make_smoothing_spline` does, which takes far longer.

    Args:
        places: Increasing, at least 5.
        values: To smooth.
    """
    smoothed, number = compiled(_smoothed_with), len(places)

    def score(penalty: float) -> float:
        smooth, freedom = smoothed(places, values, penalty)
        return float(np.sum((values - smooth) ** 2)) / freedom**2

    best = minimize_scalar(score, bounds=(0, number), method="bounded")
    return smoothed(places, values, best.x)[0]


def _smoothed_with(places, values, penalty):
    """Returns the natural cubic spline with the least sum of squared residuals plus penalty times the integral of its
    squared second derivative, and the degrees of freedom of the residuals.

    The second derivatives c at the inner knots solve (R + penalty Q^T Q) c = Q^T values (Reinsch, Numerische Mathematik
    1967). The trace needs the five central bands of the inverse of that matrix (Hutchinson and de Hoog, Numerische
    Mathematik 1985).
    """
    step = places[1:] - places[:-1]
    inner = len(step) - 1
    left, right = 1.0 / step[:-1], 1.0 / step[1:]
    middle = -left - right
    bands = np.zeros((3, inner + 2))  # of Q^T Q, with zeros behind its end
    bands[0, :inner] = left**2 + middle**2 + right**2
    bands[1, : inner - 1] = middle[:-1] * left[1:] + right[:-1] * middle[1:]
    bands[2, : inner - 2] = right[:-2] * left[2:]
    diagonal, first, second = np.zeros(inner + 2), np.zeros(inner + 2), np.zeros(inner + 2)  # of the factors L D L^T
    slopes, inverse = np.zeros(inner + 2), np.zeros((3, inner + 2))
    for i in range(inner):
        j, k = i - 1, i - 2  # which are zeros behind the end at first
        diagonal[i] = (step[i] + step[i + 1]) / 3.0 + penalty * bands[0, i]
        diagonal[i] -= first[j] ** 2 * diagonal[j] + second[k] ** 2 * diagonal[k]
        beside = penalty * bands[1, i] - first[j] * second[j] * diagonal[j]
        if i < inner - 1:
            first[i] = (beside + step[i + 1] / 6.0) / diagonal[i]
            second[i] = penalty * bands[2, i] / diagonal[i]
        slopes[i] = left[i] * values[i] + middle[i] * values[i + 1] + right[i] * values[i + 2]
        slopes[i] -= first[j] * slopes[j] + second[k] * slopes[k]
    for i in range(inner - 1, -1, -1):
        slopes[i] = slopes[i] / diagonal[i] - first[i] * slopes[i + 1] - second[i] * slopes[i + 2]
        inverse[1, i] = -first[i] * inverse[0, i + 1] - second[i] * inverse[1, i + 1]
        inverse[2, i] = -first[i] * inverse[1, i + 1] - second[i] * inverse[0, i + 2]
        inverse[0, i] = 1.0 / diagonal[i] - first[i] * inverse[1, i] - second[i] * inverse[2, i]
    smooth = values.copy()
    smooth[:-2] -= penalty * left * slopes[:inner]
    smooth[1:-1] -= penalty * middle * slopes[:inner]
    smooth[2:] -= penalty * right * slopes[:inner]
    freedom = penalty * (np.sum(bands[0] * inverse[0]) + 2.0 * np.sum(bands[1:] * inverse[1:]))
    return smooth, freedom
