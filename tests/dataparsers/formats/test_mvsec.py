"""Sequences of MVSEC, written by h5py and PyYAML from the data set's documents, which show points that are known."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass, field
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
from PIL import Image
from recordings import joined
from scipy.spatial.transform import Rotation

from enerf_ns.dataparsers.event_dataparser import event_pictures
from enerf_ns.dataparsers.formats.conversion import convert_recording
from enerf_ns.dataparsers.formats.mvsec import read
from enerf_ns.dataparsers.formats.registry import read_recording
from enerf_ns.dataparsers.index.indexing import index_events
from enerf_ns.dataparsers.index.picture_files import write_pictures
from enerf_ns.dataparsers.recording.errors import RecordingError
from enerf_ns.dataparsers.recording.recording import EventRecording

WIDTH, HEIGHT = 96, 72
MATRIX = np.array([[70.0, 0, 47.0], [0, 71.0, 35.5], [0, 0, 1]])
DISTORTION = (-0.048, 0.011, -0.055, 0.021)
CLOCK = 1_504_645_177
"""Seconds since 1970 at the begin, as in indoor_flying1."""

NUM_EVENTS = 1200
STEM = "indoor_flying1"
CAMCHAIN = "camchain-imucam-indoor_flying.yaml"


@dataclass
class Scene:
    """What is written. Times are seconds since 1970, exact to the last bit."""

    events: np.ndarray
    """x y t p, float64 [events, 4]; p is -1 or 1."""
    pose_times: np.ndarray
    poses: np.ndarray
    """Camera to world, [poses, 4, 4]."""
    frame_times: np.ndarray
    frames: np.ndarray
    depth_times: np.ndarray
    depths: np.ndarray
    spots: list[np.ndarray] = field(default_factory=list)
    """Points that each frame shows, [points, 3]."""


def nanoseconds(seconds: np.ndarray) -> np.ndarray:
    """Exact, by Python's integers."""
    return np.array([round(int(time * 2**40) * 10**9 / 2**40) for time in (seconds - CLOCK).tolist()], np.int64)


def pose_matrices(number: int) -> np.ndarray:
    phase = np.linspace(0, 1, number)
    poses = np.tile(np.eye(4), (number, 1, 1))
    turns = np.column_stack([0.1 * np.sin(3 * phase), 0.2 * phase, 0.1 * phase])
    poses[:, :3, :3] = Rotation.from_rotvec(turns).as_matrix()
    poses[:, :3, 3] = np.column_stack([0.4 * phase, 0.1 * np.sin(5 * phase), 0.05 * np.cos(7 * phase)])
    return poses


def at(scene_times: np.ndarray, poses: np.ndarray, times: np.ndarray) -> np.ndarray:
    quaternions = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    return reference_poses(nanoseconds(scene_times), poses[:, :3, 3], quaternions, nanoseconds(times))


def make_scene() -> Scene:
    rng = np.random.default_rng(0)
    pose_times, poses = CLOCK + 0.25 + np.linspace(0, 1.5, 151), pose_matrices(151)
    places = [rng.permutation(np.arange(NUM_EVENTS) % side) for side in (WIDTH, HEIGHT)]
    times = CLOCK + 0.25 + np.sort(rng.uniform(0.001, 1.499, NUM_EVENTS))
    events = np.column_stack([*places, times, rng.choice([-1.0, 1.0], NUM_EVENTS)])
    frame_times, depth_times = CLOCK + 0.25 + np.array([0.2, 0.6, 1.0]), CLOCK + 0.25 + np.array([0.3, 0.9])
    frames, spots = [], []
    for pose in at(pose_times, poses, frame_times):
        pixels = np.array([[30.0, 25.0], [60.0, 22.0], [45.0, 50.0]]) + rng.uniform(-2, 2, (3, 2))
        seen = points_seen(pixels, rng.uniform(1, 3, 3), np.repeat(pose[None], 3, 0), MATRIX, DISTORTION, "fisheye")
        spots.append(seen)
        frames.append(spots_image(pixels, WIDTH, HEIGHT))
    depths = rng.uniform(1, 4, (2, HEIGHT, WIDTH)).astype(np.float32)
    depths[:, :10] = np.nan
    return Scene(events, pose_times, poses, frame_times, np.stack(frames), depth_times, depths, spots)


