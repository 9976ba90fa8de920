"""What the two layouts of Robust e-NeRF share: poses in any order, ROS's cameras, and views to evaluate with."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, Float64, Int64
from scipy.spatial.transform import Rotation

from enerf_ns.dataparsers.formats.json_values import parse_array
from enerf_ns.dataparsers.formats.text_tables import FARTHEST, QUATERNION_TOLERANCE
from enerf_ns.dataparsers.recording.camera import Camera, check_rotation
from enerf_ns.dataparsers.recording.errors import RecordingError
from enerf_ns.dataparsers.recording.files import check_is_folder, image_size, of_file, read_json
from enerf_ns.dataparsers.recording.recording import Frames
from enerf_ns.dataparsers.recording.trajectory import Trajectory

SHORTEST_STEP = 1000
"""Least nanoseconds between poses. ESIM states poses at the times of its inertial sensor and of its images, which may
all but coincide; as stamps are whole nanoseconds, the speed between two such poses would be anything, and the spline
follow."""

LATEST = 2**62
"""Time in nanoseconds, 146 years; what lies beyond is no time."""

DISTORTION_MODELS: dict[str, Literal["pinhole", "radtan", "fisheye"]] = {
    "plumb_bob": "radtan",
    "equidistant": "fisheye",
    "fisheye": "fisheye",
}
"""This package's names of the distortion models, by those of ROS."""

IMAGE_SUFFIXES = ("", ".png", ".jpg", ".jpeg")
"""Suffixes of the images of views; the file may be named with or without."""


def listed(names: Iterable[str]) -> str:
    """The first of some names in order; what cannot be printed, as names in damaged files may hold, becomes "?"."""
    text = ", ".join(sorted(names)[:12]) or "none"
    return "".join(letter if letter.isprintable() else "?" for letter in text)


def checked_trajectory(
    path: Path,
    times: Int64[np.ndarray, " poses"],
    positions: Float64[np.ndarray, "poses 3"],
    quaternions: Float64[np.ndarray, "poses 4"],
    notes: list[str],
) -> Trajectory:
    """A trajectory from poses, camera to world, that may be out of order or come twice.

    Args:
        path: The file that they come from.
        times: Nanoseconds.
        positions: Metres.
        quaternions: xyzw.
        notes: Gets a sentence for each thing that had to be mended.

    Raises:
        RecordingError: Fewer than two poses, a number that is not finite, a quaternion whose norm is off by more than
            1e-3, or a time unit other than nanoseconds, by which most poses coincide.
    """
    if len(times) < 2:
        raise RecordingError(f"{path} holds {len(times)} poses, but at least 2 were expected.")
    finite = np.isfinite(positions).all(axis=1) & np.isfinite(quaternions).all(axis=1)
    if not finite.all():
        raise RecordingError(
            f"{path} holds a position or quaternion that is not finite in pose {np.argmin(finite) + 1}, where numbers "
            "were expected."
        )
    if np.abs(positions).max() > FARTHEST:
        raise RecordingError(
            f"{path} holds a position {np.abs(positions).max():g} m from the origin, but positions within "
            f"{FARTHEST:g} m were expected."
        )
    norms = np.linalg.norm(quaternions, axis=1)
    errors = np.abs(norms - 1.0)
    if errors.max() > QUATERNION_TOLERANCE:
        bad = int(np.argmax(errors > QUATERNION_TOLERANCE))
        raise RecordingError(
            f"{path} holds a quaternion of norm {norms[bad]:.6g} in pose {bad + 1}, but rotations are unit quaternions "
            "(qx qy qz qw)."
        )
    if errors.max() > 1e-6:
        notes.append(
            f"{(errors > 1e-6).sum():,} of {len(norms):,} quaternions in {path.name} were off norm 1 by up to "
            f"{errors.max():.2g} and are renormalised."
        )
    num_backwards = np.count_nonzero(np.diff(times) < 0)
    if num_backwards:
        notes.append(f"The poses in {path.name} go back in time {num_backwards:,} times and are sorted.")
    order = np.argsort(times, kind="stable")
    kept = order[np.diff(times[order], prepend=-LATEST) >= SHORTEST_STEP]
    dropped = len(times) - len(kept)
    if len(kept) < 2 or dropped >= len(kept):
        raise RecordingError(
            f"{path} holds {len(times):,} poses of which {dropped:,} follow another one within 1 µs; give one "
            "pose a time, and times in nanoseconds."
        )
    if dropped:
        notes.append(
            f"{dropped:,} of {len(times):,} poses in {path.name} follow another one within 1 µs and are left out."
        )
    return Trajectory(times[kept], positions[kept], quaternions[kept] / norms[kept, None])


