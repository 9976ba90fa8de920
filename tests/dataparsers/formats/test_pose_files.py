"""Poses in the formats of trackers, written here by their documents: by hand, with SciPy, and with rosbags' writers."""

from __future__ import annotations

import json
import shutil
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import test_dsec
import test_m3ed
import torch
from recordings import FRAME_TIMES, POSE_TIMES, write_davis, write_esim
from scipy.spatial.transform import Rotation, Slerp
from test_bad_input import is_one_sentence
from test_event_recording import CAMERA, write_recording

from enerf_ns.dataparsers.formats.pose_files import GivenPoses, NamedFrames, PoseFlags
from enerf_ns.dataparsers.formats.registry import read_recording
from enerf_ns.dataparsers.recording.errors import FlagError, RecordingError, UserError

TIMES = 1_700_000_000_000_000_000 + 12_345_678 * np.arange(5)
NAMES = [f"frame {i}.png" for i in (3, 0, 1, 4, 2)]
MATRICES = np.tile(np.eye(4), (5, 1, 1))
MATRICES[:, :3, :3] = Rotation.random(5, np.random.default_rng(1)).as_matrix()
MATRICES[:, :3, 3] = np.random.default_rng(2).normal(size=(5, 3))
"""Poses of the event camera: camera to world, OpenCV axes, metres."""

MOUNT = np.eye(4)
MOUNT[:3, :3], MOUNT[:3, 3] = Rotation.from_euler("xyz", [0.4, -1.2, 2.0]).as_matrix(), [0.05, -0.02, 0.1]
"""Pose of the event camera in the axes of a tracked body."""


def rows_of(matrices: np.ndarray, order: str = "xyzw") -> np.ndarray:
    """px py pz and a quaternion in this order."""
    turns = Rotation.from_matrix(matrices[:, :3, :3]).as_quat()
    return np.column_stack([matrices[:, :3, 3], turns if order == "xyzw" else turns[:, [3, 0, 1, 2]]])


def decimal(times: np.ndarray, unit: str) -> list[str]:
    digits = {"s": 9, "ms": 6, "us": 3, "ns": 0}[unit]
    return [f"{t // 10**digits}.{t % 10**digits:0{digits}d}" if digits else str(t) for t in times.tolist()]


def lines(times: np.ndarray, rows: np.ndarray, unit: str = "s", separator: str = " ") -> str:
    pairs = zip(decimal(times, unit), rows.tolist(), strict=True)
    return "".join(separator.join([time, *map(repr, row)]) + "\n" for time, row in pairs)


def named(frame_times: dict[str, int]) -> list[NamedFrames]:
    return [NamedFrames([*map(Path, frame_times)], np.array([*frame_times.values()], np.int64))]


