"""M3ED, written here by h5py from the pages of the data set."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from recordings import FRAME_TIMES, HEIGHT, POSE_TIMES, TRUE_EVENTS, WIDTH, check_poses, image, joined, poses
from scipy.spatial.transform import Rotation
from test_bad_input import is_one_sentence

from enerf_ns.dataparsers.formats import m3ed
from enerf_ns.dataparsers.formats.conversion import convert_recording
from enerf_ns.dataparsers.formats.pose_files import GivenPoses, PoseFlags
from enerf_ns.dataparsers.formats.registry import read_recording
from enerf_ns.dataparsers.index.indexing import index_events
from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.dataparsers.recording.errors import RecordingError
from enerf_ns.dataparsers.recording.hdf5_files import file_of, load_picture

CAMERA = Camera(WIDTH, HEIGHT, 20.0, 21.0, 11.5, 8.5, (-0.1, 0.02, 0.001, -0.002), "radtan")
FRAME_CAMERA = Camera(WIDTH, HEIGHT, 25.0, 25.0, 11.0, 9.0, (0.01, 0.002, 0.0, 0.001), "fisheye")


def mount(x: float, angle: float) -> np.ndarray:
    """Where a camera lies in the axes of the left event camera."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec([0.0, angle, 0.02]).as_matrix()
    pose[:3, 3] = [x, 0.01, -0.02]
    return pose


RIGHT, OVC = mount(0.12, 0.03), mount(0.06, -0.05)


def camera_to_world() -> np.ndarray:
    """Of the left event camera, in its axes at the first pose."""
    found = np.tile(np.eye(4), (len(POSE_TIMES), 1, 1))
    found[:, :3, :3] = Rotation.from_quat(poses()[:, 3:]).as_matrix()
    found[:, :3, 3] = poses()[:, :3]
    return np.linalg.inv(found[0]) @ found


