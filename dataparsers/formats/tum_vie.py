"""Reader and writer of TUM-VIE: two event cameras, two cameras of grey frames, and motion capture.

As it is unpacked, for the left event camera; the right one has files of its own:

    <sequence>-events_left.h5             events/x, y, t and p, microseconds, polarity 0 or 1
    <sequence>-vi_gt_data/                or what it holds, beside the events
        mocap_data.txt                    t_us px py pz qx qy qz qw of the markers, one pose a line, metres
        left_images/*.jpg                 or .png (optional), with, in this folder or the one above,
            image_timestamps_left.txt     t_us, one frame a line
            image_exposures_left.txt      exposure_us, one frame a line (optional)
    camera-calibrationA.json              value0: intrinsics (kb4), resolution and T_imu_cam of four cameras
    mocap-imu-calibrationA.json           value0: T_imu_marker

The calibrations, of which some sequences need those with a B, may also lie in `vi_gt_data` or in one of the two folders
above. Cameras 0 and 1 take the frames on the left and on the right, 2 and 3 the events, and kb4 is OpenCV's fisheye.

As the reference code of E-NeRF prepares it, all in one folder:

    *events_left.h5, *mocap*.txt          as above
    *rectify_map_left.h5                  rectify_map (720, 1280, 2): where each pixel lies in the undistorted image
    calib_undist.json                     value0: intrinsics_undistorted and T_imu_cam of four cameras
    calibration.json                      the camera calibration as it was (optional)
    mocap-imu-calib.json                  the calibration of the markers as it was
    left_images_undistorted/*.png         or .jpg (optional), with stamps and exposures as above

Poses are those of the markers, and a camera's pose is T_mocap_marker * inv(T_imu_marker) * T_imu_cam. The published
stamps of all sensors lie on one clock; the time offsets that the calibrations state are not applied again.

A frame's time is the middle of its exposure. We found nowhere stated whether a stamp is the start, the middle or the
end of the exposure. It is taken to be the start, which is when cameras are triggered, so that half of the exposure is
added; E-NeRF and Robust e-NeRF, which do not read the exposures, take the stamp itself.

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

from enerf_ns.dataparsers.formats.format import Format, FormatOptions
from enerf_ns.dataparsers.formats.hdf5_events import Hdf5Events, Hdf5EventsFile, read_rectify_map
from enerf_ns.dataparsers.formats.text_tables import (
    QUATERNION_TOLERANCE,
    parse_numbers,
    read_poses,
    read_rows,
    read_times,
)
from enerf_ns.dataparsers.formats.writer import EventFiles, Writer, encode_json, encode_poses, poses_at
from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.dataparsers.recording.errors import FlagError, RecordingError
from enerf_ns.dataparsers.recording.files import check_is_folder, image_size, of_file, read_json
from enerf_ns.dataparsers.recording.recording import LARGEST_SPAN_RATIO, EventRecording, Frames
from enerf_ns.dataparsers.recording.trajectory import Trajectory

FILES = ("*events_left.h5", "*events_right.h5", "*mocap*.txt", "*vi_gt_data/mocap_data.txt", "calib_undist.json")

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
"""Pose of the left frame camera in the axes of the left event camera, metres; it and the two published cameras are of
camera-calibrationA, with which mocap-desk and mocap-desk2 were recorded."""

WRITTEN_SEQUENCE = "simulated"
"""Name that the files of a recording that is written begin with, in place of a sequence's."""

SEQUENCES = {
    "A": ("loop-floor0", "loop-floor1", "loop-floor2", "loop-floor3", "mocap-desk", "mocap-desk2", "skate-easy"),
    "B": (
        *("mocap-1d-trans", "mocap-3d-trans", "mocap-6dof", "mocap-shake", "mocap-shake2", "office-maze", "slide"),
        *("running-easy", "running-hard", "skate-hard", "bike-easy", "bike-hard", "bike-dark", "floor2-dark"),
    ),
}
"""Names of the sequences, by the letter of the calibration that they were recorded with."""

CALIBRATIONS = ("camera-calibration", "mocap-imu-calibration")

SHORTEST_STEP = 100_000
"""Least nanoseconds between frames or poses (median)."""

BALANCE_TOLERANCE = 1.0
"""Pixels by which intrinsics may differ from those that OpenCV gives; its versions differ by less."""