def read(
    path: Path, frame_times: dict[str, int] | None = None, **flags: Any
) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Times, matrices and notes."""
    notes: list[str] = []
    times, positions, quaternions = GivenPoses(path, PoseFlags(**flags)).rows(named(frame_times or {}), notes)
    matrices = np.tile(np.eye(4), (len(times), 1, 1))
    matrices[:, :3, :3], matrices[:, :3, 3] = Rotation.from_quat(quaternions).as_matrix(), positions
    return times, matrices, notes


def same(found: tuple[np.ndarray, np.ndarray, list[str]], times: np.ndarray = TIMES, matrices: np.ndarray = MATRICES):
    np.testing.assert_array_equal(found[0], times)
    np.testing.assert_allclose(found[1], matrices, atol=1e-9)


@pytest.mark.parametrize("unit", ["s", "ms", "us", "ns"])
def test_text_of_tum(tmp_path: Path, unit: str):
    (tmp_path / "poses.txt").write_text("# t px py pz qx qy qz qw\n" + lines(TIMES, rows_of(MATRICES), unit))
    same(read(tmp_path / "poses.txt", None, **({} if unit == "s" else {"poses_unit": unit})))


@pytest.mark.parametrize(
    ("header", "order", "further"),
    [
        ("#timestamp,p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z [],v", "wxyz", 9),
        ("timestamp,tx,ty,tz,qx,qy,qz,qw", "xyzw", 0),
        ("", "wxyz", 0),
    ],
)
def test_csv_of_euroc(tmp_path: Path, header: str, order: str, further: int):
    rows = np.column_stack([rows_of(MATRICES, order), np.ones((5, further))])
    (tmp_path / "data.csv").write_text(header + "\n" * bool(header) + lines(TIMES, rows, "ns", ","))
    same(read(tmp_path / "data.csv"))
    (tmp_path / "data.csv").rename(tmp_path / "data.txt")  # commas show what it is
    same(read(tmp_path / "data.txt"))


def write_colmap(folder: Path, kind: str, matrices: np.ndarray = MATRICES) -> Path:
    """As colmap.github.io/format.html describes it: world to camera, and points of each image, which are none here."""
    folder.mkdir()
    rows = rows_of(np.linalg.inv(matrices), "wxyz")[:, [3, 4, 5, 6, 0, 1, 2]]
    if kind == "text":
        text = "# Image list with two lines of data per image:\n#   IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, "
        text += "NAME\n#   POINTS2D[] as (X, Y, POINT3D_ID)\n"
        for number, (name, row) in enumerate(zip(NAMES, rows.tolist(), strict=True)):
            points = "" if number % 2 else "1.5 2.5 -1 3.5 4.5 7"
            text += f"{number + 1} {' '.join(map(repr, row))} 1 {name}\n{points}\n"
        (folder / "images.txt").write_text(text)
    else:
        content = struct.pack("<Q", len(NAMES))
        for number, (name, row) in enumerate(zip(NAMES, rows.tolist(), strict=True)):
            content += struct.pack("<i7di", number + 1, *row, 1) + name.encode() + b"\0" + struct.pack("<Q", number)
            content += b"".join(struct.pack("<2dq", 1.5, 2.5, -1) for _ in range(number))
        (folder / "images.bin").write_bytes(content)
    return folder


@pytest.mark.parametrize("kind", ["text", "binary"])
def test_models_of_colmap_are_in_the_order_of_their_images(tmp_path: Path, kind: str):
    folder = write_colmap(tmp_path / "0", kind)
    order = np.argsort(NAMES)
    same(read(folder, dict(zip(NAMES, TIMES[np.argsort(order)].tolist(), strict=True))), TIMES, MATRICES[order])


def test_points_of_images_may_be_many(tmp_path: Path):
    """A model of COLMAP has tens of megabytes of points, which are passed over."""
    file = write_colmap(tmp_path / "0", "text") / "images.txt"
    file.write_text(file.read_text().replace("1.5 2.5 -1 3.5 4.5 7\n", "1.5 2.5 -1 " * 600_000 + "\n"))
    assert file.stat().st_size > 2**24
    order = np.argsort(NAMES)
    times = dict(zip(NAMES, TIMES[np.argsort(order)].tolist(), strict=True))
    same(read(file.parent, times), TIMES, MATRICES[order])


@pytest.mark.parametrize(("count", "said"), [(2**62, "images"), (2, "does not end within 4,096 letters")])
def test_a_model_without_end_is_refused(tmp_path: Path, count: int, said: str):
    """A sparse file of gigabytes takes no memory."""
    file = write_colmap(tmp_path / "0", "binary") / "images.bin"
    with file.open("wb") as opened:
        opened.write(struct.pack("<Q", count) + struct.pack("<i7di", 1, *range(1, 8), 1) + b"a" * 5000)
        opened.truncate(6 * 2**30)
    with pytest.raises(RecordingError, match=f"images.bin.*{said}"):
        read(file.parent, {})


@pytest.mark.parametrize("suffix", [".png", ""])
def test_transforms_of_nerfstudio(tmp_path: Path, suffix: str):
    """Some programs leave out the suffix of the images."""
    opengl = MATRICES @ np.diag([1.0, -1.0, -1.0, 1.0])
    frames = [
        {"file_path": f"images/{name.removesuffix('.png')}{suffix}", "transform_matrix": matrix.tolist()}
        for name, matrix in zip(NAMES, opengl, strict=True)
    ]
    (tmp_path / "transforms.json").write_text(json.dumps({"fl_x": 1.0, "frames": frames}))
    same(read(tmp_path / "transforms.json", dict(zip(NAMES, TIMES.tolist(), strict=True))))


@pytest.mark.parametrize("unit", ["s", "us"])
def test_times_of_images_in_a_table(tmp_path: Path, unit: str):
    """Images without a time are left out."""
    rows = zip(decimal(TIMES[:4], unit), NAMES, strict=False)
    (tmp_path / "times.txt").write_text("".join(f"{time} images/{name.replace(' ', '_')}\n" for time, name in rows))
    folder = write_colmap(tmp_path / "0", "text")
    (folder / "images.txt").write_text((folder / "images.txt").read_text().replace("frame ", "frame_"))
    found = read(folder, poses_times=tmp_path / "times.txt", poses_unit=unit)
    same(found, TIMES[:4], MATRICES[:4])
    assert found[2] == ["1 of 5 poses in 0 are left out, because their image has no time."]


# ------------------------------------------------------------------------------------------------------- conventions


ROS = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
"""Columns: forward, left and up, in OpenCV's axes."""


