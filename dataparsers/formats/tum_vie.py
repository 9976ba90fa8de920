"""Reader and writer of TUM-VIE: two event cameras, two cameras of grey frames, and motion capture.

As it is unpacked, for the left event camera (the right one has its own files):

    <sequence>-events_left.h5             events/x, y, t and p, microseconds, polarity 0 or 1
    <sequence>-vi_gt_data/                or its content beside the events
        mocap_data.txt                    t_us px py pz qx qy qz qw of the markers, one pose a line, metres
        left_images/*.jpg                 or .png (optional), with, in this folder or the one above,
            image_timestamps_left.txt     t_us, one frame a line
            image_exposures_left.txt      exposure_us, one frame a line (optional)
    camera-calibrationA.json              value0: intrinsics (kb4), resolution and T_imu_cam of four cameras
    mocap-imu-calibrationA.json           value0: T_imu_marker

Some sequences need the calibrations with a B. The calibrations may also lie in `vi_gt_data` or in one of the two
folders above. Cameras 0 and 1 take the left and the right frames, cameras 2 and 3 the events. kb4 is OpenCV's fisheye.

As the reference code of E-NeRF prepares it, all in one folder:

    *events_left.h5, *mocap*.txt          as above
    *rectify_map_left.h5                  rectify_map (720, 1280, 2): where each pixel lies in the undistorted image
    calib_undist.json                     value0: intrinsics_undistorted and T_imu_cam of four cameras
    calibration.json                      the camera calibration as it was (optional)
    mocap-imu-calib.json                  the calibration of the markers as it was
    left_images_undistorted/*.png         or .jpg (optional), with stamps and exposures as above

The poses are those of the markers. A camera's pose is T_mocap_marker * inv(T_imu_marker) * T_imu_cam. The published
stamps of all sensors are on one clock. The time offsets in the calibrations are not applied again.

A frame's time is the middle of its exposure. The data set does not state whether a stamp is the start, the middle or
the end of the exposure. The reader takes it as the start, when cameras are triggered, and adds half of the exposure.
E-NeRF and Robust e-NeRF do not read the exposures and take the stamp itself.

Klenk et al., "TUM-VIE: The TUM stereo visual-inertial event dataset", IROS 2021; published at
https://vision.in.tum.de/data/datasets/visual-inertial-event-dataset.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Float64, Int64
from scipy.spatial.transform import Rotation

from enerf_ns.dataparsers.formats.columns import unit_quaternions
from enerf_ns.dataparsers.formats.format import Format, FormatOptions
from enerf_ns.dataparsers.formats.frame_folders import check_one_each, images_in, read_stamps
from enerf_ns.dataparsers.formats.hdf5_events import Hdf5Events, Hdf5EventsFile, read_rectified_camera
from enerf_ns.dataparsers.formats.json_values import Value, open_json
from enerf_ns.dataparsers.formats.text_tables import parse_numbers, read_poses, read_rows
from enerf_ns.dataparsers.formats.writer import EventFiles, Writer, encode_json, encode_poses, poses_at
from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.dataparsers.recording.errors import FlagError, RecordingError
from enerf_ns.dataparsers.recording.files import check_image_sizes, files_in, image_size, of_file
from enerf_ns.dataparsers.recording.recording import EventRecording, Frames
from enerf_ns.dataparsers.recording.time_units import Times, check_units, check_usual_units
from enerf_ns.dataparsers.recording.trajectory import Trajectory

FILES = ("*events_left.h5", "*events_right.h5", "*mocap*.txt", "*vi_gt_data/mocap_data.txt", "calib_undist.json")

SIDES = ("left", "right")

SENSOR_SIZE = (1280, 720)
"""Width and height of the event cameras in pixels."""

PUBLISHED_EVENT_CAMERA = Camera(
    *SENSOR_SIZE,
    *(1049.5830934616608, 1049.4229746040553, 634.7184038833433, 263.46974530961836),
    (-0.11519655713574485, -0.06222183183004903, 0.21682612342850954, -0.23528623774744806),
    "fisheye",
)
PUBLISHED_FRAME_CAMERA = Camera(
    *(1024, 1024),
    *(747.3121949097032, 747.1524375957724, 490.8606682225008, 505.2373814853779),
    (0.019702988705266412, 0.0019647288278805426, 0.0020858202586604944, -0.0009536922337319427),
    "fisheye",
)
PUBLISHED_EXTRINSICS = np.array(
    [
        [0.9996531471970287, 0.016267207253101275, 0.020711428421532566, 0.004961248261481997],
        [-0.016224659683973887, 0.9998659054721688, -0.0022206963906204855, -0.044440526824174015],
        [-0.02074477566075011, 0.0018838902581444984, 0.9997830290819506, -0.010716232401772177],
        [0.0, 0.0, 0.0, 1.0],
    ]
)
"""Pose of the left frame camera in the axes of the left event camera, metres. It and the two cameras above are from
camera-calibrationA, with which mocap-desk and mocap-desk2 were recorded."""

WRITTEN_SEQUENCE = "simulated"
"""Name of the sequence in the names of the files of a written recording."""

SEQUENCES = {
    "A": ("loop-floor0", "loop-floor1", "loop-floor2", "loop-floor3", "mocap-desk", "mocap-desk2", "skate-easy"),
    "B": (
        *("mocap-1d-trans", "mocap-3d-trans", "mocap-6dof", "mocap-shake", "mocap-shake2", "office-maze", "slide"),
        *("running-easy", "running-hard", "skate-hard", "bike-easy", "bike-hard", "bike-dark", "floor2-dark"),
    ),
}
"""Names of the sequences, by the letter of their calibration."""

CALIBRATIONS = ("camera-calibration", "mocap-imu-calibration")

BALANCE_TOLERANCE = 1.0
"""Largest difference between stated intrinsics and OpenCV's, pixels. Versions of OpenCV differ by less."""


