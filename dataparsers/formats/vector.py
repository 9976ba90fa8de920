"""Reader of VECtor, an event camera and the left grey camera of one small-scale sequence.

    <name>.synced.left_event.hdf5       events/x, y, t (µs), p, and t_offset, µs since 1970, which is added to t
    <name>.synced.gt.txt                t px py pz qx qy qz qw: seconds since 1970, metres; body to world
    <name>.synced.left_camera/*.png     grey frames (optional), with timestamp.txt in their folder: start and end of
                                        each exposure, seconds since 1970
    the calibration, here or in a calibration folder beside this one, such as 0_calib/
        left_event_camera_intrinsic_results.yaml        camera_matrix.data (9) and distortion_coefficients.data (4 or 5,
        left_regular_camera_intrinsic_results.yaml      plumb_bob, which is radtan)
        camera_mocap_extrinsic_results1.yaml            cam0.T_cam_body (16): body to left grey camera
        small_scale_joint_camera_extrinsic_results.yaml cam2.T_cam0_cam2 (16): left event camera to left grey camera

The right event camera has files named after it in place of those named left_event, and T_cam0_cam3 of cam3. The frames
are those of the left grey camera in either case.

The pose of the event camera is T_world_body * inv(T_cam_body) * T_cam0_cam2. The file of T_cam_body also holds its
inverse T_body_cam, and the reader checks that both agree. The poses of the large-scale sequences (corridors, school,
units) are those of a lidar, and are not read. The recording's zero is the earliest first stamp.

The documents do not state whether whole numbers are the centres of pixels; they are read as such, as in OpenCV's
calibration. `enerf inspect` compares poses, clocks and calibration with the events.

Gao et al., "VECtor: A versatile event-centric benchmark for multi-sensor SLAM", RA-L 2022; https://star-datasets.github.io/vector.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float64, Int64

from enerf_ns.dataparsers.formats.format import Format, FormatOptions
from enerf_ns.dataparsers.formats.frame_folders import check_one_each, images_in
from enerf_ns.dataparsers.formats.hdf5_events import Hdf5Events
from enerf_ns.dataparsers.formats.text_tables import parse_times, read_poses, read_rows
from enerf_ns.dataparsers.formats.yaml_values import find_calibration, read_yaml
from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.dataparsers.recording.errors import RecordingError
from enerf_ns.dataparsers.recording.files import check_image_sizes, files_in, image_size, of_file
from enerf_ns.dataparsers.recording.recording import EventRecording, Frames
from enerf_ns.dataparsers.recording.time_units import Times, check_units
from enerf_ns.dataparsers.recording.trajectory import Trajectory

POSES, IMAGES = ".synced.gt.txt", ".synced.left_camera"
FILES = ("*.synced.*_event.hdf5", f"*{POSES}", f"*{IMAGES}/timestamp.txt")

CAMERAS = {"left": "cam2", "right": "cam3"}
"""The event cameras in the calibration of all cameras."""

SENSOR_SIZE = (640, 480)
"""Width and height of the event cameras in pixels."""

LARGE_SCALE = ("corridors", "school", "units")
"""Begins of the names of sequences whose poses are those of a lidar."""

FRAME_CAMERA = "left_regular_camera_intrinsic_results.yaml"
BODY, JOINT = "camera_mocap_extrinsic_results1.yaml", "small_scale_joint_camera_extrinsic_results.yaml"

INVERSE_TOLERANCE = 1e-3
"""Largest entry of the difference between T_body_cam times T_cam_body and the identity."""


@dataclass(frozen=True)
class VectorOptions(FormatOptions):
    """Options of VECtor."""

    event_camera: Literal["left", "right"] = "left"
    """The event camera that is read."""


def read(folder: Path, event_camera: Literal["left", "right"] = "left") -> EventRecording:
    """Reads everything but the events, which are read when they are needed.

    Args:
        folder: The folder with the files that the module describes.
        event_camera: The event camera.

    Raises:
        RecordingError: A file is missing, empty or cannot be used, or the sequence is a large-scale one.
    """
    suffix = f".synced.{event_camera}_event.hdf5"
    found = files_in(folder, f"*{suffix}")
    if len(found) != 1:
        raise RecordingError(
            f"{folder} holds {len(found)} files *{suffix}, but the events of one sequence were expected; give each "
            "sequence its own folder."
        )
    events, name = Hdf5Events(found[0]), found[0].name.removesuffix(suffix)
    if name.startswith(LARGE_SCALE):
        raise RecordingError(
            f"{folder} holds the large-scale sequence {name}, whose poses are those of a lidar, but poses of the "
            "motion capture were expected; convert them to those of the event camera, and give them by enerf convert "
            "--poses with the events as a recording of their own."
        )
    notes: list[str] = []
    poses_file, images = folder / f"{name}{POSES}", folder / f"{name}{IMAGES}"
    times, positions, quaternions = read_poses(poses_file, "s", notes)
    poses = Times.of_rows("poses", poses_file, "s", times)
    check_units(folder, [events.times(SENSOR_SIZE[0] * SENSOR_SIZE[1]), poses])
    files, opens, closes = _read_frames(images, poses)
    zero = int(min(events.first_time, times[0], *opens[:1]))

    body_file, joint_file = _find(folder, BODY), _find(folder, JOINT)
    body_from_camera = np.linalg.inv(_read_body(body_file))
    body = Trajectory(times - zero, positions, quaternions)
    number = CAMERAS[event_camera]
    mount = read_yaml(joint_file, "a calibration")[1][number][f"T_cam0_{number}"].nested(4).pose()
    frames = None
    if files:
        size = image_size(files[0])
        camera = _read_camera(_find(folder, FRAME_CAMERA), size)
        check_image_sizes(files, *size)
        with of_file(images / "timestamp.txt"):
            middles, exposures = opens + (closes - opens) // 2 - zero, closes - opens
            frames = Frames(files, middles, camera, body.of_mounted(body_from_camera), exposures=exposures)
    return EventRecording(
        path=folder,
        format="vector",
        camera=_read_camera(_find(folder, f"{event_camera}_event_camera_intrinsic_results.yaml"), SENSOR_SIZE),
        trajectory=body.of_mounted(body_from_camera @ mount),
        stream_events=lambda: events.stream(zero),
        event_files=(events.path,),
        zero=zero,
        frames=frames,
        notes=tuple(notes),
        num_events=events.num_events,
        times_in={
            "events": (events.path, "us"),
            "poses": (poses_file, "s"),
            "frames": (images / "timestamp.txt", "s"),
        },
    )


def _find(folder: Path, name: str) -> Path:
    path = find_calibration(folder, name)
    if path is None:
        raise RecordingError(
            f"{folder} holds no {name}, and neither does a calibration folder beside it, such as 0_calib; put it "
            "there, as it is published with the data set."
        )
    return path


def _read_frames(
    folder: Path, poses: Times
) -> tuple[tuple[Path, ...], Int64[np.ndarray, " frames"], Int64[np.ndarray, " frames"]]:
    """Returns files, and start and end (ns) of each exposure."""
    files, stamps = images_in(folder), folder / "timestamp.txt"
    if not files and not stamps.exists():
        return (), np.zeros(0, np.int64), np.zeros(0, np.int64)
    rows, numbers = read_rows(stamps, "start_s end_s")
    check_one_each(folder, len(files), stamps, len(rows), "exposures")
    opens, closes = (parse_times(stamps, [row[i] for row in rows], numbers, "s", "frames") for i in (0, 1))
    check_units(folder, [poses, Times.of_rows("frames", stamps, "s", opens)])
    wrong = closes < opens
    if wrong.any():
        raise RecordingError(
            f"{stamps}, line {numbers[int(np.argmax(wrong))]} holds an exposure that ends before it starts, but start "
            "and end were expected."
        )
    return files, opens, closes


def _read_camera(path: Path, size: tuple[int, int]) -> Camera:
    calibration = read_yaml(path, "a calibration of a camera")[1]
    for side, key in zip(size, ("image_width", "image_height"), strict=True):
        stated = calibration.get(key)
        if stated is not None and stated.numbers(()) != side:
            raise stated.wrong(f"{side} pixels, as the data have, were")
    intrinsics = calibration["camera_matrix"]["data"].intrinsics()
    coefficients = calibration["distortion_coefficients"]["data"]
    count = 4 if isinstance(coefficients.found, list) and len(coefficients.found) == 4 else 5
    distortion = coefficients.numbers((count,), "k1 k2 p1 p2 and perhaps k3 were").tolist()
    model = calibration.get("distortion_model")
    if model is not None:
        model.choice(("plumb_bob", "radtan"))
    return calibration.camera(size, intrinsics, distortion, "radtan")


def _read_body(path: Path) -> Float64[np.ndarray, "4 4"]:
    """Returns T_cam_body, which maps from the body to the left grey camera."""
    entry = read_yaml(path, "a calibration")[1]["cam0"]
    camera_from_body = entry["T_cam_body"].nested(4).pose()
    inverse = entry.get("T_body_cam")
    if (
        inverse is not None
        and np.abs(inverse.nested(4).pose() @ camera_from_body - np.eye(4)).max() > INVERSE_TOLERANCE
    ):
        raise RecordingError(
            f"{path} holds T_cam_body and T_body_cam of cam0 that are not inverse to each other, but one calibration "
            "was expected in both; copy it again."
        )
    return camera_from_body


FORMAT = Format(
    name="vector",
    command="vector-events",
    description="Events of an event camera of a small-scale sequence of VECtor.",
    files=FILES,
    read=read,
    options=VectorOptions,
)
