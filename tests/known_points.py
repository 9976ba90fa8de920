"""Points in space and where cameras see them, with SciPy and OpenCV alone: what readers are checked against."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import torch
from recordings import joined
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, Slerp

from enerf_ns.dataparsers.recording.recording import EventRecording, Frames

SPOT_SIZE = 1.5
"""Standard deviation of a spot, pixels."""

SPOT_RADIUS = 7
"""Beyond it a spot is black, pixels."""


def reference_poses(times: np.ndarray, positions: np.ndarray, quaternions: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Camera-to-world matrices, float64 [n, 4, 4], at some times (ns) between poses xyzw at other times (ns)."""
    seconds, at_seconds = (times - times[0]) * 1e-9, (np.asarray(at) - times[0]) * 1e-9
    poses = np.tile(np.eye(4), (len(at_seconds), 1, 1))
    poses[:, :3, :3] = Slerp(seconds, Rotation.from_quat(quaternions))(at_seconds).as_matrix()
    poses[:, :3, 3] = CubicSpline(seconds, positions)(at_seconds)
    return poses


def points_seen(
    pixels: np.ndarray, depths: np.ndarray, poses: np.ndarray, matrix: np.ndarray, distortion=(), model: str = "radtan"
) -> np.ndarray:
    """World points [n, 3] that a camera sees at pixels [n, 2] in depths [n] along its axis, from poses [n, 4, 4].

    Args:
        matrix: Of the camera, [3, 3].
        distortion: k1 k2 p1 p2 (k3) of the model "radtan", k1 to k4 of "fisheye"; none for "pinhole".
    """
    places, coefficients = np.asarray(pixels, float).reshape(-1, 1, 2), np.array(distortion, float)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 500, 1e-12)
    if model == "fisheye":
        undistorted = cv2.fisheye.undistortPoints(places, matrix, coefficients, criteria=criteria)
    else:
        undistorted = cv2.undistortPointsIter(places, matrix, coefficients, np.eye(3), np.eye(3), criteria)
    rays = np.concatenate([undistorted[:, 0], np.ones((len(undistorted), 1))], axis=1)
    return np.einsum("nij,nj->ni", poses[:, :3, :3], rays * np.asarray(depths)[:, None]) + poses[:, :3, 3]


def project(
    points: np.ndarray, poses: np.ndarray, matrix: np.ndarray, distortion=(), model: str = "radtan"
) -> np.ndarray:
    """Pixels [n, 2] at which a camera at poses [n, 4, 4] sees the points [n, 3], each from its own pose."""
    seen = np.einsum("nji,nj->ni", poses[:, :3, :3], points - poses[:, :3, 3])
    assert (seen[:, 2] > 0).all(), "a point lies behind the camera"
    zero, coefficients = np.zeros(3), np.array(distortion, float)
    if model == "fisheye":
        return cv2.fisheye.projectPoints(seen[:, None], zero, zero, matrix, coefficients)[0][:, 0]
    return cv2.projectPoints(seen[:, None], zero, zero, matrix, coefficients)[0][:, 0]


def spots_image(pixels: np.ndarray, width: int, height: int) -> np.ndarray:
    """A black picture, uint8 [height, width], with a small white spot at each of the places [n, 2]."""
    rows, columns = np.mgrid[:height, :width]
    image = np.zeros((height, width))
    for x, y in np.asarray(pixels):
        squared = (columns - x) ** 2 + (rows - y) ** 2
        image += np.where(squared < SPOT_RADIUS**2, np.exp(-squared / (2 * SPOT_SIZE**2)), 0.0)
    return np.rint(255 * image.clip(0, 1)).astype(np.uint8)


def spot_centre(image: np.ndarray, near: np.ndarray) -> np.ndarray:
    """Where the spot around a place (x, y) lies in a picture, to fractions of a pixel: its centre of mass."""
    grey = image if image.ndim == 2 else image[..., 0]
    column, row = np.rint(near).astype(int)
    rows, columns = np.mgrid[row - SPOT_RADIUS : row + SPOT_RADIUS + 1, column - SPOT_RADIUS : column + SPOT_RADIUS + 1]
    weights = grey[rows, columns].astype(float)
    assert weights.max() > 100, f"there is no spot near {near}"
    return np.array([(weights * columns).sum(), (weights * rows).sum()]) / weights.sum()


def check_events_see(recording: EventRecording, points: np.ndarray) -> None:
    """Checks that each event of a recording lies in the direction of its point [events, 3], within 0.01 pixel."""
    found = joined(recording.stream_events())
    camera_to_world = recording.trajectory.poses(torch.from_numpy(found.t)).numpy()
    seen = np.einsum("nji,nj->ni", camera_to_world[:, :, :3], points - camera_to_world[:, :, 3])
    directions = recording.camera.pixel_directions()[found.y, found.x]
    error = np.linalg.norm(seen[:, :2] / seen[:, 2:] - directions[:, :2], axis=1) * recording.camera.fx
    assert error.max() < 0.01


def check_pictures_show(frames: Frames, spots: Sequence[np.ndarray]) -> None:
    """Checks that each undistorted picture shows its points [points, 3] as spots in their place, within 0.15 pixel."""
    poses = frames.trajectory.poses(torch.from_numpy(frames.times)).numpy()
    for number, points in enumerate(spots):
        whole = np.vstack([poses[number], [0, 0, 0, 1]])[None].repeat(len(points), 0)
        for place in project(points, whole, frames.picture_camera.matrix):
            assert np.linalg.norm(spot_centre(frames.picture(number), place) - place) < 0.15
