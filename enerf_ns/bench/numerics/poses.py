"""Cases of times and poses: long recordings, late clocks, half turns."""

from __future__ import annotations

import numpy as np
import torch
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, Slerp

from enerf_ns.bench.numerics.case import case
from enerf_ns.dataparsers.recording.trajectory import Trajectory

EPOCH = 1_600_000_000 * 10**9
"""A time in 2020, nanoseconds since 1970."""


def _poses(times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Positions and quaternions of a random walk, one for each time."""
    generator = np.random.default_rng(0)
    positions = generator.normal(size=(len(times), 3)).cumsum(axis=0)
    rotations = Rotation.from_rotvec(generator.normal(size=(len(times), 3)).cumsum(axis=0))
    return positions, rotations.as_quat()


def _off_scipy(times: np.ndarray) -> float:
    """Largest difference between our poses and SciPy's, whose times start at the first pose."""
    positions, quaternions = _poses(times)
    between = np.random.default_rng(1).integers(times[0], times[-1] + 1, 1000)
    seconds, at = (times - times[0]) * 1e-9, (between - times[0]) * 1e-9
    found = Trajectory(times, positions, quaternions).poses(torch.from_numpy(between)).numpy()
    turned = found[:, :, :3] - Slerp(seconds, Rotation.from_quat(quaternions))(at).as_matrix()
    moved = found[:, :, 3] - CubicSpline(seconds, positions)(at)
    return max(np.abs(turned).max(), np.abs(moved).max())


@case("stamps of 1.6e18 ns", "poses of SciPy's slerp and cubic spline", 1e-9, "m, rad")
def epoch_stamps() -> float:
    return _off_scipy(EPOCH + np.arange(100) * 10_000_000)


@case("a recording of an hour", "poses of SciPy's slerp and cubic spline", 1e-9, "m, rad")
def an_hour() -> float:
    return _off_scipy(np.arange(3600 * 20) * 50_000_000)


@case("a recording of a millisecond", "poses of SciPy's slerp and cubic spline", 1e-9, "m, rad")
def a_millisecond() -> float:
    return _off_scipy(EPOCH + np.arange(11) * 100_000)


@case("poses 1 ns apart", "poses of SciPy's slerp and cubic spline", 1e-9, "m, rad")
def a_nanosecond() -> float:
    return _off_scipy(np.arange(2, dtype=np.int64))


@case("turns of 180 degrees between two poses", "orthonormal rotations that end at the poses", 1e-12)
def half_turns() -> float:
    times = np.arange(5) * 10**9
    turns = Rotation.from_rotvec(np.pi * np.eye(3)[[0, 1, 2, 0]])
    rotations = [Rotation.identity()]
    for turn in turns:
        rotations.append(rotations[-1] * turn)
    quaternions = np.array([rotation.as_quat() for rotation in rotations])
    trajectory = Trajectory(times, np.zeros((5, 3)), quaternions)
    between = trajectory.poses(torch.arange(0, 4 * 10**9, 10**7))[..., :3]
    at_poses = trajectory.poses(torch.from_numpy(times))[..., :3].numpy() - Rotation.from_quat(quaternions).as_matrix()
    skew = between @ between.mT - torch.eye(3, dtype=torch.float64)
    return max(float(skew.abs().max()), float(np.abs(at_poses).max()))
