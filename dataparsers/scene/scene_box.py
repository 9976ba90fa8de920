"""The box around a scene, and the transform to Nerfstudio's box of size 2."""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from enerf_ns.dataparsers.recording.recording import EventRecording


def scene_normalisation(
    recording: EventRecording,
    near: float,
    far: float,
    cube: tuple[float, float, float, float] | None = None,
    contraction_depth: float | None = None,
) -> tuple[np.ndarray, float, np.ndarray]:
    """Transform and scale from the world to the scene, and the box of all that the event camera sees in the depth
    range.

    Contraction leaves [-1, 1] as it is. So what the camera sees up to the depth of contraction is moved there.

    Args:
        recording: Its camera is placed at all poses that are used.
        near: Nearest depth, metres.
        far: Farthest depth, metres.
        cube: Middle (x, y, z) and half side, metres, of a cube along the axes of the world that holds the scene.
            Default: the box of all that the camera sees.
        contraction_depth: Depth from which space is contracted, metres. Default: the farthest. A cube takes its place.

    Returns:
        transform (3, 4) and scale: a world point p lies at scale * (transform @ [p, 1]) in the scene. The transform
        turns the mean up direction of the cameras to +z, and moves the middle of the box that reaches to the depth of
        contraction to the origin. The longest side of that box is 2. The box (2, 3) of all depths is in scene units.
        With a cube, the transform does not turn the world.
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
    end = far if contraction_depth is None else min(max(contraction_depth, near), far)
    seen = np.einsum("nij,dmj->dnmi", poses[:, :, :3], np.array([near, end, far])[:, None, None] * directions)
    seen = (seen + poses[:, None, :, 3]) @ rotation.T
    low, high = (found(seen[:2], axis=(0, 1, 2)) for found in (np.min, np.max))
    middle, half = (low + high) / 2.0, (high - low) / 2.0
    scale = 1.0 / half.max()
    transform = np.concatenate([rotation, -middle[:, None]], axis=1)
    corners = np.stack([found(seen, axis=(0, 1, 2)) for found in (np.min, np.max)])
    return transform, float(scale), (corners - middle) * scale
