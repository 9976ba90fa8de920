"""Reader for the .npz layout into which Robust e-NeRF converts simulated recordings, TUM-VIE and EDS.

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

Stamps are nanoseconds from the recording's own zero. The views are rendered from places beside the path of the event
camera, and have no stamps; they serve for evaluation. Training views and depth maps in views/ are not read.

Low and Lee, "Robust e-NeRF: NeRF from sparse & noisy events under non-uniform motion", ICCV 2023;
https://github.com/wengflow/robust-e-nerf.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from zipfile import ZipFile

import numpy as np

from enerf_ns.dataparsers.formats.columns import check_lengths, check_times
from enerf_ns.dataparsers.formats.format import Format
from enerf_ns.dataparsers.formats.robust_enerf import (
    checked_camera,
    checked_trajectory,
    listed,
    read_views,
    whole_nanoseconds,
)
from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.dataparsers.recording.errors import RecordingError
from enerf_ns.dataparsers.recording.files import LARGEST_ARRAY, check_npy_header, of_file, reading
from enerf_ns.dataparsers.recording.recording import EVENTS_AT_A_TIME, EventRecording, Events
from enerf_ns.dataparsers.recording.trajectory import Trajectory

FILES = ("raw_events.npz", "camera_poses.npz", "camera_calibration.npz")

KINDS = {"integers": "iu", "whole numbers or booleans": "iub", "numbers": "iuf", "text": "US"}


def read(folder: Path) -> EventRecording:
    """Reads everything but the events, which are read when they are needed.

    Args:
        folder: The folder with the files that the module describes.

    Raises:
        RecordingError: A file is missing, empty or cannot be used.
    """
    notes: list[str] = []
    events_file, poses_file, calibration_file = (folder / name for name in FILES)
    trajectory = _read_trajectory(poses_file, notes)
    camera, contrast_thresholds, refractory_period, bayer_pattern = _read_calibration(calibration_file)
    with ExitStack() as stack:
        num_events = len(_open_events(events_file, stack)[1])
    views = read_views(folder, notes)
    with of_file(calibration_file):
        return EventRecording(
            path=folder,
            format="esim_npz",
            camera=camera,
            trajectory=trajectory,
            stream_events=lambda: _stream_events(events_file, num_events),
            event_files=(events_file,),
            held_out_frames=views,
            contrast_thresholds=contrast_thresholds,
            refractory_period=refractory_period,
            bayer_pattern=bayer_pattern,
            notes=tuple(notes),
            num_events=num_events,
            times_in={"events": (events_file, "ns"), "poses": (poses_file, "ns")},
        )


class _StoredArray:
    """An array in an .npz file, which is read from its first to its last row and never unpickled."""

    def __init__(self, path: Path, archive: ZipFile, name: str, kind: str, shape: tuple[int | None, ...]):
        if f"{name}.npy" not in archive.namelist():
            found = listed(entry.removesuffix(".npy") for entry in archive.namelist())
            raise RecordingError(f"{path} lacks the array {name}, and holds {found}; save it with {name}.")
        self._stream = archive.open(f"{name}.npy")
        version = np.lib.format.read_magic(self._stream)
        if version not in ((1, 0), (2, 0)):
            raise ValueError(f"the array {name} is of version {version} of the format")
        self._stream.seek(0)
        check_npy_header(self._stream)
        np.lib.format.read_magic(self._stream)
        header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        self.shape, self.by_column, self.dtype = header(self._stream)
        if self.dtype.hasobject:
            raise RecordingError(
                f"{path} holds {name} as pickled Python objects, which are never loaded, since they can run code; save "
                f"it as an array of {kind}."
            )
        fits = len(self.shape) == len(shape) and all(
            size in (None, found) for size, found in zip(shape, self.shape, strict=True)
        )
        if self.dtype.kind not in KINDS[kind] or not fits:
            expected = "(" + ", ".join("n" if size is None else str(size) for size in shape) + ")"
            raise RecordingError(
                f"{path} holds {name} as {self.dtype} of shape {self.shape}, but {kind} of shape {expected} were "
                "expected."
            )
        stored = archive.getinfo(f"{name}.npy").file_size - self._stream.tell()
        if stored != math.prod(self.shape) * self.dtype.itemsize:
            raise EOFError(f"the array {name} of shape {self.shape} does not fill its {stored:,} bytes")

    def __len__(self) -> int:
        return self.shape[0]

    def rows(self, count: int) -> np.ndarray:
        """Returns the next rows."""
        return self._numbers((count, *self.shape[1:]))

    def whole(self) -> np.ndarray:
        """Returns the whole array.

        Raises:
            ValueError: It has more than `LARGEST_ARRAY` bytes.
        """
        if (size := math.prod(self.shape) * self.dtype.itemsize) > LARGEST_ARRAY:
            raise ValueError(f"an array has {size:,} bytes, but at most {LARGEST_ARRAY:,} were expected")
        return self._numbers(self.shape)

    def close(self) -> None:
        self._stream.close()

    def _numbers(self, shape: tuple[int, ...]) -> np.ndarray:
        data = self._stream.read(math.prod(shape) * self.dtype.itemsize)
        return np.frombuffer(data, self.dtype).reshape(shape, order="F" if self.by_column else "C")


EXPECTED = "an .npz file of NumPy"


def load_npz(path: Path, arrays: dict[str, tuple[str, tuple[int | None, ...]]]) -> list[np.ndarray]:
    """Returns arrays of an .npz file as a whole.

    Args:
        path: The file.
        arrays: By name, one of `KINDS`, and the shape, with None for any length.

    Raises:
        RecordingError: The file cannot be read, lacks an array, or holds another kind or shape.
    """
    with reading(path, EXPECTED), ZipFile(path) as archive:
        return [_StoredArray(path, archive, name, *form).whole() for name, form in arrays.items()]


def _read_trajectory(path: Path, notes: list[str]) -> Trajectory:
    forms = {
        "T_wc_timestamp": ("integers", (None,)),
        "T_wc_position": ("numbers", (None, 3)),
        "T_wc_orientation": ("numbers", (None, 4)),
    }
    times, positions, quaternions = load_npz(path, forms)
    check_lengths(path, {"times": len(times), "positions": len(positions), "orientations": len(quaternions)})
    check_times(path, times)
    return checked_trajectory(
        path, times.astype(np.int64), positions.astype(np.float64), quaternions.astype(np.float64), notes
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
    *scalars, matrix, distortion, model, pattern = load_npz(path, forms)
    width, height, on, off, refractory_period = (float(scalar) for scalar in scalars)
    model, pattern = (_text(text) for text in (model, pattern))
    camera = checked_camera(path, width, height, matrix, model, distortion)
    return camera, (on, off), whole_nanoseconds(path, refractory_period), pattern or None


def _text(array: np.ndarray) -> str:
    text = array.item()
    return text.decode(errors="replace") if isinstance(text, bytes) else text


def _open_events(path: Path, stack: ExitStack) -> tuple[_StoredArray, _StoredArray, _StoredArray]:
    """Returns positions, times and polarities, which stay open until the stack closes."""
    forms = {"position": (None, 2), "timestamp": (None,), "polarity": (None,)}
    arrays = []
    with reading(path, EXPECTED):
        archive = stack.enter_context(ZipFile(path))
        for name, shape in forms.items():
            kind = "whole numbers or booleans" if name == "polarity" else "integers"
            arrays.append(_StoredArray(path, archive, name, kind, shape))
            stack.callback(arrays[-1].close)
    position, time, polarity = arrays
    check_lengths(path, {"positions": len(position), "timestamps": len(time), "polarities": len(polarity)})
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
            check_times(path, time)
            yield Events(position[:, 0], position[:, 1], time.astype(np.int64), polarity)


FORMAT = Format(
    name="esim_npz",
    command="esim-npz",
    description="Events in the .npz layout of Robust e-NeRF's simulated sequences.",
    files=FILES,
    read=read,
)
