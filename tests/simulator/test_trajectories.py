"""The simulated camera's motions, against closed forms, SciPy and OpenCV."""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from recordings import POSE_TIMES, poses, write_esim
from scipy.interpolate import PchipInterpolator
from scipy.spatial.transform import Rotation, Slerp

from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.dataparsers.recording.errors import RecordingError
from enerf_ns.dataparsers.recording.trajectory import Trajectory
from enerf_ns.simulator.scene.render import Renderer
from enerf_ns.simulator.scene.scenes import SCENES
from enerf_ns.simulator.trajectories import MOTIONS, from_file, key_frames, look_at, sampled, shake, spiral

KEY_FRAMES = np.array(
    [
        # t_s, x, y, z, tx, ty, tz
        [2.5, 0.0, 0.0, 1.0, 0.0, 2.0, 0.0],
        [2.75, 0.5, -0.25, 1.2, 0.1, 2.0, 0.1],
        [3.125, 0.5, 0.5, 0.8, -0.3, 2.5, 0.0],
        [3.5, -0.25, 0.25, 1.5, 0.0, 2.0, -0.2],
    ]
)
CAMERA, TARGET = np.array([0.3, -1.0, 0.5]), np.array([0.1, 1.5, -0.2])


def write_table(path: Path, rows: np.ndarray) -> Path:
    path.write_text("# comment\n" + "".join(" ".join(map(repr, row)) + "\n" for row in rows.tolist()))
    return path


def matrices(trajectory: Trajectory, times: np.ndarray) -> np.ndarray:
    return trajectory.poses(torch.from_numpy(np.asarray(times, np.int64))).numpy()


