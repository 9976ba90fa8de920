"""Reader for DSEC with poses of the user, since the data set has none.

    events/left/events.h5               events/x, y, t (µs), p; t_offset (µs), to the clock of the images
    events/left/rectify_map.h5          rectify_map (480, 640, 2): place of each pixel in the rectified image (optional)
    calibration/cam_to_cam.yaml         intrinsics of cam0 (left event camera), cam1 and cam2 (left and right frame
                                        camera), cam3 (right event camera), and camRect0 to camRect3: camera_matrix (fx
                                        fy cx cy), distortion_coeffs (k1 k2 p1 p2), resolution; extrinsics T_10, T_21,
                                        T_32 (from camera 0 to camera 1 and so on) and R_rect0 to R_rect3
    images/left/rectified/*.png         of camRect1 (optional), with
    images/timestamps.txt               one stamp (µs) a line, and
    images/left/exposure_timestamps.txt start and end (µs) of each exposure, separated by a comma (optional)
    poses.txt                           of the user: t_s px py pz qx qy qz qw; left event camera (cam0) to world, OpenCV
                                        axes, metres, on the clock of the images

Files may also lie as the archives unpack: events_left/, images_rectified_left/, cam_to_cam.yaml in the folder, and
<sequence>_image_timestamps.txt, <sequence>_image_exposure_timestamps_left.txt.

Each event is on the raw pixel, whose direction comes from cam0 and its distortion. Where there is a rectify_map, the
reader checks that it agrees with cam0, camRect0 and R_rect0 to `MAP_TOLERANCE`. The time of a frame is the middle of
its exposure; stamps must lie within `STAMP_TOLERANCE` of it. Not read: disparity, which has no depth at the frames.

Gehrig et al., "DSEC: A stereo event camera dataset for driving scenarios", RA-L 2021; dsec.ifi.uzh.ch/data-format.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Float64, Int64

from enerf_ns.dataparsers.formats.format import Format, FormatOptions
from enerf_ns.dataparsers.formats.frame_folders import check_one_each, images_in, read_stamps
from enerf_ns.dataparsers.formats.hdf5_events import Hdf5Events, read_rectified_camera
from enerf_ns.dataparsers.formats.json_values import Value
from enerf_ns.dataparsers.formats.pose_files import GivenPoses, NamedFrames, poses_of
from enerf_ns.dataparsers.formats.text_tables import parse_times, read_rows
from enerf_ns.dataparsers.formats.yaml_values import read_yaml
from enerf_ns.dataparsers.recording.camera import Camera, check_rotation
from enerf_ns.dataparsers.recording.errors import RecordingError
from enerf_ns.dataparsers.recording.files import check_image_sizes, files_in
from enerf_ns.dataparsers.recording.recording import EventRecording, Frames
from enerf_ns.dataparsers.recording.trajectory import Trajectory

FILES = (
    *("events/*/events.h5", "events_*/events.h5", "events/*/rectify_map.h5", "events_*/rectify_map.h5"),
    *("calibration/cam_to_cam.yaml", "cam_to_cam.yaml"),
)

CAMERAS = {"left": ("cam0", "camRect0", "R_rect0", "camRect1"), "right": ("cam3", "camRect3", "R_rect3", "camRect2")}
"""Event camera, the same rectified, its rectification, and the rectified frame camera of each side."""

MAP_TOLERANCE = 0.5
"""Largest distance between rectify_map and the calibration, pixels."""

STAMP_TOLERANCE = 5_000_000
"""Largest time between the stamp of a frame, which is the mean of both cameras, and the middle of its exposure, ns."""


@dataclass(frozen=True)
class DsecOptions(FormatOptions):
    """Options of DSEC."""

    event_camera: Literal["left", "right"] = "left"
    """The event camera that is read, with the frame camera beside it."""


def read(
    folder: Path, poses: GivenPoses | None = None, event_camera: Literal["left", "right"] = "left"
) -> EventRecording:
    """Reads everything but the events, which are read when they are needed.

    The recording's zero of time is the earliest first stamp among events, frames and poses.

    Args:
        folder: The folder with the files that the module describes.
        poses: Poses of the left event camera in place of poses.txt.
        event_camera: The event camera; the frames are those of the same side.

    Raises:
        RecordingError: A file is missing, empty or cannot be used.
    """
    notes: list[str] = []
    side = event_camera
    events = Hdf5Events(_place(folder, (f"events/{side}/events.h5", f"events_{side}/events.h5"), "events"))
    _, calibration = read_yaml(
        _place(folder, ("calibration/cam_to_cam.yaml", "cam_to_cam.yaml"), "the calibration"), "cam_to_cam.yaml of DSEC"
    )
    camera = _camera(calibration, CAMERAS[side][0])
    left_from_event, left_from_frame = _mountings(calibration, side)
    rectify_map = events.path.with_name("rectify_map.h5")
    if rectify_map.exists():
        _check_map(rectify_map, calibration, side, camera)
    files, frame_times, exposures, stamps_file = _read_frames(folder, side)
    named = [NamedFrames(files, frame_times, left_from_frame)]
    poses_file, unit = (folder / "poses.txt", "s") if poses is None else (poses.path, poses.unit)
    rows = poses_of(poses_file, unit, poses, named, notes)
    zero = int(min(events.first_time, rows[0][0], *frame_times[:1]))
    left = Trajectory(rows[0] - zero, *rows[1:])
    trajectory = left if side == "left" else left.of_mounted(left_from_event)
    frames = None
    if files:
        frame_camera = _camera(calibration, CAMERAS[side][3])
        check_image_sizes(files, frame_camera.width, frame_camera.height)
        mounting = np.linalg.inv(left_from_event) @ left_from_frame
        frames = Frames(files, frame_times - zero, frame_camera, trajectory.of_mounted(mounting), exposures=exposures)
    return EventRecording(
        path=folder,
        format="dsec",
        camera=camera,
        trajectory=trajectory,
        stream_events=lambda: events.stream(zero),
        event_files=(events.path,),
        zero=zero,
        frames=frames,
        notes=tuple(notes),
        num_events=events.num_events,
        times_in={"events": (events.path, "us"), "poses": (poses_file, unit), "frames": (stamps_file, "us")},
    )


def _place(folder: Path, names: tuple[str, ...], what: str) -> Path:
    """Returns the first of these files that is there."""
    found = next((folder / name for name in names if (folder / name).exists()), None)
    if found is None:
        raise RecordingError(f"{folder} lacks {' or '.join(names)}, which holds {what} of DSEC; put it there.")
    return found


def _camera(calibration: Value, name: str) -> Camera:
    """Returns a camera of cam_to_cam.yaml; those named camRect have no distortion."""
    entry = calibration["intrinsics"][name]
    size, intrinsics = entry["resolution"].numbers((2,)).tolist(), entry["camera_matrix"].numbers((4,)).tolist()
    if name.startswith("camRect"):
        return entry.camera(size, intrinsics)
    coefficients = entry["distortion_coeffs"].numbers((4,)).tolist()
    return entry.camera(size, intrinsics, coefficients, "radtan")


def _rotation(calibration: Value, name: str) -> Float64[np.ndarray, "4 4"]:
    """Returns the rotation from a camera to the same one rectified."""
    value = calibration["extrinsics"][name]
    matrix = np.eye(4)
    matrix[:3, :3] = value.numbers((3, 3), "a matrix of 3 x 3 numbers was")
    try:
        check_rotation(matrix[:3, :3])
    except ValueError as error:
        raise RecordingError(f"{value.place} {error}.") from error
    return matrix


def _mountings(calibration: Value, side: str) -> tuple[Float64[np.ndarray, "4 4"], Float64[np.ndarray, "4 4"]]:
    """Returns the poses of the event camera and of the rectified frame camera in the axes of cam0."""
    extrinsics = calibration["extrinsics"]
    first_to = np.linalg.inv(extrinsics["T_10"].pose())
    if side == "left":
        return np.eye(4), first_to @ np.linalg.inv(_rotation(calibration, "R_rect1"))
    frame = first_to @ np.linalg.inv(extrinsics["T_21"].pose())
    event = frame @ np.linalg.inv(extrinsics["T_32"].pose())
    if event[0, 3] < 0:
        raise RecordingError(
            f"{calibration.path} places the right event camera {-event[0, 3]:g} m to the left of the left one by T_10, "
            "T_21 and T_32, which are taken as motions from camera 0 to 1, 1 to 2 and 2 to 3; get the file as it is "
            "published."
        )
    return event, frame @ np.linalg.inv(_rotation(calibration, "R_rect2"))


def _check_map(path: Path, calibration: Value, side: str, camera: Camera) -> None:
    """Checks that the rectify map is that of the calibration, which shows that both are read as they are meant."""
    _, rectified, rotation, _ = CAMERAS[side]
    undistorted = _camera(calibration, rectified)
    table = read_rectified_camera(path, undistorted).directions
    assert table is not None
    rows, columns = np.mgrid[: camera.height : 16, : camera.width : 16]
    pixels = np.stack([columns, rows], axis=-1).reshape(-1, 1, 2).astype(float)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-9)
    turn = _rotation(calibration, rotation)[:3, :3]
    expected = cv2.undistortPointsIter(
        pixels, camera.matrix, np.array(camera.distortion), turn, undistorted.matrix, criteria
    )[:, 0]
    found = table[rows.ravel(), columns.ravel()] * [undistorted.fx, undistorted.fy] + [undistorted.cx, undistorted.cy]
    error = float(np.abs(found - expected).max())
    if error > MAP_TOLERANCE:
        raise RecordingError(
            f"{path} holds a rectify_map that is up to {error:.3g} pixels from that of {calibration.path}; give both "
            "of one sequence."
        )


def _read_frames(
    folder: Path, side: str
) -> tuple[tuple[Path, ...], Int64[np.ndarray, " frames"], Int64[np.ndarray, " frames"] | None, Path]:
    """Returns files, middles of the exposures (ns on the clock of the images), exposures (ns) or None, and the file of
    the times."""
    files = images_in(folder / f"images/{side}/rectified") or images_in(folder / f"images_rectified_{side}")
    stamps_file = _optional(folder, ("images/timestamps.txt", "*image_timestamps.txt"))
    if not files:
        return (), np.zeros(0, np.int64), None, folder
    place = files[0].parent
    stamps = None if stamps_file is None else read_stamps(files, stamps_file, "us", place)
    names = (f"images/{side}/exposure_timestamps.txt", f"images/{side}/exposure_timestamps_{side}.txt")
    exposures_file = _optional(folder, (*names, f"*image_exposure_timestamps_{side}.txt"))
    if exposures_file is None:
        if stamps_file is None or stamps is None:
            raise RecordingError(
                f"{place} holds {len(files):,} images, but their stamps are missing; add images/timestamps.txt or "
                f"{names[0]}."
            )
        return files, stamps, None, stamps_file
    rows, numbers = read_rows(exposures_file, "start_us end_us", ",")
    check_one_each(place, len(files), exposures_file, len(rows), "exposures")
    starts = parse_times(exposures_file, [row[0] for row in rows], numbers, "us", "frames")
    ends = parse_times(exposures_file, [row[1] for row in rows], numbers, "us", "frames")
    middles, exposures = starts + (ends - starts) // 2, ends - starts
    if exposures.min() <= 0:
        line = numbers[int(np.argmin(exposures))]
        raise RecordingError(
            f"{exposures_file}, line {line} holds an end that is not after its start; start, end were expected."
        )
    if stamps is not None and (apart := np.abs(stamps - middles)).max() > STAMP_TOLERANCE:
        raise RecordingError(
            f"{exposures_file} holds exposures whose middles are up to {apart.max() * 1e-6:.3g} ms from the stamps in "
            f"{stamps_file}; give both of one sequence, in µs."
        )
    return files, middles, exposures, exposures_file


def _optional(folder: Path, patterns: tuple[str, ...]) -> Path | None:
    """Returns the first file that is there, if only as a link that leads nowhere, which reading refuses."""
    for pattern in patterns:
        if os.path.lexists(folder / pattern):
            return folder / pattern
        for file in files_in(folder, pattern):
            return file
    return None


FORMAT = Format(
    name="dsec",
    command="dsec-events",
    description="Events and frames of DSEC, with poses of yours.",
    files=FILES,
    read=read,
    options=DsecOptions,
    takes_poses=True,
)