def write_camchain(path: Path, **changes: Any) -> None:
    cam0: dict[str, Any] = {
        "T_cam_imu": np.eye(4).tolist(),
        "camera_model": "pinhole",
        "distortion_coeffs": list(DISTORTION),
        "distortion_model": "equidistant",
        "intrinsics": [MATRIX[0, 0], MATRIX[1, 1], MATRIX[0, 2], MATRIX[1, 2]],
        "resolution": [WIDTH, HEIGHT],
        "rostopic": "/davis/left/image_raw",
    }
    cam0 = {name: value.item() if isinstance(value, np.generic) else value for name, value in (cam0 | changes).items()}
    cam0["intrinsics"] = [float(value) for value in cam0["intrinsics"]]
    path.write_text(yaml.safe_dump({"cam0": cam0, "cam1": cam0 | {"T_cn_cnm1": np.eye(4).tolist()}}))


def write_mvsec(folder: Path, scene: Scene | None = None, with_frames: bool = True, with_depth: bool = True) -> Path:
    scene = make_scene() if scene is None else scene
    folder.mkdir(parents=True)
    with h5py.File(folder / f"{STEM}_data.hdf5", "w") as file:
        left: Any = file.create_group("davis/left")
        left.create_dataset("events", data=scene.events, chunks=(500, 4), compression="gzip")
        if with_frames:
            left["image_raw"], left["image_raw_ts"] = scene.frames, scene.frame_times
            left["image_raw_event_inds"] = np.searchsorted(scene.events[:, 2], scene.frame_times)
        file.create_dataset("davis/right/events", data=scene.events)
    with h5py.File(folder / f"{STEM}_gt.hdf5", "w") as file:
        left = file.create_group("davis/left")
        left["pose"], left["pose_ts"] = scene.poses, scene.pose_times
        left["odometry"], left["odometry_ts"] = scene.poses, scene.pose_times
        if with_depth:
            left.create_dataset("depth_image_raw", data=scene.depths, chunks=(1, HEIGHT, WIDTH), compression="gzip")
            left["depth_image_raw_ts"] = scene.depth_times
    write_camchain(folder / CAMCHAIN)
    return folder


def test_what_was_written_is_read(tmp_path: Path):
    scene = make_scene()
    recording = read_recording(write_mvsec(tmp_path / "flight", scene))
    assert recording.format == "mvsec" and recording.notes == ()
    zero = nanoseconds(scene.pose_times)[0]
    for _ in range(2):
        found = joined(recording.stream_events())
        np.testing.assert_array_equal(np.stack([found.x, found.y, found.p], axis=1), scene.events[:, [0, 1, 3]])
        assert np.abs(found.t - (nanoseconds(scene.events[:, 2]) - zero)).max() <= 1
    np.testing.assert_allclose(recording.trajectory.times, nanoseconds(scene.pose_times) - zero, rtol=0, atol=1)
    np.testing.assert_allclose(recording.trajectory.positions, scene.poses[:, :3, 3], rtol=0, atol=1e-12)
    turns = Rotation.from_quat(recording.trajectory.quaternions).as_matrix()
    np.testing.assert_allclose(turns, scene.poses[:, :3, :3], rtol=0, atol=1e-12)
    frames = recording.frames
    assert frames is not None and frames.depth_filenames is None
    np.testing.assert_allclose(frames.times, nanoseconds(scene.frame_times) - zero, rtol=0, atol=1)
    for number, image in enumerate(scene.frames):
        np.testing.assert_array_equal(frames.image(number)[..., 0], image)
    assert frames.white_in_words == ""


def test_events_are_seen_where_the_points_are(tmp_path: Path):
    """By SciPy and OpenCV's fisheye, within 0.01 pixel."""
    scene = make_scene()
    recording = read(write_mvsec(tmp_path / "flight", scene))
    poses = at(scene.pose_times, scene.poses, scene.events[:, 2])
    depths = np.random.default_rng(3).uniform(0.5, 5, NUM_EVENTS)
    points = points_seen(scene.events[:, :2].copy(), depths, poses, MATRIX, DISTORTION, "fisheye")
    check_events_see(recording, points)


def test_pictures_without_distortion_show_points_where_they_are(tmp_path: Path):
    scene = make_scene()
    frames = read(write_mvsec(tmp_path / "flight", scene)).frames
    assert frames is not None
    check_pictures_show(frames, scene.spots)


RIGHT_FROM_LEFT = np.eye(4)
RIGHT_FROM_LEFT[:3, :3], RIGHT_FROM_LEFT[:3, 3] = Rotation.from_rotvec([0.01, 0.04, -0.02]).as_matrix(), [-0.1, 0, 0.01]


