from __future__ import annotations

from decimal import Decimal
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from recordings import EVENTS, FRAME_TIMES, HEIGHT, POSE_TIMES, WIDTH, joined, poses, write_davis

from enerf_ns.dataparsers.formats import davis
from enerf_ns.dataparsers.formats.registry import read_recording
from enerf_ns.dataparsers.index.indexing import index_events
from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.dataparsers.recording.files import load_image
from enerf_ns.dataparsers.recording.recording import EventRecording

EPOCH = 1_468_939_802_123_456_789
"""An absolute time in ns; float64 seconds would round it to 0.2 microseconds."""


@pytest.mark.parametrize("zero", [0, EPOCH])
def test_reads_what_was_written(tmp_path: Path, zero: int):
    recording = read_recording(write_davis(tmp_path / "davis", zero=zero))
    events, trajectory = index_events(recording).events(), recording.trajectory
    np.testing.assert_array_equal(np.stack([events.x, events.y, events.t, events.p], axis=1), EVENTS)
    np.testing.assert_array_equal(trajectory.times, POSE_TIMES)
    np.testing.assert_allclose(np.column_stack([trajectory.positions, trajectory.quaternions]), poses(), atol=1e-15)
    assert recording.frames is not None and recording.blurred_frames is None
    np.testing.assert_array_equal(recording.frames.times, FRAME_TIMES)
    assert recording.camera == Camera(
        WIDTH, HEIGHT, 330.0, 340.0, 11.5, 8.5, (-0.14, 0.09, -0.0003, 0.0002, 0.0), "radtan"
    )
    assert list(recording.notes) == []


def test_the_zero_of_time_is_the_earliest_first_stamp(tmp_path: Path):
    folder = write_davis(tmp_path / "davis", zero=5_000_000_000)
    lines = (folder / "events.txt").read_text()
    (folder / "events.txt").write_text("4.900000000 1 1 1\n" + lines)
    recording = read_recording(folder)
    assert recording.trajectory.start == 100_000_000
    assert index_events(recording).events().t[0] == EVENTS[0, 2] + 100_000_000


def test_without_frames_the_sensor_is_the_davis240c(tmp_path: Path):
    recording = read_recording(write_davis(tmp_path / "davis", frames=False))
    assert recording.frames is None
    assert (recording.camera.width, recording.camera.height) == (240, 180)


@pytest.mark.parametrize(
    ("middle", "size"), [((120.9, 94.1), (240, 180)), ((168.2, 134.5), (346, 260)), ((60, 70), (128, 128))]
)
def test_without_frames_the_principal_point_tells_the_sensor(
    tmp_path: Path, middle: tuple[float, float], size: tuple[int, int]
):
    folder = write_davis(tmp_path / "davis", frames=False)
    (folder / "calib.txt").write_text(f"300 300 {middle[0]} {middle[1]} 0 0 0 0 0\n")
    recording = read_recording(folder)
    assert (recording.camera.width, recording.camera.height) == size
    assert [f"{size[0]} x {size[1]}" in note for note in recording.notes] == [True] * (size != (240, 180))


def test_a_list_of_frames_without_the_folder_of_images_means_no_frames(tmp_path: Path):
    folder = write_davis(tmp_path / "davis")
    for file in (folder / "images").iterdir():
        file.unlink()
    (folder / "images").rmdir()
    recording = read_recording(folder)
    assert recording.frames is None
    assert list(recording.notes) == ["images.txt lists 3 frames, but there is no folder images/ of images."]


def test_a_calibration_without_distortion_is_a_pinhole_camera(tmp_path: Path):
    folder = write_davis(tmp_path / "davis")
    (folder / "calib.txt").write_text("330 340 11.5 8.5 0 0 0 0 0\n")
    assert read_recording(folder).camera == Camera(WIDTH, HEIGHT, 330.0, 340.0, 11.5, 8.5)


@pytest.mark.parametrize("end", ["\n", "", "\n\n \n", "\r\n"])
@pytest.mark.parametrize("separator", [" ", "\t", "   "])
def test_line_ends_and_separators(tmp_path: Path, end: str, separator: str):
    folder = write_davis(tmp_path / "davis")
    text = (folder / "events.txt").read_text().rstrip("\n").replace(" ", separator)
    text = text.replace("\n", "\r\n") if end == "\r\n" else text
    (folder / "events.txt").write_bytes((text + end).encode())
    assert len(index_events(read_recording(folder)).events()) == len(EVENTS)


def test_event_times_are_exact_however_they_are_written(tmp_path: Path):
    times = [
        "0.000000001", "0.3", "1", "1.", "1.5e0", "15E-1", "+1.500000001", "1.6000000019999", "0.0000000017e9",
        f"{EPOCH // 10**9}.{EPOCH % 10**9:09d}", f"{Decimal(EPOCH + 1) / 10**9:.18e}",
    ]  # fmt: skip
    path = tmp_path / "events.txt"
    path.write_text("".join(f"{time} 1e1 2.0 +1\n" for time in times))
    events = joined(davis._stream_events(path, path.stat().st_size, zero=0))
    assert events.t.tolist() == [int(Decimal(time) * 10**9) for time in times]
    assert set(events.x.tolist()) == {10} and set(events.y.tolist()) == {2} and set(events.p.tolist()) == {1}