def pixel_of(point: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Pixel at which a camera with focal length 100 and principal point (50, 40) sees a point."""
    rotation = cv2.Rodrigues(np.ascontiguousarray(pose[:, :3].T))[0]
    matrix = np.array([[100.0, 0, 50], [0, 100, 40], [0, 0, 1]])
    return cv2.projectPoints(point[None], rotation, -pose[:, :3].T @ pose[:, 3], matrix, np.zeros(4))[0].ravel()


def test_key_frames_are_passed_at_their_times_with_the_target_in_the_centre(tmp_path: Path):
    trajectory = key_frames(write_table(tmp_path / "keys.txt", KEY_FRAMES))
    assert (trajectory.start, trajectory.end) == (0, 10**9)
    for key, pose in zip(KEY_FRAMES, matrices(trajectory, (KEY_FRAMES[:, 0] - 2.5) * 1e9), strict=True):
        np.testing.assert_allclose(pose[:, 3], key[1:4], atol=1e-9)
        np.testing.assert_allclose(pixel_of(key[4:], pose), [50, 40], atol=1e-6)
        assert abs(pose[2, 0]) < 1e-9 and pose[2, 1] < 0, "x is level and y points down"


def test_between_key_frames_place_and_target_follow_pchip(tmp_path: Path):
    trajectory = key_frames(write_table(tmp_path / "keys.txt", KEY_FRAMES))
    curve = PchipInterpolator(KEY_FRAMES[:, 0] - 2.5, KEY_FRAMES[:, 1:])
    times = np.linspace(0, 10**9, 777).astype(np.int64)
    for place, pose in zip(curve(times * 1e-9), matrices(trajectory, times), strict=True):
        np.testing.assert_allclose(pose[:, 3], place[:3], atol=1e-6)
        np.testing.assert_allclose(pixel_of(place[3:], pose), [50, 40], atol=1e-3)
    assert np.diff(trajectory.times).max() <= 10**6


def test_two_key_frames_less_than_two_milliseconds_apart_make_a_line(tmp_path: Path):
    rows = KEY_FRAMES[:2].copy()
    rows[1, 0] = rows[0, 0] + 0.0015
    trajectory = key_frames(write_table(tmp_path / "keys.txt", rows))
    halfway = matrices(trajectory, np.array([750_000]))[0]
    np.testing.assert_allclose(halfway[:, 3], rows[:, 1:4].mean(0), atol=1e-12)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda rows: rows[:1], "holds one key frame"),
        (lambda rows: rows[[0, 2, 1]], "line 4 has the time 2.75 s, which is not after"),
        (lambda rows: rows[:, :6], "has 6 columns, but 7 were expected"),
        (lambda rows: rows * [1e5, 1, 1, 1, 1, 1, 1], "lasts 100000 s, .* must be in seconds"),
        (lambda rows: rows * [1e-6, 1, 1, 1, 1, 1, 1], "lasts 1e-06 s"),
        (lambda rows: rows * [1, 1, 1, 1, 1, 1e10, 1], r"line 2 holds a place beyond 1e\+09 m"),
        (lambda rows: rows * [1e18, 1, 1, 1, 1, 1, 1], "beyond 146 years"),
        (lambda rows: np.column_stack([rows[:, :4], rows[:, 1:4]]), "0.000 s after its beginning .* at its target"),
        (lambda rows: np.column_stack([rows[:, :6], rows[:, 3] + 1]) * [1, 0, 0, 1, 0, 0, 1], "straight up or down"),
    ],
)
def test_key_frames_that_make_no_flight_are_refused(tmp_path: Path, change, message: str):
    with pytest.raises(RecordingError, match=message) as refused:
        key_frames(write_table(tmp_path / "keys.txt", change(KEY_FRAMES)))
    assert str(refused.value).startswith(str(tmp_path / "keys.txt")) and "\n" not in str(refused.value)


def test_a_flight_over_the_vertical_between_two_poses_is_refused(tmp_path: Path):
    rows = np.array([[0, -50.3, 0, 2, 0, 0.003, 0], [1, 50, 0, 2, 0, 0.003, 0]])
    with pytest.raises(RecordingError, match=r"0\.501 s after its beginning the camera looks straight up or down"):
        key_frames(write_table(tmp_path / "keys.txt", rows))


def test_a_flight_through_the_target_between_two_poses_is_refused(tmp_path: Path):
    rows = np.array([[0, -50, 0, 1, 0, 0, 1], [1.001, 50.3, 0, 1, 0, 0, 1]])
    with pytest.raises(RecordingError, match="the camera is at its target; move one of them"):
        key_frames(write_table(tmp_path / "keys.txt", rows))


@pytest.mark.parametrize("content", [None, b"", b"\xff\xfe\x00\x00", b"{}", b"nan 0 0 0 1 1 1\n1 0 0 0 1 1 1\n"])
@pytest.mark.parametrize("read", [key_frames, lambda path: from_file(path, [])])
def test_files_that_are_no_table_are_refused(tmp_path: Path, content: bytes | None, read):
    path = tmp_path / "poses.txt"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(RecordingError, match=r"poses\.txt") as refused:
        read(path)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(("unit", "size"), [("s", 1), ("us", 10**6), ("ns", 10**9)])
def test_a_pose_file_begins_at_zero_and_is_slerped(tmp_path: Path, unit: str, size: int):
    rows = np.column_stack([(POSE_TIMES / 10**9 + 12.5) * size, poses()])
    trajectory = from_file(write_table(tmp_path / "poses.txt", rows), notes := [], unit)
    assert (trajectory.start, trajectory.end) == (0, 10**9) and not notes
    times = np.linspace(0, 10**9, 101).astype(np.int64)
    expected = Slerp(POSE_TIMES, Rotation.from_quat(poses()[:, 3:]))(times).as_matrix()
    np.testing.assert_allclose(matrices(trajectory, times)[:, :, :3], expected, atol=1e-9)


def test_a_pose_file_in_another_unit_than_said_is_refused(tmp_path: Path):
    rows = np.column_stack([POSE_TIMES / 1000, poses()])
    with pytest.raises(RecordingError, match=r"lasts 1e\+06 s, .* its times were taken to be in s\."):
        from_file(write_table(tmp_path / "poses.txt", rows), [])
    with pytest.raises(RecordingError, match=r"lasts 1e-06 s, .* its times were taken to be in ns\."):
        from_file(write_table(tmp_path / "poses.txt", rows / [1000, *[1] * 7]), [], "ns")


def test_quaternions_that_are_renormalised_are_noted(tmp_path: Path):
    rows = np.column_stack([POSE_TIMES * 1e-9, poses() * [1, 1, 1, *[1.0001] * 4]])
    from_file(write_table(tmp_path / "poses.txt", rows), notes := [])
    assert len(notes) == 1 and "renormalised" in notes[0]


def test_the_trajectory_of_a_recording_begins_at_zero(tmp_path: Path):
    folder = write_esim(tmp_path / "recording")
    file = folder / "0_poses_all.txt"
    rows = np.column_stack([POSE_TIMES + 50_000_000, poses()])
    file.write_text("".join(f"{int(row[0])} {' '.join(map(repr, row[1:].tolist()))}\n" for row in rows))
    trajectory = from_file(folder, [])
    np.testing.assert_array_equal(trajectory.times, POSE_TIMES)
    np.testing.assert_allclose(trajectory.positions, poses()[:, :3], atol=1e-12)


def test_a_folder_that_is_no_recording_is_refused(tmp_path: Path):
    with pytest.raises(RecordingError, match="no known format"):
        from_file(tmp_path, [])


def test_look_at_is_the_same_for_one_camera_and_many():
    cameras = np.random.default_rng(0).normal(size=(5, 3))
    together = look_at(cameras, TARGET).as_matrix()
    for camera, matrix in zip(cameras, together, strict=True):
        np.testing.assert_allclose(look_at(camera, TARGET).as_matrix(), matrix, atol=1e-12)
        np.testing.assert_allclose(pixel_of(TARGET, np.column_stack([matrix, camera])), [50, 40], atol=1e-9)


def test_the_spiral_goes_inwards_about_the_line_to_the_target_and_looks_at_it():
    trajectory = spiral(10**9, CAMERA, TARGET, np.random.default_rng(0), turns_per_second=4)
    axis = (TARGET - CAMERA) / np.linalg.norm(TARGET - CAMERA)
    offsets = trajectory.positions - CAMERA
    radius = np.linalg.norm(offsets, axis=1)
    np.testing.assert_allclose(offsets @ axis, 0, atol=1e-12)
    np.testing.assert_allclose(radius, np.linspace(0.5, 0.1, len(radius)), atol=1e-9)
    steps = np.einsum("ij,ij->i", offsets[:-1], offsets[1:]) / radius[:-1] / radius[1:]
    np.testing.assert_allclose(np.arccos(steps.clip(-1, 1)).sum(), 4 * 2 * math.pi, rtol=1e-6)
    for pose in matrices(trajectory, trajectory.times[::100]):
        np.testing.assert_allclose(pixel_of(TARGET, pose), [50, 40], atol=1e-6)


def test_shake_turns_as_often_as_asked():
    trajectory = shake(4 * 10**9, CAMERA, TARGET, np.random.default_rng(0), turns_per_second=5)
    sideways = (trajectory.positions - CAMERA) @ look_at(CAMERA, TARGET).as_matrix()[:, 0]
    velocity = np.diff(sideways)
    turns = np.flatnonzero(np.sign(velocity[1:]) != np.sign(velocity[:-1])) + 1
    at_knots = np.abs(trajectory.times[turns] * 1e-9 * 5 - np.round(trajectory.times[turns] * 1e-9 * 5)) < 0.02
    assert len(turns) > 5 and at_knots.all(), "PCHIP turns nowhere but at its knots"


def test_shake_moves_sideways_and_in_height_and_keeps_looking_at_the_target():
    camera, target = np.array([0.0, 0, 0]), np.array([0.0, 2, 0])
    trajectory = MOTIONS["shake"](3 * 10**9, camera, target, np.random.default_rng(0))
    extent = np.ptp(trajectory.positions, axis=0)
    assert (extent[[0, 2]] > 0.4).all() and (extent <= 0.6).all()
    forward = Rotation.from_quat(trajectory.quaternions).apply([0, 0, 1])
    assert forward[:, 1].min() > math.cos(math.radians(15))


def test_look_at_is_upright_with_opencv_axes():
    rotation = look_at(np.array([1.0, 2, 3]), np.array([1.0, 5, 3])).as_matrix()
    np.testing.assert_allclose(rotation, [[1, 0, 0], [0, 0, 1], [0, -1, 0]], atol=1e-12)


def test_poses_of_tum_vie_are_as_many_as_those_of_its_motion_capture():
    trajectory = MOTIONS["shake"](123_456_789, np.zeros(3), np.array([0.0, 2, 0]), np.random.default_rng(0))
    found = sampled(trajectory, 120)
    assert abs(1e9 / np.median(np.diff(found.times)) - 120) < 1 and (np.diff(found.times) > 4_000_000).all()
    assert (found.start, found.end) == (0, 123_456_789) and (found.times[:-1] % 1000 == 0).all()
    times = torch.from_numpy(found.times)
    torch.testing.assert_close(found.poses(times), trajectory.poses(times), atol=1e-9, rtol=0)
    assert sampled(found, 120) is found


def test_the_shortest_trajectories_have_poses_enough():
    trajectory = MOTIONS["shake"](4_000_000, np.zeros(3), np.array([0.0, 2, 0]), np.random.default_rng(0))
    assert sampled(trajectory, 120).times.tolist() == [0, 4_000_000]


@pytest.mark.sweep(3)
@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize("motion", MOTIONS)
def test_every_ray_of_every_motion_hits_something(scene, motion):
    made = SCENES[scene](np.random.default_rng(0))
    renderer = Renderer(made, Camera(48, 36, 41.6, 41.6, 24.0, 18.0))
    trajectory = MOTIONS[motion](2 * 10**9, made.camera, made.target, np.random.default_rng(1))
    poses = trajectory.poses(torch.linspace(0, 2e9, 40).long()).numpy()
    assert min(renderer.depth(pose).min() for pose in poses) > 0.3
