"""Trajectories of the simulated camera: motions, key frames, recordings and files of poses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64
from scipy.interpolate import PchipInterpolator
from scipy.spatial.transform import Rotation

from enerf_ns.dataparsers.formats.columns import FARTHEST
from enerf_ns.dataparsers.formats.registry import read_recording
from enerf_ns.dataparsers.formats.text_tables import parse_numbers, parse_times, read_poses, read_rows
from enerf_ns.dataparsers.recording.errors import RecordingError
from enerf_ns.dataparsers.recording.trajectory import Trajectory

POSES_PER_SECOND = 1000

SHORTEST, LONGEST = 10**6, 10**12
"""Shortest and longest duration (ns) of a trajectory from a file. Other durations mean that the unit of the times is
wrong."""

SMALLEST_DISTANCE = 1e-3
"""Smallest distance between a camera and its target, metres."""

STEEPEST_LOOK = 0.01
"""Smallest angle between the optical axis and the vertical, radians; below it, an upright camera is not defined."""


def shake(
    duration: int, camera: np.ndarray, target: np.ndarray, rng: np.random.Generator, turns_per_second: float = 9.5
) -> Trajectory:
    """Forward-facing random motion with abrupt turns: up to 0.3 m sideways and in height, 0.15 m forward and back,
    10 degrees of yaw and pitch and 5 of roll about looking at the target.

    Args:
        duration: Nanoseconds.
        camera: Mean position of the camera, float64 [3], metres.
        target: Point that the camera looks at from its mean position, float64 [3], metres.
        rng: Draws the way points.
        turns_per_second: Way points per second, at which the camera turns.
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
    duration: int, camera: np.ndarray, target: np.ndarray, rng: np.random.Generator, turns_per_second: float = 3
) -> Trajectory:
    """Inward-facing spiral around the line from the camera to the target: its radius shrinks from 0.5 to 0.1 metres.

    The arguments are those of `shake`, but `rng` draws the angle at the start, and a turn is one round.
    """
    times = _pose_times(duration)
    done = times / duration
    angle = 2 * np.pi * (turns_per_second * times * 1e-9 + rng.uniform())
    radius = 0.5 - 0.4 * done
    offsets = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.zeros(len(times))], axis=1)
    positions = camera + look_at(camera, target).apply(offsets)
    return Trajectory(times, positions, look_at(positions, target).as_quat())


MOTIONS = {"shake": shake, "spiral": spiral}


