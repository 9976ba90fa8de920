"""Reader of MVSEC, one DAVIS 346 of one sequence, in its HDF5 format.

    <sequence>_data.hdf5
        davis/left/events               (n, 4) floats: column, row, seconds since 1970, polarity (-1 or 1)
        davis/left/image_raw            (f, 260, 346) uint8: grey frames (optional), with image_raw_ts, seconds
    <sequence>_gt.hdf5
        davis/left/pose                 (m, 4, 4) floats: camera to world, metres, with pose_ts, seconds
        davis/left/depth_image_raw      (d, 260, 346) floats: metres, NaN without depth (optional), with
                                        depth_image_raw_ts, seconds
    camchain-imucam-*.yaml              Kalibr's calibration, of which cam0 is the left DAVIS; here or in a calibration
                                        folder beside this one, such as indoor_flying_calib/

The right DAVIS has davis/right in place of davis/left. Only the left one has poses: the right one is mounted by the
inverse of cam1.T_cn_cnm1, from cam0 to cam1, which must place it to the right.

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
from dataclasses import dataclass
from glob import escape
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from jaxtyping import Float64, Int64
from scipy.spatial.transform import Rotation

from enerf_ns.dataparsers.formats.columns import FARTHEST, LATEST
from enerf_ns.dataparsers.formats.format import Format, FormatOptions
from enerf_ns.dataparsers.formats.json_values import Value
from enerf_ns.dataparsers.formats.text_tables import MOST_ROWS
from enerf_ns.dataparsers.formats.yaml_values import find_calibration, kalibr_camera, read_yaml
from enerf_ns.dataparsers.recording.camera import ROTATION_TOLERANCE, Camera
from enerf_ns.dataparsers.recording.errors import RecordingError
from enerf_ns.dataparsers.recording.files import files_in, reading
from enerf_ns.dataparsers.recording.hdf5_files import dataset_at, member_at, open_hdf5
from enerf_ns.dataparsers.recording.recording import EVENTS_AT_A_TIME, EventRecording, Events, Frames
from enerf_ns.dataparsers.recording.trajectory import Trajectory

if TYPE_CHECKING:
    import h5py

FILES = ("*_data.hdf5", "*_gt.hdf5", "*camchain-imucam-*.yaml")

LONGEST_COORDINATE = 2**16
"""Limit of the columns and rows of events."""


@dataclass(frozen=True)
class MvsecOptions(FormatOptions):
    """Options of MVSEC."""

    event_camera: Literal["left", "right"] = "left"
    """The DAVIS that is read, with its frames and depth maps."""


def read(folder: Path, event_camera: Literal["left", "right"] = "left") -> EventRecording:
    """Reads everything but the events, frames and depth maps, which are read when they are needed.

    Args:
        folder: The folder with the files that the module describes.
        event_camera: The DAVIS.

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
        iter(files_in(folder, FILES[2])), None
    )
    if calibration is None:
        raise RecordingError(
            f"{folder} holds no camchain-imucam-{place}.yaml, and neither does a calibration folder beside it; put it "
            "there, as it is published with the data set."
        )
    camchain = read_yaml(calibration, "a Kalibr camchain")[1]
    camera = kalibr_camera(camchain["cam0" if event_camera == "left" else "cam1"])
    group = f"davis/{event_camera}"
    notes = [] if calibration.parent == folder else [f"The calibration is read from {calibration}."]

    num_events, first = _open_events(data, group)
    times, positions, quaternions = _read_poses(truth)
    frames = _pictures(data, f"{group}/image_raw", camera)
    depth = _pictures(truth, f"{group}/depth_image_raw", camera)
    starts = [first, times[0], *(pictures[0][0] for pictures in (frames, depth) if pictures is not None)]
    zero = int(min(starts))
    trajectory = Trajectory(times - zero, positions, quaternions)
    if event_camera == "right":
        trajectory = trajectory.of_mounted(_left_from_right(camchain))
    depth_maps = _frames(depth, zero, camera, trajectory)
    if depth_maps is not None:
        depth_maps = Frames(depth_maps.filenames, depth_maps.times, camera, trajectory, depth_maps.filenames)
    return EventRecording(
        path=folder,
        format="mvsec",
        camera=camera,
        trajectory=trajectory,
        stream_events=lambda: _stream_events(data, group, num_events, zero),
        event_files=(data,),
        zero=zero,
        frames=_frames(frames, zero, camera, trajectory),
        depth_maps=depth_maps,
        notes=tuple(notes),
        num_events=num_events,
        times_in={"events": (data, "s"), "poses": (truth, "s"), "frames": (data, "s"), "depth maps": (truth, "s")},
    )


def _find_one(folder: Path, pattern: str) -> Path:
    found = files_in(folder, pattern)
    if len(found) != 1:
        names = " and ".join(path.name for path in found[:2]) or "none"
        raise RecordingError(
            f"{folder} holds {len(found)} files {pattern} ({names}), but one sequence was expected; give each sequence "
            "its own folder, with links to its files."
        )
    return found[0]


