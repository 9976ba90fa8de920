"""Pictures of a mesh from a camera that swings around it."""

from __future__ import annotations

from typing import Any

import numpy as np
import trimesh
from jaxtyping import Float64, UInt8
from scipy.spatial.transform import Rotation

from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.export.open3d_library import open3d

NUM_PICTURES = 24
"""Pictures of one swing."""
SWING, TILT = 40.0, 8.0
"""Degrees by which the camera swings to each side, and by which it rises and sinks."""
PULLED_BACK = 1.5
"""Distance of the camera from the middle of the mesh, relative to that of the recording's camera."""
SIDE = 320
"""Width of a picture, pixels."""
NOTHING = (214, 226, 242)
"""Colour of holes, a pale blue."""
DARKEST = 0.35
"""Brightness of surfaces that are seen edge-on, relative to those that face the camera."""


def turntable(
    mesh: trimesh.Trimesh, camera: Camera, pose: Float64[np.ndarray, "3 4"], number: int = NUM_PICTURES
) -> list[UInt8[np.ndarray, "height width 3"]]:
    """Pictures of a mesh, seen while a camera swings around its middle. Holes are pale blue.

    A surface is the darker the more it is turned away from the camera, so that dents are visible.

    Args:
        mesh: Mesh in metres with colours of its vertices, not empty.
        camera: Camera without distortion.
        pose: Pose in the middle of the swing, camera to world in OpenCV axes, metres. The camera keeps its direction,
            and is moved so that the middle of the mesh is in the middle of the picture.
        number: Number of pictures.

    Raises:
        UserError: Open3D cannot be loaded.
    """
    library = open3d()
    tensor = library.core.Tensor
    scene = library.t.geometry.RaycastingScene(nthreads=1)
    scene.add_triangles(tensor(np.asarray(mesh.vertices, np.float32)), tensor(np.asarray(mesh.faces, np.uint32)))
    visual: Any = mesh.visual
    colours = np.asarray(visual.vertex_colors, np.float32)[:, :3][mesh.faces]
    middle = np.asarray(mesh.vertices).mean(axis=0)
    distance = PULLED_BACK * float(np.linalg.norm(middle - pose[:, 3]))
    height = round(SIDE * camera.height / camera.width)
    x = (np.arange(SIDE) + 0.5 - SIDE / 2) * camera.width / SIDE / camera.fx
    y = (np.arange(height) + 0.5 - height / 2) * camera.height / height / camera.fy
    directions = np.stack([*np.meshgrid(x, y), np.ones((height, SIDE))], axis=-1)
    pictures = []
    for phase in 2.0 * np.pi * np.arange(number) / number:
        turn = Rotation.from_euler("yx", (SWING * np.sin(phase), TILT * np.sin(2.0 * phase)), degrees=True).as_matrix()
        to_world = pose[:, :3] @ turn
        place = middle - distance * to_world[:, 2]
        rays = np.concatenate([np.broadcast_to(place, directions.shape), directions @ to_world.T], axis=-1)
        hit = scene.cast_rays(tensor(rays.astype(np.float32)))
        seen = np.isfinite(hit["t_hit"].numpy())
        second, third = np.moveaxis(hit["primitive_uvs"].numpy()[seen], -1, 0)
        shares = np.stack([1.0 - second - third, second, third], axis=-1)
        colour = (shares[..., None] * colours[hit["primitive_ids"].numpy()[seen]]).sum(axis=-2)
        towards = rays[seen][:, 3:] / np.linalg.norm(rays[seen][:, 3:], axis=-1, keepdims=True)
        facing = np.abs((hit["primitive_normals"].numpy()[seen] * towards).sum(axis=-1, keepdims=True))
        picture = np.full((height, SIDE, 3), NOTHING, np.uint8)
        picture[seen] = np.rint(colour * (DARKEST + (1.0 - DARKEST) * facing)).clip(0, 255)
        pictures.append(picture)
    return pictures
