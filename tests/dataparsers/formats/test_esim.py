from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from recordings import EVENTS, FRAME_TIMES, HEIGHT, POSE_TIMES, WIDTH, image, poses, write_esim

from enerf_ns.dataparsers.formats.registry import read_recording
from enerf_ns.dataparsers.index.indexing import index_events
from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.dataparsers.recording.files import load_image


@pytest.mark.parametrize("dtype", [np.float64, np.int64])
@pytest.mark.parametrize("off", [-1, 0])
@pytest.mark.parametrize("fifth_column", [False, True])
def test_events_of_all_files(tmp_path: Path, dtype: type, off: int, fifth_column: bool):
    folder = write_esim(tmp_path / "esim", dtype=dtype)
    for file in (folder / "events").iterdir():
        rows = np.load(file)
        rows[rows[:, 3] < 0, 3] = off
        np.save(file, np.column_stack([rows, np.full(len(rows), 99)]) if fifth_column else rows)
    events = index_events(read_recording(folder, "esim")).events()
    np.testing.assert_array_equal(np.stack([events.x, events.y, events.t, events.p], axis=1), EVENTS)


def test_event_files_are_read_in_the_order_of_their_names(tmp_path: Path):
    folder = write_esim(tmp_path / "esim")
    for old, new in (("00001", "b"), ("00000", "a")):
        (folder / f"events/{old}.npy").rename(folder / f"events/{new}.npy")
    assert (np.diff(index_events(read_recording(folder)).events().t) >= 0).all()


def test_a_file_without_events_is_fine(tmp_path: Path):
    folder = write_esim(tmp_path / "esim")
    np.save(folder / "events/00000b.npy", np.zeros((0, 4)))
    assert len(index_events(read_recording(folder)).events()) == len(EVENTS)


def test_poses_and_camera(tmp_path: Path):
    recording = read_recording(write_esim(tmp_path / "esim"))
    np.testing.assert_array_equal(recording.trajectory.times, POSE_TIMES)
    np.testing.assert_allclose(
        np.column_stack([recording.trajectory.positions, recording.trajectory.quaternions]), poses()
    )
    assert recording.camera == Camera(WIDTH, HEIGHT, 20.0, 20.0, WIDTH / 2, HEIGHT / 2)
    assert recording.depth_range == (0.5, 4.0)
    assert recording.contrast_thresholds is None
    assert list(recording.notes) == []


@pytest.mark.parametrize("frames", [(), ("images",), ("images_corrupted",), ("images", "images_corrupted")])
@pytest.mark.parametrize("depth", [False, True])
def test_sharp_blurred_or_no_frames_with_or_without_depth(tmp_path: Path, frames: tuple[str, ...], depth: bool):
    recording = read_recording(write_esim(tmp_path / "esim", frames=frames, depth=depth))
    for name, found in (("images", recording.frames), ("images_corrupted", recording.blurred_frames)):
        if name not in frames:
            assert found is None
            continue
        assert found is not None
        np.testing.assert_array_equal(found.times, FRAME_TIMES)
        assert [file.parent.name for file in found.filenames] == [name] * 3
        assert (found.depth_filenames is not None) == depth
        if found.depth_filenames:
            assert [np.load(file).max() for file in found.depth_filenames] == [1.0, 2.0, 3.0]


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_images_of_one_three_or_four_channels(tmp_path: Path, channels: int):
    frames = read_recording(write_esim(tmp_path / "esim", channels=channels)).frames
    assert frames is not None
    expected = image(2, channels).astype(float)
    if channels == 4:  # laid over white
        expected = 255.0 + (expected[..., :3] - 255.0) * expected[..., 3:] / 255.0
    np.testing.assert_allclose(load_image(frames.filenames[2]), expected, atol=1.0 if channels == 4 else 0.0)


def test_simulation_json_states_thresholds_response_exposure_depth_and_camera(tmp_path: Path):
    folder = write_esim(tmp_path / "esim", ("images", "images_corrupted"))
    camera = {"width": WIDTH, "height": HEIGHT, "fx": 21.0, "fy": 22.0, "cx": 11.5, "cy": 8.5}
    about = {"contrast_thresholds": [0.2, 0.3], "depth_range": [1, 2], "camera": camera, "seed": 0}
    about |= {"response": "logarithm:0.01", "exposure_ns": 5_000_000}
    (folder / "simulation.json").write_text(json.dumps(about))
    recording = read_recording(folder)
    assert recording.contrast_thresholds == (0.2, 0.3)
    assert recording.depth_range == (1.0, 2.0)
    assert recording.camera == Camera(WIDTH, HEIGHT, 21.0, 22.0, 11.5, 8.5)
    assert recording.response == "logarithm:0.01"
    assert recording.frames is not None and recording.blurred_frames is not None
    for frames, exposure in ((recording.frames, 0), (recording.blurred_frames, 5_000_000)):
        assert frames.exposures is not None and frames.exposures.tolist() == [exposure] * 3


def test_exposures_are_not_known_without_simulation_json(tmp_path: Path):
    recording = read_recording(write_esim(tmp_path / "esim", ("images", "images_corrupted")))
    assert recording.frames is not None and recording.frames.exposures is None
    assert recording.blurred_frames is not None and recording.blurred_frames.exposures is None


@pytest.mark.parametrize("bounds", [(0.0, 1.0), (2.0, 1.0), (np.nan, 1.0), (1.0, np.inf), (-1.0, 1.0)])
def test_bounds_without_meaning_are_no_depth_range(tmp_path: Path, bounds: tuple[float, float]):
    folder = write_esim(tmp_path / "esim")
    rows = np.load(folder / "poses_bounds.npy")
    rows[:, 15:] = bounds
    np.save(folder / "poses_bounds.npy", rows)
    assert read_recording(folder).depth_range is None


def test_small_errors_of_quaternions_are_renormalised(tmp_path: Path):
    folder = write_esim(tmp_path / "esim")
    rows = np.loadtxt(folder / "0_poses_all.txt", skiprows=1)
    rows[3, 4:] *= 1.0005
    np.savetxt(folder / "0_poses_all.txt", rows, header="t px py pz qx qy qz qw")
    recording = read_recording(folder)
    np.testing.assert_allclose(np.linalg.norm(recording.trajectory.quaternions, axis=1), 1.0, atol=1e-12)
    assert list(recording.notes) == [
        "1 of 11 quaternions in 0_poses_all.txt were off norm 1 by up to 0.0005 and are renormalised."
    ]


@pytest.mark.parametrize("header", ["", "timestamp px py pz qx qy qz qw\n"])
def test_poses_with_any_header_or_none(tmp_path: Path, header: str):
    folder = write_esim(tmp_path / "esim")
    lines = (folder / "0_poses_all.txt").read_text().splitlines(keepends=True)
    (folder / "0_poses_all.txt").write_text(header + "".join(lines[1:]))
    np.testing.assert_array_equal(read_recording(folder).trajectory.times, POSE_TIMES)
