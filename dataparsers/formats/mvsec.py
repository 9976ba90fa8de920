"""Reader of MVSEC, the left DAVIS 346 of one sequence, in its HDF5 format.

    <sequence>_data.hdf5
        davis/left/events               (n, 4) floats: column, row, seconds since 1970, polarity (-1 or 1)
        davis/left/image_raw            (f, 260, 346) uint8: grey frames (optional), with image_raw_ts, seconds
    <sequence>_gt.hdf5
        davis/left/pose                 (m, 4, 4) floats: camera to world, metres, with pose_ts, seconds
        davis/left/depth_image_raw      (d, 260, 346) floats: metres, NaN without depth (optional), with
                                        depth_image_raw_ts, seconds
    camchain-imucam-*.yaml              Kalibr's calibration, of which cam0 is the left DAVIS; here or in a calibration
                                        folder beside this one, such as indoor_flying_calib/

Events, frames and depth maps are those of the raw sensor, with the distortion of the lens: equidistant, which is
OpenCV's fisheye. Frames and depth maps stay in the HDF5 files. The recording's zero is the earliest first stamp.

The documents of the data set leave open:
    the direction of the poses          they are read as camera to world, as those who evaluate odometry read them;
                                        `enerf inspect` tries the other reading, and compares depth maps with the events
    to which camera the poses belong    they are read as those of the left DAVIS
    the instant of a frame              its stamp is read as the middle of the exposure, which is not stated
    whole numbers                       are read as the centres of pixels, as in OpenCV's calibration

The reader checks that the poses are rigid, that all stamps increase, that the frames have the size of the calibration,
and that events, frames and poses lie on one clock.

Zhu et al., "The multivehicle stereo event camera dataset: An event camera dataset for 3D perception", RA-L 2018;
https://daniilidis-group.github.io/mvsec.
"""

from __future__ import annotations

from collections.abc import Iterator
from glob import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float64, Int64
from scipy.spatial.transform import Rotation

from enerf_ns.dataparsers.formats.columns import FARTHEST, LATEST
from enerf_ns.dataparsers.formats.format import Format
from enerf_ns.dataparsers.formats.text_tables import MOST_ROWS
from enerf_ns.dataparsers.formats.yaml_values import find_calibration, kalibr_camera, read_yaml
from enerf_ns.dataparsers.recording.camera import ROTATION_TOLERANCE, Camera
from enerf_ns.dataparsers.recording.errors import RecordingError
from enerf_ns.dataparsers.recording.files import reading
from enerf_ns.dataparsers.recording.hdf5_files import dataset_at, member, open_hdf5
from enerf_ns.dataparsers.recording.recording import EVENTS_AT_A_TIME, EventRecording, Events, Frames
from enerf_ns.dataparsers.recording.trajectory import Trajectory

if TYPE_CHECKING:
    import h5py

FILES = ("*_data.hdf5", "*_gt.hdf5", "*camchain-imucam-*.yaml")

CAMERA = "davis/left"
"""Group of the left DAVIS in both files."""

LONGEST_COORDINATE = 2**16
"""Limit of the columns and rows of events."""


def read(folder: Path) -> EventRecording:
    """Reads everything but the events, frames and depth maps, which are read when they are needed.

    Args:
        folder: The folder with the files that the module describes.

    Raises:
        RecordingError: A file is missing, empty or cannot be used.
    """
    data, truth = (_find_one(folder, pattern) for pattern in FILES[:2])
    if data.name.removesuffix("_data.hdf5") != truth.name.removesuffix("_gt.hdf5"):
        raise RecordingError(
            f"{folder} holds {data.name} and {truth.name}, but both files of one sequence were expected; give each "
            "sequence its own folder."
        )
    place = data.name.removesuffix("_data.hdf5").rstrip("0123456789")
    calibration = find_calibration(folder, f"*camchain-imucam-{escape(place)}.yaml") or next(
        folder.glob(FILES[2]), None
    )
    if calibration is None:
        raise RecordingError(
            f"{folder} holds no camchain-imucam-{place}.yaml, and neither does a calibration folder beside it; put it "
            "there, as it is published with the data set."
        )
    camera = kalibr_camera(read_yaml(calibration, "a Kalibr camchain")[1]["cam0"])
    notes = [] if calibration.parent == folder else [f"The calibration is read from {calibration}."]

    num_events, first = _open_events(data)
    times, positions, quaternions = _read_poses(truth)
    frames = _pictures(data, "image_raw", camera)
    depth = _pictures(truth, "depth_image_raw", camera)
    starts = [first, times[0], *(pictures[0][0] for pictures in (frames, depth) if pictures is not None)]
    zero = int(min(starts))
    trajectory = Trajectory(times - zero, positions, quaternions)
    depth_maps = _frames(depth, zero, camera, trajectory)
    if depth_maps is not None:
        depth_maps = Frames(depth_maps.filenames, depth_maps.times, camera, trajectory, depth_maps.filenames)
    return EventRecording(
        path=folder,
        format="mvsec",
        camera=camera,
        trajectory=trajectory,
        stream_events=lambda: _stream_events(data, num_events, zero),
        event_files=(data,),
        frames=_frames(frames, zero, camera, trajectory),
        depth_maps=depth_maps,
        notes=tuple(notes),
        num_events=num_events,
        times_in={"events": (data, "s"), "poses": (truth, "s"), "frames": (data, "s"), "depth maps": (truth, "s")},
    )


