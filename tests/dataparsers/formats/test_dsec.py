"""DSEC, written here by h5py, OpenCV and PyYAML from the pages of the data set, with poses of a user."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
import pytest
import yaml
from recordings import (
    FRAME_TIMES,
    HEIGHT,
    POSE_TIMES,
    TRUE_EVENTS,
    WIDTH,
    check_poses,
    image,
    joined,
    poses,
    seconds,
    write_image,
)
from scipy.spatial.transform import Rotation
from test_bad_input import is_one_sentence

from enerf_ns.dataparsers.formats import dsec
from enerf_ns.dataparsers.formats.pose_files import GivenPoses, PoseFlags
from enerf_ns.dataparsers.formats.registry import read_recording
from enerf_ns.dataparsers.index.indexing import index_events
from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.dataparsers.recording.errors import RecordingError

ZERO = 50_000_000_000_000
"""Time of the clock of the images at the recording's zero, ns."""

EXPOSURES = np.array([4_000_000, 300_000, 14_996_000])
CAMERA = Camera(WIDTH, HEIGHT, 20.0, 21.0, 11.5, 8.5, (-0.1, 0.02, 0.001, -0.002), "radtan")
RECTIFIED, FRAME_CAMERA = Camera(WIDTH, HEIGHT, 19.0, 19.0, 12.0, 9.0), Camera(32, 20, 30.0, 30.0, 15.0, 10.0)


def motion(x: float, angle: float) -> np.ndarray:
    found = np.eye(4)
    found[:3, :3] = Rotation.from_rotvec([0.0, angle, 0.02]).as_matrix()
    found[:3, 3] = [x, 0.01, -0.02]
    return found


IN_LEFT = {0: np.eye(4), 1: motion(0.05, 0.02), 2: motion(0.55, -0.03), 3: motion(0.6, 0.04)}
"""Where each camera lies in the axes of cam0."""
RECTIFYING = {i: Rotation.from_rotvec([0.01, 0.02 * i - 0.03, 0.005]).as_matrix() for i in range(4)}
"""From each camera's axes to those of the rectified one."""