def write_right(folder: Path, scene: Scene, right_from_left: np.ndarray = RIGHT_FROM_LEFT) -> Path:
    """What the left DAVIS saw is the right one's, but for the poses."""
    write_mvsec(folder, scene)
    with h5py.File(folder / f"{STEM}_data.hdf5", "r+") as file:
        del file["davis/right"]
        file.move("davis/left", "davis/right")
    with h5py.File(folder / f"{STEM}_gt.hdf5", "r+") as file:
        file.create_group("davis/right")
        for name in ("depth_image_raw", "depth_image_raw_ts"):
            file.move(f"davis/left/{name}", f"davis/right/{name}")
    tree = yaml.safe_load((folder / CAMCHAIN).read_text())
    tree["cam1"]["T_cn_cnm1"] = right_from_left.tolist()
    tree["cam0"]["intrinsics"] = [80, 80, 50, 40]
    (folder / CAMCHAIN).write_text(yaml.safe_dump(tree))
    return folder


def test_the_right_camera(tmp_path: Path):
    """Against SciPy and OpenCV's fisheye, from the poses of the left one."""
    scene = make_scene()
    recording = read_recording(write_right(tmp_path / "flight", scene), event_camera="right")
    poses = at(scene.pose_times, scene.poses @ np.linalg.inv(RIGHT_FROM_LEFT), scene.events[:, 2])
    depths = np.random.default_rng(3).uniform(0.5, 5, NUM_EVENTS)
    check_events_see(recording, points_seen(scene.events[:, :2].copy(), depths, poses, MATRIX, DISTORTION, "fisheye"))
    frames, maps = recording.frames, recording.depth_maps
    assert frames is not None and maps is not None and maps.trajectory is recording.trajectory
    np.testing.assert_array_equal(frames.image(1)[..., 0], scene.frames[1])
    assert maps.depth(1) is not None


def test_a_right_camera_on_the_left_is_refused(tmp_path: Path):
    folder = write_right(tmp_path / "flight", make_scene(), np.linalg.inv(RIGHT_FROM_LEFT))
    with pytest.raises(
        RecordingError, match=r"places cam1, the right DAVIS, 0\.\d+ m to the left of cam0 by T_cn_cnm1"
    ):
        read(folder, "right")


def test_depth_maps_have_an_instant_and_a_camera_of_their_own(tmp_path: Path):
    """Against OpenCV's map of the pixels without distortion."""
    scene = make_scene()
    recording = read(write_mvsec(tmp_path / "flight", scene, with_frames=False))
    maps = recording.depth_maps
    assert maps is not None and recording.frames is None
    zero = nanoseconds(scene.pose_times)[0]
    np.testing.assert_allclose(maps.times, nanoseconds(scene.depth_times) - zero, rtol=0, atol=1)
    new = maps.picture_camera.matrix
    x, y = cv2.fisheye.initUndistortRectifyMap(
        MATRIX, np.array(DISTORTION), np.eye(3), new, (WIDTH, HEIGHT), cv2.CV_32FC1
    )
    for number, depth in enumerate(scene.depths):
        expected = cv2.remap(np.nan_to_num(depth), x, y, cv2.INTER_NEAREST)
        found = maps.depth(number)
        assert found is not None and (found == 0).any()
        np.testing.assert_array_equal(found, expected)
    pictures = event_pictures(recording)
    assert len(pictures.times) == 2 and pictures.depth(0) is not None


