"""Reader for the .npz layout of Robust e-NeRF, into which it brings simulated recordings, TUM-VIE and EDS.

    raw_events.npz              position (N, 2): x y; timestamp (N): ns; polarity (N): true where it became brighter
    camera_poses.npz            T_wc_position (P, 3): metres; T_wc_orientation (P, 4): xyzw; T_wc_timestamp (P): ns;
                                camera to world, OpenCV axes
    camera_calibration.npz      intrinsics (3, 3); distortion_params (0 or 4); distortion_model: plumb_bob (radtan) or
                                equidistant (OpenCV's fisheye); img_width, img_height; pos_contrast_threshold,
                                neg_contrast_threshold; refractory_period: ns; bayer_pattern: such as RGGB, or empty
    views/                      or beside the folder (optional)
        transforms_test.json    or transforms_val.json: camera_angle_x (radians) or intrinsics (3, 3), and frames, each
                                with file_path (mostly without .png) and transform_matrix (4, 4): camera to world,
                                OpenGL axes

Stamps are nanoseconds from the recording's own zero. The views are rendered from other places than those the event
camera passes, and have no stamps: they serve to evaluate. What views/ holds for training is not read, nor are its depth
maps.

Low and Lee, "Robust e-NeRF: NeRF from sparse & noisy events under non-uniform motion", ICCV 2023;
https://github.com/wengflow/robust-e-nerf.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Literal
from zipfile import ZipFile

import numpy as np
from jaxtyping import Float, Float64, Int, Int64
from scipy.spatial.transform import Rotation

from enerf_ns.dataparsers.camera import Camera, check_rotation
from enerf_ns.dataparsers.errors import RecordingError, UserError
from enerf_ns.dataparsers.files import image_size
from enerf_ns.dataparsers.formats.text_tables import FARTHEST, QUATERNION_TOLERANCE, parse_array
from enerf_ns.dataparsers.recording import EVENTS_AT_A_TIME, EventRecording, Events, Frames
from enerf_ns.dataparsers.trajectory import Trajectory

FILES = ("raw_events.npz", "camera_poses.npz", "camera_calibration.npz")

SHORTEST_STEP = 1000
"""Nanoseconds between poses. ESIM states poses at the times of its inertial sensor and of its images, which may all but
coincide; as stamps are whole nanoseconds, the speed between two such poses would be anything, and the spline follow."""

LATEST = 2**62
"""Nanoseconds, 146 years; what lies beyond is no time."""

DISTORTION_MODELS: dict[str, Literal["radtan", "fisheye"]] = {
    "plumb_bob": "radtan",
    "equidistant": "fisheye",
    "fisheye": "fisheye",
}
"""Names of ROS, and ours."""

KINDS = {"integers": "iu", "whole numbers or booleans": "iub", "numbers": "iuf", "text": "US"}

IMAGE_SUFFIXES = ("", ".png", ".jpg", ".jpeg")
"""Of views; the file may be named with or without."""


def read(folder: Path) -> EventRecording:
    """Reads all but the events, which are read when asked for.

    Args:
        folder: With the files above.

    Raises:
        RecordingError: A file is missing or empty, or anything in it cannot be used.
    """
    notes: list[str] = []
    events_file, poses_file, calibration_file = (folder / name for name in FILES)
    trajectory = _read_trajectory(poses_file, notes)
    camera, contrast_thresholds, refractory_period, bayer_pattern = _read_calibration(calibration_file)
    with ExitStack() as stack:
        num_events = len(_open_events(events_file, stack)[1])
    return EventRecording(
        path=folder,
        format="esim_npz",
        camera=camera,
        trajectory=trajectory,
        stream_events=lambda: _stream_events(events_file, num_events),
        event_files=(events_file,),
        held_out_frames=read_views(folder, notes),
        contrast_thresholds=contrast_thresholds,
        refractory_period=refractory_period,
        bayer_pattern=bayer_pattern,
        notes=tuple(notes),
        locate_event=lambda index: f"{events_file}, event {index + 1}",
        num_events=num_events,
    )


@contextmanager
def reading(path: Path, expected: str) -> Iterator[None]:
    """Turns whatever a library raises at a damaged file into one sentence about it.

    Args:
        path: The file.
        expected: What it is to hold.

    Raises:
        RecordingError: Anything went wrong.
    """
    try:
        yield
    except UserError:
        raise
    except FileNotFoundError as error:
        raise RecordingError(f"{path} is missing; {expected} was expected there.") from error
    except Exception as error:
        if path.is_file() and path.stat().st_size == 0:
            raise RecordingError(f"{path} is empty; {expected} was expected.") from error
        reason = " ".join(str(error).split()).rstrip(".").replace(". ", ", ") or type(error).__name__
        raise RecordingError(
            f"{path} cannot be read as {expected} ({reason}); copy it again from its source."
        ) from error


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
        RecordingError: The size is not of whole pixels, the matrix is not of this form, or the distortion is of another
            model, has another number of coefficients, or fits no lens.
    """
    if not all(0 < size < 2**16 and size == int(size) for size in (width, height)):
        raise RecordingError(f"{path} holds a sensor of {width:g} x {height:g} pixels, but whole pixels were expected.")
    fx, skew, cx, _, fy, cy = matrix[:2].ravel().astype(float).tolist()
    if not (np.isfinite(matrix).all() and fx > 0 and fy > 0 and skew == matrix[1, 0] == 0):
        raise RecordingError(
            f"{path} holds the intrinsics {matrix.astype(float).tolist()}, but fx 0 cx, 0 fy cy, 0 0 1 with focal "
            "lengths above 0 were expected."
        )
    if matrix[2].tolist() != [0, 0, 1]:
        raise RecordingError(f"{path} holds intrinsics whose last row is {matrix[2].tolist()}, but 0 0 1 was expected.")
    size = int(width), int(height)
    model, coefficients = DISTORTION_MODELS.get(distortion_model), tuple(distortion.astype(float).tolist())
    if not coefficients or (model == "radtan" and not any(coefficients)):
        return Camera(*size, fx, fy, cx, cy)
    if model is None:
        raise RecordingError(
            f"{path} holds the distortion model {distortion_model!r}, but plumb_bob (radtan) or equidistant (fisheye) "
            "was expected; undistort the events and frames, or fit one of these."
        )
    if len(coefficients) not in {"radtan": (4, 5), "fisheye": (4,)}[model] or not np.isfinite(coefficients).all():
        raise RecordingError(
            f"{path} holds the distortion {coefficients} of the model {distortion_model}, but "
            f"{'k1 k2 p1 p2 and perhaps k3' if model == 'radtan' else 'k1 k2 k3 k4'} were expected."
        )
    camera = Camera(*size, fx, fy, cx, cy, coefficients, model)
    try:
        camera.pixel_directions()
    except ValueError as error:
        raise RecordingError(f"{path} fits no lens: {error}.") from error
    return camera