@pytest.mark.parametrize(
    ("flags", "written"),
    [
        ({"poses_direction": "world-to-camera"}, np.linalg.inv),
        ({"poses_axes": "opengl"}, lambda camera: camera @ np.diag([1.0, -1.0, -1.0, 1.0])),
        ({"poses_axes": "ros"}, lambda camera: camera @ np.block([[ROS, np.zeros((3, 1))], [np.zeros((1, 3)), 1.0]])),
        ({"poses_scale": 1e-3}, lambda camera: camera * np.where(np.arange(4) == 3, [[1e3]] * 3 + [[1]], 1.0)),
        (
            {"poses_direction": "world-to-camera", "poses_axes": "opengl", "poses_scale": 0.5},
            lambda camera: np.linalg.inv(
                camera @ np.diag([1.0, -1.0, -1.0, 1.0]) * np.where(np.arange(4) == 3, [[2.0]] * 3 + [[1]], 1.0)
            ),
        ),
    ],
)
def test_flags_state_conventions(tmp_path: Path, flags: dict[str, Any], written: Callable[[np.ndarray], np.ndarray]):
    (tmp_path / "poses.txt").write_text(lines(TIMES, rows_of(written(MATRICES))))
    same(read(tmp_path / "poses.txt", **flags))


def test_the_order_of_quaternions_and_a_delay(tmp_path: Path):
    (tmp_path / "poses.txt").write_text(lines(TIMES + 7_500_000, rows_of(MATRICES, "wxyz")))
    same(read(tmp_path / "poses.txt", poses_quaternions="wxyz", poses_delay_ms=7.5))


@pytest.mark.parametrize("kind", ["matrix", "brackets", "3 x 4", "numbers"])
def test_a_hand_eye_transform(tmp_path: Path, kind: str):
    text = {
        "matrix": "\n".join(" ".join(map(repr, row)) for row in MOUNT.tolist()),
        "brackets": json.dumps(MOUNT.tolist()),
        "3 x 4": " ".join(map(repr, MOUNT[:3].ravel().tolist())),
        "numbers": " ".join(map(repr, rows_of(MOUNT[None])[0].tolist())),
    }[kind]
    (tmp_path / "mount.txt").write_text(text)
    body = MATRICES @ np.linalg.inv(MOUNT)
    (tmp_path / "poses.txt").write_text(lines(TIMES, rows_of(np.linalg.inv(body))))
    same(read(tmp_path / "poses.txt", poses_direction="world-to-camera", hand_eye=tmp_path / "mount.txt"))


# --------------------------------------------------------------------------------------------------------- ROS bags