@dataclass(frozen=True)
class TumVieOptions(FormatOptions):
    """What is read of a recording."""

    event_camera: Literal["left", "right"] = "left"
    """Which of the two event cameras is read, with the frame camera beside it."""


@dataclass(frozen=True)
class _Rig:
    """What a layout's files say about the cameras of one side."""

    camera: Camera
    """Camera of the events."""
    imu_from_camera: Float64[np.ndarray, "4 4"]
    frame_camera: Camera | None
    """Camera of the frames; None without frames."""
    imu_from_frame_camera: Float64[np.ndarray, "4 4"]
    imu_from_marker: Float64[np.ndarray, "4 4"]


def read(folder: Path, event_camera: Literal["left", "right"] = "left") -> EventRecording:
    """Reads all but the events, which are read when asked for.

    The recording's zero of time is the earliest first stamp among events, frames and poses.

    Args:
        folder: With the files that the module describes.
        event_camera: Which events; the frames are those of the same side.

    Raises:
        RecordingError: A file is missing or empty, or anything in it cannot be used.
    """
    notes: list[str] = []
    events_file = _find_one(folder, f"*events_{event_camera}.h5", f"events of the {event_camera} camera")
    sequence = events_file.name.removesuffix(f"events_{event_camera}.h5").rstrip("-_. ")
    events = Hdf5Events(events_file)

    prepared = [folder / "calib_undist.json", folder / f"{event_camera}_images_undistorted"]
    prepared += folder.glob(f"*rectify_map_{event_camera}.h5")
    is_prepared = any(path.exists() for path in prepared)
    data = folder if is_prepared else _data_folder(folder, sequence)
    images = data / f"{event_camera}_images{'_undistorted' * is_prepared}"
    poses_file = _find_one(data, "*mocap*.txt", "poses (t_us px py pz qx qy qz qw)")
    pose_times, positions, quaternions = read_poses(poses_file, "us", notes)
    _check_unit(poses_file, pose_times, longest=len(pose_times) * 10**9)
    longest = LARGEST_SPAN_RATIO * int(pose_times[-1] - pose_times[0])
    frame_files, stamps, frame_times, exposures = _read_frames(images, event_camera, longest, notes)
    zero = int(min(events.first_time, pose_times[0], *stamps[:1]))

    if is_prepared:
        rig = _read_prepared_rig(folder, event_camera, sequence, frame_files, notes)
    else:
        rig = _read_raw_rig(folder, data, event_camera, sequence, frame_files, notes)
    markers = Trajectory(pose_times - zero, positions, quaternions)
    marker_from_imu = np.linalg.inv(rig.imu_from_marker)
    frames = None
    if rig.frame_camera is not None:
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
        frames=frames,
        notes=tuple(notes),
        locate_event=lambda index: f"{events_file}, event {index + 1}",
        num_events=events.num_events,
    )


def _find_one(folder: Path, pattern: str, what: str) -> Path:
    """The one file of a name; of several, none is better than another."""
    found = sorted(folder.glob(pattern))
    if not found:
        raise RecordingError(f"{folder} holds no {pattern}; a file of {what} was expected there.")
    if len(found) > 1:
        names = " and ".join(path.name for path in found[:2])
        raise RecordingError(f"{folder} holds {len(found)} files {pattern}, such as {names}; leave the one to be read.")
    return found[0]


def _data_folder(folder: Path, sequence: str) -> Path:
    """The unpacked archive of frames and poses, or the recording's folder itself where there is none."""
    named = folder / f"{sequence}-vi_gt_data"
    found = [named] if named.is_dir() else sorted(path for path in folder.glob("*vi_gt_data") if path.is_dir())
    if len(found) > 1:
        raise RecordingError(
            f"{folder} holds {len(found)} folders *vi_gt_data and none of them is {named.name}; name the one that "
            "belongs to the events so."
        )
    return found[0] if found else folder