def _find_one(folder: Path, pattern: str) -> Path:
    found = sorted(folder.glob(pattern))
    if len(found) != 1:
        names = " and ".join(path.name for path in found[:2]) or "none"
        raise RecordingError(
            f"{folder} holds {len(found)} files {pattern} ({names}), but one sequence was expected; give each sequence "
            "its own folder, with links to its files."
        )
    return found[0]


def _numbers(
    path: Path, file: h5py.File, name: str, kinds: str, shape: tuple[int | None, ...], expected: str
) -> h5py.Dataset:
    """Returns a dataset of the camera, of these kinds of numbers and this shape, with None for any length."""
    return dataset_at(path, file, f"{CAMERA}/{name}", expected, shape, kinds)


def _nanoseconds(path: Path, name: str, seconds: np.ndarray, start: int = 0) -> Int64[np.ndarray, " times"]:
    """Returns times in seconds as whole nanoseconds, without rounding of the many digits since 1970.

    Args:
        path, name: File and name of the dataset, for errors.
        seconds: The times.
        start: Number of the first of them.
    """
    seconds = seconds.astype(np.float64)
    wrong = ~(np.abs(seconds) < LATEST * 1e-9)
    if wrong.any():
        row = int(np.argmax(wrong))
        raise RecordingError(
            f"{path} holds in {CAMERA}/{name}, row {start + row + 1}, the time {seconds[row]:g} s, but seconds within "
            "146 years were expected."
        )
    whole = np.floor(seconds)
    return whole.astype(np.int64) * 10**9 + np.rint((seconds - whole) * 1e9).astype(np.int64)


def _stamps(path: Path, file: h5py.File, name: str) -> Int64[np.ndarray, " stamps"]:
    """Returns the stamps (ns) of poses or pictures, which must increase."""
    name = f"{name}_ts"
    dataset = _numbers(path, file, name, "f", (None,), "seconds")
    if len(dataset) > MOST_ROWS:
        raise RecordingError(f"{path} holds {len(dataset):,} times in {name}, but at most {MOST_ROWS:,} were expected.")
    times = _nanoseconds(path, name, dataset[...])
    late = np.flatnonzero(np.diff(times) <= 0)
    if len(late):
        raise RecordingError(
            f"{path} holds in {CAMERA}/{name}, row {late[0] + 2}, a time that is not after that of the row before; "
            "times must increase from row to row."
        )
    return times


def _open_events(path: Path) -> tuple[int, int]:
    """Returns the number of events and the time (ns) of the first."""
    with reading(path, "an HDF5 file of MVSEC"), open_hdf5(path) as file:
        events = _events(path, file)
        if not len(events):
            raise RecordingError(f"{path} holds no events; give a recording with some.")
        return len(events), int(_nanoseconds(path, "events", events[:1, 2])[0])


def _events(path: Path, file: h5py.File) -> h5py.Dataset:
    return _numbers(path, file, "events", "f", (None, 4), "rows of column, row, seconds and polarity")