def message_of(store: Any, kind: str, time: int, matrix: np.ndarray, is_ros1: bool) -> Any:
    """A message of a pose, as the definitions of ROS describe it; or a path of several poses at the first of TIMES."""
    types = SimpleNamespace(**{name.split("/")[-1]: kind for name, kind in store.types.items()})
    if matrix.ndim == 3:
        path = [
            message_of(store, "geometry_msgs/msg/PoseStamped", *pose, is_ros1)
            for pose in zip(TIMES[: len(matrix)].tolist(), matrix, strict=True)
        ]
        return types.Path(path[-1].header, path)
    stamp = store.types["builtin_interfaces/msg/Time"](sec=time // 10**9, nanosec=time % 10**9)
    header = types.Header(**({"seq": 0} if is_ros1 else {}), stamp=stamp, frame_id="world")
    px, py, pz, qx, qy, qz, qw = rows_of(matrix[None])[0].tolist()
    pose = types.Pose(types.Point(px, py, pz), types.Quaternion(qx, qy, qz, qw))
    uncertain = types.PoseWithCovariance(pose, np.zeros(36))
    zero = types.Vector3(0.0, 0.0, 0.0)
    if kind == "geometry_msgs/msg/PoseStamped":
        return types.PoseStamped(header, pose)
    if kind == "geometry_msgs/msg/PoseWithCovarianceStamped":
        return types.PoseWithCovarianceStamped(header, uncertain)
    if kind == "nav_msgs/msg/Odometry":
        still = types.TwistWithCovariance(types.Twist(zero, zero), np.zeros(36))
        return types.Odometry(header, "body", uncertain, still)
    if kind == "nav_msgs/msg/Path":
        return types.Path(header, [types.PoseStamped(header, pose)])
    moved = types.Transform(types.Vector3(px, py, pz), types.Quaternion(qx, qy, qz, qw))
    if kind == "geometry_msgs/msg/TransformStamped":
        return types.TransformStamped(header, "body", moved)
    return types.TFMessage([types.TransformStamped(header, "body", moved)])


Message = tuple[str, str, int, np.ndarray, dict[str, str]]
"""Topic, type, time, pose, and names of the frames of tf."""


def write_bag(path: Path, messages: list[Message]) -> Path:
    """Writes a bag of ROS 1 (.bag) or ROS 2 (a folder)."""
    pytest.importorskip("rosbags")
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import Writer as Writer2
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    is_ros1 = path.suffix == ".bag"
    store = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_HUMBLE)
    if is_ros1:
        store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage"))
    with Writer1(path) if is_ros1 else Writer2(path, version=9) as writer:
        connections = {}
        for topic, kind, time, matrix, frames in messages:
            message = message_of(store, kind, time, matrix, is_ros1)
            for one in getattr(message, "transforms", []):
                one.header.frame_id, one.child_frame_id = frames["parent"], frames["child"]
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=store)  # type: ignore[union-attr]
            serialize = store.serialize_ros1 if is_ros1 else store.serialize_cdr
            writer.write(connections[topic], time, serialize(message, kind))
    return path


def poses_on(
    topic: str, kind: str, matrices: np.ndarray = MATRICES, times: np.ndarray = TIMES, **frames: str
) -> list[Message]:
    return [(topic, kind, time, matrix, frames) for time, matrix in zip(times.tolist(), matrices, strict=True)]


GEOMETRY = ("PoseStamped", "PoseWithCovarianceStamped", "TransformStamped")
KINDS = [*(f"geometry_msgs/msg/{kind}" for kind in GEOMETRY), "nav_msgs/msg/Odometry", "nav_msgs/msg/Path"]


@pytest.mark.parametrize("name", ["recording.bag", "recording"])
@pytest.mark.parametrize("kind", KINDS)
def test_bags_of_poses(tmp_path: Path, name: str, kind: str):
    bag = write_bag(tmp_path / name, poses_on("/pose", kind))
    same(read(bag))
    same(read(bag, poses_topic="/pose"))


