"""The parts that both layouts of Robust e-NeRF share: poses in any order, cameras of ROS, and views for evaluation."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float64, Int64
from scipy.spatial.transform import Rotation

from enerf_ns.dataparsers.formats.columns import LATEST, unit_quaternions
from enerf_ns.dataparsers.formats.json_values import Value, open_json
from enerf_ns.dataparsers.recording.camera import Camera, CameraModel
from enerf_ns.dataparsers.recording.errors import RecordingError
from enerf_ns.dataparsers.recording.files import check_image_sizes, check_is_folder, image_size, name_links_out, of_file
from enerf_ns.dataparsers.recording.recording import Frames
from enerf_ns.dataparsers.recording.time_units import unit_by_step
from enerf_ns.dataparsers.recording.trajectory import Trajectory

SHORTEST_STEP = 1000
"""Least time between poses, nanoseconds. ESIM states poses at the times of its inertial sensor and of its images, which
may be almost equal. Stamps are rounded to nanoseconds, so the speed between two such poses would be arbitrary."""

DISTORTION_MODELS: dict[str, CameraModel] = {"plumb_bob": "radtan", "equidistant": "fisheye", "fisheye": "fisheye"}
"""Camera models of this package by ROS's name of the distortion model."""

IMAGE_SUFFIXES = ("", ".png", ".jpg", ".jpeg")
"""Suffixes of the images of views; file_path states them or not."""


def listed(names: Iterable[str]) -> str:
    """Returns the first 12 names in order; letters that cannot be printed, as in damaged files, become "?"."""
    text = ", ".join(sorted(names)[:12]) or "none"
    return "".join(letter if letter.isprintable() else "?" for letter in text)


def checked_trajectory(
    path: Path,
    times: Int64[np.ndarray, " poses"],
    positions: Float64[np.ndarray, "poses 3"],
    quaternions: Float64[np.ndarray, "poses 4"],
    notes: list[str],
) -> Trajectory:
    """Returns the trajectory of poses, camera to world, that may be out of order or repeated.

    Args:
        path: The file of the poses.
        times: Nanoseconds.
        positions: Metres.
        quaternions: xyzw.
        notes: Gets a sentence for each correction.

    Raises:
        RecordingError: There are fewer than two poses, a number is not finite, the norm of a quaternion is off by more
            than 1e-3, or most poses have the same time, as in a unit other than nanoseconds.
    """
    if len(times) < 2:
        raise RecordingError(f"{path} holds {len(times)} poses, but at least 2 were expected.")
    quaternions = unit_quaternions(path, positions, quaternions, notes, lambda row: f"pose {row + 1}")
    num_backwards = np.count_nonzero(np.diff(times) < 0)
    if num_backwards:
        notes.append(f"The poses in {path.name} go back in time {num_backwards:,} times and are sorted.")
    order = np.argsort(times, kind="stable")
    kept = order[np.diff(times[order], prepend=-LATEST) >= SHORTEST_STEP]
    dropped = len(times) - len(kept)
    if len(kept) < 2 or dropped >= len(kept):
        wrong = unit_by_step(float(np.median(np.diff(times[order]))), "ns", "poses")
        raise RecordingError(
            f"{path} holds {len(times):,} poses, but {dropped:,} of them follow another one within 1 µs; "
            f"{wrong or 'give one pose for each time, and times in nanoseconds'}."
        )
    if dropped:
        notes.append(
            f"{dropped:,} of {len(times):,} poses in {path.name} follow another one within 1 µs and are left out."
        )
    return Trajectory(times[kept], positions[kept], quaternions[kept])


