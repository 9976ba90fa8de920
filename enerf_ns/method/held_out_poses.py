"""The distance of held-out views from the poses of the training."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int64

if TYPE_CHECKING:
    from enerf_ns.method.datamanager import EnerfDataManager

CLOSE = 0.01
"""Largest difference of a held-out view on a trajectory of its own from a pose of the training, to be on its path. It
is the distance as a share of the view's depth plus the angle in radians: about the shift of the picture as a share of
the focal length."""

INSTANTS = 1000
"""Number of poses along the trajectory of the events with which held-out views are compared."""


def nearest_poses(
    held_out: Float64[np.ndarray, "views 3 4"],
    training: Float64[np.ndarray, "poses 3 4"],
    depths: Float64[np.ndarray, " views"],
) -> tuple[Float64[np.ndarray, " views"], Float64[np.ndarray, " views"]]:
    """Distance (metres) and angle (radians) of each held-out view to the nearest pose of the training.

    The nearest pose has the least sum of the distance, as a share of the view's depth, and the angle.

    Args:
        held_out: Poses of the views, camera to world, metres.
        training: Poses of the training, camera to world, metres.
        depths: Median depth of each held-out view, metres.
    """
    distances = np.linalg.norm(held_out[:, None, :, 3] - training[None, :, :, 3], axis=-1)
    angles = rotation_angles(held_out[:, None, :, :3], training[None, :, :, :3])
    nearest = np.argmin(distances / depths[:, None] + angles, axis=1)[:, None]
    return np.take_along_axis(distances, nearest, 1)[:, 0], np.take_along_axis(angles, nearest, 1)[:, 0]


def rotation_angles(
    first: Float64[np.ndarray, "*batch 3 3"], second: Float64[np.ndarray, "*batch 3 3"]
) -> Float64[np.ndarray, "*batch"]:
    """Angle (radians) between two rotations, precise for small angles too: the norm of their difference is
    sqrt(8) sin(angle / 2)."""
    apart = np.linalg.norm(first - second, axis=(-2, -1))
    return 2.0 * np.arcsin(np.clip(apart / np.sqrt(8.0), 0.0, 1.0))


def on_path(
    times: Int64[np.ndarray, " views"] | None,
    spans: Int64[np.ndarray, "spans 2"],
    differences: Float64[np.ndarray, " views"],
) -> Bool[np.ndarray, " views"]:
    """Whether each held-out view lies on the path of the training.

    A view on the clock of the training does so if its time is in a span of the training. Any view does so if its
    difference from the nearest pose is at most `CLOSE`.

    Args:
        times: Times of the views, ns; None if they have a clock of their own.
        spans: First and last instant of each span of the training, ns.
        differences: Distance to the nearest pose, as a share of the depth, plus the angle in radians.
    """
    close = differences <= CLOSE
    if times is None:
        return close
    return close | ((times[:, None] >= spans[:, 0]) & (times[:, None] <= spans[:, 1])).any(axis=1)


def held_out_numbers(
    manager: EnerfDataManager, chosen: Int64[np.ndarray, " views"], depths: Float64[np.ndarray, " views"]
) -> dict[str, float]:
    """Numbers that say how far the held-out views are from the training.

    Args:
        manager: Data manager of a recording with held-out frames.
        chosen: Numbers of the held-out frames, from 0.
        depths: Median depth of each of them, metres.

    Returns:
        held_out_on_path, how many are `on_path`; and means over them of held_out_distance (metres),
        held_out_distance_share (of the median depth) and held_out_angle (degrees) to the nearest pose of the training:
        of the events at `INSTANTS` and at the times of the views, and of the frames that are learnt from.
    """
    held_out, recording, supervision = manager.eval_dataset.frames, manager.recording, manager.config.supervision
    times = held_out.times[chosen] if recording.held_out_frames is None else None
    poses, spans = [], []
    if "events" in supervision:
        spans.append(recording.stretches)
        instants = recording.instants(INSTANTS)
        if times is not None:
            begins, ends = recording.stretches.T
            covered = ((times[:, None] >= begins) & (times[:, None] <= ends)).any(axis=1)
            instants = np.concatenate([instants, times[covered]])
        poses.append(recording.trajectory.poses(torch.from_numpy(instants)))
    if "frames" in supervision:
        frames = manager.train_dataset.frames
        spans.append(np.array([[frames.times.min(), frames.times.max()]]))
        poses.append(frames.trajectory.poses(torch.from_numpy(frames.times)))
    seen = held_out.trajectory.poses(torch.from_numpy(held_out.times[chosen])).numpy()
    distances, angles = nearest_poses(seen, torch.cat(poses).numpy(), depths)
    shares = distances / depths
    return {
        "held_out_on_path": int(on_path(times, np.concatenate(spans), shares + angles).sum()),
        "held_out_distance": float(distances.mean()),
        "held_out_distance_share": float(shares.mean()),
        "held_out_angle": float(np.degrees(angles).mean()),
    }