def checked_sensor(
    path: Path, on: float, off: float, refractory_period: float, bayer_pattern: str
) -> tuple[tuple[float, float], int, str | None]:
    """How the pixels of an event camera work, as an `EventRecording` holds it.

    Args:
        path: The file that it comes from.
        on, off: Contrast thresholds.
        refractory_period: Nanoseconds.
        bayer_pattern: Four letters of R, G and B, row by row, or empty for a grey sensor.

    Returns:
        contrast_thresholds, refractory_period and bayer_pattern.

    Raises:
        RecordingError: A threshold that is not above 0, a negative refractory period, or other letters.
    """
    if not (0 < on < np.inf and 0 < off < np.inf):
        raise RecordingError(
            f"{path} holds the contrast thresholds {on:g} (positive) and {off:g} (negative), but both must be above 0."
        )
    if not 0 <= refractory_period < LATEST:
        raise RecordingError(
            f"{path} holds the refractory period {refractory_period:g} ns, but it must not be below 0."
        )
    if bayer_pattern and (len(bayer_pattern) != 4 or set(bayer_pattern) != set("RGB")):
        raise RecordingError(
            f"{path} holds the Bayer pattern {bayer_pattern!r}, but four letters of R, G and B such as RGGB, or none "
            "for a grey sensor, were expected."
        )
    return (on, off), round(refractory_period), bayer_pattern or None


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
    views = next((views for views in (folder / "views", folder.parent / "views") if views.is_dir()), None)
    if views is None:
        return None
    path = next(
        (file for file in (views / f"transforms_{split}.json" for split in ("test", "val")) if file.exists()), None
    )
    if path is None:
        notes.append(f"{views} holds neither transforms_test.json nor transforms_val.json, so that no view is used.")
        return None
    with reading(path, "JSON"):
        content = json.loads(path.read_text(encoding="utf-8-sig"))
    entries = content.get("frames") if isinstance(content, dict) else None
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


class _StoredArray:
    """An array in an .npz file, read from its first to its last row, and never unpickled."""

    def __init__(self, path: Path, archive: ZipFile, name: str, kind: str, shape: tuple[int | None, ...]):
        if f"{name}.npy" not in archive.namelist():
            found = listed(entry.removesuffix(".npy") for entry in archive.namelist())
            raise RecordingError(f"{path} lacks the array {name}, and holds {found}; save it with {name}.")
        self._stream = archive.open(f"{name}.npy")
        version = np.lib.format.read_magic(self._stream)
        if version not in ((1, 0), (2, 0)):
            raise ValueError(f"the array {name} is of version {version} of the format")
        header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        self.shape, self.by_column, self._dtype = header(self._stream)
        if self._dtype.hasobject:
            raise RecordingError(
                f"{path} holds {name} as pickled Python objects, which are never loaded since that can run code; save "
                f"it as an array of {kind}."
            )
        fits = len(self.shape) == len(shape) and all(
            size in (None, found) for size, found in zip(shape, self.shape, strict=True)
        )
        if self._dtype.kind not in KINDS[kind] or not fits:
            expected = "(" + ", ".join("n" if size is None else str(size) for size in shape) + ")"
            raise RecordingError(
                f"{path} holds {name} as {self._dtype} of shape {self.shape}, but {kind} of shape {expected} were "
                "expected."
            )
        stored = archive.getinfo(f"{name}.npy").file_size - self._stream.tell()
        if stored != math.prod(self.shape) * self._dtype.itemsize:
            raise EOFError(f"the array {name} of shape {self.shape} does not fill its {stored:,} bytes")

    def __len__(self) -> int:
        return self.shape[0]

    def rows(self, count: int) -> np.ndarray:
        """The next ones."""
        return self._numbers((count, *self.shape[1:]))

    def whole(self) -> np.ndarray:
        """All of it, at once."""
        return self._numbers(self.shape)

    def close(self) -> None:
        self._stream.close()

    def _numbers(self, shape: tuple[int, ...]) -> np.ndarray:
        data = self._stream.read(math.prod(shape) * self._dtype.itemsize)
        return np.frombuffer(data, self._dtype).reshape(shape, order="F" if self.by_column else "C")