@dataclass(frozen=True)
class TumVieOptions(FormatOptions):
    """Options of the reader."""

    event_camera: Literal["left", "right"] = "left"
    """The event camera that is read, with the frame camera beside it."""


@dataclass(frozen=True)
class _Rig:
    """The cameras of one side, as the files of a layout state them."""

    camera: Camera
    """Camera of the events."""
    imu_from_camera: Float64[np.ndarray, "4 4"]
    frame_camera: Camera | None
    """Camera of the frames; None without frames."""
    imu_from_frame_camera: Float64[np.ndarray, "4 4"]
    imu_from_marker: Float64[np.ndarray, "4 4"]


def read(folder: Path, event_camera: Literal["left", "right"] = "left") -> EventRecording:
    """Reads everything but the events, which are read when they are needed.

    The recording's zero of time is the earliest first stamp among events, frames and poses.

    Args:
        folder: The folder with the files that the module describes.
        event_camera: The event camera; the frames are those of the same side.

    Raises:
        RecordingError: A file is missing, empty or cannot be used.
    """
    notes: list[str] = []
    events_file = _find_one(folder, f"*events_{event_camera}.h5", f"events of the {event_camera} camera")
    sequence = events_file.name.removesuffix(f"events_{event_camera}.h5").rstrip("-_. ")
    events = Hdf5Events(events_file)

    prepared = [folder / "calib_undist.json", folder / f"{event_camera}_images_undistorted"]
    prepared += files_in(folder, f"*rectify_map_{event_camera}.h5")
    is_prepared = any(path.exists() for path in prepared)
    data = folder if is_prepared else _data_folder(folder, sequence)
    images = data / f"{event_camera}_images{'_undistorted' * is_prepared}"
    poses_file = _find_one(data, "*mocap*.txt", "poses (t_us px py pz qx qy qz qw)")
    pose_times, positions, quaternions = read_poses(poses_file, "us", notes)
    poses = Times.of_rows("poses", poses_file, "us", pose_times)
    check_units(folder, [events.times(SENSOR_SIZE[0] * SENSOR_SIZE[1]), poses])
    frame_files, stamps, frame_times, exposures = _read_frames(images, event_camera, poses, notes)
    zero = int(min(events.first_time, pose_times[0], *stamps[:1]))

    if is_prepared:
        rig = _read_prepared_rig(folder, event_camera, sequence, frame_files, notes)
    else:
        rig = _read_raw_rig(folder, data, event_camera, sequence, bool(frame_files), notes)
    markers = Trajectory(pose_times - zero, positions, quaternions)
    marker_from_imu = np.linalg.inv(rig.imu_from_marker)
    frames = None
    if rig.frame_camera is not None:
        check_image_sizes(frame_files, rig.frame_camera.width, rig.frame_camera.height)
        frame_trajectory = markers.of_mounted(marker_from_imu @ rig.imu_from_frame_camera)
        with of_file(images):
            frames = Frames(frame_files, frame_times - zero, rig.frame_camera, frame_trajectory, exposures=exposures)
    return EventRecording(
        path=folder,
        format="tum_vie",
        camera=rig.camera,
        trajectory=markers.of_mounted(marker_from_imu @ rig.imu_from_camera),
        stream_events=lambda: events.stream(zero),
        event_files=(events_file,),
        zero=zero,
        frames=frames,
        notes=tuple(notes),
        num_events=events.num_events,
        times_in={
            "events": (events_file, "us"),
            "poses": (poses_file, "us"),
            "frames": (_stamps_file(images, event_camera), "us"),
        },
    )


