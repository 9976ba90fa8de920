from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from enerf_ns.dataparsers.formats.robust_enerf import checked_camera, checked_trajectory, listed, whole_nanoseconds
from enerf_ns.dataparsers.recording.errors import RecordingError

FILE = Path("poses.npz")
MATRIX = np.array([[100.0, 0, 31.5], [0, 110, 23.5], [0, 0, 1]])


def poses(times: list[int], scale: float = 1.0) -> tuple[Path, np.ndarray, np.ndarray, np.ndarray]:
    quaternions = Rotation.from_rotvec(np.outer(np.arange(len(times)), [0, 0, 0.1])).as_quat()
    return FILE, np.array(times, np.int64), np.arange(3.0 * len(times)).reshape(-1, 3), scale * quaternions


def test_poses_are_put_in_order_and_those_that_all_but_coincide_are_left_out():
    path, times, positions, quaternions = poses([0, 3_000_000, 1_000_000, 1_000_400, 2_000_000])
    notes: list[str] = []
    trajectory = checked_trajectory(path, times, positions, quaternions, notes)
    np.testing.assert_array_equal(trajectory.times, [0, 1_000_000, 2_000_000, 3_000_000])
    np.testing.assert_array_equal(trajectory.positions, positions[[0, 2, 4, 1]])
    assert notes == [
        "The poses in poses.npz go back in time 1 times and are sorted.",
        "1 of 5 poses in poses.npz follow another one within 1 µs and are left out.",
    ]


def test_quaternions_a_little_off_norm_one_are_renormalised():
    notes: list[str] = []
    trajectory = checked_trajectory(*poses([0, 10**6], scale=1.0005), notes)
    np.testing.assert_allclose(np.linalg.norm(trajectory.quaternions, axis=1), 1, atol=1e-12)
    assert len(notes) == 1 and notes[0].startswith("2 of 2 quaternions in poses.npz were off norm 1")


@pytest.mark.parametrize(
    ("changed", "sentence"),
    [
        (poses([0]), "holds 1 poses, but at least 2"),
        (poses([0, 10**6], scale=1.01), r"pose 1, holds a quaternion of norm 1\.01"),
        (
            poses([0, 1, 2, 3]),
            "3 of them follow another one within 1 µs; the times .* look like milliseconds where nanoseconds were",
        ),
        (
            (*poses([0, 10**6])[:2], np.array([[0, 0, 0], [0, np.nan, 0]]), np.tile([0.0, 0, 0, 1], (2, 1))),
            "pose 2, holds the position",
        ),
        ((*poses([0, 10**6])[:2], np.full((2, 3), 1e30), np.tile([0.0, 0, 0, 1], (2, 1))), "of the origin"),
    ],
)
def test_poses_that_cannot_be_used_are_refused(changed: tuple[Path, np.ndarray, np.ndarray, np.ndarray], sentence: str):
    with pytest.raises(RecordingError, match=rf"^poses\.npz.* .*{sentence}"):
        checked_trajectory(*changed, [])


@pytest.mark.parametrize(
    ("name", "coefficients", "model"),
    [
        ("plumb_bob", (0.1, 0.01, 0.001, 0.002), "radtan"),
        ("plumb_bob", (0.0, 0.0, 0.0, 0.0), "pinhole"),
        ("equidistant", (0.1, 0.01, 0.001, 0.002), "fisheye"),
        ("fisheye", (0.1, 0.01, 0.001, 0.002), "fisheye"),
        ("anything", (), "pinhole"),
    ],
)
def test_the_models_of_ros_become_this_packages(name: str, coefficients: tuple[float, ...], model: str):
    camera = checked_camera(FILE, 64, 48, MATRIX, name, np.array(coefficients))
    assert camera.model == model and camera.distortion == (coefficients if model != "pinhole" else ())
    assert (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy) == (64, 48, 100, 110, 31.5, 23.5)


@pytest.mark.parametrize(
    ("matrix", "model", "sentence"),
    [
        (MATRIX + np.eye(3)[[1, 2, 0]], "plumb_bob", "0 fy cy, 0 0 1 were expected"),
        (MATRIX * [[1], [1], [2]], "plumb_bob", "last row"),
        (MATRIX, "rational_polynomial", "undistort the events and frames"),
        (MATRIX * [[-1], [1], [1]], "plumb_bob", "focal lengths"),
    ],
)
def test_what_is_no_camera_is_refused(matrix: np.ndarray, model: str, sentence: str):
    with pytest.raises(RecordingError, match=rf"^poses\.npz .*{sentence}"):
        checked_camera(FILE, 64, 48, matrix, model, np.full(4, 0.01))


def test_periods_are_whole_nanoseconds():
    assert whole_nanoseconds(FILE, 1499.6) == 1500
    with pytest.raises(RecordingError, match=r"^poses\.npz holds the refractory period nan"):
        whole_nanoseconds(FILE, float("nan"))


def test_names_are_shown_in_order_without_what_cannot_be_printed():
    assert listed(["b", "a\x00\x1b"]) == "a??, b" and listed([]) == "none"