def _left_from_right(camchain: Value) -> Float64[np.ndarray, "4 4"]:
    """Returns the pose of the right DAVIS in the axes of the left one."""
    pose = np.linalg.inv(camchain["cam1"]["T_cn_cnm1"].pose())
    if pose[0, 3] <= 0:
        raise RecordingError(
            f"{camchain.path} places cam1, the right DAVIS, {-pose[0, 3]:g} m to the left of cam0 by T_cn_cnm1, which "
            "is taken as the motion from cam0 to cam1; get the file as it is published."
        )
    return pose


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
            f"{path} holds in {name}, row {start + row + 1}, the time {seconds[row]:g} s, but seconds within "
            "146 years were expected."
        )
    whole = np.floor(seconds)
    return whole.astype(np.int64) * 10**9 + np.rint((seconds - whole) * 1e9).astype(np.int64)


def _stamps(path: Path, file: h5py.File, name: str) -> Int64[np.ndarray, " stamps"]:
    """Returns the stamps (ns) of poses or pictures, which must increase."""
    name = f"{name}_ts"
    dataset = dataset_at(path, file, name, "seconds", (None,), "f")
    if len(dataset) > MOST_ROWS:
        raise RecordingError(f"{path} holds {len(dataset):,} times in {name}, but at most {MOST_ROWS:,} were expected.")
    times = _nanoseconds(path, name, dataset[...])
    late = np.flatnonzero(np.diff(times) <= 0)
    if len(late):
        raise RecordingError(
            f"{path} holds in {name}, row {late[0] + 2}, a time that is not after that of the row before; "
            "times must increase from row to row."
        )
    return times


def _open_events(path: Path, group: str) -> tuple[int, int]:
    """Returns the number of events and the time (ns) of the first."""
    with reading(path, "an HDF5 file of MVSEC"), open_hdf5(path) as file:
        events = _events(path, file, group)
        if not len(events):
            raise RecordingError(f"{path} holds no events; give a recording with some.")
        return len(events), int(_nanoseconds(path, f"{group}/events", events[:1, 2])[0])


def _events(path: Path, file: h5py.File, group: str) -> h5py.Dataset:
    expected = "rows of column, row, seconds and polarity"
    return dataset_at(path, file, f"{group}/events", expected, (None, 4), "f")


def _stream_events(path: Path, group: str, num_events: int, zero: int) -> Iterator[Events]:
    with reading(path, "an HDF5 file of MVSEC"):
        file = open_hdf5(path)
    with file:
        for start in range(0, num_events, EVENTS_AT_A_TIME):
            stop = min(start + EVENTS_AT_A_TIME, num_events)
            with reading(path, f"an HDF5 file with events {start + 1:,} to {stop:,}"):
                rows = _events(path, file, group)[start:stop]
            if len(rows) != stop - start:
                raise RecordingError(f"{path} held {num_events:,} events and holds fewer now; read it again.")
            times = _nanoseconds(path, f"{group}/events", rows[:, 2], start) - zero
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
    """Returns times (ns), positions (metres) and quaternions xyzw of the left DAVIS."""
    name = "davis/left/pose"
    with reading(path, "an HDF5 file of MVSEC"), open_hdf5(path) as file:
        times = _stamps(path, file, name)
        dataset = dataset_at(path, file, name, "matrices of 4 x 4 numbers", (None, 4, 4), "f")
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
            f"{path} holds in {name}, row {int(np.argmin(rigid)) + 1}, no rigid motion, but a rotation, a "
            f"position within {FARTHEST:g} m and the last row 0 0 0 1 were expected."
        )
    return times, places, Rotation.from_matrix(turns).as_quat()


Pictures = tuple[Int64[np.ndarray, " pictures"], tuple[Path, ...]]
"""Times (ns) and paths within an HDF5 file of pictures."""


def _pictures(path: Path, name: str, camera: Camera) -> Pictures | None:
    """Returns times and paths of frames or depth maps; None if the file holds none."""
    is_depth = "depth" in name
    with reading(path, "an HDF5 file of MVSEC"), open_hdf5(path) as file:
        if member_at(path, file, name) is None:
            return None
        shape, expected = (None, camera.height, camera.width), f"pictures of {camera.width} x {camera.height} pixels"
        dataset = dataset_at(path, file, name, f"{expected}, as in the calibration,", shape, "f" if is_depth else "u")
        times = _stamps(path, file, name)
        if dataset.dtype.itemsize > (8 if is_depth else 1):
            raise RecordingError(f"{path} holds {name} as {dataset.dtype}, but 8 bits were expected.")
        if len(dataset) != len(times):
            raise RecordingError(
                f"{path} holds {len(dataset):,} pictures in {name}, but {len(times):,} times of them; as many "
                "of each were expected."
            )
    if not len(times):
        return None
    return times, tuple(path / name / str(number) for number in range(len(times)))


def _frames(pictures: Pictures | None, zero: int, camera: Camera, trajectory: Trajectory) -> Frames | None:
    return None if pictures is None else Frames(pictures[1], pictures[0] - zero, camera, trajectory)


FORMAT = Format(
    name="mvsec",
    command="mvsec-events",
    description="Events of a DAVIS of a sequence of MVSEC (HDF5).",
    files=FILES,
    read=read,
    options=MvsecOptions,
)