def _find_one(folder: Path, pattern: str, what: str) -> Path:
    """Returns the only file of a pattern; several files are an error, since none is better than another."""
    found = files_in(folder, pattern)
    if not found:
        raise RecordingError(f"{folder} holds no {pattern}; a file of {what} was expected there.")
    if len(found) > 1:
        names = " and ".join(path.name for path in found[:2])
        raise RecordingError(
            f"{folder} holds {len(found)} files {pattern}, such as {names}; leave only the one to read."
        )
    return found[0]


def _data_folder(folder: Path, sequence: str) -> Path:
    """Returns the unpacked archive of frames and poses, or the recording's folder if there is none."""
    named = folder / f"{sequence}-vi_gt_data"
    found = [named] if named.is_dir() else [path for path in files_in(folder, "*vi_gt_data") if path.is_dir()]
    if len(found) > 1:
        raise RecordingError(
            f"{folder} holds {len(found)} folders *vi_gt_data, but none of them is {named.name}; rename the one that "
            "belongs to the events."
        )
    return found[0] if found else folder


def _read_frames(
    folder: Path, side: str, poses: Times, notes: list[str]
) -> tuple[
    tuple[Path, ...], Int64[np.ndarray, " frames"], Int64[np.ndarray, " frames"], Int64[np.ndarray, " frames"] | None
]:
    """Returns files, stamps, middles of the exposures (both ns on the clock of the data set), and exposures (ns).

    The exposures are None if they are not known.
    """
    files = images_in(folder)
    stamps_file = _stamps_file(folder, side)
    if not files and not stamps_file.exists():
        return (), np.zeros(0, np.int64), np.zeros(0, np.int64), None
    stamps = read_stamps(files, stamps_file, "us", folder)
    columns = [poses, Times.of_rows("frames", stamps_file, "us", stamps)]
    check_units(folder, columns)
    exposures_file = _here_or_above(folder, f"image_exposures_{side}.txt")
    if not exposures_file.exists():
        notes.append(f"{exposures_file.name} is missing, so each frame has the pose at its stamp.")
        return files, stamps, stamps, None

    rows, numbers = read_rows(exposures_file, "exposure_us")
    exposures = parse_numbers(exposures_file, rows, numbers)[:, 0]
    check_one_each(folder, len(files), exposures_file, len(exposures), "exposures")
    gap = float(np.diff(stamps).max(initial=0) or 10**9) * 1e-3
    middles = stamps + np.rint(exposures.clip(0, gap) * 500).astype(np.int64)
    fit = (exposures >= 0).all() and exposures.max() <= gap and not 0 < exposures.max() < 1
    if not fit or (np.diff(middles) <= 0).any():
        check_usual_units(folder, columns)
        raise RecordingError(
            f"{exposures_file} holds exposures from {exposures.min():g} to {exposures.max():g} us, which do not fit "
            f"frames at most {gap:g} us apart; exposures in microseconds were expected."
        )
    return files, stamps, middles, np.rint(exposures * 1000).astype(np.int64)