def write_dsec(folder: Path, events: np.ndarray = TRUE_EVENTS, unpacked: bool = False) -> Path:
    """As the data set's page shows it, or as its archives unpack."""
    folder.mkdir(parents=True)
    names = {side: f"events_{side}" if unpacked else f"events/{side}" for side in ("left", "right")}
    for side, number in (("left", 0), ("right", 3)):
        place = folder / names[side]
        place.mkdir(parents=True)
        with h5py.File(place / "events.h5", "w") as file:
            for name, column, kind in zip("xytp", events.T, ("u2", "u2", "u4", "u1"), strict=True):
                file[f"events/{name}"] = (column // 1000 if name == "t" else column).astype(kind)
            file["t_offset"] = np.int64(ZERO // 1000)
            file["ms_to_idx"] = np.searchsorted(events[:, 2], np.arange(1000) * 1_000_000).astype("u8")
        rows, columns = np.mgrid[:HEIGHT, :WIDTH].astype(np.float64)
        pixels = np.stack([columns, rows], axis=-1).reshape(-1, 1, 2)
        stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-10)
        lens = CAMERA.matrix, np.array(CAMERA.distortion)
        table = cv2.undistortPointsIter(pixels, *lens, RECTIFYING[number], RECTIFIED.matrix, stop)
        with h5py.File(place / "rectify_map.h5", "w") as file:
            file["rectify_map"] = table.reshape(HEIGHT, WIDTH, 2).astype(np.float32)
    cameras: dict[str, Any] = {}
    for number in range(4):
        is_event = number in (0, 3)
        raw, flat = (CAMERA, RECTIFIED) if is_event else (FRAME_CAMERA, FRAME_CAMERA)
        for name, camera in ((f"cam{number}", raw), (f"camRect{number}", flat)):
            about = [camera.fx, camera.fy, camera.cx, camera.cy]
            cameras[name] = {"camera_matrix": about, "resolution": [camera.width, camera.height]}
        cameras[f"cam{number}"]["distortion_coeffs"] = list(CAMERA.distortion if is_event else (0.0, 0.0, 0.0, 0.0))
    extrinsics = {f"T_{i + 1}{i}": (np.linalg.inv(IN_LEFT[i + 1]) @ IN_LEFT[i]).tolist() for i in range(3)}
    extrinsics |= {f"R_rect{i}": turn.tolist() for i, turn in RECTIFYING.items()}
    calibration = folder / ("cam_to_cam.yaml" if unpacked else "calibration/cam_to_cam.yaml")
    calibration.parent.mkdir(exist_ok=True)
    calibration.write_text(yaml.safe_dump({"intrinsics": cameras, "extrinsics": extrinsics}))
    for side in ("left", "right"):
        place = folder / (f"images_rectified_{side}" if unpacked else f"images/{side}/rectified")
        place.mkdir(parents=True)
        for i in range(len(FRAME_TIMES)):
            write_image(place / f"{i:06d}.png", np.resize(image(i, 3), (20, 32, 3)))
        starts = FRAME_TIMES + ZERO - EXPOSURES // 2
        rows = "".join(f"{a // 1000}, {b // 1000}\n" for a, b in zip(starts, starts + EXPOSURES, strict=True))
        name = f"seq_image_exposure_timestamps_{side}.txt" if unpacked else f"images/{side}/exposure_timestamps.txt"
        (folder / name).write_text("# exposure start, exposure end\n" + rows)
    name = "seq_image_timestamps.txt" if unpacked else "images/timestamps.txt"
    (folder / name).write_text("".join(f"{(time + ZERO) // 1000 + 500}\n" for time in FRAME_TIMES.tolist()))
    rows = zip(POSE_TIMES.tolist(), poses().tolist(), strict=True)
    (folder / "poses.txt").write_text("".join(f"{seconds(ZERO + t)} {' '.join(map(repr, row))}\n" for t, row in rows))
    return folder


def camera_to_world() -> np.ndarray:
    found = np.tile(np.eye(4), (len(POSE_TIMES), 1, 1))
    found[:, :3, :3] = Rotation.from_quat(poses()[:, 3:]).as_matrix()
    found[:, :3, 3] = poses()[:, :3]
    return found


@pytest.mark.parametrize("unpacked", [False, True])
@pytest.mark.parametrize(("side", "number"), [("left", 0), ("right", 3)])
def test_both_sides_in_both_layouts(tmp_path: Path, side: str, number: int, unpacked: bool):
    recording = read_recording(write_dsec(tmp_path / "dsec", unpacked=unpacked), event_camera=side)
    assert recording.format == "dsec" and recording.camera == CAMERA and not recording.notes
    events = joined(recording.stream_events())
    np.testing.assert_array_equal(np.column_stack([events.x, events.y, events.t, events.p]), TRUE_EVENTS)
    assert len(index_events(recording)) == recording.num_events == len(TRUE_EVENTS)
    check_poses(recording.trajectory, camera_to_world() @ IN_LEFT[number])
    frames = recording.frames
    assert frames is not None and frames.camera == FRAME_CAMERA and frames.exposures is not None
    assert recording.times_in["frames"][0].name.endswith(".txt") and recording.times_in["frames"][0].exists()
    np.testing.assert_array_equal(frames.times, FRAME_TIMES)
    np.testing.assert_array_equal(frames.exposures, EXPOSURES)
    frame = {0: 1, 3: 2}[number]
    flat = np.eye(4)
    flat[:3, :3] = RECTIFYING[frame].T
    check_poses(frames.trajectory, camera_to_world() @ IN_LEFT[frame] @ flat)


def test_without_poses_the_error_says_that_there_are_none(tmp_path: Path):
    folder = write_dsec(tmp_path / "dsec")
    own = (folder / "poses.txt").rename(tmp_path / "poses.txt")
    with pytest.raises(RecordingError, match=r"dsec/poses\.txt is missing, a text file with the columns t_s px"):
        read_recording(folder)
    given = GivenPoses(own, PoseFlags())
    check_poses(read_recording(folder, poses=given).trajectory, camera_to_world())


def test_frames_without_exposures_have_the_pose_at_their_stamp(tmp_path: Path):
    folder = write_dsec(tmp_path / "dsec")
    (folder / "images/left/exposure_timestamps.txt").unlink()
    frames = dsec.read(folder).frames
    assert frames is not None and frames.exposures is None
    np.testing.assert_array_equal(frames.times, FRAME_TIMES + 500_000)
    (folder / "images/timestamps.txt").unlink()
    with pytest.raises(
        RecordingError, match=r"holds 3 images, but their stamps are missing; add images/timestamps\.txt"
    ):
        dsec.read(folder)


def test_events_and_calibration_alone(tmp_path: Path):
    folder = write_dsec(tmp_path / "dsec")
    for file in (*folder.rglob("images/*/*.txt"), *folder.rglob("*.png"), *folder.rglob("rectify_map.h5")):
        file.unlink()
    assert dsec.read(folder).frames is None


def set_in(name: str, *keys: str, value: Any) -> Callable[[Path], Any]:
    def change(folder: Path) -> None:
        path = folder / name
        tree = yaml.safe_load(path.read_text())
        inside = tree
        for key in keys[:-1]:
            inside = inside[key]
        inside[keys[-1]] = value
        path.write_text(yaml.safe_dump(tree))

    return change


def shifted_map(folder: Path) -> None:
    with h5py.File(folder / "events/left/rectify_map.h5", "r+") as file:
        file["rectify_map"][...] += 0.7  # type: ignore[index]


CALIBRATION = "calibration/cam_to_cam.yaml"
BAD: dict[str, tuple[Callable[[Path], Any], str]] = {
    "no events": (
        lambda folder: (folder / "events/left/events.h5").unlink(),
        "lacks events/left/events.h5 or events_left/events.h5, which holds events of DSEC; put it there",
    ),
    "no calibration": (
        lambda folder: (folder / CALIBRATION).unlink(),
        "lacks calibration/cam_to_cam.yaml or cam_to_cam.yaml, which holds the calibration of DSEC",
    ),
    "map of another camera": (shifted_map, "holds a rectify_map that is up to 0.7 pixels from that of"),
    "rotation the other way": (
        set_in(CALIBRATION, "extrinsics", "R_rect0", value=RECTIFYING[0].T.tolist()),
        "holds a rectify_map that is up to",
    ),
    "no rotation": (
        set_in(CALIBRATION, "extrinsics", "R_rect1", value=(2 * np.eye(3)).tolist()),
        "extrinsics.R_rect1, is no rotation, since it is off orthonormal by 3",
    ),
    "exposures of another sequence": (
        lambda folder: shift(folder / "images/left/exposure_timestamps.txt", 10_000),
        "holds exposures whose middles are up to 10.5 ms from the stamps in",
    ),
    "an exposure back in time": (
        lambda folder: (folder / "images/left/exposure_timestamps.txt").write_text("1,2\n3,4\n6,5\n"),
        "exposure_timestamps.txt, line 3 holds an end that is not after its start",
    ),
    "an exposure fewer": (
        lambda folder: (folder / "images/left/exposure_timestamps.txt").write_text("1,2\n3,4\n"),
        "holds 3 images, but",
    ),
    "poses on another clock": (
        lambda folder: (folder / "poses.txt").write_text("0 0 0 0 0 0 0 1\n1 0 0 1 0 0 0 1\n"),
        "do not cover the events",
    ),
}


def shift(path: Path, by: int) -> None:
    head, *lines = path.read_text().splitlines()
    rows = [[int(cell) - by for cell in line.split(",")] for line in lines]
    path.write_text("\n".join([head, *(f"{a},{b}" for a, b in rows)]))


@pytest.mark.parametrize("name", BAD)
def test_bad_files_give_one_sentence(tmp_path: Path, name: str):
    break_it, message = BAD[name]
    folder = write_dsec(tmp_path / "dsec")
    break_it(folder)
    with pytest.raises(RecordingError) as error:
        len(index_events(dsec.read(folder)))
    assert message in str(error.value)
    assert str(folder) in str(error.value) and is_one_sentence(str(error.value))


def test_extrinsics_of_the_right_side_the_other_way(tmp_path: Path):
    folder = write_dsec(tmp_path / "dsec")
    for i in range(3):
        value = (np.linalg.inv(IN_LEFT[i]) @ IN_LEFT[i + 1]).tolist()
        set_in(CALIBRATION, "extrinsics", f"T_{i + 1}{i}", value=value)(folder)
    with pytest.raises(
        RecordingError, match=r"places the right event camera 0\.\d+ m to the left of the left one by T_10,"
    ):
        read_recording(folder, event_camera="right")
