"""Gaussian splats of the surface of a run, for viewers of 3D Gaussian splatting; nothing is optimised.

The file is that of the reference code (Kerbl et al., "3D Gaussian Splatting for Real-Time Radiance Field Rendering",
SIGGRAPH 2023) with spherical harmonics of degree 0: colours that do not depend on the view.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import trimesh
from jaxtyping import Float64

from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.export.surface import SurfaceView

OPACITY = 0.95
"""Opacity at the centre of a splat."""

SPREAD = 0.75
"""Standard deviation of a splat, as a multiple of the distance of neighbouring points, so that gaps are not seen."""

CONSTANT_HARMONIC = 0.5 / np.sqrt(np.pi)
"""Spherical harmonic of degree 0. A colour c in [0, 1] is stored as (c - 0.5) / `CONSTANT_HARMONIC`."""

PROPERTIES = (
    *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"),
    *("scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
)


def splat_sizes(
    points: Float64[np.ndarray, "points 3"], camera: Camera, views: Sequence[SurfaceView], voxel: float
) -> Float64[np.ndarray, " points"]:
    """Standard deviations of splats at these points, metres.

    Neighbouring points are as far apart as a voxel or, beyond some depth, as a pixel of the nearest view.

    Args:
        points: Means of the points in each voxel, metres.
        camera: Camera without distortion.
        views: Its views.
        voxel: Side of a voxel, metres.
    """
    nearest = np.full(len(points), np.inf)
    for view in views:
        nearest = np.minimum(nearest, np.linalg.norm(points - view.pose[:, 3], axis=1))
    return SPREAD * np.maximum(nearest / camera.fx, voxel)


def encode_splats(cloud: trimesh.PointCloud, sizes: Float64[np.ndarray, " points"]) -> bytes:
    """Content of a .ply file of round splats.

    Args:
        cloud: Points in metres, with colours for a display.
        sizes: Standard deviation of each splat, metres.
    """
    rows = np.zeros((len(sizes), len(PROPERTIES)), "<f4")
    rows[:, :3] = cloud.vertices
    rows[:, 6:9] = (np.asarray(cloud.colors)[:, :3] / 255.0 - 0.5) / CONSTANT_HARMONIC
    rows[:, 9] = np.log(OPACITY / (1.0 - OPACITY))
    rows[:, 10:13] = np.log(sizes)[:, None]
    rows[:, 13] = 1.0  # the quaternion w x y z of no rotation
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    header += [*(f"property float {name}" for name in PROPERTIES), "end_header", ""]
    return "\n".join(header).encode() + rows.tobytes()