def _stamps_file(folder: Path, side: str) -> Path:
    return _here_or_above(folder, f"image_timestamps_{side}.txt")


def _here_or_above(folder: Path, name: str) -> Path:
    above = folder.parent / name
    return above if above.exists() and not (folder / name).exists() else folder / name


def _read_raw_rig(folder: Path, data: Path, side: str, sequence: str, has_frames: bool, notes: list[str]) -> _Rig:
    index = SIDES.index(side)
    camera_file, marker_file = _find_calibrations(folder, data, sequence, notes)
    calibration = _read_calibration(camera_file)
    camera = _fisheye(calibration, 2 + index)
    _check_event_camera(camera_file, camera)
    return _Rig(
        camera,
        _pose(calibration["T_imu_cam"].values(4)[2 + index]),
        _fisheye(calibration, index) if has_frames else None,
        _pose(calibration["T_imu_cam"].values(4)[index]),
        _read_marker(marker_file, marker_file.name),
    )


def _find_calibrations(folder: Path, data: Path, sequence: str, notes: list[str]) -> tuple[Path, Path]:
    """Returns the calibrations of the cameras and of the markers."""
    folders = (folder, data, folder.parent, folder.parent.parent)

    def find(kind: str, letter: str) -> Path | None:
        paths = (path / f"{kind}{letter}.json" for path in folders)
        return next((path for path in paths if path.is_file()), None)

    letter = _letter(sequence)
    if letter is None:
        there = [letter for letter in SEQUENCES if any(find(kind, letter) for kind in CALIBRATIONS)]
        if len(there) > 1:
            raise RecordingError(
                f"{folder} can be read with calibration A or B, and its events, called {sequence!r}, are none of the "
                "published sequences; name the events file <sequence>-events_left.h5, or leave only the calibration "
                "of this recording."
            )
        if not there:
            raise RecordingError(
                f"{folder} has neither camera-calibrationA.json nor camera-calibrationB.json; put the one of "
                "this recording there, which is published with the data set."
            )
        letter = there[0]
        notes.append(f"{sequence or folder.name} is none of the published sequences; calibration {letter} is used.")
    found = []
    for kind in CALIBRATIONS:
        path = find(kind, letter)
        if path is None:
            raise RecordingError(
                f"{folder / f'{kind}{letter}.json'} is missing, the calibration of {sequence or folder.name}; put it "
                "there, as it is published with the data set."
            )
        found.append(path)
    return found[0], found[1]


def _letter(sequence: str) -> str | None:
    return next((letter for letter, names in SEQUENCES.items() if sequence in names), None)


def _read_prepared_rig(folder: Path, side: str, sequence: str, frame_files: tuple[Path, ...], notes: list[str]) -> _Rig:
    index = SIDES.index(side)
    path = folder / "calib_undist.json"
    calibration = _read_calibration(path)
    raw_path = folder / "calibration.json"
    raw = _read_calibration(raw_path) if raw_path.exists() else calibration
    has_raw = raw_path.exists() or raw.get("intrinsics") is not None

    camera = _undistorted(calibration, 2 + index, *SENSOR_SIZE)
    rectify_map = _find_one(folder, f"*rectify_map_{side}.h5", "a rectify map")
    camera = read_rectified_camera(rectify_map, camera)
    if has_raw:
        _check_event_camera(raw.path, _fisheye(raw, 2 + index))

    frame_camera = None
    if frame_files:
        lens = _fisheye(raw, index) if has_raw else None
        width, height = (lens.width, lens.height) if lens is not None else image_size(frame_files[0])
        frame_camera = _undistorted(calibration, index, width, height)
        if lens is not None:
            frame_camera = _mend_balance(path, frame_camera, lens, notes)
    return _Rig(
        camera,
        _pose(calibration["T_imu_cam"].values(4)[2 + index]),
        frame_camera,
        _pose(calibration["T_imu_cam"].values(4)[index]),
        _read_marker(folder / "mocap-imu-calib.json", f"mocap-imu-calibration{_letter(sequence) or '{A,B}'}.json"),
    )


