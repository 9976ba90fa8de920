"""Sequences of VECtor, written by h5py and PyYAML from the data set's documents, which show points that are known."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
import pytest
import yaml
from known_points import (
    check_events_see,
    check_pictures_show,
    points_seen,
    reference_poses,
    spots_image,
)
from recordings import joined
from scipy.spatial.transform import Rotation

from enerf_ns.dataparsers.formats.registry import read_recording
from enerf_ns.dataparsers.formats.vector import read
from enerf_ns.dataparsers.index.indexing import index_events
from enerf_ns.dataparsers.recording.errors import RecordingError

NAME = "desk_normal1"
CLOCK = 1_642_661_138_000_000
"""Microseconds since 1970 of the stamp 0 of the events."""

EVENT_MATRIX = np.array([[327.3, 0, 304.9], [0, 327.5, 235.0], [0, 0, 1]])
EVENT_LENS = (-0.0317, 0.0553, 0.0004, -0.0009, -0.0123)
FRAME_SIZE = (204, 170)
"""Smaller than the published frames; the reader takes the size of the files."""
FRAME_MATRIX = np.array([[170.0, 0, 101.0], [0, 170.5, 86.0], [0, 0, 1]])
FRAME_LENS = (-0.05, 0.02, 0.0003, -0.0006, 0.0)
NUM_EVENTS = 1200
EXPOSURES = (4_000, 12_000, 30_001)
"""Microseconds."""


def motion(turn: list[float], place: list[float]) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = Rotation.from_rotvec(turn).as_matrix(), place
    return matrix


CAMERA_FROM_BODY = motion([0.3, -1.2, 0.4], [0.06, -0.03, 0.07])
FRAME_FROM_EVENT = motion([0.01, 0.006, -0.009], [0.0005, -0.041, -0.014])


@dataclass
class Scene:
    """Times are microseconds since 1970."""

    events: np.ndarray
    """x y t p, int64 [events, 4]."""
    times: np.ndarray
    bodies: np.ndarray
    """Body to world, [poses, 4, 4]."""
    opens: np.ndarray
    frames: list[np.ndarray]
    spots: list[np.ndarray]

    def poses(self, mount: np.ndarray, at: np.ndarray) -> np.ndarray:
        """Of a camera that is mounted in the body, at times in ns since 1970."""
        whole = self.bodies @ mount
        quaternions = Rotation.from_matrix(whole[:, :3, :3]).as_quat()
        return reference_poses(self.times * 1000, whole[:, :3, 3], quaternions, at)


def make_scene() -> Scene:
    rng = np.random.default_rng(0)
    times = CLOCK + 250_000 + np.rint(np.arange(181) * 1e6 / 120).astype(np.int64)
    phase = np.linspace(0, 1, 181)
    bodies = np.tile(np.eye(4), (181, 1, 1))
    bodies[:, :3, :3] = Rotation.from_rotvec(
        np.column_stack([0.1 * np.sin(3 * phase), 0.2 * phase, 0.1 * phase])
    ).as_matrix()
    bodies[:, :3, 3] = np.column_stack([0.4 * phase, 0.1 * np.sin(5 * phase), 0.05 * np.cos(7 * phase)])
    places = [np.tile(rng.permutation(np.linspace(0, side - 1, NUM_EVENTS // 2).astype(int)), 2) for side in (640, 480)]
    stamps = np.sort(rng.integers(times[0] + 1000, times[-1] - 1000, NUM_EVENTS))
    events = np.column_stack([*places, stamps, rng.integers(0, 2, NUM_EVENTS)])
    opens = times[0] + np.array([200_000, 600_000, 1_100_000])
    scene = Scene(events, times, bodies, opens, [], [])
    middles = opens * 1000 + np.array(EXPOSURES) * 500
    for pose in scene.poses(np.linalg.inv(CAMERA_FROM_BODY), middles):
        pixels = np.array([[60.0, 50.0], [140.0, 60.0], [100.0, 120.0]]) + rng.uniform(-3, 3, (3, 2))
        poses = np.repeat(pose[None], 3, 0)
        scene.spots.append(points_seen(pixels, rng.uniform(1, 3, 3), poses, FRAME_MATRIX, FRAME_LENS))
        scene.frames.append(spots_image(pixels, *FRAME_SIZE))
    return scene


def in_seconds(microseconds: int) -> str:
    return f"{microseconds // 10**6}.{microseconds % 10**6:06d}"


def calibrations() -> dict[str, Any]:
    """What each file of the calibration holds."""

    def camera(matrix: np.ndarray, lens: tuple[float, ...], size: tuple[int, int]) -> dict[str, Any]:
        return {
            "image_width": size[0],
            "image_height": size[1],
            "camera_name": "camera",
            "camera_matrix": {"rows": 3, "cols": 3, "data": matrix.ravel().tolist()},
            "distortion_model": "plumb_bob",
            "distortion_coefficients": {"rows": 1, "cols": 5, "data": list(lens)},
        }

    def flat(matrix: np.ndarray) -> list[float]:
        return matrix.ravel().tolist()

    body = {"T_body_cam": flat(np.linalg.inv(CAMERA_FROM_BODY)), "T_cam_body": flat(CAMERA_FROM_BODY)}
    return {
        "left_event_camera_intrinsic_results.yaml": camera(EVENT_MATRIX, EVENT_LENS, (640, 480)),
        "left_regular_camera_intrinsic_results.yaml": camera(FRAME_MATRIX, FRAME_LENS, FRAME_SIZE),
        "camera_mocap_extrinsic_results1.yaml": {"cam0": body},
        "small_scale_joint_camera_extrinsic_results.yaml": {
            "cam1": {"T_cam0_cam1": flat(np.eye(4))},
            "cam2": {"T_cam0_cam2": flat(FRAME_FROM_EVENT)},
            "cam3": {"T_cam0_cam3": flat(np.eye(4))},
        },
    }


def write_vector(folder: Path, scene: Scene | None = None, with_frames: bool = True, name: str = NAME) -> Path:
    scene = make_scene() if scene is None else scene
    folder.mkdir(parents=True)
    with h5py.File(folder / f"{name}.synced.left_event.hdf5", "w") as file:
        columns = scene.events - [0, 0, CLOCK, 0]
        for column, letter, dtype in zip(columns.T, "xytp", ("u2", "u2", "i8", "u1"), strict=True):
            file.create_dataset(f"events/{letter}", data=column.astype(dtype), compression="gzip")
        file["ms_to_idx"], file["t_offset"] = np.zeros(10, np.uint64), np.array([CLOCK])
    lines = ["# ground truth poses of the body", "# timestamp tx ty tz qx qy qz qw"]
    for time, body in zip(scene.times.tolist(), scene.bodies, strict=True):
        values = [*body[:3, 3].tolist(), *Rotation.from_matrix(body[:3, :3]).as_quat().tolist()]
        lines.append(" ".join([in_seconds(time), *map(repr, values)]))
    (folder / f"{name}.synced.gt.txt").write_text("\n".join(lines) + "\n")
    if with_frames:
        images = folder / f"{name}.synced.left_camera"
        images.mkdir()
        lines = ["# exposure of each frame", "# start end"]
        for number, (start, exposure) in enumerate(zip(scene.opens.tolist(), EXPOSURES, strict=True)):
            cv2.imwrite(str(images / f"{number:06d}.png"), scene.frames[number])
            lines.append(f"{in_seconds(start)} {in_seconds(start + exposure)}")
        (images / "timestamp.txt").write_text("\n".join(lines) + "\n")
    for file_name, content in calibrations().items():
        (folder / file_name).write_text(yaml.safe_dump(content))
    return folder


def test_what_was_written_is_read(tmp_path: Path):
    scene = make_scene()
    recording = read_recording(write_vector(tmp_path / "desk", scene))
    assert recording.format == "vector" and recording.notes == ()
    zero = int(scene.times[0]) * 1000
    for _ in range(2):
        found = joined(recording.stream_events())
        np.testing.assert_array_equal(np.stack([found.x, found.y, found.p], axis=1), scene.events[:, [0, 1, 3]])
        np.testing.assert_array_equal(found.t, scene.events[:, 2] * 1000 - zero)
    frames = recording.frames
    assert frames is not None and frames.exposures is not None
    np.testing.assert_array_equal(frames.exposures, np.array(EXPOSURES) * 1000)
    np.testing.assert_array_equal(frames.times, scene.opens * 1000 + np.array(EXPOSURES) * 500 - zero)
    assert len(index_events(recording)) == NUM_EVENTS


def test_events_are_seen_where_the_points_are(tmp_path: Path):
    """By SciPy and OpenCV, within 0.01 pixel, through the chain of body, grey camera and event camera."""
    scene = make_scene()
    recording = read(write_vector(tmp_path / "desk", scene))
    mount = np.linalg.inv(CAMERA_FROM_BODY) @ FRAME_FROM_EVENT
    poses = scene.poses(mount, scene.events[:, 2] * 1000)
    depths = np.random.default_rng(3).uniform(0.5, 5, NUM_EVENTS)
    points = points_seen(scene.events[:, :2].astype(float).copy(), depths, poses, EVENT_MATRIX, EVENT_LENS)
    check_events_see(recording, points)


def test_the_right_event_camera(tmp_path: Path):
    """It has files of its own, and cam3 of the calibration."""
    scene = make_scene()
    folder = write_vector(tmp_path / "desk", scene)
    for name in (f"{NAME}.synced.left_event.hdf5", "left_event_camera_intrinsic_results.yaml"):
        (folder / name).rename(folder / name.replace("left", "right"))
    frame_from_right = motion([-0.02, 0.013, 0.004], [0.17, -0.04, -0.012])
    stated(JOINT, "cam3", "T_cam0_cam3", value=frame_from_right.ravel().tolist())(folder)
    recording = read_recording(folder, event_camera="right")
    poses = scene.poses(np.linalg.inv(CAMERA_FROM_BODY) @ frame_from_right, scene.events[:, 2] * 1000)
    depths = np.random.default_rng(3).uniform(0.5, 5, NUM_EVENTS)
    points = points_seen(scene.events[:, :2].astype(float).copy(), depths, poses, EVENT_MATRIX, EVENT_LENS)
    check_events_see(recording, points)
    assert recording.frames is not None
    check_pictures_show(recording.frames, scene.spots)  # of the left grey camera


def test_pictures_without_distortion_show_points_where_they_are(tmp_path: Path):
    scene = make_scene()
    frames = read(write_vector(tmp_path / "desk", scene)).frames
    assert frames is not None
    check_pictures_show(frames, scene.spots)


def test_the_calibration_may_lie_beside_the_folder(tmp_path: Path):
    folder = write_vector(tmp_path / "desk", with_frames=False)
    (tmp_path / "0_calib").mkdir()
    for name in calibrations():
        shutil.move(folder / name, tmp_path / "0_calib" / name)
    recording = read_recording(folder)
    assert recording.frames is None and recording.camera.fx == EVENT_MATRIX[0, 0]


def test_the_poses_of_a_lidar_are_refused(tmp_path: Path):
    folder = write_vector(tmp_path / "corridors", name="corridors_dolly1")
    with pytest.raises(RecordingError, match=r"corridors_dolly1, whose poses are those of a lidar"):
        read(folder)


def stated(name: str, *keys: str, value: Any) -> Callable[[Path], None]:
    def state(folder: Path) -> None:
        content = calibrations()[name]
        inside = content
        for key in keys[:-1]:
            inside = inside[key]
        inside[keys[-1]] = value
        (folder / name).write_text(yaml.safe_dump(content))

    return state


def replaced(pattern: str, old: str, new: str) -> Callable[[Path], None]:
    def replace(folder: Path) -> None:
        (file,) = folder.glob(pattern)
        assert old in file.read_text()
        file.write_text(file.read_text().replace(old, new))

    return replace


EVENTS_LENS, FRAMES_LENS, BODY, JOINT = calibrations()
FIRST = in_seconds(CLOCK + 450_000)
BAD: dict[str, tuple] = {
    "no poses": (lambda folder: next(folder.glob("*.gt.txt")).unlink(), "gt.txt is missing"),
    "no calibration": (lambda folder: (folder / BODY).unlink(), f"holds no {BODY}, and neither does a calibration"),
    "two sequences": (
        lambda folder: shutil.copy(next(folder.glob("*.hdf5")), folder / "b.synced.left_event.hdf5"),
        "holds 2 files *.synced.left_event.hdf5",
    ),
    "no inverse": (stated(BODY, "cam0", "T_body_cam", value=np.eye(4).ravel().tolist()), "are not inverse to each"),
    "no rotation": (stated(JOINT, "cam2", "T_cam0_cam2", value=[1.0] * 16), "T_cam0_cam2 whose upper left 3 x 3"),
    "no motion": (stated(JOINT, "cam2", "T_cam0_cam2", value=[1.0] * 12), "but a matrix of 4 x 4 numbers was"),
    "no right camera": (stated(JOINT, "cam2", value={}), "lacks cam2.T_cam0_cam2"),
    "another size": (stated(EVENTS_LENS, "image_width", value=320), "image_width = 320, but 640 pixels, as the data"),
    "a skew": (
        stated(EVENTS_LENS, "camera_matrix", "data", value=[300, 1, 320, 0, 300, 240, 0, 0, 1]),
        "but fx 0 cx 0 fy cy 0 0 1 was expected",
    ),
    "another lens": (stated(FRAMES_LENS, "distortion_model", value="equidistant"), 'distortion_model = "equidistant"'),
    "six coefficients": (
        stated(FRAMES_LENS, "distortion_coefficients", "data", value=[0.1] * 6),
        "but k1 k2 p1 p2 and perhaps k3 were expected",
    ),
    "an exposure that ends first": (
        replaced("*camera/timestamp.txt", f"{FIRST} ", in_seconds(CLOCK + 500_000) + " "),
        "holds an exposure that ends before it starts",
    ),
    "one stamp a frame": (replaced("*camera/timestamp.txt", f"{FIRST} ", ""), "line 3 has 1 columns, but 2 were"),
    "a frame fewer": (lambda folder: next(folder.glob("*camera/*.png")).unlink(), "holds 2 images, but its timestamp"),
}


@pytest.mark.parametrize("name", BAD)
def test_what_is_wrong_is_said(tmp_path: Path, name: str):
    break_it, message = BAD[name]
    folder = write_vector(tmp_path / "desk")
    break_it(folder)
    with pytest.raises(RecordingError) as caught:
        joined(read(folder).stream_events())
    assert message in str(caught.value) and str(folder) in str(caught.value)
