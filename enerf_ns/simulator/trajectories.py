"""How the simulated camera moves."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.spatial.transform import Rotation

from enerf_ns.dataparsers.trajectory import Trajectory

POSES_PER_SECOND = 1000


def shake(
    duration: int, camera: np.ndarray, target: np.ndarray, rng: np.random.Generator, turns_per_second: float = 9.5
) -> Trajectory:
    """Forward-facing random motion with abrupt turns: up to 0.3 m sideways and in height, 0.15 m forward and back,
    10 degrees of yaw and pitch and 5 of roll about looking at the target.

    Args:
        duration: nanoseconds.
        camera: float64 [3], mean position in metres.
        target: float64 [3], what the camera looks at from there.
        rng: draws the way points.
        turns_per_second: how often the camera turns.
    """
    times = _pose_times(duration)
    knots = np.arange(int(np.ceil(duration * 1e-9 * turns_per_second)) + 2) / turns_per_second * 1e9
    amplitudes = np.array([0.3, 0.3, 0.15, *np.radians([10, 10, 5])])
    points = [rng.uniform(-1, 1, 6)]
    while len(points) < len(knots):
        point = rng.uniform(-1, 1, 6)
        if 0.8 < np.hypot(*(point - points[-1])[:2]) < 1.4:
            points.append(point)
    offsets = PchipInterpolator(knots, amplitudes * np.array(points))(times)
    mean = look_at(camera, target)
    positions = camera + mean.apply(offsets[:, :3])
    rotations = mean * Rotation.from_euler("yxz", offsets[:, 3:])
    return Trajectory(times, positions, rotations.as_quat())


def spiral(
    duration: int, camera: np.ndarray, target: np.ndarray, rng: np.random.Generator, turns: float = 3
) -> Trajectory:
    """Inward-facing spiral about the line from the camera to the target: its radius shrinks from 0.5 to 0.1 metres.

    Args as for `shake`; `rng` draws the angle at which it starts.
    """
    times = _pose_times(duration)
    done = times / duration
    angle = 2 * np.pi * (turns * done + rng.uniform())
    radius = 0.5 - 0.4 * done
    offsets = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.zeros(len(times))], axis=1)
    positions = camera + look_at(camera, target).apply(offsets)
    rotations = Rotation.concatenate([look_at(position, target) for position in positions])
    return Trajectory(times, positions, rotations.as_quat())


MOTIONS = {"shake": shake, "spiral": spiral}


def look_at(camera: np.ndarray, target: np.ndarray) -> Rotation:
    """Rotation, camera to world, of an upright camera that sees the target in its centre; z is up in the world."""
    forward = (target - camera) / np.linalg.norm(target - camera)
    right = np.cross(forward, [0, 0, 1])
    right /= np.linalg.norm(right)
    return Rotation.from_matrix(np.stack([right, np.cross(forward, right), forward], axis=1))


def _pose_times(duration: int) -> np.ndarray:
    return np.linspace(0, duration, max(200, round(duration * 1e-9 * POSES_PER_SECOND)) + 1).astype(np.int64)