def checked_camera(
    path: Path,
    width: float,
    height: float,
    matrix: Float[np.ndarray, "3 3"],
    distortion_model: str,
    distortion: Float[np.ndarray, " coefficients"],
) -> Camera:
    """A camera from what ROS says about one.

    Args:
        path: The file that it comes from.
        width, height: Pixels.
        matrix: fx 0 cx, 0 fy cy, 0 0 1.
        distortion_model: plumb_bob, or equidistant, which is also called fisheye.
        distortion: k1 k2 p1 p2 and perhaps k3 of plumb_bob, k1 to k4 of equidistant, or none for a pinhole camera.

    Raises:
        RecordingError: The matrix is not of this form, the distortion is of another model, or all this is no camera.
    """
    size: tuple[Any, Any] = width, height  # which Camera makes whole
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
        return Camera(size[0], size[1], fx, fy, cx, cy, coefficients, model)


def whole_nanoseconds(path: Path, refractory_period: float) -> int:
    """A refractory period as an `EventRecording` holds it.

    Raises:
        RecordingError: It is not finite; the error names `path`, the file that it comes from.
    """
    if not math.isfinite(refractory_period):
        raise RecordingError(f"{path} holds the refractory period {refractory_period:g} ns, but a number was expected.")
    return round(refractory_period)


def read_views(folder: Path, notes: list[str]) -> Frames | None:
    """The views to evaluate with, at times 0 s, 1 s, 2 s ... of a clock of their own.

    Args:
        folder: Of the recording; views/ lies in it or beside it.
        notes: Gets a sentence if there are views that are not used, or whose transparency is dropped.

    Returns:
        The test views, or else the validation views; None if there are none.

    Raises:
        RecordingError: Anything in the list of views cannot be used, or an image is missing or of another size.
    """
    check_is_folder(folder / "views", "a folder of views")
    views = next((views for views in (folder / "views", folder.parent / "views") if views.is_dir()), None)
    if views is None:
        return None
    path = next(
        (file for file in (views / f"transforms_{split}.json" for split in ("test", "val")) if file.exists()), None
    )
    if path is None:
        notes.append(f"{views} holds neither transforms_test.json nor transforms_val.json, so that no view is used.")
        return None
    content = read_json(path)
    entries = content.get("frames")
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise RecordingError(f"{path} holds no list of frames; views (file_path, transform_matrix) were expected.")
    if len(entries) < 2:
        notes.append(f"{path} lists {len(entries)} views, of which at least 2 are needed, so that none is used.")
        return None
    poses = [
        _matrix(path, entry, "transform_matrix", (4, 4), f" of frame {i}") for i, entry in enumerate(entries, start=1)
    ]
    for i, pose in enumerate(poses, start=1):
        try:
            check_rotation(pose[:3, :3])
        except ValueError as error:
            raise RecordingError(f"{path} holds a transform_matrix of frame {i} that {error}.") from error

    files = [_find_image(views, entry.get("file_path")) for entry in entries]
    if not any(files):
        notes.append(f"{path} lists {len(files)} views, but none is there as .png or .jpg, so that none is used.")
        return None
    if None in files:
        missing = files.index(None)
        raise RecordingError(
            f"{path} lists {entries[missing].get('file_path')!r} as frame {missing + 1}, but {views} holds no such "
            ".png or .jpg; add it or drop the frame."
        )
    images = tuple(file for file in files if file)
    width, height = image_size(images[0])
    for image in images:
        if (found := image_size(image)) != (width, height):
            raise RecordingError(
                f"{image} has {found[0]} x {found[1]} pixels, but {images[0].name} has {width} x {height}; views must "
                "be of one size."
            )
    rotations = Rotation.from_matrix(np.stack(poses)[:, :3, :3] * [1.0, -1.0, -1.0])
    times = np.arange(len(images), dtype=np.int64) * 10**9
    trajectory = Trajectory(times, np.stack(poses)[:, :3, 3], rotations.as_quat())
    return Frames(images, times, _view_camera(path, content, width, height), trajectory)


def _view_camera(path: Path, content: dict, width: int, height: int) -> Camera:
    if "camera_angle_x" not in content and "intrinsics" in content:
        return checked_camera(path, width, height, _matrix(path, content, "intrinsics", (3, 3)), "", np.zeros(0))
    angle = content.get("camera_angle_x")
    if not isinstance(angle, (int, float)) or isinstance(angle, bool) or not 0 < angle < np.pi:
        raise RecordingError(
            f"{path} holds camera_angle_x = {angle!r}, but the angle of view in radians, or intrinsics, was expected."
        )
    focal_length = 0.5 * width / math.tan(0.5 * angle)
    return Camera(width, height, focal_length, focal_length, (width - 1) / 2, (height - 1) / 2)


def _matrix(path: Path, entry: dict, name: str, shape: tuple[int, int], where: str = "") -> np.ndarray:
    try:
        return parse_array(entry.get(name), shape)
    except ValueError as error:
        expected = f"{shape[0]} x {shape[1]} numbers, which was expected"
        raise RecordingError(f"{path} holds no {name}{where} of {expected}.") from error


def _find_image(views: Path, name: object) -> Path | None:
    if not isinstance(name, str):
        return None
    candidates = (views / f"{name}{suffix}" for suffix in IMAGE_SUFFIXES)
    return next((file for file in candidates if os.path.isfile(file)), None)