def test_the_poses_of_paths_are_those_of_the_latest(tmp_path: Path):
    """Odometry publishes its whole path anew with each pose, and corrects it. The last path lacks one."""
    drifted = MATRICES.copy()
    drifted[:, 0, 3] += 0.5
    paths = [drifted[:count] for count in range(1, len(TIMES))] + [MATRICES, MATRICES[:-1]]
    messages = [("/path", "nav_msgs/msg/Path", int(TIMES[0]) + i, path, {}) for i, path in enumerate(paths)]
    found = read(write_bag(tmp_path / "r.bag", messages))
    same(found)
    assert found[2] == []


def test_one_topic_of_several_is_chosen(tmp_path: Path):
    other = poses_on("/other", "geometry_msgs/msg/PoseStamped", MATRICES[::-1])
    bag = write_bag(tmp_path / "r.bag", [*poses_on("/odometry", "nav_msgs/msg/Odometry"), *other, *other])
    found = read(bag, poses_topic="/other")
    same(found, TIMES, MATRICES[::-1])
    assert found[2] == ["5 of 10 poses in r.bag repeat a stamp and are left out."]
    with pytest.raises(FlagError, match="2 topics with poses; give --poses-topic as one of /odometry and /other"):
        read(bag)
    with pytest.raises(FlagError, match="no poses on /none; give --poses-topic as one of"):
        read(bag, poses_topic="/none")


@pytest.mark.parametrize("name", ["recording.bag", "recording"])
def test_frames_of_tf(tmp_path: Path, name: str):
    """The map drifts slowly against odometry, the camera is fixed to the body, and the tracker is beside the map."""
    place = np.linalg.inv(MOUNT) @ MATRICES[0]
    drift = MATRICES[[1, 2]]
    kind = "tf2_msgs/msg/TFMessage"
    body = MATRICES @ np.linalg.inv(MOUNT)
    bag = write_bag(
        tmp_path / name,
        [
            *poses_on("/tf_static", kind, MOUNT[None], TIMES[:1], parent="body", child="camera"),
            *poses_on("/tf_static", kind, place[None], TIMES[:1], parent="room", child="tracker"),
            *poses_on("/tf", kind, drift, TIMES[[0, 4]], parent="room", child="/map"),
            *poses_on("/tf", kind, body, parent="/map", child="body"),
        ],
    )
    same(read(bag, poses_frames=("map", "camera")))
    same(read(bag, poses_frames=("map", "body")), TIMES, body)
    same(read(bag, poses_frames=("camera", "map")), TIMES, np.linalg.inv(MATRICES))
    drifting = np.tile(np.eye(4), (5, 1, 1))
    drifting[:, :3, :3] = Slerp([0.0, 4.0], Rotation.from_matrix(drift[:, :3, :3]))(range(5)).as_matrix()
    drifting[:, :3, 3] = np.linspace(drift[0, :3, 3], drift[1, :3, 3], 5)
    same(read(bag, poses_frames=("tracker", "camera")), TIMES, np.linalg.inv(place) @ drifting @ MATRICES)
    with pytest.raises(FlagError, match="give --poses-frames WORLD CAMERA, two frames of its tf"):
        read(bag)
    with pytest.raises(
        FlagError, match=r"second of --poses-frames is cam, but .* holds the frames body, camera, map, room"
    ):
        read(bag, poses_frames=("map", "cam"))
    with pytest.raises(RecordingError, match="holds no motion between room and tracker"):
        read(bag, poses_frames=("room", "tracker"))
    with pytest.raises(FlagError, match="leave one out"):
        read(bag, poses_frames=("map", "camera"), poses_topic="/tf")


# ------------------------------------------------------------------------------------------------------- recordings