def _read_frames(
    folder: Path, side: str, longest: int, notes: list[str]
) -> tuple[
    tuple[Path, ...], Int64[np.ndarray, " frames"], Int64[np.ndarray, " frames"], Int64[np.ndarray, " frames"] | None
]:
    """Files, stamps, the middles of the exposures (ns on the clock of the data set, over at most `longest`), and how
    long those are (ns), where that is known."""
    check_is_folder(folder, "a folder of frames")
    files = tuple(sorted(folder.glob("*.png")) or sorted(folder.glob("*.jpg")))
    stamps_file = _here_or_above(folder, f"image_timestamps_{side}.txt")
    if not files and not stamps_file.exists():
        return (), np.zeros(0, np.int64), np.zeros(0, np.int64), None
    stamps = read_times(stamps_file, "us")
    if len(stamps) != len(files):
        raise RecordingError(
            f"{folder} holds {len(files)} images, but {stamps_file} holds {len(stamps)} stamps; give one each."
        )
    _check_unit(stamps_file, stamps, longest)
    exposures_file = _here_or_above(folder, f"image_exposures_{side}.txt")
    if not exposures_file.exists():
        notes.append(f"{exposures_file.name} is missing, so frames have the poses at their stamps.")
        return files, stamps, stamps, None

    rows, numbers = read_rows(exposures_file, "exposure_us")
    exposures = parse_numbers(exposures_file, rows, numbers)[:, 0]
    if len(exposures) != len(files):
        raise RecordingError(
            f"{exposures_file} holds {len(exposures)} exposures, but {folder} holds {len(files)} images; give one each."
        )
    gap = float(np.diff(stamps).max(initial=0) or 10**9) * 1e-3
    middles = stamps + np.rint(exposures.clip(0, gap) * 500).astype(np.int64)
    fit = (exposures >= 0).all() and exposures.max() <= gap and not 0 < exposures.max() < 1
    if not fit or (np.diff(middles) <= 0).any():
        raise RecordingError(
            f"{exposures_file} holds exposures from {exposures.min():g} to {exposures.max():g} us, which do not fit "
            f"frames at most {gap:g} us apart; exposures in microseconds were expected."
        )
    return files, stamps, middles, np.rint(exposures * 1000).astype(np.int64)


def _here_or_above(folder: Path, name: str) -> Path:
    above = folder.parent / name
    return above if above.exists() and not (folder / name).exists() else folder / name


def _check_unit(path: Path, times: Int64[np.ndarray, " rows"], longest: int) -> None:
    """Whether rows are at least 0.1 ms apart (median) and span at most `longest` ns, as they do in the right unit."""
    steps = np.diff(times)
    if len(steps) and (np.median(steps) < SHORTEST_STEP or steps.sum() > longest):
        raise RecordingError(
            f"{path} has times {np.median(steps) * 1e-3:g} us apart (median) over {steps.sum() * 1e-9:g} s, which "
            "fits no recording; microseconds were expected."
        )


def _read_raw_rig(
    folder: Path, data: Path, side: str, sequence: str, frame_files: tuple[Path, ...], notes: list[str]
) -> _Rig:
    index = ("left", "right").index(side)
    camera_file, marker_file = _find_calibrations(folder, data, sequence, notes)
    calibration = _read_calibration(camera_file)
    camera = _fisheye(camera_file, calibration, 2 + index)
    _check_size(camera_file, camera, SENSOR_SIZE, "the event camera")
    frame_camera = _fisheye(camera_file, calibration, index) if frame_files else None
    _check_images(camera_file, frame_camera, frame_files)
    return _Rig(
        camera,
        _mount(camera_file, calibration, 2 + index),
        frame_camera,
        _mount(camera_file, calibration, index),
        _read_marker(marker_file, marker_file.name),
    )


def _find_calibrations(folder: Path, data: Path, sequence: str, notes: list[str]) -> tuple[Path, Path]:
    folders = (folder, data, folder.parent, folder.parent.parent)
    found = {
        letter: [
            next((path / f"{kind}{letter}.json" for path in folders if (path / f"{kind}{letter}.json").is_file()), None)
            for kind in CALIBRATIONS
        ]
        for letter in SEQUENCES
    }
    letter = _letter(sequence)
    if letter is None:
        there = [letter for letter, paths in found.items() if any(paths)]
        if len(there) > 1:
            raise RecordingError(
                f"{folder} has calibrations A and B at hand, and its events, called {sequence!r}, are none of the "
                "published sequences; name the events file <sequence>-events_left.h5 or leave the calibration that "
                "belongs to it."
            )
        if not there:
            raise RecordingError(
                f"{folder} has neither camera-calibrationA.json nor camera-calibrationB.json; put the one of "
                "this recording there, which is published with the data set."
            )
        letter = there[0]
        notes.append(f"{sequence or folder.name} is none of the published sequences; calibration {letter} is used.")
    for kind, path in zip(CALIBRATIONS, found[letter], strict=True):
        if path is None:
            raise RecordingError(
                f"{folder / f'{kind}{letter}.json'} is missing, the calibration of {sequence or folder.name}; put it "
                "there, as it is published with the data set."
            )
    camera_file, marker_file = found[letter]
    assert camera_file is not None and marker_file is not None
    return camera_file, marker_file