def write_m3ed(folder: Path, events: np.ndarray = TRUE_EVENTS, poses_in: str = "pose_gt") -> Path:
    """The right camera sees the events of the left one 5 pixels further to the left, where they are within it."""
    folder.mkdir(parents=True, exist_ok=True)
    shifted = events - [5, 0, 0, 0]
    with h5py.File(folder / "seq_data.h5", "w") as file:
        for side, rows, pose in (("left", events, np.eye(4)), ("right", shifted[shifted[:, 0] >= 0], RIGHT)):
            group = file.create_group(f"prophesee/{side}")
            for name, column, kind in zip("xytp", rows.T, ("u2", "u2", "i8", "i1"), strict=True):
                group[name] = (column // 1000 if name == "t" else column).astype(kind)
            group["ms_map_idx"] = np.searchsorted(rows[:, 2], np.arange(1000) * 1_000_000)
            write_calibration(group, CAMERA, pose, "radtan")
        group = file.create_group("ovc/left")
        group["data"] = np.stack([image(i) for i in range(len(FRAME_TIMES))])
        write_calibration(group, FRAME_CAMERA, OVC, "equidistant")
        file["ovc/ts"] = FRAME_TIMES // 1000
        file["ovc/ts_map_prophesee_left_t"] = np.searchsorted(events[:, 2], FRAME_TIMES)
    with h5py.File(folder / f"seq_{poses_in}.h5", "w") as file:
        file["Cn_T_C0"] = np.linalg.inv(camera_to_world())
        file["Ln_T_L0"] = np.tile(np.eye(4), (len(POSE_TIMES), 1, 1))
        file["ts"] = POSE_TIMES // 1000
        file["ts_map_prophesee_left"] = np.searchsorted(events[:, 2], POSE_TIMES)
    return folder


def write_calibration(group: h5py.Group, camera: Camera, pose: np.ndarray, lens: str) -> None:
    calib = group.create_group("calib")
    calib["camera_model"], calib["distortion_model"] = "pinhole", lens
    calib["intrinsics"] = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
    calib["distortion_coeffs"] = np.array(camera.distortion)
    calib["resolution"] = np.array([camera.width, camera.height])
    calib["T_to_prophesee_left"] = pose


@pytest.mark.parametrize("poses_in", ["pose_gt", "depth_gt"])
def test_the_left_camera(tmp_path: Path, poses_in: str):
    recording = read_recording(write_m3ed(tmp_path / "m3ed", poses_in=poses_in))
    assert recording.format == "m3ed" and recording.camera == CAMERA and not recording.notes
    events = joined(recording.stream_events())
    np.testing.assert_array_equal(np.column_stack([events.x, events.y, events.t, events.p]), TRUE_EVENTS)
    assert len(index_events(recording)) == recording.num_events == len(TRUE_EVENTS)
    check_poses(recording.trajectory, camera_to_world())
    frames = recording.frames
    assert frames is not None and frames.camera == FRAME_CAMERA
    np.testing.assert_array_equal(frames.times, FRAME_TIMES)
    check_poses(frames.trajectory, camera_to_world() @ OVC)
    for i, file in enumerate(frames.filenames):
        np.testing.assert_array_equal(load_picture(file), image(i))


def test_frames_stay_in_their_file_until_they_are_converted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("ENERF_CACHE", str(tmp_path / "cache"))
    folder = write_m3ed(tmp_path / "m3ed")
    frames = read_recording(folder).frames
    assert frames is not None and {file_of(file) for file in frames.filenames} == {folder / "seq_data.h5"}
    assert not (tmp_path / "cache").exists()
    convert_recording(folder, tmp_path / "new")
    names = sorted((tmp_path / "new/frames").glob("*.png"))
    for i, file in enumerate(names):
        np.testing.assert_array_equal(load_picture(file), image(i))
    assert [file.name for file in names] == ["00000.png", "00001.png", "00002.png"]  # as poses of the user name them


def test_the_right_camera(tmp_path: Path):
    """The same frames are mounted to another body."""
    recording = read_recording(write_m3ed(tmp_path / "m3ed"), event_camera="right")
    events = joined(recording.stream_events())
    seen = TRUE_EVENTS[TRUE_EVENTS[:, 0] >= 5] - [5, 0, 0, 0]
    np.testing.assert_array_equal(np.column_stack([events.x, events.y, events.t, events.p]), seen)
    check_poses(recording.trajectory, camera_to_world() @ RIGHT)
    frames = recording.frames
    assert frames is not None
    check_poses(frames.trajectory, camera_to_world() @ OVC)


def test_poses_of_the_user(tmp_path: Path):
    folder = write_m3ed(tmp_path / "m3ed")
    (folder / "seq_pose_gt.h5").unlink()
    rows = "".join(f"{t} {' '.join(map(repr, pose))}\n" for t, pose in zip(POSE_TIMES, poses().tolist(), strict=True))
    (tmp_path / "poses.txt").write_text(rows)
    with pytest.raises(RecordingError, match=r"lacks a file \*_pose_gt\.h5 or \*_depth_gt\.h5, which hold the poses"):
        read_recording(folder)
    given = GivenPoses(tmp_path / "poses.txt", PoseFlags(poses_unit="ns"))
    np.testing.assert_array_equal(read_recording(folder, poses=given).trajectory.positions, poses()[:, :3])


def test_events_alone(tmp_path: Path):
    folder = write_m3ed(tmp_path / "m3ed")
    with h5py.File(folder / "seq_data.h5", "r+") as file:
        del file["ovc"], file["prophesee/right"]
    assert read_recording(folder).frames is None
    with pytest.raises(RecordingError, match=r"lacks the datasets x, y, t, p in its root; events are"):
        read_recording(folder, event_camera="right")


def test_times_of_poses_may_be_floats(tmp_path: Path):
    """As the published files hold them before 28 February 2025."""
    folder = write_m3ed(tmp_path / "m3ed")
    changed("ts", (POSE_TIMES // 1000).astype(np.float64) + 0.25, "seq_pose_gt.h5")(folder)
    np.testing.assert_array_equal(read_recording(folder).trajectory.times, POSE_TIMES)


def changed(name: str, value: Any, file: str = "seq_data.h5") -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        with h5py.File(folder / file, "r+") as opened:
            del opened[name]
            if value is not None:
                opened[name] = value

    return change


POSES = "seq_pose_gt.h5"
BAD: dict[str, tuple[Callable[[Path], Any], str]] = {
    "two sequences": (
        lambda folder: (folder / "other_data.h5").write_bytes(b""),
        "holds other_data.h5, seq_data.h5, but one file *_data.h5 was expected",
    ),
    "no events": (lambda folder: (folder / "seq_data.h5").unlink(), "lacks a file *_data.h5, which holds the events"),
    "another lens": (
        changed("prophesee/left/calib/distortion_model", "fov"),
        "holds in prophesee/left/calib a camera 'pinhole' with the distortion 'fov', but pinhole with radtan or",
    ),
    "no intrinsics": (
        changed("prophesee/left/calib/intrinsics", None),
        "lacks the dataset prophesee/left/calib/intrinsics, fx, fy, cx and cy; get",
    ),
    "inverse extrinsics": (
        changed("prophesee/right/calib/T_to_prophesee_left", np.linalg.inv(RIGHT)),
        "m to the left of the left one by prophesee/right/calib/T_to_prophesee_left, so that the matrix is the inverse",
    ),
    "no rotation": (
        changed("Cn_T_C0", np.tile(1.1 * np.eye(4), (11, 1, 1)), POSES),
        "holds in Cn_T_C0 matrix 0, which is no rotation, since it is off orthonormal by 0.21",
    ),
    "fewer times": (changed("ts", np.arange(5), POSES), "holds 11 poses and 5 times, but as many, at least 2, were"),
    "times back": (
        changed("ts", POSE_TIMES[::-1] // 1000, POSES),
        "the time 900000 µs after 1000000 µs, but times must",
    ),
    "times of another clock": (
        changed("ts", POSE_TIMES // 1000 + 400_000, POSES),
        "for the time 900000 µs, but its time in seq_data.h5 is 501354 µs; both files must be of one sequence",
    ),
    "frames of another clock": (
        changed("ovc/ts", FRAME_TIMES // 1000 + 400_000),
        "for the time 550000 µs, but its time in seq_data.h5 is 15",
    ),
    "frames of another size": (
        changed("ovc/left/data", np.zeros((3, 10, 10, 1), np.uint8)),
        "holds ovc/left/data as uint8 of shape (3, 10, 10, 1), but numbers of shape 3 x 18 x 24 x 1 were expected",
    ),
    "deep frames": (
        changed("ovc/left/data", np.zeros((3, HEIGHT, WIDTH, 1), np.uint16)),
        "holds ovc/left/data as uint16, but uint8 was expected",
    ),
    "too many poses": (
        lambda folder: changed("Cn_T_C0", None, POSES)(folder) or huge(folder / POSES),
        "holds Cn_T_C0 of 320,000,000 numbers, but poses of 4 x 4 numbers of at most 134,217,728 bytes was expected",
    ),
}


def huge(path: Path) -> None:
    with h5py.File(path, "r+") as file:
        file.create_dataset("Cn_T_C0", (20_000_000, 4, 4), np.float64, chunks=(1000, 4, 4))


@pytest.mark.parametrize("name", BAD)
def test_bad_files_give_one_sentence(tmp_path: Path, name: str):
    break_it, message = BAD[name]
    folder = write_m3ed(tmp_path / "m3ed")
    break_it(folder)
    with pytest.raises(RecordingError) as error:
        m3ed.read(folder)
    assert message in str(error.value)
    assert str(folder) in str(error.value) and is_one_sentence(str(error.value))
