"""Faults that recordings are handed over with."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from enerf_ns.dataparsers.recording.recording import EventRecording
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
