"""Where the scene lies, in the recording's world and in Nerfstudio's box of size 2."""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from enerf_ns.dataparsers.recording.recording import EventRecording


def scene_normalisation(
    recording: EventRecording, near: float, far: float, cube: tuple[float, float, float, float] | None = None
) -> tuple[np.ndarray, float, np.ndarray]:
    """Where the scene lies, seen from all poses of the event camera that are used, between nearest and farthest depth.

    Args:
        recording: Trajectory and camera.
        near: Nearest depth in metres.
        far: Farthest depth in metres.
        cube: Middle and half side in metres of a cube along the axes of the world, where the scene is known to be.

    Returns:
        transform (3, 4) and scale, so that a world point p becomes scale * (transform @ [p, 1]): the mean up direction
        of the cameras turned to +z, the middle of what they see moved to the origin; and the box (2, 3) of what they
        see, in scene units, whose longest side is 2. Of a cube, the world is not turned.
    """
    if cube is not None:
        return np.column_stack([np.eye(3), -np.array(cube[:3])]), 1.0 / cube[3], np.array([[-1.0] * 3, [1.0] * 3])
    trajectory, camera = recording.trajectory, recording.camera
    poses = trajectory.poses(torch.from_numpy(recording.instants(100))).numpy()
    up = -poses[:, :, 1].mean(axis=0)
    rotation = np.eye(3)
    if np.linalg.norm(up) > 0.1:
        rotation = Rotation.align_vectors([[0.0, 0.0, 1.0]], [up])[0].as_matrix()

    rows = np.linspace(0, camera.height - 1, 5).astype(int)
    columns = np.linspace(0, camera.width - 1, 5).astype(int)
    directions = camera.pixel_directions()[np.ix_(rows, columns)].reshape(-1, 3)
    points = np.concatenate([directions * near, directions * far])
    seen = np.einsum("nij,mj->nmi", poses[:, :, :3], points) + poses[:, None, :, 3]
    seen = seen.reshape(-1, 3) @ rotation.T
    low, high = seen.min(axis=0), seen.max(axis=0)
    middle, half = (low + high) / 2.0, (high - low) / 2.0
    scale = 1.0 / half.max()
    transform = np.concatenate([rotation, -middle[:, None]], axis=1)
    return transform, float(scale), np.stack([-half, half]) * scale
