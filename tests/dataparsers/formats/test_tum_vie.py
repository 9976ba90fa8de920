"""Recordings of TUM-VIE in both layouts, whose events and frames show points that are known to lie there."""

from __future__ import annotations

import copy
import hashlib
import json
import re
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import h5py
import hdf5plugin
import numpy as np
import pytest
import torch
from known_points import points_seen, project, reference_poses
from scipy.spatial.transform import Rotation

from enerf_ns.dataparsers.formats import tum_vie
from enerf_ns.dataparsers.formats.registry import read_recording
from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.dataparsers.recording.errors import RecordingError
from enerf_ns.dataparsers.recording.files import load_image
from enerf_ns.dataparsers.recording.recording import EventRecording, Frames

SIDES = ("left", "right")
EXPOSURES = (4_000, 30_000, 12_000)
"""Microseconds."""

SPOT_SIZE = 2.5
"""Standard deviation of a point in an image, pixels."""


@dataclass
class Scene:
    """A recording and the truth about it. Times are microseconds on the clock of the data set."""

    calibration: dict
    """camera-calibration.json"""
    marker: dict
    """mocap-imu-calibration.json"""
    poses: np.ndarray
    """Rows of mocap_data.txt."""
    side: str
    events: np.ndarray
    """x y t p, int64 [events, 4]"""
    points: np.ndarray
    """What each event saw, [events, 3]."""
    stamps: np.ndarray
    images: list[np.ndarray]
    frame_points: np.ndarray = field(default_factory=lambda: np.zeros((3, 0, 3)))
    """What each frame saw, [frames, points, 3]."""

    def lens(self, index: int) -> tuple[np.ndarray, np.ndarray, tuple[int, int]]:
        """Matrix, coefficients, and width and height of a camera."""
        return lens(self.calibration, index)

    def camera_poses(self, index: int, at: np.ndarray) -> np.ndarray:
        """Camera-to-world matrices of a camera at some times (us)."""
        imu_from_marker = matrix_of(self.marker["value0"]["T_imu_marker"])
        imu_from_camera = matrix_of(self.calibration["value0"]["T_imu_cam"][index])
        marker = np.tile(np.eye(4), (len(self.poses), 1, 1))
        marker[:, :3, :3] = Rotation.from_quat(self.poses[:, 4:]).as_matrix()
        marker[:, :3, 3] = self.poses[:, 1:4]
        camera = marker @ np.linalg.inv(imu_from_marker) @ imu_from_camera
        quaternions = Rotation.from_matrix(camera[:, :3, :3]).as_quat()
        times = np.rint(self.poses[:, 0]).astype(np.int64) * 1000
        return reference_poses(times, camera[:, :3, 3], quaternions, np.rint(np.asarray(at) * 1000).astype(np.int64))