def _letter(sequence: str) -> str | None:
    return next((letter for letter, names in SEQUENCES.items() if sequence in names), None)


def _read_prepared_rig(folder: Path, side: str, sequence: str, frame_files: tuple[Path, ...], notes: list[str]) -> _Rig:
    index = ("left", "right").index(side)
    path = folder / "calib_undist.json"
    calibration = _read_calibration(path)
    raw_path = folder / "calibration.json" if (folder / "calibration.json").exists() else path
    raw = _read_calibration(raw_path) if raw_path != path else calibration
    has_raw = raw_path != path or "intrinsics" in raw

    fx, fy, cx, cy = _matrix(path, calibration, 2 + index)
    rectify_map = read_rectify_map(_find_one(folder, f"*rectify_map_{side}.h5", "a rectify map"), *SENSOR_SIZE)
    directions = (rectify_map.astype(np.float64) - [cx, cy]) / [fx, fy]
    with of_file(f"{path}, intrinsics_undistorted[{2 + index}],"):
        camera = Camera(*SENSOR_SIZE, fx, fy, cx, cy, model="lookup", directions=directions)
    _check_principal_point(path, camera, "the event camera")
    if has_raw:
        _check_size(raw_path, _fisheye(raw_path, raw, 2 + index), SENSOR_SIZE, "the event camera")

    frame_camera = None
    if frame_files:
        lens = _fisheye(raw_path, raw, index) if has_raw else None
        width, height = (lens.width, lens.height) if lens is not None else image_size(frame_files[0])
        with of_file(f"{path}, intrinsics_undistorted[{index}],"):
            frame_camera = Camera(width, height, *_matrix(path, calibration, index))
        _check_images(raw_path, frame_camera, frame_files)
        _check_principal_point(path, frame_camera, "the frames")
        if lens is not None:
            frame_camera = _mend_balance(path, frame_camera, lens, notes)
    return _Rig(
        camera,
        _mount(path, calibration, 2 + index),
        frame_camera,
        _mount(path, calibration, index),
        _read_marker(folder / "mocap-imu-calib.json", f"mocap-imu-calibration{_letter(sequence) or '{A,B}'}.json"),
    )