def key_frames(path: Path) -> Trajectory:
    """The trajectory of an upright camera through the key frames of a text file.

    Each line of the file is a key frame, `t_s x y z tx ty tz`: time in seconds, position of the camera and position of
    the target that it looks at, in metres, z up. Between key frames both positions are interpolated by PCHIP (Fritsch
    and Butland, 1984), which never leaves the range of neighbouring key frames. The trajectory begins at time 0.

    Raises:
        RecordingError: The file is missing or is no such table; it has fewer than two rows, a position beyond 1e9 m, or
            times that do not increase or last less than a millisecond or more than 1000 seconds; or the camera reaches
            its target or looks straight up or down.
    """
    columns = "t_s x y z tx ty tz"
    rows, numbers = read_rows(path, columns)
    if len(rows) < 2:
        raise RecordingError(f"{path} holds one key frame, but at least 2 were expected, with the columns {columns}.")
    keys = _from_zero(path, parse_times(path, [row[0] for row in rows], numbers, "s"), "must be in seconds")
    places = parse_numbers(path, [row[1:] for row in rows], numbers)
    if (far := np.abs(places).max(1) > FARTHEST).any():
        raise RecordingError(
            f"{path}, line {numbers[np.argmax(far)]} holds a place beyond {FARTHEST:g} m, where none was expected."
        )
    counts = np.maximum(1, np.diff(keys) * POSES_PER_SECOND // 10**9)
    steps = [np.linspace(keys[i], keys[i + 1], count, endpoint=False) for i, count in enumerate(counts)]
    times = np.append(np.concatenate(steps), keys[-1]).astype(np.int64)
    cameras, targets = np.hsplit(PchipInterpolator(keys, places)(times), 2)
    _check_looks(path, times, targets - cameras)
    return Trajectory(times, cameras, look_at(cameras, targets).as_quat())


def from_file(path: Path, notes: list[str], unit: str = "s") -> Trajectory:
    """The trajectory of a recording's event camera or of a pose file, shifted to begin at time 0.

    Args:
        path: Folder of a recording in any format that `read_recording` reads, or a text file with one pose a line,
            `t px py pz qx qy qz qw`: camera to world, OpenCV axes, metres.
        notes: Gets a sentence if quaternions of a pose file had to be normalised.
        unit: Unit of the times of a pose file: "s", "us" or "ns".

    Raises:
        RecordingError: The folder is no recording; or the file is no table of poses (see `read_poses`), or lasts less
            than a millisecond or more than 1000 seconds.
    """
    if path.is_dir():
        trajectory = read_recording(path).trajectory
        return Trajectory(trajectory.times - trajectory.start, trajectory.positions, trajectory.quaternions)
    times, positions, quaternions = read_poses(path, unit, notes)
    return Trajectory(_from_zero(path, times, f"were taken to be in {unit}"), positions, quaternions)


def sampled(trajectory: Trajectory, per_second: int) -> Trajectory:
    """The trajectory sampled at this many poses per second, at whole microseconds, with a last pose at its end.

    A trajectory that already has this many poses per second is returned as it is.
    """
    period = 10**9 // per_second
    if abs(np.median(np.diff(trajectory.times)) - period) < 1000:
        return trajectory
    count = max(0, trajectory.end - trajectory.start - period // 2) * per_second // 10**9 + 1
    times = trajectory.start + np.arange(count) * 10**6 // per_second * 1000
    times = np.append(times, trajectory.end)
    poses = trajectory.poses(torch.from_numpy(times)).numpy()
    return Trajectory(times, poses[:, :, 3], Rotation.from_matrix(poses[:, :, :3]).as_quat())


def look_at(camera: Float64[np.ndarray, "*batch 3"], target: Float64[np.ndarray, "*batch 3"]) -> Rotation:
    """Rotations, camera to world, of upright cameras that look at a target; z is up in the world."""
    forward = _normalised(target - camera)
    right = _normalised(np.cross(forward, [0, 0, 1]))
    return Rotation.from_matrix(np.stack([right, np.cross(forward, right), forward], axis=-1))


def _normalised(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def _pose_times(duration: int) -> np.ndarray:
    return np.linspace(0, duration, max(200, round(duration * 1e-9 * POSES_PER_SECOND)) + 1).astype(np.int64)


def _from_zero(path: Path, times: np.ndarray, unit: str) -> np.ndarray:
    if not SHORTEST <= times[-1] - times[0] <= LONGEST:
        raise RecordingError(
            f"{path} lasts {(times[-1] - times[0]) * 1e-9:.6g} s, but between a millisecond and 1000 seconds were "
            f"expected; its times {unit}."
        )
    return times - times[0]


def _check_looks(path: Path, times: np.ndarray, looks: np.ndarray) -> None:
    """Refuses looks [N, 3] from camera to target that, at or between poses, are too short or vertical."""
    near = _closest(looks) < SMALLEST_DISTANCE
    steep = _closest(looks[:, :2]) < STEEPEST_LOOK * np.linalg.norm(looks[1:], axis=1)
    for wrong, what, advice in (
        (near, "is at its target", "move one of them"),
        (steep, "looks straight up or down, where no side of the picture is the upper one", "look past the vertical"),
    ):
        if wrong.any():
            time = times[:-1][wrong][0] * 1e-9
            raise RecordingError(f"{path}: {time:.3f} s after its beginning the camera {what}; {advice}.")


def _closest(points: np.ndarray) -> np.ndarray:
    """Smallest distance [N - 1] from the origin to the line from each point [N, D] to the next."""
    first, step = points[:-1], np.diff(points, axis=0)
    square = (step**2).sum(1)
    passed = np.divide(-(first * step).sum(1), square, out=np.zeros(len(step)), where=square > 0).clip(0, 1)
    return np.linalg.norm(first + passed[:, None] * step, axis=1)