def around(place: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns of the pixels about a place (x, y)."""
    column, row = np.rint(place).astype(int)
    reach = int(5 * SPOT_SIZE)
    steps = np.arange(-reach, reach + 1)
    return row + steps[:, None], column + steps


def spot_centre(image: np.ndarray, near: Sequence[float]) -> np.ndarray:
    """The centre of mass (x, y) of the spot near a place."""
    rows, columns = around(near)
    weights = image[rows, columns, 0].astype(float)
    assert weights.max() > 100
    return np.array([(weights * columns).sum(), (weights * rows).sum()]) / weights.sum()


def matrix_of(pose: dict) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_quat([pose[name] for name in ("qx", "qy", "qz", "qw")]).as_matrix()
    matrix[:3, 3] = [pose[name] for name in ("px", "py", "pz")]
    return matrix


def lens(calibration: dict, index: int) -> tuple[np.ndarray, np.ndarray, tuple[int, int]]:
    values = calibration["value0"]["intrinsics"][index]["intrinsics"]
    matrix = np.array([[values["fx"], 0, values["cx"]], [0, values["fy"], values["cy"]], [0, 0, 1.0]])
    width, height = calibration["value0"]["resolution"][index]
    return matrix, np.array([values[name] for name in ("k1", "k2", "k3", "k4")]), (width, height)


def make_scene(calibration: dict, marker: dict, poses: np.ndarray, side: str, with_spots: bool) -> Scene:
    """300 events, and three frames, of points that lie where the cameras saw them then."""
    rng = np.random.default_rng(7)
    start, end = poses[0, 0], poses[-1, 0]
    stamps = np.rint(np.linspace(start + 50_000, end - 100_000, 3)).astype(np.int64)
    times = np.sort(rng.integers(start + 1_000, end, 300))
    events = np.stack([rng.integers(0, 1280, 300), rng.integers(0, 720, 300), times, rng.integers(0, 2, 300)], axis=1)
    scene = Scene(calibration, marker, poses, side, events, np.zeros((0, 3)), stamps, [])
    index = SIDES.index(side)
    matrix, coefficients, _ = scene.lens(2 + index)
    depths = rng.uniform(0.5, 3.0, 300)
    scene.points = points_seen(
        events[:, :2], depths, scene.camera_poses(2 + index, times), matrix, coefficients, "fisheye"
    )
    if not with_spots:
        scene.images = [np.zeros((1024, 1024), np.uint8)] * 3
        return scene
    matrix, coefficients, (width, height) = scene.lens(index)
    frame_points = []
    for middle in stamps + np.array(EXPOSURES) / 2:
        pixels = np.array([[380, 400], [640, 370], [512, 512], [370, 650], [650, 660]]) + rng.uniform(-20, 20, (5, 2))
        camera = np.repeat(scene.camera_poses(index, np.array([middle])), 5, axis=0)
        frame_points.append(points_seen(pixels, rng.uniform(0.5, 3.0, 5), camera, matrix, coefficients, "fisheye"))
        image = np.zeros((height, width), np.uint8)
        for x, y in pixels:
            rows, columns = around((x, y))
            image[rows, columns] = np.rint(255 * np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / (2 * SPOT_SIZE**2)))
        scene.images.append(image)
    scene.frame_points = np.array(frame_points)
    return scene


def plain_calibration() -> tuple[dict, dict]:
    """Two calibrations as the data set's, with numbers that are easy to remember."""
    pose = {"px": 0.01, "py": 0.02, "pz": 0.03, "qx": 0.0, "qy": 0.0, "qz": 0.6, "qw": 0.8}
    frame = {"fx": 750.0, "fy": 751.0, "cx": 500.0, "cy": 510.0, "k1": 0.02, "k2": 0.002, "k3": 0.002, "k4": -0.001}
    event = {"fx": 1050.0, "fy": 1049.0, "cx": 640.0, "cy": 260.0, "k1": -0.1, "k2": -0.05, "k3": 0.2, "k4": -0.2}
    cameras = [{"camera_type": "kb4", "intrinsics": values} for values in (frame, frame, event, event)]
    resolution = [[1024, 1024], [1024, 1024], [1280, 720], [1280, 720]]
    calibration = {"value0": {"T_imu_cam": [pose] * 4, "intrinsics": cameras, "resolution": resolution}}
    return copy.deepcopy(calibration), {"value0": {"T_imu_marker": dict(pose)}}


def plain_poses() -> np.ndarray:
    """One second at 120 poses a second: a slide along x while turning about y."""
    times = 5_000_000 + np.rint(np.arange(121) * 1e6 / 120)
    angles, zero = np.linspace(0, 0.3, 121) / 2, np.zeros(121)
    return np.column_stack([times, angles, zero, zero, zero, np.sin(angles), zero, np.cos(angles)])


def write_events(path: Path, scene: Scene) -> None:
    """As the data set: the filter Blosc with Zstandard, and a table of milliseconds that readers may pass over."""
    with h5py.File(path, "w") as file:
        for column, name, dtype in zip(scene.events.T, "xytp", ("u2", "u2", "i8", "u1"), strict=True):
            file.create_dataset(f"events/{name}", data=column.astype(dtype), chunks=(100,), **hdf5plugin.Blosc("zstd"))
        file["ms_to_idx"] = np.zeros(10, np.uint64)


def write_stamps(folder: Path, scene: Scene) -> None:
    (folder / f"image_timestamps_{scene.side}.txt").write_text("".join(f"{stamp}\n" for stamp in scene.stamps))
    (folder / f"image_exposures_{scene.side}.txt").write_text("".join(f"{exposure}\n" for exposure in EXPOSURES))


def write_poses(path: Path, scene: Scene) -> None:
    rows = ("{:.0f} {} {} {} {} {} {} {}\n".format(*row) for row in scene.poses.tolist())
    path.write_text("# timestamp[us] px py pz qx qy qz qw\n" + "".join(rows))


def write_raw(folder: Path, scene: Scene, sequence: str = "mocap-desk2", letter: str = "A") -> Path:
    """As it is unpacked."""
    data = folder / f"{sequence}-vi_gt_data"
    images = data / f"{scene.side}_images"
    images.mkdir(parents=True)
    write_events(folder / f"{sequence}-events_{scene.side}.h5", scene)
    write_poses(data / "mocap_data.txt", scene)
    for i, image in enumerate(scene.images):
        cv2.imwrite(str(images / f"{i:05d}.jpg"), image, [cv2.IMWRITE_JPEG_QUALITY, 100])
    write_stamps(images, scene)
    (folder / f"camera-calibration{letter}.json").write_text(json.dumps(scene.calibration))
    (folder / f"mocap-imu-calibration{letter}.json").write_text(json.dumps(scene.marker))
    return folder


def write_prepared(folder: Path, scene: Scene) -> Path:
    """As the reference code prepares it, with its fault: intrinsics for balance 0.5, images of balance 0."""
    side, index = scene.side, SIDES.index(scene.side)
    images = folder / f"{side}_images_undistorted"
    images.mkdir(parents=True)
    write_events(folder / f"mocap-desk2-events_{side}.h5", scene)
    write_poses(folder / "mocap_data.txt", scene)
    (folder / "calibration.json").write_text(json.dumps(scene.calibration))
    (folder / "mocap-imu-calib.json").write_text(json.dumps(scene.marker))
    undistorted = []
    for camera in range(4):
        matrix, coefficients, size = scene.lens(camera)
        new = cv2.fisheye.estimateNewCameraMatrixForUndistortRectify(matrix, coefficients, size, np.eye(3), balance=0.5)
        undistorted.append({"fx": new[0, 0], "fy": new[1, 1], "cx": new[0, 2], "cy": new[1, 2]})
        if camera == 2 + index:
            places = np.stack(np.meshgrid(np.arange(size[0]), np.arange(size[1])), axis=-1).astype(np.float32)
            with h5py.File(folder / f"rectify_map_{side}.h5", "w") as file:
                rectified = cv2.fisheye.undistortPoints(places, matrix, coefficients, R=np.eye(3), P=new)
                file.create_dataset("rectify_map", data=rectified, dtype="<f4")
    calibration = copy.deepcopy(scene.calibration)
    calibration["value0"]["intrinsics_undistorted"] = undistorted
    (folder / "calib_undist.json").write_text(json.dumps(calibration))
    matrix, coefficients, size = scene.lens(index)
    new = cv2.fisheye.estimateNewCameraMatrixForUndistortRectify(matrix, coefficients, size, np.eye(3), balance=0)
    for i, image in enumerate(scene.images):
        pixels = cv2.fisheye.undistortImage(image, matrix, coefficients, Knew=new, new_size=size)
        cv2.imwrite(str(images / f"{i:05d}.png"), pixels)
    write_stamps(images, scene)
    return folder


WRITERS = {"raw": write_raw, "prepared": write_prepared}


def read(folder: Path, side: str = "left") -> EventRecording:
    recording = read_recording(folder, "tum_vie", event_camera=side)
    assert isinstance(recording, EventRecording)
    return recording


def frames_of(recording: EventRecording) -> Frames:
    assert recording.frames is not None
    return recording.frames


def read_events(recording: EventRecording) -> np.ndarray:
    return np.concatenate([np.stack([e.x, e.y, e.t, e.p], axis=1) for e in recording.stream_events()])


def undistorted_pixels(camera: Camera, directions: np.ndarray) -> np.ndarray:
    """Where the undistorted camera sees directions [n, 3] in its axes."""
    seen = directions @ camera.undistorted().matrix.T
    return seen[:, :2] / seen[:, 2:]


@pytest.fixture(scope="module")
def real_scenes(shared_data: Path) -> dict[str, Scene]:
    """The real rig on 1.7 s of its real path in which it moves fast, by the side of the cameras."""
    folder = shared_data / "tum_vie"
    calibration = json.loads((folder / "camera-calibrationA.json").read_text())
    marker = json.loads((folder / "mocap-imu-calibrationA.json").read_text())
    poses = np.loadtxt(folder / "mocap_data_reconstructed.txt")
    turned = (Rotation.from_quat(poses[:-1, 4:]).inv() * Rotation.from_quat(poses[1:, 4:])).magnitude()
    first = int(np.argmax(np.convolve(turned, np.ones(200), "valid")))
    return {side: make_scene(calibration, marker, poses[first : first + 201], side, with_spots=True) for side in SIDES}


@pytest.fixture(scope="module")
def real_recordings(real_scenes: dict[str, Scene], tmp_path_factory: pytest.TempPathFactory) -> dict[tuple, Path]:
    """Folders by layout and side."""
    top = tmp_path_factory.mktemp("real")
    return {
        (layout, side): write(top / f"{layout}_{side}", scene)
        for layout, write in WRITERS.items()
        for side, scene in real_scenes.items()
    }


@pytest.fixture(scope="module")
def plain_recordings(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Folders by layout, to be copied before they are changed."""
    top = tmp_path_factory.mktemp("plain")
    scene = make_scene(*plain_calibration(), plain_poses(), "left", with_spots=False)
    return {layout: write(top / layout / "mocap-desk2", scene) for layout, write in WRITERS.items()}


@pytest.fixture
def raw(plain_recordings: dict[str, Path], tmp_path: Path) -> Path:
    return shutil.copytree(plain_recordings["raw"], tmp_path / "top" / "set" / "recording")


@pytest.fixture
def prepared(plain_recordings: dict[str, Path], tmp_path: Path) -> Path:
    return shutil.copytree(plain_recordings["prepared"], tmp_path / "prepared")


def test_the_real_ground_truth_comes_out_of_mocap_and_calibration(shared_data: Path, tmp_path: Path):
    source = shared_data / "tum_vie"
    truth = np.loadtxt(source / "groundtruth_left_event_camera.txt")
    calibration = json.loads((source / "camera-calibrationA.json").read_text())
    marker = json.loads((source / "mocap-imu-calibrationA.json").read_text())
    poses = np.loadtxt(source / "mocap_data_reconstructed.txt")
    left, right = (matrix_of(calibration["value0"]["T_imu_cam"][index]) for index in (2, 3))
    expected = np.tile(np.eye(4), (len(truth), 1, 1))
    expected[:, :3, :3] = Rotation.from_quat(truth[:, 4:]).as_matrix()
    expected[:, :3, 3] = truth[:, 1:4]
    times = torch.from_numpy(np.rint((truth[:, 0] - truth[0, 0]) * 1e6).astype(np.int64) * 1000)
    for side, mount in (("left", np.eye(4)), ("right", np.linalg.inv(left) @ right)):
        scene = make_scene(calibration, marker, poses, side, with_spots=False)
        found = read(write_raw(tmp_path / side, scene), side).trajectory.poses(times).numpy()
        wanted = expected @ mount
        assert np.linalg.norm(found[:, :, 3] - wanted[:, :3, 3], axis=1).max() < 1e-5
        turned = Rotation.from_matrix(found[:, :, :3]).inv() * Rotation.from_matrix(wanted[:, :3, :3])
        assert turned.magnitude().max() < 1e-5


@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize("layout", WRITERS)
def test_events_see_the_points_they_came_from(real_scenes, real_recordings, layout: str, side: str):
    scene, recording = real_scenes[side], read(real_recordings[layout, side], side)
    events = read_events(recording)
    written = scene.events.copy()
    written[:, 2] = written[:, 2] * 1000 - round(scene.poses[0, 0]) * 1000
    np.testing.assert_array_equal(events, written)
    np.testing.assert_array_equal(read_events(recording), events)

    poses = recording.trajectory.poses(torch.from_numpy(events[:, 2])).numpy()
    seen = np.einsum("nji,nj->ni", poses[:, :, :3], scene.points - poses[:, :, 3])
    rays = recording.camera.pixel_directions()[events[:, 1], events[:, 0]]
    camera = recording.camera
    errors = np.linalg.norm(undistorted_pixels(camera, seen) - undistorted_pixels(camera, rays), axis=1)
    assert errors.max() < 0.05
    if layout == "raw":
        matrix, coefficients = recording.camera.matrix, recording.camera.distortion
        padded = np.concatenate([poses, np.tile([[[0, 0, 0, 1.0]]], (len(poses), 1, 1))], axis=1)
        pixels = project(scene.points, padded, matrix, coefficients, "fisheye")
        assert np.linalg.norm(pixels - events[:, :2], axis=1).max() < 0.05


@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize("layout", WRITERS)
def test_frames_show_the_points_at_the_middle_of_the_exposure(real_scenes, real_recordings, layout: str, side: str):
    scene = real_scenes[side]
    frames = frames_of(read(real_recordings[layout, side], side))
    poses, at_stamps = (
        frames.trajectory.poses(torch.from_numpy(times)).numpy()
        for times in (frames.times, (scene.stamps - round(scene.poses[0, 0])) * 1000)
    )
    for file, pose, at_stamp, points in zip(frames.filenames, poses, at_stamps, scene.frame_points, strict=True):
        image = frames.camera.undistort(load_image(file))
        seen = undistorted_pixels(frames.camera, (points - pose[:, 3]) @ pose[:, :3])
        centres = np.array([spot_centre(image, place) for place in seen])
        assert np.linalg.norm(centres - seen, axis=1).max() < 0.05
        wrong = undistorted_pixels(frames.camera, (points - at_stamp[:, 3]) @ at_stamp[:, :3])
        assert np.linalg.norm(wrong - seen, axis=1).min() > 0.5


@pytest.mark.parametrize("side", SIDES)
def test_both_layouts_give_the_same_rays(real_recordings, side: str):
    raw, prepared = (read(real_recordings[layout, side], side) for layout in ("raw", "prepared"))
    np.testing.assert_allclose(prepared.camera.pixel_directions(), raw.camera.pixel_directions(), rtol=0, atol=2e-6)
    raw_frames, prepared_frames = frames_of(raw), frames_of(prepared)
    assert prepared_frames.camera == raw_frames.camera.undistorted()
    np.testing.assert_array_equal(prepared_frames.times, raw_frames.times)
    times = torch.arange(50) * (raw.trajectory.end // 50)
    for one, other in (
        (prepared.trajectory, raw.trajectory),
        (prepared_frames.trajectory, raw_frames.trajectory),
    ):
        assert torch.equal(one.poses(times), other.poses(times))
    assert list(raw.notes) == []
    assert len(prepared.notes) == 1
    assert "calib_undist.json states the frames' intrinsics for balance 0.5" in prepared.notes[0]


def test_cameras_are_those_of_the_calibration(raw: Path):
    recording = read(raw)
    assert recording.format == "tum_vie"
    assert recording.camera == Camera(
        1280, 720, 1050.0, 1049.0, 640.0, 260.0, (-0.1, -0.05, 0.2, -0.2), model="fisheye"
    )
    assert frames_of(recording).camera == Camera(
        1024, 1024, 750.0, 751.0, 500.0, 510.0, (0.02, 0.002, 0.002, -0.001), model="fisheye"
    )
    assert recording.event_files == (raw / "mocap-desk2-events_left.h5",)
    assert recording.locate(3) == f"{raw / 'mocap-desk2-events_left.h5'}, event 4"


def test_the_zero_of_time_is_the_earliest_first_stamp(raw: Path):
    stamps = raw / "mocap-desk2-vi_gt_data/left_images/image_timestamps_left.txt"
    before = read(raw)
    first = int(stamps.read_text().split()[0])
    stamps.write_text(stamps.read_text().replace(str(first), str(4_900_000)))
    after = tum_vie.read(raw)
    assert before.trajectory.start == 0
    assert after.trajectory.start == 100_000_000
    assert (read_events(after)[:, 2] == read_events(before)[:, 2] + 100_000_000).all()
    assert len(frames_of(after).times) == 2
    assert list(after.notes) == ["1 of 3 frames (33 %) lie outside the poses and are left out."]


@pytest.mark.parametrize("layout", WRITERS)
def test_a_folder_is_recognised(plain_recordings: dict[str, Path], layout: str):
    assert sum(any(plain_recordings[layout].glob(pattern)) for pattern in tum_vie.FILES) >= 2


@pytest.mark.parametrize("place", [".", "mocap-desk2-vi_gt_data", "..", "../.."])
def test_calibrations_lie_in_the_recording_or_above_it(raw: Path, place: str):
    for name in ("camera-calibrationA.json", "mocap-imu-calibrationA.json"):
        (raw / name).rename(raw / place / name)
    assert read(raw).camera.fx == 1050.0


@pytest.mark.parametrize(
    ("sequence", "fx"), [("mocap-desk2", 1050.0), ("loop-floor3", 1050.0), ("mocap-6dof", 1100.0), ("slide", 1100.0)]
)
def test_of_two_calibrations_the_one_of_the_sequence_is_taken(raw: Path, sequence: str, fx: float):
    calibration, marker = plain_calibration()
    calibration["value0"]["intrinsics"][2]["intrinsics"]["fx"] = 1100.0
    (raw / "camera-calibrationB.json").write_text(json.dumps(calibration))
    (raw / "mocap-imu-calibrationB.json").write_text(json.dumps(marker))
    for path in list(raw.glob("mocap-desk2-*")):
        path.rename(raw / path.name.replace("mocap-desk2", sequence))
    recording = read(raw)
    assert recording.camera.fx == fx and list(recording.notes) == []


def test_a_sequence_of_another_name_takes_the_only_calibration_and_says_so(raw: Path):
    (raw / "mocap-desk2-events_left.h5").rename(raw / "kitchen-events_left.h5")
    assert list(read(raw).notes) == ["kitchen is none of the published sequences; calibration A is used."]


def test_frames_and_poses_may_lie_beside_the_events(raw: Path):
    for path in list((raw / "mocap-desk2-vi_gt_data").iterdir()):
        path.rename(raw / path.name)
    (raw / "mocap-desk2-vi_gt_data").rmdir()
    assert len(frames_of(read(raw)).filenames) == 3


@pytest.mark.parametrize("layout", WRITERS)
def test_stamps_and_exposures_may_lie_above_the_images(raw: Path, prepared: Path, layout: str):
    folder = {"raw": raw / "mocap-desk2-vi_gt_data/left_images", "prepared": prepared / "left_images_undistorted"}
    expected = frames_of(tum_vie.read({"raw": raw, "prepared": prepared}[layout])).times
    for path in list(folder[layout].glob("*.txt")):
        path.rename(folder[layout].parent / path.name)
    found = frames_of(tum_vie.read({"raw": raw, "prepared": prepared}[layout])).times
    np.testing.assert_array_equal(found, expected)


def test_exposures_lie_half_before_and_half_after_the_times_of_frames(raw: Path):
    frames = frames_of(read(raw))
    stamps = np.loadtxt(raw / "mocap-desk2-vi_gt_data/left_images/image_timestamps_left.txt").astype(np.int64)
    begins = (stamps - 5_000_000) * 1000
    np.testing.assert_array_equal(frames.exposed.T, [begins, begins + np.array(EXPOSURES) * 1000])


def test_without_exposures_frames_have_their_stamps(raw: Path):
    images = raw / "mocap-desk2-vi_gt_data/left_images"
    (images / "image_exposures_left.txt").unlink()
    recording = read(raw)
    stamps = np.loadtxt(images / "image_timestamps_left.txt").astype(np.int64)
    np.testing.assert_array_equal(frames_of(recording).times, (stamps - 5_000_000) * 1000)
    assert frames_of(recording).exposures is None
    assert list(recording.notes) == ["image_exposures_left.txt is missing, so each frame has the pose at its stamp."]


@pytest.mark.parametrize("layout", WRITERS)
def test_without_images_there_are_no_frames(raw: Path, prepared: Path, layout: str):
    shutil.rmtree(raw / "mocap-desk2-vi_gt_data/left_images")
    shutil.rmtree(prepared / "left_images_undistorted")
    recording = read({"raw": raw, "prepared": prepared}[layout])
    assert recording.frames is None and len(read_events(recording)) == 300


def test_gaps_in_the_poses_are_told(raw: Path):
    poses = raw / "mocap-desk2-vi_gt_data/mocap_data.txt"
    lines = poses.read_text().splitlines(keepends=True)
    poses.write_text("".join(lines[:31] + lines[91:]))
    assert read(raw).notes == ()
    np.testing.assert_allclose(read(raw).pose_gaps * 1e-9, [[0.242, 0.75]], atol=5e-4)


def test_mended_intrinsics_of_prepared_frames(prepared: Path):
    matrix, coefficients, size = lens(plain_calibration()[0], 0)
    balanced = cv2.fisheye.estimateNewCameraMatrixForUndistortRectify(
        matrix, coefficients, size, np.eye(3), balance=0.0
    )
    recording = read(prepared)
    np.testing.assert_allclose(frames_of(recording).camera.matrix, balanced, atol=1e-9)


def test_other_intrinsics_of_prepared_frames_stand(prepared: Path):
    content = json.loads((prepared / "calib_undist.json").read_text())
    content["value0"]["intrinsics_undistorted"][0] = {"fx": 655.0, "fy": 656.0, "cx": 501.0, "cy": 511.0}
    (prepared / "calib_undist.json").write_text(json.dumps(content))
    recording = read(prepared)
    assert frames_of(recording).camera == Camera(1024, 1024, 655.0, 656.0, 501.0, 511.0)
    assert list(recording.notes) == []


def test_the_intrinsics_of_prepared_frames_stand_where_the_lens_is_not_known(prepared: Path):
    content = json.loads((prepared / "calib_undist.json").read_text())["value0"]
    (prepared / "calibration.json").unlink()
    known = {name: content[name] for name in ("intrinsics_undistorted", "T_imu_cam")}
    (prepared / "calib_undist.json").write_text(json.dumps({"value0": known}))
    recording = read(prepared)
    assert frames_of(recording).camera == Camera(1024, 1024, **content["intrinsics_undistorted"][0])
    assert list(recording.notes) == []


def edit_json(name: str, change: Callable[[dict], object]) -> Callable[[Path], None]:
    """Changes the object value0 of a calibration."""

    def edit(folder: Path) -> None:
        content = json.loads((folder / name).read_text())
        change(content["value0"])
        (folder / name).write_text(json.dumps(content))

    return edit


def put(*keys: str | int, value: object) -> Callable[[dict], None]:
    """Sets what lies under a path of keys."""

    def change(content: dict) -> None:
        for key in keys[:-1]:
            content = content[key]  # type: ignore[index]
        content[keys[-1]] = value  # type: ignore[index]

    return change


def write(name: str, content: str) -> Callable[[Path], object]:
    return lambda folder: (folder / name).write_text(content)


def remove(name: str) -> Callable[[Path], None]:
    return lambda folder: (folder / name).unlink()


def rename(name: str, new: str) -> Callable[[Path], object]:
    return lambda folder: (folder / name).rename(folder / new)


def duplicate(name: str, new: str) -> Callable[[Path], object]:
    return lambda folder: shutil.copy(folder / name, folder / new)


def both(*steps: Callable[[Path], object]) -> Callable[[Path], None]:
    def edit(folder: Path) -> None:
        for step in steps:
            step(folder)

    return edit


def scale_times(name: str, factor: float) -> Callable[[Path], None]:
    """Multiplies the first column of a table."""

    def edit(folder: Path) -> None:
        rows = [line.split() for line in (folder / name).read_text().splitlines() if not line.startswith("#")]
        lines = (" ".join([f"{float(first) * factor:.12f}", *others]) for first, *others in rows)
        (folder / name).write_text("\n".join(lines) + "\n")

    return edit


def resize(name: str) -> Callable[[Path], object]:
    return lambda folder: cv2.imwrite(str(folder / name), np.zeros((512, 512), np.uint8))


def new_map(shape: tuple[int, ...]) -> Callable[[Path], None]:
    def edit(folder: Path) -> None:
        with h5py.File(folder / "rectify_map_left.h5", "w") as file:
            file["rectify_map"] = np.zeros(shape, np.float32)

    return edit


DATA = "mocap-desk2-vi_gt_data"
STAMPS = f"{DATA}/left_images/image_timestamps_left.txt"
EXPOSURES_FILE = f"{DATA}/left_images/image_exposures_left.txt"
CAMERAS, MARKER = "camera-calibrationA.json", "mocap-imu-calibrationA.json"
PREPARED_MARKER = "mocap-imu-calib.json"

BAD_RAW = {
    "no events": (remove("mocap-desk2-events_left.h5"), "no *events_left.h5", "left camera"),
    "two files of events": (
        duplicate("mocap-desk2-events_left.h5", "b-events_left.h5"),
        "2 files",
        "b-events_left.h5 and mocap-desk2-events_left.h5",
    ),
    "events that are no HDF5": (write("mocap-desk2-events_left.h5", "no events"), "mocap-desk2-events_left.h5"),
    "two folders of data": (
        both(rename(DATA, "a-vi_gt_data"), lambda folder: (folder / "b-vi_gt_data").mkdir()),
        "2 folders",
        "mocap-desk2-vi_gt_data",
    ),
    "no poses": (remove(f"{DATA}/mocap_data.txt"), DATA, "*mocap*.txt", "t_us px py pz qx qy qz qw"),
    "poses in seconds": (scale_times(f"{DATA}/mocap_data.txt", 1e-6), "mocap_data.txt", "microseconds"),
    "a quaternion off norm in the poses": (
        write(f"{DATA}/mocap_data.txt", "0 0 0 0 0 0 0 1\n8333 0 0 0 0 0 0 2\n"),
        "mocap_data.txt, line 2",
        "norm 2",
    ),
    "no calibration of a known sequence": (remove(CAMERAS), CAMERAS, "mocap-desk2", "published with the data set"),
    "no calibration of the markers": (remove(MARKER), MARKER, "mocap-desk2", "published with the data set"),
    "the other calibration": (
        both(rename(CAMERAS, "camera-calibrationB.json"), rename(MARKER, "mocap-imu-calibrationB.json")),
        CAMERAS,
        "missing",
    ),
    "A is of no use to a sequence of B": (
        rename("mocap-desk2-events_left.h5", "mocap-6dof-events_left.h5"),
        "camera-calibrationB.json",
        "mocap-6dof",
    ),
    "no calibration at all": (
        both(remove(CAMERAS), remove(MARKER), rename("mocap-desk2-events_left.h5", "events_left.h5")),
        "neither camera-calibrationA.json nor camera-calibrationB.json",
    ),
    "two calibrations and an unknown sequence": (
        both(
            duplicate(CAMERAS, "camera-calibrationB.json"),
            duplicate(MARKER, "mocap-imu-calibrationB.json"),
            rename("mocap-desk2-events_left.h5", "kitchen-events_left.h5"),
        ),
        "'kitchen'",
        "<sequence>-events_left.h5",
    ),
    "broken JSON": (write(CAMERAS, '{"value0": {'), CAMERAS, "JSON"),
    "JSON nested too deeply": (write(CAMERAS, "[" * 100_000), CAMERAS, "JSON"),
    "JSON of something else": (write(MARKER, "[1, 2]"), MARKER, "holds a list"),
    "bytes that are no text": (lambda folder: (folder / CAMERAS).write_bytes(b"\xff\xfe\x00\x81"), CAMERAS, "JSON"),
    "too few cameras": (
        edit_json(CAMERAS, lambda value: value.update(intrinsics=value["intrinsics"][:2])),
        CAMERAS,
        "value0.intrinsics = [",
        "but a list of 4 was expected",
    ),
    "too few extrinsics": (
        edit_json(CAMERAS, lambda value: value.update(T_imu_cam=value["T_imu_cam"][:1])),
        CAMERAS,
        "value0.T_imu_cam = [",
    ),
    "another camera model": (
        edit_json(CAMERAS, put("intrinsics", 2, "camera_type", value="ds")),
        CAMERAS,
        '"ds"',
        "kb4",
    ),
    "a missing focal length": (
        edit_json(CAMERAS, lambda value: value["intrinsics"][2]["intrinsics"].pop("fx")),
        CAMERAS,
        "lacks value0.intrinsics[2].intrinsics.fx",
    ),
    "a focal length of zero": (
        edit_json(CAMERAS, put("intrinsics", 2, "intrinsics", "fx", value=0)),
        CAMERAS,
        "above 0",
    ),
    "a parameter that is no number": (
        edit_json(CAMERAS, put("intrinsics", 0, "intrinsics", "k1", value="wide")),
        CAMERAS,
        'k1 = "wide"',
    ),
    "a parameter that is a truth value": (
        edit_json(CAMERAS, put("intrinsics", 0, "intrinsics", "k1", value=True)),
        CAMERAS,
        "k1 = true",
    ),
    "a parameter that is not finite": (
        edit_json(CAMERAS, put("intrinsics", 0, "intrinsics", "cx", value=float("nan"))),
        CAMERAS,
        "cx = NaN",
    ),
    "a lens that cannot be": (
        edit_json(CAMERAS, put("intrinsics", 2, "intrinsics", "k1", value=-9.0)),
        CAMERAS,
        "intrinsics[2]",
        "no inverse",
    ),
    "a sensor of another resolution": (
        edit_json(CAMERAS, put("resolution", 2, value=[640, 480])),
        CAMERAS,
        "640 x 480",
        "1280 x 720",
    ),
    "no resolution": (edit_json(CAMERAS, lambda value: value.pop("resolution")), CAMERAS, "lacks value0.resolution"),
    "images of another resolution": (resize(f"{DATA}/left_images/00001.jpg"), "00001.jpg", "512 x 512"),
    "a calibration of other images": (
        edit_json(CAMERAS, put("resolution", 0, value=[512, 512])),
        "00000.jpg",
        "512 x 512 of its camera",
    ),
    "an image that is none": (write(f"{DATA}/left_images/00001.jpg", "no image"), "00001.jpg", "image"),
    "an extrinsic that is no rotation": (
        edit_json(CAMERAS, put("T_imu_cam", 2, "qw", value=1.5)),
        CAMERAS,
        "T_imu_cam[2]",
        "norm",
    ),
    "a marker that is no rotation": (edit_json(MARKER, put("T_imu_marker", "qw", value=0)), MARKER, "norm 0.6"),
    "no T_imu_marker": (edit_json(MARKER, lambda value: value.pop("T_imu_marker")), MARKER, "no T_imu_marker"),
    "images without stamps": (remove(STAMPS), "image_timestamps_left.txt", "missing"),
    "stamps without images": (
        both(*(remove(f"{DATA}/left_images/{i:05d}.jpg") for i in range(3))),
        "0 images",
        "3 stamps",
    ),
    "an image too few": (remove(f"{DATA}/left_images/00001.jpg"), "2 images", "3 stamps"),
    "stamps in seconds": (scale_times(STAMPS, 1e-6), "image_timestamps_left.txt", "microseconds"),
    "stamps in nanoseconds": (
        scale_times(STAMPS, 1e3),
        "image_timestamps_left.txt",
        "microseconds",
    ),
    "an exposure too few": (write(EXPOSURES_FILE, "1000\n1000\n"), "image_exposures_left.txt", "2 exposures"),
    "exposures in nanoseconds": (scale_times(EXPOSURES_FILE, 1e3), "image_exposures_left.txt", "microseconds"),
    "exposures in seconds": (scale_times(EXPOSURES_FILE, 1e-6), "image_exposures_left.txt", "microseconds"),
    "a negative exposure": (write(EXPOSURES_FILE, "1000\n-1000\n1000\n"), "image_exposures_left.txt", "-1000"),
    "an exposure that is no number": (
        write(EXPOSURES_FILE, "1000\nauto\n1000\n"),
        "image_exposures_left.txt, line 2",
        "'auto'",
    ),
}

BAD_PREPARED = {
    "no calib_undist.json": (remove("calib_undist.json"), "calib_undist.json", "missing"),
    "no map": (remove("rectify_map_left.h5"), "*rectify_map_left.h5"),
    "a map of another sensor": (new_map((480, 640, 2)), "rectify_map_left.h5", "(480, 640, 2)", "(720, 1280, 2)"),
    "a map of nothing": (new_map((720, 1280, 2)), "rectify_map_left.h5", "increase"),
    "a map that is cut off": (
        lambda folder: (folder / "rectify_map_left.h5").write_bytes(
            (folder / "rectify_map_left.h5").read_bytes()[:-5000]
        ),
        "rectify_map_left.h5",
    ),
    "no undistorted intrinsics": (
        edit_json("calib_undist.json", lambda value: value.pop("intrinsics_undistorted")),
        "calib_undist.json",
        "lacks value0.intrinsics_undistorted",
    ),
    "a calibration of another sensor": (
        edit_json("calibration.json", put("resolution", 2, value=[640, 480])),
        "calibration.json",
        "640 x 480",
        "1280 x 720",
    ),
    "a principal point outside the sensor": (
        edit_json("calib_undist.json", put("intrinsics_undistorted", 2, "cy", value=760.0)),
        "calib_undist.json",
        "760",
        "1280 x 720",
    ),
    "images of another resolution": (resize("left_images_undistorted/00002.png"), "00002.png", "512 x 512"),
    "the wrong file that the README names": (
        duplicate("calibration.json", PREPARED_MARKER),
        PREPARED_MARKER,
        "no calibration of the markers",
        "T_imu_marker",
        "mocap-imu-calibrationA.json",
    ),
    "no calibration of the markers": (remove(PREPARED_MARKER), PREPARED_MARKER, "mocap-imu-calibrationA.json"),
}


def digest(folder: Path) -> dict[str, str]:
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {str(path): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def check_message(folder: Path, break_it: Callable[[Path], object], expected: tuple[str, ...]) -> None:
    break_it(folder)
    before = digest(folder)
    with pytest.raises(RecordingError) as caught:
        read(folder)
    message = str(caught.value)
    assert all(text in message for text in expected), message
    assert message.endswith(".") and "\n" not in message and not re.search(r"[a-z]\. [A-Z]", message), message
    assert str(folder) in message
    assert digest(folder) == before


@pytest.mark.parametrize("name", BAD_RAW)
def test_bad_raw_input(raw: Path, name: str):
    break_it, *expected = BAD_RAW[name]
    check_message(raw, break_it, tuple(expected))


@pytest.mark.parametrize("name", BAD_PREPARED)
def test_bad_prepared_input(prepared: Path, name: str):
    break_it, *expected = BAD_PREPARED[name]
    check_message(prepared, break_it, tuple(expected))


def test_events_of_the_other_side_are_missing(raw: Path):
    with pytest.raises(RecordingError, match=r"no \*events_right\.h5; a file of events of the right camera"):
        read(raw, "right")