def _stream_events(path: Path, num_events: int, zero: int) -> Iterator[Events]:
    with reading(path, "an HDF5 file of MVSEC"):
        file = open_hdf5(path)
    with file:
        for start in range(0, num_events, EVENTS_AT_A_TIME):
            stop = min(start + EVENTS_AT_A_TIME, num_events)
            with reading(path, f"an HDF5 file with events {start + 1:,} to {stop:,}"):
                rows = _events(path, file)[start:stop]
            if len(rows) != stop - start:
                raise RecordingError(f"{path} held {num_events:,} events and holds fewer now; read it again.")
            times = _nanoseconds(path, "events", rows[:, 2], start) - zero
            others = rows[:, [0, 1, 3]]
            wrong = ~((np.abs(others) < LONGEST_COORDINATE) & (others == np.rint(others))).all(axis=1)
            if wrong.any():
                row = int(np.argmax(wrong))
                raise RecordingError(
                    f"{path}, event {start + row + 1}, holds the column, row and polarity {others[row].tolist()}, but "
                    "whole numbers were expected."
                )
            x, y, p = others.astype(np.int32).T
            yield Events(x, y, times, p)


def _read_poses(
    path: Path,
) -> tuple[Int64[np.ndarray, " poses"], Float64[np.ndarray, "poses 3"], Float64[np.ndarray, "poses 4"]]:
    """Returns times (ns), positions (metres) and quaternions xyzw."""
    with reading(path, "an HDF5 file of MVSEC"), open_hdf5(path) as file:
        times = _stamps(path, file, "pose")
        dataset = _numbers(path, file, "pose", "f", (None, 4, 4), "matrices of 4 x 4 numbers")
        if len(dataset) != len(times) or len(times) < 2:
            raise RecordingError(
                f"{path} holds {len(dataset):,} poses and {len(times):,} times of poses, but at least 2, and as many "
                "of each, were expected."
            )
        poses = dataset[...].astype(np.float64)
    turns, places = poses[:, :3, :3], poses[:, :3, 3]
    with np.errstate(invalid="ignore", over="ignore"):
        rigid = np.abs(turns @ turns.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2)) <= ROTATION_TOLERANCE
        rigid &= (np.linalg.det(np.where(np.isfinite(turns), turns, 0)) > 0) & (poses[:, 3] == [0, 0, 0, 1]).all(axis=1)
        rigid &= (np.abs(places) < FARTHEST).all(axis=1)
    if not rigid.all():
        raise RecordingError(
            f"{path} holds in {CAMERA}/pose, row {int(np.argmin(rigid)) + 1}, no rigid motion, but a rotation, a "
            f"position within {FARTHEST:g} m and the last row 0 0 0 1 were expected."
        )
    return times, places, Rotation.from_matrix(turns).as_quat()


Pictures = tuple[Int64[np.ndarray, " pictures"], tuple[Path, ...]]
"""Times (ns) and paths within an HDF5 file of pictures."""


def _pictures(path: Path, name: str, camera: Camera) -> Pictures | None:
    """Returns times and paths of frames or depth maps; None if the file holds none."""
    is_depth = name.startswith("depth")
    with reading(path, "an HDF5 file of MVSEC"), open_hdf5(path) as file:
        group: Any = file
        for part in CAMERA.split("/"):
            group = member(path, group, part)
        if group.get(name, getlink=True) is None:
            return None
        shape, expected = (None, camera.height, camera.width), f"pictures of {camera.width} x {camera.height} pixels"
        dataset = _numbers(path, file, name, "f" if is_depth else "u", shape, f"{expected}, as in the calibration,")
        times = _stamps(path, file, name)
        if dataset.dtype.itemsize > (8 if is_depth else 1):
            raise RecordingError(f"{path} holds {CAMERA}/{name} as {dataset.dtype}, but 8 bits were expected.")
        if len(dataset) != len(times):
            raise RecordingError(
                f"{path} holds {len(dataset):,} pictures in {CAMERA}/{name}, but {len(times):,} times of them; as many "
                "of each were expected."
            )
    if not len(times):
        return None
    return times, tuple(path / CAMERA / name / str(number) for number in range(len(times)))


def _frames(pictures: Pictures | None, zero: int, camera: Camera, trajectory: Trajectory) -> Frames | None:
    return None if pictures is None else Frames(pictures[1], pictures[0] - zero, camera, trajectory)


FORMAT = Format(
    name="mvsec",
    command="mvsec-events",
    description="Events of the left DAVIS of a sequence of MVSEC (HDF5).",
    files=FILES,
    read=read,
)