@pytest.mark.parametrize("write", [write_davis, lambda folder: write_recording(folder, ("frames", "blurred_frames"))])
def test_a_recording_takes_poses_in_place_of_its_own(tmp_path: Path, write: Callable[[Path], Path]):
    """The frames of a recording state the times of COLMAP's images, and its own poses may be missing."""
    folder = write(tmp_path / "recording")
    (folder / ("groundtruth.txt" if write is write_davis else "poses.txt")).unlink()
    recording = read_recording(folder, poses=GivenPoses(lines_file(tmp_path)))
    np.testing.assert_array_equal(recording.trajectory.times - recording.trajectory.start, POSE_TIMES[:5])
    np.testing.assert_allclose(recording.trajectory.positions, MATRICES[:, :3, 3], atol=1e-12)
    assert recording.frames is not None and recording.frames.trajectory is recording.trajectory

    names = [file.name for file in recording.frames.files_of_recording[: len(FRAME_TIMES)]]
    colmap, matrices = colmap_of(names, tmp_path / "0")
    recording = read_recording(folder, poses=GivenPoses(colmap, PoseFlags(poses_scale=2.0)))
    np.testing.assert_array_equal(np.diff(recording.trajectory.times), np.diff(FRAME_TIMES))
    np.testing.assert_allclose(recording.trajectory.positions, 2 * matrices[:, :3, 3], atol=1e-12)


def colmap_of(frames: list[str], folder: Path) -> tuple[Path, np.ndarray]:
    """A model with a pose of each of these images, and the poses in their order, camera to world."""
    colmap = write_colmap(folder, "text")
    text = (colmap / "images.txt").read_text()
    for i, name in enumerate(frames):
        text = text.replace(f"frame {i}.png", name)
    (colmap / "images.txt").write_text(text)
    return colmap, MATRICES[[NAMES.index(f"frame {i}.png") for i in range(len(frames))]]


def two_cameras(folder: Path, *frames: str, **about: Any) -> Path:
    mounting = np.linalg.inv(MOUNT).tolist()
    return write_recording(folder, frames, frame_camera={**CAMERA, "event_camera_from_frame_camera": mounting}, **about)


TWO_CAMERAS: dict[str, tuple[Callable[[Path], Any], dict[str, Any]]] = {
    "event_recording": (lambda folder: two_cameras(folder, "frames"), {}),
    "dsec": (test_dsec.write_dsec, {}),
    "dsec, right": (test_dsec.write_dsec, {"event_camera": "right"}),
    "m3ed": (test_m3ed.write_m3ed, {}),
    "m3ed, right": (test_m3ed.write_m3ed, {"event_camera": "right"}),
}


@pytest.mark.parametrize("name", TWO_CAMERAS)
def test_poses_of_frames_are_those_of_their_camera(tmp_path: Path, name: str):
    """The event camera then keeps the place in its axes that it has with poses of its own."""
    write, options = TWO_CAMERAS[name]
    write(tmp_path / "recording")
    own = read_recording(tmp_path / "recording", **options)
    assert own.frames is not None
    names = [file.name for file in own.frames.filenames] if "m3ed" not in name else [f"{i:05d}.png" for i in range(3)]
    colmap, matrices = colmap_of(names, tmp_path / "0")
    found = read_recording(tmp_path / "recording", poses=GivenPoses(colmap, PoseFlags(poses_scale=0.5)), **options)
    assert found.frames is not None and any("second camera" in note for note in found.notes)
    times = torch.from_numpy(found.frames.times)
    poses = found.frames.trajectory.poses(times).numpy()
    matrices[:, :3, 3] *= 0.5
    np.testing.assert_allclose(poses, matrices[:, :3], atol=1e-9)
    mounts = []
    for recording in (own, found):
        assert recording.frames is not None
        at = torch.from_numpy(recording.frames.times)
        frame = np.tile(np.eye(4), (len(at), 1, 1))
        event = frame.copy()
        frame[:, :3] = recording.frames.trajectory.poses(at).numpy()
        event[:, :3] = recording.trajectory.poses(at).numpy()
        mounts.append(np.linalg.inv(frame) @ event)
    np.testing.assert_allclose(mounts[1], mounts[0], atol=1e-9)
    assert np.abs(mounts[0] - np.eye(4)).max() > 0.01