def _mend_balance(path: Path, stated: Camera, lens: Camera, notes: list[str]) -> Camera:
    """Returns the camera of undistorted frames, with the intrinsics that the images have.

    The reference code undistorts images with balance 0 of OpenCV's fisheye model, but states the intrinsics of 0.5.
    """
    half = cv2.fisheye.estimateNewCameraMatrixForUndistortRectify(
        lens.matrix, np.array(lens.distortion), (lens.width, lens.height), np.eye(3), balance=0.5
    )
    none = lens.undistorted()
    error = np.abs(stated.matrix - half).max()
    if error > BALANCE_TOLERANCE or error >= np.abs(stated.matrix - none.matrix).max():
        return stated
    notes.append(
        f"{path.name} states the frames' intrinsics for balance 0.5 (fx {stated.fx:.2f}), but the code that writes it "
        f"undistorts the images with balance 0, so the intrinsics of balance 0 (fx {none.fx:.2f}) are used."
    )
    return none


def _check_event_camera(path: Path, camera: Camera) -> None:
    if (camera.width, camera.height) != SENSOR_SIZE:
        raise RecordingError(
            f"{path} is a calibration of the event camera at {camera.width} x {camera.height} pixels, but "
            f"{SENSOR_SIZE[0]} x {SENSOR_SIZE[1]} were expected; give the calibration of the recording's resolution."
        )


def _read_calibration(path: Path) -> Value:
    return open_json(path)["value0"]


def _undistorted(calibration: Value, index: int, width: int, height: int) -> Camera:
    """Returns the pinhole camera of the undistorted image."""
    entry = calibration["intrinsics_undistorted"].values(4)[index]
    camera = entry.camera((width, height), entry.each("fx", "fy", "cx", "cy"))
    if not (0 < camera.cx < width and 0 < camera.cy < height):
        raise RecordingError(
            f"{entry.path} holds in {entry.name} the principal point ({camera.cx:g}, {camera.cy:g}), which lies "
            f"outside the {width} x {height} pixels; give the calibration of this resolution."
        )
    return camera


def _fisheye(calibration: Value, index: int) -> Camera:
    entry = calibration["intrinsics"].values(4)[index]
    entry["camera_type"].choice(("kb4",))
    intrinsics = entry["intrinsics"].each("fx", "fy", "cx", "cy")
    distortion = entry["intrinsics"].each("k1", "k2", "k3", "k4")
    return entry.camera(
        calibration["resolution"].values(4)[index].numbers((2,)).tolist(), intrinsics, distortion, "fisheye"
    )


def _pose(entry: Value) -> Float64[np.ndarray, "4 4"]:
    """Returns the matrix of a position px py pz (metres) and a quaternion qx qy qz qw."""
    position = np.array([entry.each("px", "py", "pz")])
    quaternion = np.array([entry.each("qx", "qy", "qz", "qw")])
    pose = np.eye(4)
    rotation = unit_quaternions(entry.path, position, quaternion, [], lambda _: entry.name)
    pose[:3, :3] = Rotation.from_quat(rotation[0]).as_matrix()
    pose[:3, 3] = position[0]
    return pose


def _read_marker(path: Path, published: str) -> Float64[np.ndarray, "4 4"]:
    """Returns T_imu_marker from the calibration of the markers.

    Args:
        path: The calibration of the markers.
        published: The name of this file in the data set.
    """
    if not path.exists():
        raise RecordingError(f"{path} is missing; put a copy of {published}, published with the data set, there.")
    calibration = _read_calibration(path)
    if calibration.get("T_imu_marker") is None:
        raise RecordingError(
            f"{path} states no T_imu_marker, so it is no calibration of the markers; replace it by {published}, "
            "published with the data set."
        )
    return _pose(calibration["T_imu_marker"])


