"""Motion of a picture during its exposure."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float64

from enerf_ns.dataparsers.recording.recording import Frames

STEPS = 8
"""Parts of each exposure. Within each part, motion counts as straight."""

PLACES = 3
"""Number of pixels in a row, and in a column, of the grid that is followed."""


def exposure_motion(frames: Frames, near: float, far: float) -> Float64[np.ndarray, " frames"]:
    """The longest path of a point in the picture during each exposure, pixels.

    The points lie at both depths along the rays of `PLACES` x `PLACES` pixels in mid-exposure.

    Args:
        frames: Their exposures lie within their trajectory.
        near, far: Range of depth, metres.
    """
    camera = frames.picture_camera
    columns, rows = (np.linspace(0, side - 1, PLACES) for side in (camera.width, camera.height))
    pixels = np.stack([*np.meshgrid(columns, rows), np.ones((PLACES, PLACES))], axis=-1).reshape(-1, 3)
    rays = np.concatenate([depth * pixels @ np.linalg.inv(camera.matrix).T for depth in (near, far)])

    opens, closes = frames.exposed.T
    times = opens[:, None] + (closes - opens)[:, None] * np.arange(STEPS + 1) // STEPS
    poses = frames.trajectory.poses(torch.from_numpy(times)).numpy()
    middle = poses[:, STEPS // 2]
    points = rays @ middle[:, :, :3].transpose(0, 2, 1) + middle[:, None, :, 3]
    seen = (points[:, None] - poses[:, :, None, :, 3]) @ poses[..., :3] @ camera.matrix.T
    places = seen[..., :2] / seen[..., 2:].clip(min=1e-3 * near)  # behind the camera counts as just before it
    return np.linalg.norm(np.diff(places, axis=1), axis=-1).sum(axis=1).max(axis=1)