EXPECTED = "an .npz file of NumPy"


def _load(path: Path, arrays: dict[str, tuple[str, tuple[int | None, ...]]]) -> list[np.ndarray]:
    with reading(path, EXPECTED), ZipFile(path) as archive:
        return [_StoredArray(path, archive, name, *form).whole() for name, form in arrays.items()]


def _read_trajectory(path: Path, notes: list[str]) -> Trajectory:
    forms = {
        "T_wc_timestamp": ("integers", (None,)),
        "T_wc_position": ("numbers", (None, 3)),
        "T_wc_orientation": ("numbers", (None, 4)),
    }
    times, positions, quaternions = _load(path, forms)
    if not len(times) == len(positions) == len(quaternions):
        raise RecordingError(
            f"{path} holds {len(times):,} times, {len(positions):,} positions and {len(quaternions):,} orientations, "
            "but as many of each were expected."
        )
    return checked_trajectory(
        path, _nanoseconds(path, times), positions.astype(np.float64), quaternions.astype(np.float64), notes
    )


def _read_calibration(path: Path) -> tuple[Camera, tuple[float, float], int, str | None]:
    names = ("img_width", "img_height", "pos_contrast_threshold", "neg_contrast_threshold", "refractory_period")
    forms = {
        **{name: ("numbers", ()) for name in names},
        "intrinsics": ("numbers", (3, 3)),
        "distortion_params": ("numbers", (None,)),
        "distortion_model": ("text", ()),
        "bayer_pattern": ("text", ()),
    }
    *scalars, matrix, distortion, model, pattern = _load(path, forms)
    width, height, on, off, refractory_period = (float(scalar) for scalar in scalars)
    model, pattern = (_text(text) for text in (model, pattern))
    camera = checked_camera(path, width, height, matrix, model, distortion)
    return camera, *checked_sensor(path, on, off, refractory_period, pattern)


def _text(array: np.ndarray) -> str:
    text = array.item()
    return text.decode(errors="replace") if isinstance(text, bytes) else text


def _open_events(path: Path, stack: ExitStack) -> tuple[_StoredArray, _StoredArray, _StoredArray]:
    """Positions, times and polarities, open as long as the stack is."""
    with reading(path, EXPECTED):
        archive = stack.enter_context(ZipFile(path))
        position = _StoredArray(path, archive, "position", "integers", (None, 2))
        stack.callback(position.close)
        time = _StoredArray(path, archive, "timestamp", "integers", (None,))
        stack.callback(time.close)
        polarity = _StoredArray(path, archive, "polarity", "whole numbers or booleans", (None,))
        stack.callback(polarity.close)
    if not len(position) == len(time) == len(polarity):
        raise RecordingError(
            f"{path} holds {len(position):,} positions, {len(time):,} timestamps and {len(polarity):,} polarities, but "
            "as many of each were expected."
        )
    if len(time) == 0:
        raise RecordingError(f"{path} holds no events; give a recording with some.")
    if position.by_column:
        raise RecordingError(
            f"{path} holds position column by column (Fortran order), which cannot be read in pieces; save "
            "numpy.ascontiguousarray(position)."
        )
    return position, time, polarity


def _stream_events(path: Path, num_events: int) -> Iterator[Events]:
    with ExitStack() as stack:
        columns = _open_events(path, stack)
        if len(columns[0]) != num_events:
            raise RecordingError(
                f"{path} held {num_events:,} events and holds {len(columns[0]):,} now; read the recording again."
            )
        for start in range(0, num_events, EVENTS_AT_A_TIME):
            with reading(path, EXPECTED):
                position, time, polarity = (
                    column.rows(min(EVENTS_AT_A_TIME, num_events - start)) for column in columns
                )
            yield Events(position[:, 0], position[:, 1], _nanoseconds(path, time), polarity)


def _nanoseconds(path: Path, times: Int[np.ndarray, " times"]) -> Int64[np.ndarray, " times"]:
    extremes = (int(times.min()), int(times.max())) if len(times) else (0,)
    if any(abs(time) >= LATEST for time in extremes):
        raise RecordingError(
            f"{path} holds the time {max(extremes, key=abs)} ns, which is beyond 146 years; times were expected in "
            "nanoseconds."
        )
    return times.astype(np.int64)