def test_files_larger_than_a_piece_are_read_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    rng = np.random.default_rng(0)
    rows = np.column_stack([np.sort(rng.integers(0, 10**10, 500)), *rng.integers(0, 180, (2, 500)), np.arange(500) % 2])
    path = tmp_path / "events.txt"
    path.write_text("\n".join(f"{t // 10**9}.{t % 10**9:09d} {x} {y} {p}" for t, x, y, p in rows.tolist()))
    for size in (1, 37, 1000):
        monkeypatch.setattr(davis, "BYTES_AT_A_TIME", size)
        events = joined(davis._stream_events(path, path.stat().st_size, zero=0))
        np.testing.assert_array_equal(np.column_stack([events.t, events.x, events.y, events.p]), rows)


@pytest.fixture(scope="module")
def slider(shared_data: Path) -> EventRecording:
    return read_recording(shared_data / "slider_depth")


def test_slider_depth_holds_what_its_files_hold(slider: EventRecording):
    raw = joined(slider.stream_events())
    assert len(raw) == 1_078_541
    assert (raw.p == 0).sum() / (raw.p == 1).sum() == pytest.approx(1.41, abs=0.005)
    assert raw.t[[0, -1]].tolist() == [3_811_000, 3_404_080_001]
    table = np.loadtxt(slider.path / "events.txt", max_rows=10_000)
    expected = np.column_stack([np.rint(table[:, 0] * 1e9), table[:, 1:]])
    np.testing.assert_array_equal(np.column_stack([raw.t, raw.x, raw.y, raw.p])[:10_000], expected)

    assert len(index_events(slider).events()) == np.count_nonzero((raw.t >= 22_291_582) & (raw.t <= 3_402_486_198))
    assert slider.frames is not None and len(slider.frames.times) == 86
    assert slider.notes[0] == "1 of 87 frames (1.1 %) lie outside the poses and are left out."
    assert "of 1,078,541 events (0.32 %) lie outside the poses" in index_events(slider).notes[0]


def test_slider_depth_poses(slider: EventRecording):
    trajectory = slider.trajectory
    assert len(trajectory.times) == 339
    assert (trajectory.start, trajectory.end) == (22_291_582, 3_402_486_198)
    ends = trajectory.poses(torch.tensor([trajectory.start, trajectory.end])).numpy()
    np.testing.assert_allclose(ends[:, :, :3], np.tile(np.eye(3), (2, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(ends[:, :, 3], [[0.1116875, 0, 0], [1.0924375, 0, 0]], atol=1e-12)


def test_slider_depth_corners_move_with_the_poses(slider: EventRecording):
    """Corners tracked over early frames move left as the camera slides right, by fx * dx / depth, and neither up nor
    down: so clock, poses, axes and calibration belong together."""
    frames = slider.frames
    assert frames is not None
    camera = frames.camera.undistorted()
    first, last = 2, 8
    images = [frames.camera.undistort(load_image(file))[..., 0] for file in frames.filenames[first : last + 1]]
    start = cv2.goodFeaturesToTrack(images[0], maxCorners=60, qualityLevel=0.05, minDistance=8)
    points, tracked = start, np.ones(len(start), bool)
    for before, after in pairwise(images):
        points, status, _ = cv2.calcOpticalFlowPyrLK(before, after, points, points.copy(), winSize=(15, 15))
        tracked &= status[:, 0] == 1
    back = points
    for before, after in pairwise(images[::-1]):
        back, _, _ = cv2.calcOpticalFlowPyrLK(before, after, back, back.copy(), winSize=(15, 15))
    tracked &= np.linalg.norm(back - start, axis=-1)[:, 0] < 0.3
    motion = (points - start)[tracked, 0]
    assert len(motion) >= 15

    positions = slider.trajectory.poses(torch.from_numpy(frames.times[[first, last]]))[:, :, 3].numpy()
    slide = positions[1] - positions[0]
    assert slide[0] > 0.04 and slide[1] == slide[2] == 0.0
    depth = -camera.fx * slide[0] / motion[:, 0]
    stated = (depth > 0.4) & (depth < 2.2)
    assert stated.mean() > 0.9
    assert depth[stated].max() > 2 * depth[stated].min()
    assert np.median(np.abs(motion[:, 1])) < 0.02 * np.median(np.abs(motion[:, 0]))


def test_a_byte_order_mark_is_passed_over_in_each_text(tmp_path: Path):
    marked, plain = write_davis(tmp_path / "marked"), write_davis(tmp_path / "plain")
    for file in marked.glob("*.txt"):
        file.write_bytes(b"\xef\xbb\xbf" + file.read_bytes())
    events, expected = (joined(read_recording(folder).stream_events()) for folder in (marked, plain))
    np.testing.assert_array_equal(
        [events.x, events.y, events.t, events.p], [expected.x, expected.y, expected.t, expected.p]
    )