def test_a_hand_eye_transform_replaces_the_stated_mounting(tmp_path: Path):
    colmap, matrices = colmap_of([f"{i}.png" for i in range(3)], tmp_path / "0")
    (tmp_path / "mount.txt").write_text("0 0 0 0 0 0 1")
    given = GivenPoses(colmap, PoseFlags(hand_eye=tmp_path / "mount.txt"))
    recording = read_recording(two_cameras(tmp_path / "recording", "frames"), poses=given)
    np.testing.assert_allclose(recording.trajectory.positions, matrices[:, :3, 3], atol=1e-12)
    assert not any("second camera" in note for note in recording.notes)


def test_frames_of_one_name_are_not_mixed_up(tmp_path: Path):
    """Sharp and blurred frames of other times or of another camera have the same names, as they are written."""
    colmap, matrices = colmap_of([f"{i}.png" for i in range(3)], tmp_path / "0")
    both = "frames", "blurred_frames"
    folder = write_recording(tmp_path / "recording", both)
    later = FRAME_TIMES + 100_000_000
    (folder / "blurred_frames/stamps_ns.txt").write_text("".join(f"{time}\n" for time in later.tolist()))
    with pytest.raises(FlagError, match=r"holds a pose of \d\.png, but two times .*; give --poses-times FILE"):
        read_recording(folder, poses=GivenPoses(colmap))
    rows = [f"{time} {i}.png\n" for i, time in enumerate(later.tolist())]
    (tmp_path / "times.txt").write_text("".join(rows))
    given = GivenPoses(colmap, PoseFlags(poses_times=tmp_path / "times.txt", poses_unit="ns"))
    found = read_recording(folder, poses=given).trajectory
    np.testing.assert_array_equal(found.times, later)
    np.testing.assert_allclose(found.positions, matrices[:, :3, 3], atol=1e-12)

    folder = two_cameras(tmp_path / "two", *both, reconstructed_by="E2VID")
    with pytest.raises(FlagError, match=r"of this name are of two cameras; give --hand-eye FILE"):
        read_recording(folder, poses=GivenPoses(colmap))
    shutil.rmtree(folder / "frames")
    found = read_recording(folder, poses=GivenPoses(colmap)).trajectory
    np.testing.assert_allclose(found.positions, matrices[:, :3, 3], atol=1e-12)


def lines_file(folder: Path) -> Path:
    (folder / "poses.txt").write_text(lines(POSE_TIMES[:5], rows_of(MATRICES)))
    return folder / "poses.txt"


def test_other_formats_keep_their_poses(tmp_path: Path):
    with pytest.raises(FlagError, match=r"for event files and recordings of davis, .*, but .* as esim"):
        read_recording(write_esim(tmp_path / "esim"), poses=GivenPoses(lines_file(tmp_path)))


# --------------------------------------------------------------------------------------------------------- bad input


