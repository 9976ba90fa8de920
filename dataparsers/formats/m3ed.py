"""Reader for M3ED, recorded with two Prophesee EVK4 and the grey and colour cameras of an OVC.

    *_data.h5         prophesee/{left,right}: x, y, t (µs), p; and calib: camera_model, intrinsics (fx fy cx cy),
                      distortion_model, distortion_coeffs, resolution (width, height), T_to_prophesee_left (4 x 4)
                      ovc/left: data (frames, height, width, 1) and calib; ovc/ts (µs) (optional)
    *_pose_gt.h5      Cn_T_C0 (poses, 4, 4): from the left event camera at the first pose to that of pose n; ts (µs)
    *_depth_gt.h5     the same (used where there is no *_pose_gt.h5)

The pose of the left event camera in its first axes is the inverse of Cn_T_C0. T_to_prophesee_left is taken as a
camera's pose in the axes of the left event camera, as the page of the data set describes it; it must place the right
event camera to the right. The poses come from a lidar at about 10 a second, between which they are interpolated. A fast
motion needs poses of another source (--poses).

Times are checked: ts_map_prophesee_left and ovc/ts_map_prophesee_left_t name the event at each pose and frame, where
they are there. Not read: depth, since it is of the event camera at times without frames; the lidar; the right and the
colour camera of the OVC. The exposure of a frame is not known, and its stamp is taken for its middle. Frames stay in
the HDF5 file. In poses of the user that state names of frames, they are 00000.png and so on, as enerf convert writes.

Chaney et al., "M3ED: Multi-robot, multi-sensor, multi-environment event dataset", CVPR workshops 2023; m3ed.io.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from enerf_ns.dataparsers.formats.columns import check_times
from enerf_ns.dataparsers.formats.format import Format, FormatOptions
from enerf_ns.dataparsers.formats.hdf5_events import Hdf5Events
from enerf_ns.dataparsers.formats.pose_files import GivenPoses, NamedFrames, PoseRows
from enerf_ns.dataparsers.recording.camera import Camera, CameraModel, check_rotation
from enerf_ns.dataparsers.recording.errors import RecordingError, shortened
from enerf_ns.dataparsers.recording.files import files_in, of_file, reading
from enerf_ns.dataparsers.recording.hdf5_files import dataset_at, member_at, open_hdf5, read_dataset
from enerf_ns.dataparsers.recording.recording import EventRecording, Frames
from enerf_ns.dataparsers.recording.trajectory import Trajectory

if TYPE_CHECKING:
    import h5py

FILES = ("*_data.h5", "*_pose_gt.h5", "*_depth_gt.h5")

DISTORTION_MODELS: dict[str, CameraModel] = {"radtan": "radtan", "equidistant": "fisheye"}
"""Camera models of this package by Kalibr's names."""

FRAMES = "ovc/left/data"

EXPECTED = "an HDF5 file of M3ED"

LARGEST_OFFSET = 10_000
"""Largest time between a pose or frame and the event that the file names for it, µs."""


@dataclass(frozen=True)
class M3edOptions(FormatOptions):
    """Options of M3ED."""

    event_camera: Literal["left", "right"] = "left"
    """The event camera that is read."""


def read(
    folder: Path, poses: GivenPoses | None = None, event_camera: Literal["left", "right"] = "left"
) -> EventRecording:
    """Reads everything but the events, which are read when they are needed. The zero of time is that of the files.

    Args:
        folder: The folder with the files that the module describes.
        poses: Poses of the chosen event camera in place of those of the folder.
        event_camera: The event camera.

    Raises:
        RecordingError: A file is missing or cannot be used.
    """
    notes: list[str] = []
    path = _find(folder, "_data.h5")
    if path is None:
        raise RecordingError(f"{folder} lacks a file *_data.h5, which holds the events; put it there.")
    events = Hdf5Events(path, group=f"prophesee/{event_camera}")
    with reading(path, EXPECTED), open_hdf5(path) as file:
        camera, left_from_camera = _read_camera(path, file, f"prophesee/{event_camera}/calib")
        if member_at(path, file, "prophesee/right/calib") is not None:
            _check_side(path, file)
        frame_rig = None
        if member_at(path, file, FRAMES) is not None:
            frame_rig = _read_camera(path, file, "ovc/left/calib")
    frame_times = np.zeros(0, np.int64) if frame_rig is None else _read_frame_times(path, frame_rig[0])
    mounting = np.eye(4) if frame_rig is None else np.linalg.inv(left_from_camera) @ frame_rig[1]
    if poses is None:
        poses_file, unit = _find_poses(folder), "us"
        rows = _read_poses(poses_file, path, left_from_camera)
    else:
        poses_file, unit = poses.path, poses.unit
        names = [Path(f"{number:05d}.png") for number in range(len(frame_times))]
        rows = poses.rows([NamedFrames(names, frame_times, mounting)], notes)
    trajectory = Trajectory(*rows)
    frames = None
    if frame_rig is not None and len(frame_times):
        files = tuple(path / FRAMES / str(number) for number in range(len(frame_times)))
        frames = Frames(files, frame_times, frame_rig[0], trajectory.of_mounted(mounting))
    return EventRecording(
        path=folder,
        format="m3ed",
        camera=camera,
        trajectory=trajectory,
        stream_events=lambda: events.stream(0),
        event_files=(path,),
        frames=frames,
        notes=tuple(notes),
        num_events=events.num_events,
        times_in={"events": (path, "us"), "poses": (poses_file, unit), "frames": (path, "us")},
    )