class TumVieWriter(Writer):
    """Writer of TUM-VIE as it is unpacked, with the left cameras. Markers, IMU and event camera share one pose."""

    layout = "tum_vie"
    poses_per_second = 120
    published_rig = (PUBLISHED_EVENT_CAMERA, PUBLISHED_FRAME_CAMERA, PUBLISHED_EXTRINSICS)

    def _check(self) -> None:
        self._check_size(SENSOR_SIZE)
        for camera in (self.setup.event_camera, self.setup.frame_camera):
            if camera.model != "fisheye":
                raise FlagError(
                    f"The layout tum_vie holds cameras of the model fisheye, but one of {camera.model} was asked for; "
                    "choose such a camera or another layout."
                )

    def _write_calibration(self) -> None:
        setup = self.setup
        cameras = [setup.frame_camera] * 2 + [setup.event_camera] * 2
        names = ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4")
        lenses = [(camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion) for camera in cameras]
        calibration = {
            "T_imu_cam": [_pose_json(setup.event_from_frame)] * 2 + [_pose_json(np.eye(4))] * 2,
            "intrinsics": [
                {"camera_type": "kb4", "intrinsics": dict(zip(names, lens, strict=True))} for lens in lenses
            ],
            "resolution": [[camera.width, camera.height] for camera in cameras],
        }
        self._replace("camera-calibrationA.json", encode_json({"value0": calibration}))
        marker = {"value0": {"T_imu_marker": _pose_json(np.eye(4))}}
        self._replace("mocap-imu-calibrationA.json", encode_json(marker))
        self._replace(
            f"{self._data}/right_images/image_timestamps_right.txt", b""
        )  # without which E-NeRF does not load

    def _write_poses(self, trajectory: Trajectory) -> None:
        times = np.unique(self._to_us(trajectory.times))
        header = "# timestamp[us] px py pz qx qy qz qw"
        content = encode_poses(header, times.tolist(), *poses_at(trajectory, times * 1000))
        self._replace(f"{self._data}/mocap_data.txt", content)

    def _open_events(self) -> EventFiles:
        import hdf5plugin

        path = self.folder / f"{WRITTEN_SEQUENCE}-events_left.h5"
        return Hdf5EventsFile(path, "events/", dict(hdf5plugin.Blosc("zstd")), self._to_us, self.events_held)

    def _images(self, number: int, sharp: np.ndarray, blurred: np.ndarray | None) -> dict[str, np.ndarray]:
        path = f"{self._data}/left_images/{self._name(number)}.jpg"
        if blurred is None:
            return {path: sharp}
        return {path: blurred, f"sharp_images/{self._name(number)}.png": sharp}

    def _stamps(self, time: int) -> dict[str, str]:
        """Returns stamps at the start of exposures, in µs, chosen so that the middles are closest to `time`."""
        exposure = round(self.setup.exposure / 1000)
        stamp = (2 * time - 1000 * exposure + 1000) // 2000
        folder = f"{self._data}/left_images"
        return {
            f"{folder}/image_timestamps_left.txt": f"{stamp}\n",
            f"{folder}/image_exposures_left.txt": f"{exposure}\n",
        }

    @property
    def _data(self) -> str:
        return f"{WRITTEN_SEQUENCE}-vi_gt_data"


def _pose_json(pose: np.ndarray) -> dict[str, float]:
    values = [*pose[:3, 3].tolist(), *Rotation.from_matrix(pose[:3, :3]).as_quat().tolist()]
    return dict(zip(("px", "py", "pz", "qx", "qy", "qz", "qw"), values, strict=True))


FORMAT = Format(
    name="tum_vie",
    command="tumvie-events",
    description="Events of TUM-VIE, as published or prepared by E-NeRF's reference code.",
    files=FILES,
    read=read,
    options=TumVieOptions,
    writer=TumVieWriter,
)
