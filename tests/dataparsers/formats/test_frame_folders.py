from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from enerf_ns.dataparsers.formats.frame_folders import read_frames
from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.dataparsers.recording.errors import RecordingError
from enerf_ns.dataparsers.recording.trajectory import Trajectory

CAMERA = Camera(24, 18, 20.0, 20.0, 11.5, 8.5)
TRAJECTORY = Trajectory(np.array([0, 10**9]), np.zeros((2, 3)), np.tile([0.0, 0, 0, 1], (2, 1)))


def write(folder: Path, num_images: int = 3, num_stamps: int = 3, num_depths: int = 3) -> tuple:
    for i in range(num_images):
        cv2.imwrite(str(folder / f"{i}.png"), np.full((18, 24), i, np.uint8))
    (folder / "stamps.txt").write_text("".join(f"{i * 10**8}\n" for i in range(num_stamps)))
    for i in range(num_depths):
        np.save(folder / f"{i}.npy", np.full((18, 24), 1.0 + i, np.float32))
    images, depths = sorted(folder.glob("*.png")), sorted(folder.glob("*.npy"))
    return images, folder / "stamps.txt", CAMERA, TRAJECTORY, depths


def test_images_stamps_and_depth_maps_belong_together(tmp_path: Path):
    frames = read_frames(*write(tmp_path))
    assert frames is not None and frames.depth_filenames is not None
    assert frames.times.tolist() == [0, 10**8, 2 * 10**8]
    assert [file.name for file in (*frames.filenames, *frames.depth_filenames)] == [
        *("0.png", "1.png", "2.png"),
        *("0.npy", "1.npy", "2.npy"),
    ]


def test_neither_images_nor_stamps_are_no_frames(tmp_path: Path):
    assert read_frames([], tmp_path / "stamps.txt", CAMERA, TRAJECTORY) is None


@pytest.mark.parametrize(
    ("counts", "sentence"),
    [
        ({"num_stamps": 2}, r"holds 3 images, but its stamps\.txt holds 2 stamps; give one for each image\.$"),
        ({"num_images": 0, "num_depths": 0}, r"holds 0 images, but its stamps\.txt holds 3 stamps; give one for each"),
        ({"num_depths": 1}, r"holds 1 depth maps, but .* holds 3 images; give one for each image\.$"),
    ],
)
def test_counts_that_differ_are_refused(tmp_path: Path, counts: dict[str, int], sentence: str):
    with pytest.raises(RecordingError, match=sentence):
        read_frames(*write(tmp_path, **counts))


def test_sizes_that_are_not_the_cameras_are_refused(tmp_path: Path):
    images, stamps, camera, trajectory, depths = write(tmp_path)
    np.save(depths[1], np.ones((24, 18), np.float32))
    with pytest.raises(RecordingError, match=r"1\.npy holds an array of shape \(24, 18\), but .* \(18, 24\)\.$"):
        read_frames(images, stamps, camera, trajectory, depths)
    cv2.imwrite(str(images[2]), np.zeros((24, 18), np.uint8))
    with pytest.raises(RecordingError, match=r"2\.png"):
        read_frames(images, stamps, camera, trajectory)
