"""Where points of the world are seen in the recordings of `recordings`, with OpenCV and SciPy alone."""

from __future__ import annotations

import cv2
import numpy as np
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs
from recordings import POSE_TIMES, poses
from scipy.interpolate import CubicSpline
from scipy.optimize import root
from scipy.spatial.transform import Rotation, Slerp

from enerf_ns.dataparsers.recording.camera import Camera


def world_to_camera(time: int) -> tuple[np.ndarray, np.ndarray]:
    """Rotation vector and translation as OpenCV takes them, from SciPy's interpolation of the poses in the file."""
    rotation = Slerp(POSE_TIMES, Rotation.from_quat(poses()[:, 3:]))(time)
    position = CubicSpline(POSE_TIMES, poses()[:, :3])(time)
    return rotation.inv().as_rotvec(), -rotation.inv().apply(position)


def project(point: np.ndarray, time: int, camera: Camera) -> np.ndarray:
    """Pixel (x, y), integer at pixel centres, where a camera sees a point of the world; by OpenCV."""
    rotation, translation = world_to_camera(time)
    distortion = np.array(camera.distortion or [0.0] * 4)
    return cv2.projectPoints(point[None], rotation, translation, camera.matrix, distortion)[0][0, 0]


def unproject(pixel: np.ndarray, depth: float, time: int, camera: Camera) -> np.ndarray:
    """The point of the world at a depth (along the optical axis) that OpenCV projects to a pixel, by root finding."""
    rotation = Rotation.from_rotvec(world_to_camera(time)[0])
    translation = world_to_camera(time)[1]

    def world(image_plane: np.ndarray) -> np.ndarray:
        return rotation.inv().apply(depth * np.array([*image_plane, 1.0]) - translation)

    found = root(lambda image_plane: project(world(image_plane), time, camera) - pixel, [0.0, 0.0], tol=1e-12)
    np.testing.assert_allclose(project(world(found.x), time, camera), pixel, atol=1e-6)
    return world(found.x)


def distance_to_rays(rays: RayBundle, points: np.ndarray, outputs: DataparserOutputs) -> np.ndarray:
    """How far the rays pass by points of the world, in scene units."""
    transform = outputs.dataparser_transform.double().numpy()
    scene = outputs.dataparser_scale * (points @ transform[:, :3].T + transform[:, 3])
    towards = scene - rays.origins.double().numpy()
    directions = rays.directions.double().numpy()
    along = np.sum(towards * directions, axis=-1)
    assert (along > 0).all(), "the points lie behind the camera"
    return np.linalg.norm(towards - along[:, None] * directions, axis=-1)