def wrong(name: str, folder: Path) -> tuple[GivenPoses, str]:
    """Poses that cannot be used, and a part of the sentence about them."""
    text = lines_file(folder)
    csv = folder / "poses.csv"
    transforms = folder / "transforms.json"
    frame = {"file_path": "frame 0.png", "transform_matrix": np.diag([2.0, 1, 1, 1]).tolist()}
    cases: dict[str, tuple[GivenPoses, str]] = {
        "missing": (GivenPoses(folder / "none"), "none is missing; poses (TUM, EuRoC, COLMAP,"),
        "empty folder": (GivenPoses(folder), "images.txt is missing"),
        "few columns": (GivenPoses(csv), "line 2 has 4 columns, but at least 8 were expected"),
        "word": (GivenPoses(csv), "line 1 holds 'x' where a finite number was expected"),
        "norm": (GivenPoses(csv), "line 2, holds a quaternion of norm 2"),
        "one row": (GivenPoses(csv), "holds 1 poses, but at least 2 were expected"),
        "no rotation": (
            GivenPoses(transforms),
            "frames[0].transform_matrix whose upper left 3 x 3 part is no rotation",
        ),
        "no frames": (GivenPoses(transforms), "holds no frames"),
        "lacks frames": (GivenPoses(transforms), "lacks frames"),
        "cut off": (GivenPoses(folder / "0"), "images.bin cannot be read as COLMAP's images.bin"),
        "too long": (GivenPoses(folder / "0"), "5 images end at byte"),
        "no images": (GivenPoses(folder / "0"), "images.bin holds no images"),
        "columns of an image": (GivenPoses(folder / "0"), "images.txt, line 4 has 9 columns, but 10 were expected"),
        "no times": (GivenPoses(folder / "0"), "but 0 of them have a time, as the frames of the recording state it"),
        "same time": (GivenPoses(folder / "0"), "have the same time; leave one out"),
        "no bag": (GivenPoses(folder / "r.bag"), "r.bag cannot be read as a ROS bag"),
        "no poses in a bag": (GivenPoses(folder / "r.bag"), "holds 0 topics with poses; record one of"),
        "scale": (GivenPoses(text, PoseFlags(poses_scale=0.0)), "--poses-scale is 0, but must be from"),
        "delay": (GivenPoses(text, PoseFlags(poses_delay_ms=np.nan)), "--poses-delay-ms is nan, but must be within"),
        "topic": (GivenPoses(text, PoseFlags(poses_topic="/a")), "--poses-topic changes nothing for"),
        "hand-eye": (GivenPoses(text, PoseFlags(hand_eye=folder / "mount")), "holds 3 numbers, but 4 x 4 numbers"),
        "mirror": (GivenPoses(text, PoseFlags(hand_eye=folder / "mount")), "upper left 3 x 3 part is no rotation"),
        "last row": (GivenPoses(text, PoseFlags(hand_eye=folder / "mount")), "the last row [0.0, 0.0, 0.0, 2.0]"),
    }
    row = "1,0,0,0,1,0,0,0\n"
    (folder / "mount").write_text(
        {
            "mirror": "-1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1",
            "last row": "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 2",
        }.get(name, "1 2 3")
    )
    contents = {"few columns": row + "2,0,0,0\n", "word": "-1,x,0,0,1,0,0,0\n" + row, "one row": row}
    csv.write_text(contents.get(name, row + "2,0,0,0,2,0,0,0\n"))
    transforms.write_text(json.dumps({} if name == "lacks frames" else {"frames": [frame] * (name == "no rotation")}))
    if name != "empty folder":
        write_colmap(folder / "0", "text" if name == "columns of an image" else "binary")
    images = folder / "0/images.bin"
    if name in ("cut off", "too long", "no images"):
        content = {"cut off": images.read_bytes()[:-30], "too long": images.read_bytes() + b"1", "no images": bytes(8)}
        images.write_bytes(content[name])
    if name == "columns of an image":
        table = folder / "0/images.txt"
        table.write_text(table.read_text().replace(" 1 frame 3.png", " frame"))
    if name == "same time":
        (folder / "times").write_text("1 a/frame\n1.5 b\n")
        return replace(cases[name][0]), cases[name][1]
    if name == "no poses in a bag":
        write_bag(folder / "r.bag", [])
    else:
        (folder / "r.bag").write_bytes(b"#ROSBAG V2.0\n" + bytes(50))
    return cases[name]


CASES = [
    *("missing", "empty folder", "few columns", "word", "norm", "one row", "no rotation", "no frames", "lacks frames"),
    *("cut off", "too long", "no images", "columns of an image", "no times", "same time", "no bag"),
    *("no poses in a bag", "scale", "delay", "topic", "hand-eye", "mirror", "last row"),
]


@pytest.mark.parametrize("name", CASES)
def test_wrong_poses_are_one_sentence(tmp_path: Path, name: str):
    poses, expected = wrong(name, tmp_path)
    times = dict.fromkeys(NAMES, 5) if name == "same time" else {}
    with pytest.raises(UserError) as caught:
        poses.rows(named(times), [])
    assert expected in str(caught.value) and is_one_sentence(str(caught.value))
