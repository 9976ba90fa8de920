"""Faults that recordings are handed over with."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.dataparsers.recording.recording import EventRecording, Events
from enerf_ns.dataparsers.recording.trajectory import Trajectory

KINDS = ("frames", "blurred_frames")


def with_poses(recording: EventRecording, trajectory: Trajectory) -> EventRecording:
    frames = {kind: getattr(recording, kind) for kind in KINDS}
    frames = {kind: value and replace(value, trajectory=trajectory) for kind, value in frames.items()}
    return replace(recording, trajectory=trajectory, **frames)


def poses_late(recording: EventRecording, milliseconds: int) -> EventRecording:
    read = recording.trajectory
    return with_poses(recording, Trajectory(read.times + milliseconds * 10**6, read.positions, read.quaternions))


def frames_late(recording: EventRecording, milliseconds: int) -> EventRecording:
    frames = {kind: getattr(recording, kind) for kind in KINDS}
    return replace(
        recording,
        **{kind: value and replace(value, times=value.times + milliseconds * 10**6) for kind, value in frames.items()},
    )


def inverse(recording: EventRecording) -> EventRecording:
    read = recording.trajectory
    turned = Rotation.from_quat(read.quaternions).as_matrix().transpose(0, 2, 1)
    places = -np.einsum("nij,nj->ni", turned, read.positions)
    return with_poses(recording, Trajectory(read.times, places, Rotation.from_matrix(turned).as_quat()))


def scalar_first(recording: EventRecording) -> EventRecording:
    """The file holds w x y z, and x y z w is read."""
    read = recording.trajectory
    x, y, z, w = read.quaternions.T
    return with_poses(recording, Trajectory(read.times, read.positions, np.stack([w, x, y, z], axis=1)))


def opengl(recording: EventRecording) -> EventRecording:
    """The file holds poses of a camera that looks along -z with y up."""
    read = recording.trajectory
    turned = Rotation.from_quat(read.quaternions).as_matrix() @ np.diag([1.0, -1.0, -1.0])
    return with_poses(recording, Trajectory(read.times, read.positions, Rotation.from_matrix(turned).as_quat()))


def mirrored(recording: EventRecording, axis: int) -> EventRecording:
    """The file holds poses in a world of which an axis, and the same axis of the camera, point the other way."""
    read, mirror = recording.trajectory, np.eye(3)
    mirror[axis, axis] = -1
    turned = mirror @ Rotation.from_quat(read.quaternions).as_matrix() @ mirror
    places = read.positions @ mirror
    return with_poses(recording, Trajectory(read.times, places, Rotation.from_matrix(turned).as_quat()))


def longer_focal_length(recording: EventRecording, factor: float) -> EventRecording:
    stated = recording.camera
    camera = replace(stated, fx=stated.fx * factor, fy=stated.fy * factor)
    frames = {kind: getattr(recording, kind) for kind in KINDS}
    return replace(
        recording, camera=camera, **{kind: value and replace(value, camera=camera) for kind, value in frames.items()}
    )


def turned_events(
    recording: EventRecording, of: Callable[[Events, Camera], tuple[np.ndarray, np.ndarray]]
) -> EventRecording:
    """The file holds other x and y; both are a function of the events and the camera."""

    def events() -> Iterator[Events]:
        for read in recording.stream_events():
            x, y = of(read, recording.camera)
            yield Events(x, y, read.t, read.p)

    return replace(recording, stream_events=events)


def exchanged(recording: EventRecording, camera: str) -> EventRecording:
    """The file holds x for y and y for x.

    Args:
        recording: Whose frames stay as they are.
        camera: What is exchanged in the calibration too: "size" or "all" of it.
    """
    wrong, stated = turned_events(recording, lambda events, _: (events.y, events.x)), recording.camera
    changed = replace(stated, width=stated.height, height=stated.width)
    if camera == "all":
        k1, k2, p1, p2 = stated.distortion
        changed = replace(changed, fx=stated.fy, fy=stated.fx, cx=stated.cy, cy=stated.cx, distortion=(k1, k2, p2, p1))
    return replace(wrong, camera=changed)


def cropped(recording: EventRecording, columns: slice, rows: slice) -> EventRecording:
    """The file holds only the events of a part of the sensor, counted from its first column and row."""

    def events() -> Iterator[Events]:
        for read in recording.stream_events():
            x, y = read.x.astype(int), read.y.astype(int)
            kept = (columns.start <= x) & (x < columns.stop) & (rows.start <= y) & (y < rows.stop)
            yield Events(x[kept] - columns.start, y[kept] - rows.start, read.t[kept], read.p[kept])

    return replace(recording, stream_events=events)
