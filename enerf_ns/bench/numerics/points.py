"""Events of points in closed form: an event occurs whenever a point enters another pixel."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.dataparsers.recording.recording import Events
from enerf_ns.dataparsers.recording.trajectory import Trajectory

CAMERA = Camera(width=160, height=120, fx=150.0, fy=150.0, cx=79.5, cy=59.5)
PHASE = 2 * np.pi * np.linspace(0, 1, 2000)[:, None]
TURNING = Rotation.from_rotvec(
    0.06 * np.concatenate([np.sin(2 * PHASE), np.sin(3 * PHASE + 2), np.sin(PHASE + 4)], axis=1)
)
"""Rotations of a shaking camera, one for each millisecond of two seconds."""


def shaking(amplitude: float) -> Float64[np.ndarray, "2000 3"]:
    """Positions of a shaking camera in metres, one for each millisecond of two seconds.

    Args:
        amplitude: Amplitude along each axis, metres.
    """
    return amplitude * np.concatenate([np.sin(3 * PHASE), np.sin(2 * PHASE + 1), np.sin(2.5 * PHASE + 3)], axis=1)


def recording_of_points(
    points: Float64[np.ndarray, "points 3"], positions: Float64[np.ndarray, "poses 3"], rotations: Rotation
) -> tuple[Events, Trajectory, Float64[np.ndarray, " events"]]:
    """Simulates the events of points.

    Random events without depth are added, a tenth of the number of events of points.

    Args:
        points: Points in world coordinates, metres.
        positions: Positions of `CAMERA`, metres, one for each millisecond.
        rotations: Rotations camera to world, one for each millisecond.

    Returns:
        The events, the trajectory, and the depths in metres of the events of points.
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


def points_between(near: float, far: float) -> Float64[np.ndarray, "250 3"]:
    """250 points in front of the origin, their depths (metres) evenly spread over the octaves."""
    generator = np.random.default_rng(1)
    depths = np.exp(generator.uniform(np.log(near), np.log(far), (250, 1)))
    return depths * np.append(generator.uniform(-0.6, 0.6, (250, 2)), np.ones((250, 1)), axis=1)


def noisy(positions: np.ndarray, noise: float, kind: str, seed: int) -> np.ndarray:
    """Positions with noise of a standard deviation in metres: "white", or "drift" over a fifth of the recording."""
    errors = np.random.default_rng(seed).normal(size=positions.shape)
    if kind == "drift":
        errors = gaussian_filter1d(errors, len(errors) / 5, axis=0)
    return positions + noise * errors / errors.std()