def _mend_balance(path: Path, stated: Camera, lens: Camera, notes: list[str]) -> Camera:
    """The camera of undistorted frames, with the intrinsics that its images have.

    The reference code undistorts images with balance 0 of OpenCV's fisheye model, and states the intrinsics of 0.5.
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
        f"undistorts the images with balance 0, so that the intrinsics of that (fx {none.fx:.2f}) are used."
    )
    return none


def _check_size(path: Path, camera: Camera, size: tuple[int, int], what: str) -> None:
    if (camera.width, camera.height) != size:
        raise RecordingError(
            f"{path} is a calibration of {what} at {camera.width} x {camera.height} pixels, but {size[0]} x {size[1]} "
            "were expected; give the calibration of the recording's own resolution."
        )


def _check_images(path: Path, camera: Camera | None, files: tuple[Path, ...]) -> None:
    for file in files:
        assert camera is not None
        if (found := image_size(file)) != (camera.width, camera.height):
            raise RecordingError(
                f"{file} has {found[0]} x {found[1]} pixels, but {camera.width} x {camera.height} as of {path} were "
                "expected; give images and calibration of one resolution."
            )


def _check_principal_point(path: Path, camera: Camera, what: str) -> None:
    if not (0 < camera.cx < camera.width and 0 < camera.cy < camera.height):
        raise RecordingError(
            f"{path} holds the principal point ({camera.cx:g}, {camera.cy:g}) for {what}, which lies outside their "
            f"{camera.width} x {camera.height} pixels; give the calibration of this resolution."
        )


def _read_calibration(path: Path) -> dict:
    content = read_json(path)
    if not isinstance(content.get("value0"), dict):
        raise RecordingError(f"{path} holds no object value0, but a calibration of TUM-VIE was expected.")
    return content["value0"]


def _entry(path: Path, calibration: dict, name: str, index: int) -> dict:
    entries = calibration.get(name)
    if not isinstance(entries, list) or len(entries) != 4 or not isinstance(entries[index], dict):
        raise RecordingError(
            f"{path} holds no {name} of camera {index}, but a calibration of four cameras (0 to 3) was expected."
        )
    return entries[index]


def _numbers(path: Path, entry: dict, names: str, what: str) -> list[float]:
    for name in names.split():
        value = entry.get(name)
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not -1e9 < value < 1e9:
            raise RecordingError(f"{path} holds {name} = {value!r} in {what}, where a number was expected.")
    return [float(entry[name]) for name in names.split()]


def _matrix(path: Path, calibration: dict, index: int) -> tuple[float, float, float, float]:
    entry = _entry(path, calibration, "intrinsics_undistorted", index)
    fx, fy, cx, cy = _numbers(path, entry, "fx fy cx cy", f"intrinsics_undistorted[{index}]")
    return fx, fy, cx, cy


def _fisheye(path: Path, calibration: dict, index: int) -> Camera:
    entry = _entry(path, calibration, "intrinsics", index)
    model, parameters = entry.get("camera_type"), entry.get("intrinsics")
    if model != "kb4" or not isinstance(parameters, dict):
        raise RecordingError(f"{path} holds a camera of type {model!r} as intrinsics[{index}], but kb4 was expected.")
    what = f"intrinsics[{index}]"
    fx, fy, cx, cy, *distortion = _numbers(path, parameters, "fx fy cx cy k1 k2 k3 k4", what)
    sizes = calibration.get("resolution")
    size = sizes[index] if isinstance(sizes, list) and len(sizes) == 4 else None
    if not (isinstance(size, list) and len(size) == 2 and all(type(side) is int for side in size)):
        raise RecordingError(
            f"{path} holds resolution[{index}] = {size}, but width and height in pixels were expected."
        )
    with of_file(f"{path}, {what},"):
        return Camera(size[0], size[1], fx, fy, cx, cy, tuple(distortion), "fisheye")


def _mount(path: Path, calibration: dict, index: int) -> Float64[np.ndarray, "4 4"]:
    """T_imu_cam of a camera."""
    return _pose(path, _entry(path, calibration, "T_imu_cam", index), f"T_imu_cam[{index}]")


def _pose(path: Path, entry: dict, what: str) -> Float64[np.ndarray, "4 4"]:
    values = _numbers(path, entry, "px py pz qx qy qz qw", what)
    norm = float(np.linalg.norm(values[3:]))
    if abs(norm - 1.0) > QUATERNION_TOLERANCE:
        raise RecordingError(
            f"{path} holds a quaternion of norm {norm:.6g} as {what}, but rotations are unit quaternions (qx qy qz qw)."
        )
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_quat(values[3:]).as_matrix()
    pose[:3, 3] = values[:3]
    return pose


def _read_marker(path: Path, published: str) -> Float64[np.ndarray, "4 4"]:
    """T_imu_marker from the calibration of the markers.

    Args:
        path: The calibration of the markers.
        published: Its name in the data set.
    """
    if not path.exists():
        raise RecordingError(f"{path} is missing; put a copy of {published}, published with the data set, there.")
    calibration = _read_calibration(path)
    entry = calibration.get("T_imu_marker")
    if not isinstance(entry, dict):
        found = "is a calibration of the cameras and" if "T_imu_cam" in calibration else "holds value0 but"
        raise RecordingError(
            f"{path} {found} states no T_imu_marker; replace it by {published}, published with the data set."
        )
    return _pose(path, entry, "T_imu_marker")


class TumVieWriter(Writer):
    """Writer of TUM-VIE as it is unpacked: its left cameras. Markers, IMU and event camera are in one place."""

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
        """Exposures begin at the stamps, which are such that their middles are closest to the frames' times."""
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