def test_converted_and_written_for_other_methods(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("ENERF_CACHE", str(tmp_path / "cache"))
    scene = make_scene()
    folder = write_mvsec(tmp_path / "flight", scene)
    said = convert_recording(folder, tmp_path / "new")
    assert any(sentence.startswith("2 depth maps are left out") for sentence in said)
    frames, old = read_recording(tmp_path / "new").frames, read_recording(folder).frames
    assert frames is not None and old is not None
    for number, image in enumerate(scene.frames):
        np.testing.assert_array_equal(frames.image(number)[..., 0], image)
    for number, file in enumerate(write_pictures(old)):
        with Image.open(file) as picture:
            np.testing.assert_array_equal(np.asarray(picture), old.picture(number)[..., 0])
    assert write_pictures(old) == write_pictures(old)


def test_a_calibration_beside_the_folder_is_that_of_the_place(tmp_path: Path):
    folder = write_mvsec(tmp_path / "flight")
    for name in ("a_outdoor_day", "indoor_flying"):
        (tmp_path / f"{name}_calib").mkdir()
    write_camchain(tmp_path / "a_outdoor_day_calib/camchain-imucam-outdoor_day.yaml", intrinsics=[80, 80, 47, 35])
    shutil.move(folder / CAMCHAIN, tmp_path / "indoor_flying_calib" / CAMCHAIN)
    recording = read(folder)
    assert recording.camera.fx == MATRIX[0, 0] and recording.camera.model == "fisheye"
    assert recording.notes == (f"The calibration is read from {tmp_path}/indoor_flying_calib/{CAMCHAIN}.",)


def in_file(kind: str, change: Callable[[Any], object]) -> Callable[[Path], None]:
    def changed(folder: Path) -> None:
        with h5py.File(folder / f"{STEM}_{kind}.hdf5", "r+") as file:
            change(file["davis/left"])

    return changed


def put(name: str, value: Callable[[np.ndarray], np.ndarray]) -> Callable[[Any], None]:
    def change(group: Any) -> None:
        new = value(group[name][...])
        del group[name]
        group[name] = new

    return change


def at_row(row: int, column: Any, value: float) -> Callable[[np.ndarray], np.ndarray]:
    def change(array: np.ndarray) -> np.ndarray:
        array[(row, column) if column is not None else row] = value
        return array

    return change


def link_out(group: Any) -> None:
    del group["events"]
    group["events"] = h5py.ExternalLink("/etc/passwd", "/x")


BAD: dict[str, tuple] = {
    "no truth": (lambda folder: (folder / f"{STEM}_gt.hdf5").unlink(), "holds 0 files *_gt.hdf5 (none), but one seq"),
    "two sequences": (
        lambda folder: shutil.copy(folder / f"{STEM}_data.hdf5", folder / "indoor_flying2_data.hdf5"),
        "holds 2 files *_data.hdf5",
    ),
    "another truth": (
        lambda folder: (folder / f"{STEM}_gt.hdf5").rename(folder / "indoor_flying2_gt.hdf5"),
        "but both files of one sequence were expected",
    ),
    "no calibration": (lambda folder: (folder / CAMCHAIN).unlink(), "holds no camchain-imucam-indoor_flying.yaml"),
    "another size": (
        lambda folder: write_camchain(folder / CAMCHAIN, resolution=[90, 72]),
        "shape (3, 72, 96), but numbers of shape n x 72 x 90 were expected: pictures of 90 x 72 pixels",
    ),
    "no events": (in_file("data", put("events", lambda rows: rows[:0])), "holds no events"),
    "lacks events": (in_file("data", lambda group: group.pop("events")), "lacks the dataset davis/left/events"),
    "events elsewhere": (in_file("data", link_out), "refers for events to another place"),
    "five columns": (in_file("data", put("events", lambda rows: rows[:, :3])), "events as float64 of shape (1200, 3)"),
    "a part of a pixel": (in_file("data", put("events", at_row(7, 0, 3.5))), "event 8, holds the column, row and pol"),
    "a time that is none": (in_file("data", put("events", at_row(7, 2, np.nan))), "row 8, the time nan s, but seconds"),
    "stamps that go back": (in_file("gt", put("pose_ts", at_row(5, None, CLOCK))), "pose_ts, row 6, a time that is"),
    "a pose more": (in_file("gt", put("pose", lambda p: p[1:])), "holds 150 poses and 151 times"),
    "no rotation": (in_file("gt", put("pose", lambda p: p * 1.1)), "pose, row 1, no rigid motion"),
    "a pose that is none": (in_file("gt", put("pose", at_row(3, 1, np.nan))), "pose, row 4, no rigid motion"),
    "deep frames": (in_file("data", put("image_raw", lambda a: a.astype("u2"))), "image_raw as uint16, but 8 bits"),
    "a frame fewer": (in_file("data", put("image_raw", lambda a: a[1:])), "holds 2 pictures in davis/left/image_raw"),
    "whole depth": (in_file("gt", put("depth_image_raw", lambda a: np.zeros(a.shape, int))), "_raw as int64 of shape"),
    "events on another clock": (
        in_file("data", put("events", lambda rows: rows - [0, 0, CLOCK, 0])),
        "events",
    ),
}


def read_all(folder: Path) -> EventRecording:
    recording = read(folder)
    index_events(recording)
    return recording


@pytest.mark.parametrize("name", BAD)
def test_what_is_wrong_is_said(tmp_path: Path, name: str):
    break_it, message = BAD[name]
    folder = write_mvsec(tmp_path / "flight")
    break_it(folder)
    with pytest.raises(RecordingError) as caught:
        read_all(folder)
    assert message in str(caught.value) and str(folder) in str(caught.value)


def test_a_negative_depth_is_refused(tmp_path: Path):
    folder = write_mvsec(tmp_path / "flight")
    in_file("gt", put("depth_image_raw", at_row(1, 20, -1.0)))(folder)
    maps = read(folder).depth_maps
    assert maps is not None and maps.depth(0) is not None
    with pytest.raises(RecordingError, match=r"depth_image_raw/1 holds a depth of -1 m"):
        maps.depth(1)