def _find(folder: Path, suffix: str) -> Path | None:
    """Returns the one file with this end of its name, or None."""
    found = files_in(folder, f"*{suffix}")
    if len(found) > 1:
        names = ", ".join(file.name for file in found[:8])
        raise RecordingError(
            f"{folder} holds {names}, but one file *{suffix} was expected; give each sequence a folder."
        )
    return found[0] if found else None


def _find_poses(folder: Path) -> Path:
    found = _find(folder, "_pose_gt.h5") or _find(folder, "_depth_gt.h5")
    if found is None:
        raise RecordingError(
            f"{folder} lacks a file *_pose_gt.h5 or *_depth_gt.h5, which hold the poses; put one there, or give poses "
            "as --poses of enerf convert, or none yet by its --without-poses."
        )
    return found


def _read_camera(path: Path, file: h5py.File, group: str) -> tuple[Camera, Float64[np.ndarray, "4 4"]]:
    """Returns a camera, and its pose in the axes of the left event camera."""
    number = partial(read_dataset, path, file)
    fx, fy, cx, cy = number(f"{group}/intrinsics", "fx, fy, cx and cy", (4,)).astype(float).tolist()
    width, height = number(f"{group}/resolution", "width and height", (2,)).tolist()
    coefficients = number(f"{group}/distortion_coeffs", "4 coefficients", (4,)).astype(float).tolist()
    kind, lens = (_text(path, file, f"{group}/{name}") for name in ("camera_model", "distortion_model"))
    if kind != "pinhole" or lens not in DISTORTION_MODELS:
        raise RecordingError(
            f"{path} holds in {group} a camera {shortened(kind)!r} with the distortion {shortened(lens)!r}, but "
            "pinhole with radtan or equidistant was expected."
        )
    pose = number(f"{group}/T_to_prophesee_left", "a matrix of 4 x 4 numbers", (4, 4)).astype(np.float64)
    _check_poses(path, f"{group}/T_to_prophesee_left", pose[None])
    with of_file(f"{path}, {group},"):
        return Camera(width, height, fx, fy, cx, cy, tuple(coefficients), DISTORTION_MODELS[lens]), pose


def _check_side(path: Path, file: h5py.File) -> None:
    """Checks that the right event camera lies to the right of the left one, which shows the direction of the matrix."""
    name = "prophesee/right/calib/T_to_prophesee_left"
    x = float(read_dataset(path, file, name, "a matrix of 4 x 4 numbers", (4, 4))[0, 3])
    if x < 0:
        raise RecordingError(
            f"{path} places the right event camera {-x:g} m to the left of the left one by {name}, so that the matrix "
            "is the inverse of what is expected; get the file as it is published."
        )


def _text(path: Path, file: h5py.File, name: str) -> str:
    import h5py

    member = member_at(path, file, name)
    value = member[()] if isinstance(member, h5py.Dataset) and member.shape == () else None
    if not isinstance(value, bytes | str):
        raise RecordingError(f"{path} lacks the text {name}, which was expected; get the file as it is published.")
    return value.decode(errors="replace") if isinstance(value, bytes) else value


def _check_poses(path: Path, name: str, poses: Float64[np.ndarray, "poses 4 4"]) -> None:
    for number, pose in enumerate(poses):
        try:
            if not np.isfinite(pose).all():
                raise ValueError("holds numbers that are not finite")
            check_rotation(pose[:3, :3])
            if np.abs(pose[3] - [0, 0, 0, 1]).max() > 1e-6:
                raise ValueError(f"has the last row {pose[3].tolist()}, but 0 0 0 1 was expected")
        except ValueError as error:
            raise RecordingError(f"{path} holds in {name} matrix {number}, which {error}.") from error