def checked_camera(
    path: Path,
    width: float,
    height: float,
    matrix: Float[np.ndarray, "3 3"],
    distortion_model: str,
    distortion: Float[np.ndarray, " coefficients"],
) -> Camera:
    """Returns the camera of a calibration as ROS states it.

    Args:
        path: The file of the calibration.
        width, height: Pixels.
        matrix: fx 0 cx, 0 fy cy, 0 0 1.
        distortion_model: plumb_bob, or equidistant, which is also called fisheye.
        distortion: k1 k2 p1 p2 and optionally k3 of plumb_bob, k1 to k4 of equidistant, or none for a pinhole camera.

    Raises:
        RecordingError: The matrix has another form, the distortion has another model, or the camera is impossible.
    """
    size: tuple[Any, Any] = width, height  # Camera checks that they are whole
    fx, skew, cx, _, fy, cy = matrix[:2].ravel().astype(float).tolist()
    if not (np.isfinite(matrix).all() and skew == matrix[1, 0] == 0):
        raise RecordingError(
            f"{path} holds the intrinsics {matrix.astype(float).tolist()}, but fx 0 cx, 0 fy cy, 0 0 1 were expected."
        )
    if matrix[2].tolist() != [0, 0, 1]:
        raise RecordingError(f"{path} holds intrinsics whose last row is {matrix[2].tolist()}, but 0 0 1 was expected.")
    model, coefficients = DISTORTION_MODELS.get(distortion_model), tuple(distortion.astype(float).tolist())
    if not coefficients or (model == "radtan" and not any(coefficients)):
        model, coefficients = "pinhole", ()
    if model is None:
        raise RecordingError(
            f"{path} holds the distortion model {distortion_model!r}, but plumb_bob (radtan) or equidistant (fisheye) "
            "was expected; undistort the events and frames, or fit one of these."
        )
    with of_file(path):
        return Camera(*size, fx, fy, cx, cy, coefficients, model)


def whole_nanoseconds(path: Path, refractory_period: float) -> int:
    """Returns a refractory period (ns) of a file as a whole number.

    Raises:
        RecordingError: It is not finite.
    """
    if not math.isfinite(refractory_period):
        raise RecordingError(f"{path} holds the refractory period {refractory_period:g} ns, but a number was expected.")
    return round(refractory_period)


def read_views(folder: Path, notes: list[str]) -> Frames | None:
    """Returns the views for evaluation, at times 0 s, 1 s, 2 s ... of their own clock.

    Args:
        folder: The folder of the recording; views/ lies in it or beside it.
        notes: Gets a sentence if there are views that are not used.

    Returns:
        The test views, or else the validation views; None if there are none.

    Raises:
        RecordingError: The list of views cannot be used, or an image is missing or has another size.
    """
    check_is_folder(folder / "views", "a folder of views")
    views = next((views for views in (folder / "views", folder.parent / "views") if views.is_dir()), None)
    if views is None:
        return None
    path = next(
        (file for file in (views / f"transforms_{split}.json" for split in ("test", "val")) if file.exists()), None
    )
    if views.parent != folder:
        name_links_out(views)
    if path is None:
        notes.append(f"{views} holds neither transforms_test.json nor transforms_val.json, so no view is used.")
        return None
    content = open_json(path)
    entries = content["frames"].values()
    if len(entries) < 2:
        notes.append(f"{path} lists {len(entries)} views, but at least 2 are needed, so no view is used.")
        return None
    poses = [entry["transform_matrix"].pose() for entry in entries]
    files = [_find_image(views, entry["file_path"]) for entry in entries]
    if not any(files):
        notes.append(f"{path} lists {len(files)} views, but none is there as .png or .jpg, so no view is used.")
        return None
    for entry, file in zip(entries, files, strict=True):
        if file is not None and (".." in file.parts or not file.is_relative_to(views)):
            raise entry["file_path"].wrong(f"a file within {views} was")
    if None in files:
        missing = entries[files.index(None)]["file_path"]
        raise missing.wrong(f"a .png or .jpg in {views} was")
    images = tuple(file for file in files if file)
    width, height = image_size(images[0])
    check_image_sizes(images, width, height)
    rotations = Rotation.from_matrix(np.stack(poses)[:, :3, :3] * [1.0, -1.0, -1.0])
    times = np.arange(len(images), dtype=np.int64) * 10**9
    trajectory = Trajectory(times, np.stack(poses)[:, :3, 3], rotations.as_quat())
    return Frames(images, times, _view_camera(content, width, height), trajectory)


def _view_camera(content: Value, width: int, height: int) -> Camera:
    intrinsics = content.get("intrinsics")
    if content.get("camera_angle_x") is None and intrinsics is not None:
        return checked_camera(content.path, width, height, intrinsics.numbers((3, 3)), "", np.zeros(0))
    value = content["camera_angle_x"]
    angle = float(value.numbers((), expected := "the angle of view in radians, or intrinsics, was"))
    if not 0 < angle < np.pi:
        raise value.wrong(expected)
    focal_length = 0.5 * width / math.tan(0.5 * angle)
    return Camera(width, height, focal_length, focal_length, (width - 1) / 2, (height - 1) / 2)


def _find_image(views: Path, name: Value) -> Path | None:
    candidates = (views / f"{name.found}{suffix}" for suffix in IMAGE_SUFFIXES)
    return next((file for file in candidates if os.path.isfile(file)), None)