def _read_poses(path: Path, data: Path, left_from_camera: Float64[np.ndarray, "4 4"]) -> PoseRows:
    """Returns the poses of the chosen event camera in the first axes of the left one."""
    with reading(path, EXPECTED), open_hdf5(path) as file:
        stamps = read_dataset(path, file, "ts", "the times of the poses in µs", (None,))
        to_camera = read_dataset(path, file, "Cn_T_C0", "poses of 4 x 4 numbers", (None, 4, 4)).astype(np.float64)
        places = member_at(path, file, "ts_map_prophesee_left") is not None
        indices = read_dataset(path, file, "ts_map_prophesee_left", "numbers of events", (None,)) if places else None
    if len(stamps) != len(to_camera) or len(stamps) < 2:
        raise RecordingError(
            f"{path} holds {len(to_camera):,} poses and {len(stamps):,} times, but as many, at least 2, were expected."
        )
    times = _microseconds(path, "ts", stamps)
    _check_poses(path, "Cn_T_C0", to_camera)
    if indices is not None:
        _check_clock(path, "ts_map_prophesee_left", data, times, indices)
    poses = np.linalg.inv(to_camera) @ left_from_camera
    return times, poses[:, :3, 3], Rotation.from_matrix(poses[:, :3, :3]).as_quat()


def _microseconds(path: Path, name: str, stamps: np.ndarray) -> np.ndarray:
    """Returns times (µs) as nanoseconds; they must increase."""
    if not np.isfinite(stamps).all() or np.abs(stamps.astype(np.float64)).max() > 2**62:
        raise RecordingError(
            f"{path} holds in {name} times that are not finite or beyond 146 years; times in µs were expected."
        )
    whole = np.rint(stamps).astype(np.int64)
    check_times(path, whole, "us")
    if (np.diff(whole) <= 0).any():
        at = int(np.argmax(np.diff(whole) <= 0))
        raise RecordingError(
            f"{path} holds in {name} the time {whole[at + 1]} µs after {whole[at]} µs, but times must increase; get "
            "the file as it is published."
        )
    return whole * 1000


def _check_clock(path: Path, name: str, data: Path, times: np.ndarray, indices: np.ndarray) -> None:
    """Checks that the events that a file names for its times have these times."""
    if len(indices) != len(times):
        raise RecordingError(
            f"{path} holds {len(indices):,} numbers in {name} of {len(times):,} times; one each was expected."
        )
    with reading(data, EXPECTED), open_hdf5(data) as file:
        column = dataset_at(data, file, "prophesee/left/t", "times of events", (None,))
        for i in sorted({0, len(times) // 2, len(times) - 1}):
            if not 0 < int(indices[i]) < len(column) - 1:  # before the first event or after the last one
                continue
            event = int(column[int(indices[i])])
            if abs(event - times[i] // 1000) > LARGEST_OFFSET:
                raise RecordingError(
                    f"{path} holds in {name} event {int(indices[i])} for the time {times[i] // 1000} µs, but its time "
                    f"in {data.name} is {event} µs; both files must be of one sequence, in µs."
                )


def _read_frame_times(path: Path, camera: Camera) -> np.ndarray:
    """Returns the times (ns) of the frames, which are checked to have the size of the camera and 8 bits."""
    with reading(path, EXPECTED), open_hdf5(path) as file:
        times = _microseconds(path, "ovc/ts", read_dataset(path, file, "ovc/ts", "the times of frames in µs", (None,)))
        name = "ovc/ts_map_prophesee_left_t"
        has_map = member_at(path, file, name) is not None
        indices = read_dataset(path, file, name, "numbers of events", (None,)) if has_map else None
        expected = "frames, one for each of ovc/ts, of the size of the camera"
        data = dataset_at(path, file, FRAMES, expected, (len(times), camera.height, camera.width, 1))
        if data.dtype != np.uint8:
            raise RecordingError(f"{path} holds {FRAMES} as {data.dtype}, but uint8 was expected.")
    if indices is not None:
        _check_clock(path, name, path, times, indices)
    return times


FORMAT = Format(
    name="m3ed",
    command="m3ed-events",
    description="Events, grey frames and poses of M3ED.",
    files=FILES,
    read=read,
    options=M3edOptions,
    takes_poses=True,
)
