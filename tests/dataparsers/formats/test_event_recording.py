"""The layout for recordings of one's own: read as written, written as read, and refused with one sentence."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image
from recordings import (
    EVENTS,
    FRAME_TIMES,
    HEIGHT,
    POSE_TIMES,
    WIDTH,
    image,
    poses,
    write_davis,
    write_esim,
    write_image,
)
from scipy.spatial.transform import Rotation, Slerp
from test_bad_input import is_one_sentence

from enerf_ns.dataparsers.formats import event_recording
from enerf_ns.dataparsers.formats.conversion import convert_recording
from enerf_ns.dataparsers.formats.registry import read_recording
from enerf_ns.dataparsers.index.indexing import index_events
from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.dataparsers.recording.errors import RecordingError
from enerf_ns.dataparsers.recording.recording import EventRecording, Events
from enerf_ns.dataparsers.recording.trajectory import Trajectory

CAMERA = {"width": WIDTH, "height": HEIGHT, "model": "pinhole", "fx": 20.0, "fy": 21.0, "cx": 11.5, "cy": 8.5}
MOUNTING = np.eye(4)
MOUNTING[:3, :3] = Rotation.from_euler("xyz", [10, -20, 30], degrees=True).as_matrix()
MOUNTING[:3, 3] = 0.1, -0.02, 0.03


def write_recording(folder: Path, frames: tuple[str, ...] = (), depth: bool = False, **about: object) -> Path:
    """A recording written by hand and not by the code under test."""
    (folder / "events").mkdir(parents=True)
    for name, column, dtype in zip("xytp", EVENTS.T, (np.uint16, np.uint16, np.int64, np.int8), strict=True):
        np.save(folder / "events" / f"{name}.npy", column.astype(dtype))
    rows = zip(POSE_TIMES.tolist(), poses().tolist(), strict=True)
    (folder / "poses.txt").write_text("".join(f"{time} {' '.join(map(repr, pose))}\n" for time, pose in rows))
    (folder / "recording.json").write_text(json.dumps({"camera": CAMERA, **about}))
    for name in frames:
        (folder / name).mkdir()
        (folder / name / "stamps_ns.txt").write_text("".join(f"{time}\n" for time in FRAME_TIMES))
        for i in range(len(FRAME_TIMES)):
            write_image(folder / name / f"{i}.png", image(i + 10 * (name != "frames")))
    if depth:
        (folder / "depth").mkdir()
        for i in range(len(FRAME_TIMES)):
            np.save(folder / f"depth/{i}.npy", np.full((HEIGHT, WIDTH), 1.0 + i, np.float32))
    return folder


def all_events(recording: EventRecording) -> np.ndarray:
    """Rows x, y, t, p."""
    pieces = [np.column_stack([piece.x, piece.y, piece.t, piece.p]) for piece in recording.stream_events()]
    return np.concatenate(pieces)


def in_order(events: Events) -> np.ndarray:
    rows = np.column_stack([events.x, events.y, events.t, events.p]).astype(np.int64)
    return rows[np.lexsort(rows.T)]


def test_reads_what_was_written(tmp_path: Path):
    about = {
        "contrast_thresholds": [0.2, 0.3],
        "refractory_period_ns": 1500,
        "bayer_pattern": "RGGB",
        "depth_range": [1, 4.5],
    }
    recording = read_recording(write_recording(tmp_path / "own", ("frames", "blurred_frames"), True, **about))
    assert recording.format == "event_recording"
    np.testing.assert_array_equal(all_events(recording), EVENTS)
    assert recording.num_events == len(EVENTS)
    np.testing.assert_array_equal(in_order(index_events(recording).events()), in_order(Events(*EVENTS.T)))
    np.testing.assert_array_equal(recording.trajectory.times, POSE_TIMES)
    found = np.column_stack([recording.trajectory.positions, recording.trajectory.quaternions])
    np.testing.assert_allclose(found, poses(), rtol=0, atol=1e-15)
    assert recording.camera == Camera(WIDTH, HEIGHT, 20.0, 21.0, 11.5, 8.5)
    assert recording.contrast_thresholds == (0.2, 0.3) and recording.depth_range == (1.0, 4.5)
    assert recording.refractory_period == 1500 and recording.bayer_pattern == "RGGB"
    assert recording.reconstructed_by is None
    assert recording.frames is not None and recording.blurred_frames is not None
    for frames, folder in ((recording.frames, "frames"), (recording.blurred_frames, "blurred_frames")):
        np.testing.assert_array_equal(frames.times, FRAME_TIMES)
        assert [file.parent.name for file in frames.filenames] == [folder] * 3
        assert frames.camera == recording.camera and frames.trajectory is recording.trajectory
    assert recording.blurred_frames.depth_filenames is None and recording.frames.depth_filenames is not None
    assert [np.load(file).max() for file in recording.frames.depth_filenames] == [1.0, 2.0, 3.0]
    assert list(recording.notes) == []


def test_frames_keep_their_numbers(tmp_path: Path):
    """Which count those that are left out, since they have no pose."""
    folder = write_esim(tmp_path / "esim")
    rows = (folder / "0_poses_all.txt").read_text().splitlines()
    (folder / "0_poses_all.txt").write_text("\n".join([rows[0], *rows[4:]]))  # begin after the first frame
    for source, new in (("esim", "first"), ("first", "second")):
        convert_recording(tmp_path / source, tmp_path / new)
        frames = read_recording(tmp_path / new).frames
        assert frames is not None and frames.numbers.tolist() == [1, 2]
        assert frames.times.tolist() == FRAME_TIMES[1:].tolist()
    convert_recording(write_esim(tmp_path / "whole"), tmp_path / "third")
    assert not (tmp_path / "third/frames/numbers.txt").exists()


@pytest.mark.parametrize(
    ("numbers", "message"),
    [
        ("1\n3\n", "holds 3 images, but its numbers.txt holds 2 numbers"),
        ("1\n1\n3\n", "line 2 holds 1, but whole numbers from 0 to 1,000,000,000 were expected, each above"),
        ("1\n2.5\n3\n", "line 2 holds 2.5, but"),
        ("-2\n-1\n0\n", "line 1 holds -2, but"),
        ("0\n1e300\n2e300\n", "line 2 holds 1e300, but"),
    ],
)
def test_numbers_that_cannot_be_are_one_sentence(tmp_path: Path, numbers: str, message: str):
    folder = write_recording(tmp_path / "own", ("frames",))
    (folder / "frames/numbers.txt").write_text(numbers)
    with pytest.raises(RecordingError, match=message) as error:
        read_recording(folder)
    assert is_one_sentence(str(error.value))


def test_what_is_optional_may_be_missing(tmp_path: Path):
    recording = read_recording(write_recording(tmp_path / "own"))
    assert recording.frames is None and recording.blurred_frames is None
    assert recording.contrast_thresholds is None and recording.depth_range is None
    assert recording.refractory_period == 0 and recording.bayer_pattern is None


@pytest.mark.parametrize("dtype", [np.int8, np.uint8, np.int16, np.int32, np.int64, np.uint64, ">i4", ">u2"])
def test_any_integer_type(tmp_path: Path, dtype: type | str):
    folder = write_recording(tmp_path / "own")
    off = -1 if np.dtype(dtype).kind == "i" else 0
    for name, column in zip("xyp", (EVENTS[:, 0], EVENTS[:, 1], np.maximum(EVENTS[:, 3], off)), strict=True):
        np.save(folder / f"events/{name}.npy", column.astype(dtype))
    np.save(folder / "events/t.npy", EVENTS[:, 2].astype(">i8"))
    recording = read_recording(folder)
    expected = np.column_stack([EVENTS[:, :3], np.maximum(EVENTS[:, 3], off)])
    np.testing.assert_array_equal(all_events(recording).astype(np.int64), expected)
    np.testing.assert_array_equal(in_order(index_events(recording).events()), in_order(Events(*EVENTS.T)))


def test_polarity_as_bool(tmp_path: Path):
    folder = write_recording(tmp_path / "own")
    np.save(folder / "events/p.npy", EVENTS[:, 3] > 0)
    np.testing.assert_array_equal(in_order(index_events(read_recording(folder)).events()), in_order(Events(*EVENTS.T)))


def test_times_from_any_zero(tmp_path: Path):
    zero = 1_700_000_000_123_456_789
    folder = write_recording(tmp_path / "own", ("frames",))
    np.save(folder / "events/t.npy", EVENTS[:, 2] + zero)
    for name in ("poses.txt", "frames/stamps_ns.txt"):
        lines = (folder / name).read_text().splitlines()
        cells = [line.split(" ") for line in lines]
        (folder / name).write_text("".join(" ".join([str(int(t) + zero), *rest]) + "\n" for t, *rest in cells))
    recording = read_recording(folder)
    assert recording.trajectory.start == zero and recording.frames is not None
    np.testing.assert_array_equal(recording.frames.times, FRAME_TIMES + zero)
    np.testing.assert_array_equal(np.sort(index_events(recording).events().t), EVENTS[:, 2] + zero)
    here = recording.trajectory.poses(torch.from_numpy(FRAME_TIMES + zero))
    at_zero = Trajectory(POSE_TIMES, poses()[:, :3], poses()[:, 3:]).poses(torch.from_numpy(FRAME_TIMES))
    np.testing.assert_allclose(here, at_zero, rtol=0, atol=1e-14)


def test_events_come_in_pieces(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(event_recording, "EVENTS_AT_A_TIME", 4)
    recording = read_recording(write_recording(tmp_path / "own"))
    assert [len(piece) for piece in recording.stream_events()] == [4, 2]
    np.testing.assert_array_equal(all_events(recording), EVENTS)


def test_a_recording_that_grows_is_read_as_it_was(tmp_path: Path):
    folder = write_recording(tmp_path / "own")
    recording = read_recording(folder)
    for name in "xytp":
        column = np.load(folder / f"events/{name}.npy")
        np.save(folder / f"events/{name}.npy", np.append(column, column[-1]))
    np.testing.assert_array_equal(all_events(recording), EVENTS)


def test_a_recording_that_shrinks_is_noticed(tmp_path: Path):
    folder = write_recording(tmp_path / "own")
    recording = read_recording(folder)
    np.save(folder / "events/y.npy", EVENTS[:2, 1].astype(np.uint16))
    with pytest.raises(RecordingError, match=r"y\.npy became shorter while it was read"):
        all_events(recording)


def test_the_frames_have_a_camera_of_their_own(tmp_path: Path):
    frame_camera = {**CAMERA, "model": "radtan", "fx": 25.5, "distortion": [-0.1, 0.02, 0.001, -0.002]}
    about = {**frame_camera, "event_camera_from_frame_camera": MOUNTING.tolist()}
    recording = read_recording(write_recording(tmp_path / "own", ("frames",), frame_camera=about))
    assert recording.frames is not None
    assert recording.frames.camera.distortion == (-0.1, 0.02, 0.001, -0.002) and recording.frames.camera.fx == 25.5
    bodies = Slerp(POSE_TIMES, Rotation.from_quat(poses()[:, 3:]))(FRAME_TIMES).as_matrix()
    positions = np.column_stack([np.interp(FRAME_TIMES, POSE_TIMES, poses()[:, 0]), np.zeros((3, 2))])
    found = recording.frames.trajectory.poses(torch.from_numpy(FRAME_TIMES)).numpy()
    np.testing.assert_allclose(found[:, :, :3], bodies @ MOUNTING[:3, :3], rtol=0, atol=1e-12)
    # the lever arm turns between two poses, 0.05 rad apart; the spline of positions follows it to this accuracy
    np.testing.assert_allclose(found[:, :, 3], positions + bodies @ MOUNTING[:3, 3], rtol=0, atol=1e-7)
    at_poses = recording.frames.trajectory.poses(torch.from_numpy(POSE_TIMES)).numpy()
    expected = poses()[:, :3] + Rotation.from_quat(poses()[:, 3:]).apply(MOUNTING[:3, 3])
    np.testing.assert_allclose(at_poses[:, :, 3], expected, rtol=0, atol=1e-12)


def test_a_camera_with_a_table_of_directions(tmp_path: Path):
    folder = write_recording(tmp_path / "own", camera={**CAMERA, "model": "lookup"})
    directions = np.random.default_rng(0).normal(0, 0.3, (HEIGHT, WIDTH, 2))
    np.save(folder / "camera_directions.npy", directions)
    camera = read_recording(folder).camera
    np.testing.assert_array_equal(camera.pixel_directions()[..., :2], directions)
    assert camera.undistorted() == Camera(WIDTH, HEIGHT, 20.0, 21.0, 11.5, 8.5)


# ---------------------------------------------------------------------------------------------------------- writing


def same_recording(found: EventRecording, expected: EventRecording) -> None:
    np.testing.assert_array_equal(all_events(found), all_events(expected))
    np.testing.assert_array_equal(in_order(index_events(found).events()), in_order(index_events(expected).events()))
    np.testing.assert_array_equal(found.trajectory.times, expected.trajectory.times)
    np.testing.assert_array_equal(found.trajectory.positions, expected.trajectory.positions)
    np.testing.assert_allclose(found.trajectory.quaternions, expected.trajectory.quaternions, rtol=0, atol=2e-16)
    assert found.camera == expected.camera
    np.testing.assert_array_equal(found.camera.pixel_directions(), expected.camera.pixel_directions())
    assert found.contrast_thresholds == expected.contrast_thresholds and found.depth_range == expected.depth_range
    assert found.reconstructed_by == expected.reconstructed_by
    assert found.refractory_period == expected.refractory_period and found.bayer_pattern == expected.bayer_pattern
    for ours, theirs in ((found.frames, expected.frames), (found.blurred_frames, expected.blurred_frames)):
        assert (ours is None) == (theirs is None)
        if ours is None or theirs is None:
            continue
        np.testing.assert_array_equal(ours.times, theirs.times)
        for one, other in zip(ours.filenames, theirs.filenames, strict=True):
            assert one.read_bytes() == other.read_bytes()
        assert (ours.depth_filenames is None) == (theirs.depth_filenames is None)
        for one, other in zip(ours.depth_filenames or (), theirs.depth_filenames or (), strict=True):
            np.testing.assert_array_equal(np.load(one), np.load(other))
        assert ours.camera == theirs.camera
        assert (ours.exposures is None) == (theirs.exposures is None)
        if ours.exposures is not None and theirs.exposures is not None:
            np.testing.assert_array_equal(ours.exposures, theirs.exposures)
        times = torch.from_numpy(ours.times)
        np.testing.assert_allclose(ours.trajectory.poses(times), theirs.trajectory.poses(times), rtol=0, atol=1e-12)


def copied(recording: EventRecording, folder: Path) -> EventRecording:
    folder.mkdir()
    assert event_recording.write(recording, folder) == len(all_events(recording))
    return read_recording(folder)


@pytest.mark.parametrize("depth", [False, True])
@pytest.mark.parametrize("frames", [(), ("images",), ("images_corrupted",), ("images", "images_corrupted")])
def test_esim_and_back(tmp_path: Path, frames: tuple[str, ...], depth: bool):
    folder = write_esim(tmp_path / "esim", frames=frames, depth=depth)
    camera = {"width": WIDTH, "height": HEIGHT, "fx": 1 / 3 + 20, "fy": 22.1, "cx": 11.7, "cy": 8.3}
    about = {"contrast_thresholds": [0.1 + 0.2, 0.3], "depth_range": [1 / 3, 2], "camera": camera}
    (folder / "simulation.json").write_text(json.dumps(about))
    recording = read_recording(folder)
    found = copied(recording, tmp_path / "own")
    if recording.blurred_frames is not None and depth:  # this layout has the depth of sharp frames alone
        recording = replace(recording, blurred_frames=replace(recording.blurred_frames, depth_filenames=None))
    same_recording(found, recording)


@pytest.mark.parametrize("zero", [0, 1_468_939_802_123_456_789])
def test_davis_and_back(tmp_path: Path, zero: int):
    recording = read_recording(write_davis(tmp_path / "davis", zero=zero))
    same_recording(copied(recording, tmp_path / "own"), recording)


def test_all_of_this_layout_and_back(tmp_path: Path):
    frame_camera = {**CAMERA, "model": "fisheye", "distortion": [0.01, -0.002, 1 / 3000, 1e-5]}
    mounted = {**frame_camera, "event_camera_from_frame_camera": MOUNTING.tolist()}
    about = {
        "camera": {**CAMERA, "model": "lookup"},
        "frame_camera": mounted,
        "contrast_thresholds": [0.2, 1 / 3],
        "refractory_period_ns": 10,
        "bayer_pattern": "GBRG",
        "depth_range": [0.1, 7],
    }
    folder = write_recording(tmp_path / "own", ("frames", "blurred_frames"), depth=True, **about)
    (folder / "blurred_frames/exposures_ns.txt").write_text("300000000\n1000\n0\n")
    np.save(folder / "camera_directions.npy", np.random.default_rng(0).normal(0, 0.3, (HEIGHT, WIDTH, 2)))
    recording = read_recording(folder)
    assert recording.blurred_frames is not None and recording.blurred_frames.exposures is not None
    assert recording.blurred_frames.exposures.tolist() == [300_000_000, 1000, 0]
    same_recording(copied(recording, tmp_path / "again"), recording)


def test_frames_keep_their_order_and_their_numbers(tmp_path: Path):
    folder = write_davis(tmp_path / "davis")
    names = ["images/z.png", "images/b.png", "images/a.png"]
    for old, new in zip(sorted((folder / "images").iterdir()), names, strict=True):
        old.rename(folder / new)
    stamps = [line.split()[0] for line in (folder / "images.txt").read_text().splitlines()]
    stamps[0] = "-5.0"  # long before the first pose, so that this frame is left out
    (folder / "images.txt").write_text("".join(f"{t} {name}\n" for t, name in zip(stamps, names, strict=True)))
    recording = read_recording(folder)
    found = copied(recording, tmp_path / "own")
    same_recording(found, recording)
    assert found.frames is not None and [file.name for file in found.frames.filenames] == ["00001.png", "00002.png"]
    assert found.frames.times[0] == recording.frames.times[0] == 5_450_000_000  # type: ignore[union-attr]


def test_written_columns_are_plain_npy_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    recording = read_recording(write_recording(tmp_path / "own"))
    monkeypatch.setattr(event_recording, "EVENTS_AT_A_TIME", 2)
    copied(recording, tmp_path / "again")
    for name, column, dtype in zip("xytp", EVENTS.T, (np.uint16, np.uint16, np.int64, np.int8), strict=True):
        array = np.load(tmp_path / f"again/events/{name}.npy", allow_pickle=False)
        assert array.dtype == dtype
        np.testing.assert_array_equal(array, column)


@pytest.mark.parametrize(
    ("column", "row", "value", "message"),
    [
        ("x", 2, WIDTH, "event 3 holds x = 24"),
        ("y", 5, -1, "event 6 holds y = -1"),
        ("p", 0, 257, "event 1 holds polarity = 257"),
        ("t", 4, 0, "event 5 goes back in time from 250000001 ns to 0 ns"),
    ],
)
def test_events_that_cannot_be_stored_are_refused(tmp_path: Path, column: str, row: int, value: int, message: str):
    folder = write_recording(tmp_path / "own")
    columns = dict(zip("xytp", EVENTS.T.copy(), strict=True))
    columns[column][row] = value
    np.save(folder / f"events/{column}.npy", columns[column])
    (tmp_path / "again").mkdir()
    with pytest.raises(RecordingError, match=re.escape(message)):
        event_recording.write(read_recording(folder), tmp_path / "again")


def test_a_camera_that_moves_against_the_other_is_refused(tmp_path: Path):
    recording = read_recording(write_recording(tmp_path / "own", ("frames",)))
    moving = Trajectory(POSE_TIMES, poses()[:, :3] ** 2, poses()[:, 3:])
    assert recording.frames is not None
    recording = replace(recording, frames=replace(recording.frames, trajectory=moving))
    (tmp_path / "again").mkdir()
    with pytest.raises(RecordingError, match="a camera that moves against the event camera"):
        event_recording.write(recording, tmp_path / "again")


# ----------------------------------------------------------------------------------------------------------- page


def test_the_lines_on_the_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    page = (Path(__file__).parents[3] / "docs" / "formats.md").read_text()
    blocks = [block for block in re.findall(r"```python\n(.*?)```", page, re.DOTALL) if "recording.json" in block]
    monkeypatch.chdir(tmp_path)
    x, y, t, p = EVENTS.T
    exec(blocks[0], {"x": x, "y": y, "t": t, "p": p, "pose_times": POSE_TIMES, "poses": poses()})
    recording = read_recording(tmp_path / "my-recording")
    np.testing.assert_array_equal(all_events(recording), EVENTS)
    np.testing.assert_array_equal(recording.trajectory.times, POSE_TIMES)
    np.testing.assert_array_equal(recording.trajectory.positions, poses()[:, :3])
    assert recording.camera == Camera(240, 180, 200.0, 200.0, 119.5, 89.5)
    assert len(index_events(recording)) == len(EVENTS)


# -------------------------------------------------------------------------------------------------------- bad input


def camera(**changes: object) -> dict:
    """recording.json of a camera of which some keys are changed, or left out where they are None."""
    return {"camera": {key: value for key, value in {**CAMERA, **changes}.items() if value is not None}}


def frame_camera(**changes: object) -> dict:
    return {"frame_camera": {**CAMERA, **changes}}


MIRROR = np.diag([1.0, 1.0, -1.0, 1.0]).tolist()

BAD_ABOUT: dict[str, tuple[dict, str]] = {
    "a sensor of 4 gigapixels": (
        camera(width=65535, height=65535, fx=3e4, fy=3e4, cx=3e4, cy=3e4),
        "camera, holds a camera of 65535 x 65535 pixels, but at most 67,108,864 were expected",
    ),
    "no focal length": (camera(fx=None, fy=None), "recording.json lacks fx and fy in camera"),
    "key misspelt": (camera(distorsion=[1]), "recording.json holds the unknown key 'distorsion' in camera"),
    "other key misspelt": ({"contrast_threshold": 1}, "holds the unknown key 'contrast_threshold'; known are camera,"),
    "camera is no object": ({"camera": [1, 2]}, "recording.json holds camera = [1, 2], but an object with width,"),
    "width is no whole number": (
        camera(width=24.5),
        "camera, holds a camera of 24.5 x 18 pixels, but whole numbers from 1 to 65535",
    ),
    "width is true": (camera(width=True), "holds camera.width = true, but a number was expected"),
    "height 0": (camera(height=0), "camera, holds a camera of 24 x 0 pixels"),
    "focal length negative": (camera(fx=-1), "holds the focal lengths -1 and 21, but they must be above 0"),
    "focal length NaN": (camera(fy=float("nan")), "holds camera.fy = NaN, but a number was expected"),
    "principal point a text": (camera(cx="11.5"), 'holds camera.cx = "11.5", but a number was expected'),
    "model unknown": (
        camera(model="ftheta"),
        'camera.model = "ftheta", but one of pinhole, radtan, fisheye and lookup',
    ),
    "model is a list": (camera(model=["pinhole"]), 'camera.model = ["pinhole"], but one of'),
    "pinhole with distortion": (
        camera(distortion=[0.1]),
        "the distortion (0.1,) of the model pinhole, but no coefficients",
    ),
    "radtan with three": (
        camera(model="radtan", distortion=[0, 0, 0]),
        "of the model radtan, but finite numbers k1 k2 p1 p2 and",
    ),
    "radtan with none": (camera(model="radtan"), "the distortion () of the model radtan, but finite numbers k1 k2 p1"),
    "distortion of texts": (
        camera(model="radtan", distortion=list("0000")),
        'holds camera.distortion[0] = "0", but a number was',
    ),
    "distortion nested": (
        camera(model="radtan", distortion=[[0], 0, 0, 0]),
        "holds camera.distortion[0] = [0], but a number was",
    ),
    "no such lens": (
        camera(model="radtan", fx=5, fy=5, distortion=[-0.9, 0, 0, 0]),
        "camera, holds the radtan distortion",
    ),
    "no table": (camera(model="lookup"), "camera_directions.npy is missing"),
    "frame camera lookup": (
        frame_camera(model="lookup"),
        'frame_camera.model = "lookup", but one of pinhole, radtan and',
    ),
    "frame camera is a text": (
        {"frame_camera": "left"},
        'recording.json holds frame_camera = "left", but an object was expected',
    ),
    "mirrored": (frame_camera(event_camera_from_frame_camera=MIRROR), "is no rotation"),
    "stretched": (frame_camera(event_camera_from_frame_camera=(np.eye(4) * 2).tolist()), "is no rotation"),
    "3 x 4": (frame_camera(event_camera_from_frame_camera=np.eye(3, 4).tolist()), "but a matrix of 4 x 4 numbers"),
    "ragged": (
        frame_camera(event_camera_from_frame_camera=[[1, 0], [0]]),
        "[[1, 0], [0]], but a matrix of 4 x 4 numbers",
    ),
    "transposed": (
        frame_camera(event_camera_from_frame_camera=(np.eye(4) + np.eye(4, k=-3)).tolist()),
        "last row is [1.0, 0.0, 0.0, 1.0], but 0 0 0 1 was expected",
    ),
    "one threshold": ({"contrast_thresholds": 0.2}, "contrast_thresholds = 0.2, but two numbers above 0"),
    "threshold of no sensor": (
        {"contrast_thresholds": [1e-45, 1e-45]},
        "holds the contrast thresholds 1e-45 (of on events) and 1e-45 (of off events), but both must be from 0.001",
    ),
    "threshold 0": ({"contrast_thresholds": [0.2, 0]}, "the contrast thresholds 0.2 (of on events) and 0 ("),
    "far before near": ({"depth_range": [4, 1]}, "the range of depth 4 m to 1 m, but the nearest and"),
    "period a fraction": ({"refractory_period_ns": 0.5}, "refractory_period_ns = 0.5, but a whole number"),
    "three colours": ({"bayer_pattern": "RGB"}, "the Bayer pattern 'RGB', but four letters of R, G and B, the"),
    "colour unknown": ({"bayer_pattern": "RGGX"}, "the Bayer pattern 'RGGX', but four"),
    "period negative": ({"refractory_period_ns": -1}, "the refractory period -1 ns, but from 0"),
    "response unknown": ({"response": "log"}, "the response 'log', but linlog, or logarithm:OFFSET with an"),
    "offset too large": ({"response": "logarithm:2.0"}, "with an offset from 1e-9 to 1"),
    "offset negative": ({"response": "logarithm:-1"}, "the response 'logarithm:-1', but"),
    "response no text": ({"response": 0.001}, "the response 0.001, but"),
    "reconstructed by a number": ({"reconstructed_by": 4}, "reconstructed_by = 4, but a text was expected"),
    "no colour": ({"bayer_pattern": 4}, "the Bayer pattern 4, but four"),
}


@pytest.mark.parametrize(("about", "message"), BAD_ABOUT.values(), ids=BAD_ABOUT.keys())
def test_bad_recording_json(tmp_path: Path, about: dict, message: str):
    refused(write_recording(tmp_path / "own", ("frames",), **about), message)


def one_pixel() -> dict[str, np.ndarray]:
    """600 events within the poses, all at (3, 4)."""
    number = np.arange(600)
    x, y, p = (np.full(600, value) for value in (3, 4, 1))
    return {"x": x.astype(np.uint16), "y": y.astype(np.uint16), "t": 10**8 + number * 10**6, "p": p.astype(np.int8)}


def save(name: str, array: np.ndarray) -> Callable[[Path], object]:
    return lambda folder: np.save(folder / name, array)


def put(name: str, content: bytes | str) -> Callable[[Path], object]:
    return lambda folder: (folder / name).write_bytes(content.encode() if isinstance(content, str) else content)


def cut(name: str, num_bytes: int) -> Callable[[Path], object]:
    return lambda folder: (folder / name).write_bytes((folder / name).read_bytes()[:-num_bytes])


def remove(name: str) -> Callable[[Path], object]:
    return lambda folder: (folder / name).unlink()


BAD_FILES: dict[str, tuple[Callable[[Path], object], str]] = {
    "t of -2^63": (
        save("events/t.npy", np.array([-(2**63), *EVENTS[1:, 2]])),
        "t.npy holds the time -9223372036854775808 ns, which is beyond 146 years",
    ),
    "all events of a hot pixel": (
        lambda folder: [save(f"events/{name}.npy", column)(folder) for name, column in one_pixel().items()],
        "holds 600 events, of which 600 are from 1 hot pixel, with over 10 times the events of the neighbourhood",
    ),
    "x missing": (remove("events/x.npy"), "events/x.npy is missing"),
    "p missing": (remove("events/p.npy"), "events/p.npy is missing"),
    "t empty": (put("events/t.npy", b""), "events/t.npy is empty"),
    "t cut off": (cut("events/t.npy", 1), "events/t.npy cannot be read as a NumPy array"),
    "t is text": (put("events/t.npy", "0 1 2"), "events/t.npy cannot be read as a NumPy array"),
    "t in float seconds": (
        save("events/t.npy", EVENTS[:, 2] * 1e-9),
        "events holds t.npy as float64 of shape (6,), but one whole number for each event (t in nanoseconds) was "
        "expected; save it with .astype(np.int64)",
    ),
    "x float": (save("events/x.npy", EVENTS[:, 0] * 1.0), "save it with .astype(np.uint16)"),
    "y float16": (save("events/y.npy", EVENTS[:, 1].astype(np.float16)), "holds y.npy as float16"),
    "p float": (save("events/p.npy", EVENTS[:, 3] * 1.0), "save it with .astype(np.int8)"),
    "x bool": (save("events/x.npy", EVENTS[:, 0] > 0), "holds x.npy as bool"),
    "x of texts": (save("events/x.npy", EVENTS[:, 0].astype(str)), "x.npy holds no array of numbers"),
    "x of objects": (save("events/x.npy", EVENTS[:, 0].astype(object)), "x.npy cannot be read as a NumPy array"),
    "x with two axes": (save("events/x.npy", EVENTS[:, :1]), "holds x.npy as int64 of shape (6, 1)"),
    "x one number": (save("events/x.npy", np.array(3)), "shape ()"),
    "y shorter": (
        save("events/y.npy", EVENTS[:4, 1]),
        "holds 6 x.npy, 4 y.npy, 6 t.npy, 6 p.npy, but as many of each were expected",
    ),
    "recording.json missing": (remove("recording.json"), "recording.json is missing; JSON was expected"),
    "recording.json cut off": (cut("recording.json", 3), "recording.json cannot be read as JSON"),
    "recording.json a list": (
        put("recording.json", "[]"),
        "recording.json holds a list, but a JSON object was expected",
    ),
    "recording.json not text": (put("recording.json", b"\xff\xfe"), "recording.json cannot be read as JSON"),
    "recording.json empty": (put("recording.json", "{}"), "recording.json lacks camera"),
    "recording.json nested": (put("recording.json", "[" * 100_000), "recording.json cannot be read as JSON"),
    "poses missing": (remove("poses.txt"), "poses.txt is missing"),
    "quaternion not unit": (
        put("poses.txt", "0 0 0 0 0 0 0 2\n9 0 0 0 0 0 0 2"),
        "line 1, holds a quaternion of norm 2",
    ),
    "stamps missing": (remove("frames/stamps_ns.txt"), "stamps_ns.txt is missing"),
    "an exposure too few": (
        put("frames/exposures_ns.txt", "5000000\n5000000\n"),
        "exposures_ns.txt holds 2 exposures of 3 frames, but one of each was expected",
    ),
    "exposure negative": (
        put("frames/exposures_ns.txt", "5000000\n-5000000\n5000000\n"),
        "exposures_ns.txt holds the exposure -5000000 ns, but 0, or at least 1000 ns,",
    ),
    "exposures in milliseconds": (
        put("frames/exposures_ns.txt", "20\n20\n20\n"),
        "exposures_ns.txt holds the exposure 20 ns, but 0, or at least 1000 ns,",
    ),
    "exposures in seconds": (
        put("frames/exposures_ns.txt", "0.02\n0.02\n0.02\n"),
        "exposures_ns.txt holds the exposure 1 ns, but 0, or at least 1000 ns,",
    ),
    "exposures longer than from frame to frame": (
        put("frames/exposures_ns.txt", "5000000\n400000000\n400000000\n"),
        "exposures_ns.txt holds exposures of 400 ms of frames that are 300 ms apart, but",
    ),
    "exposures beyond all times": (
        put("frames/exposures_ns.txt", "1e300\n0\n0\n"),
        "but exposures up to the time from",
    ),
    "exposure no number": (
        put("frames/exposures_ns.txt", "0\nlong\n0\n"),
        "exposures_ns.txt, line 2 holds 'long' where a finite number was expected",
    ),
    "exposures empty": (
        put("frames/exposures_ns.txt", ""),
        "exposures_ns.txt is empty; rows of the columns exposure_ns",
    ),
    "a frame missing": (remove("frames/1.png"), "frames holds 2 images, but its stamps_ns.txt holds 3 stamps"),
    "frame of another size": (
        lambda folder: write_image(folder / "frames/1.png", np.zeros((4, 5, 1), np.uint8)),
        "frames/1.png has 5 x 4 pixels, but 24 x 18",
    ),
    "frame damaged": (put("frames/1.png", b"\x89PNG\r\n"), "frames/1.png cannot be read as an image"),
    "depth missing": (remove("depth/2.npy"), "depth holds 2 depth maps"),
    "depth of another size": (
        save("depth/1.npy", np.ones((3, 4), np.float32)),
        "depth/1.npy holds an array of shape (3, 4)",
    ),
    "depth damaged": (put("depth/1.npy", b"1"), "depth/1.npy cannot be read as a NumPy array"),
    "table of another size": (
        lambda folder: (
            (folder / "recording.json").write_text(json.dumps(camera(model="lookup"))),
            np.save(folder / "camera_directions.npy", np.zeros((WIDTH, HEIGHT, 2))),
        ),
        "directions of pixels of shape (24, 18, 2), but finite numbers of shape (height, width, 2)",
    ),
}


@pytest.mark.parametrize(("break_it", "message"), BAD_FILES.values(), ids=BAD_FILES.keys())
def test_bad_files(tmp_path: Path, break_it: Callable[[Path], object], message: str):
    folder = write_recording(tmp_path / "own", ("frames",), depth=True)
    break_it(folder)
    refused(folder, message)


def test_no_events(tmp_path: Path):
    folder = write_recording(tmp_path / "own")
    for name in "xytp":
        np.save(folder / f"events/{name}.npy", np.zeros(0, np.int64))
    refused(folder, "events holds no events")


@pytest.mark.parametrize("time", [2**63 + 5, 2**62])
def test_times_beyond_146_years(tmp_path: Path, time: int):
    folder = write_recording(tmp_path / "own")
    times = EVENTS[:, 2].astype(np.uint64)
    times[-1] = time
    np.save(folder / "events/t.npy", times)
    with pytest.raises(RecordingError, match=rf"t\.npy holds the time {time} ns, which is beyond 146 years"):
        _ = index_events(read_recording(folder))


@pytest.mark.parametrize(
    ("column", "value", "message"),
    [("x", 24, "own, event 4 holds x = 24"), ("p", 2, "event 4 holds polarity 2"), ("t", 0, "event 4 goes back")],
)
def test_bad_events_are_named(tmp_path: Path, column: str, value: int, message: str):
    folder = write_recording(tmp_path / "own")
    array = np.load(folder / f"events/{column}.npy")
    array[3] = value
    np.save(folder / f"events/{column}.npy", array)
    refused(folder, message)


def refused(folder: Path, message: str) -> None:
    with pytest.raises(RecordingError) as caught:
        _ = index_events(read_recording(folder, "event_recording"))
    sentence = str(caught.value)
    assert message in sentence
    assert "\n" not in sentence and sentence.endswith(".")


@pytest.fixture(scope="module")
def fuzzed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_recording(tmp_path_factory.mktemp("fuzz") / "own", ("frames",), depth=True)


@settings(max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_damaged_files_are_refused_or_read(fuzzed: Path, data: st.DataObject):
    """Nothing but a RecordingError of one line, and never more events than there are."""
    files = sorted(file for file in fuzzed.rglob("*") if file.is_file() and file.suffix != ".png")
    file = data.draw(st.sampled_from(files))
    whole = file.read_bytes()
    content = bytearray(whole)
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    file.write_bytes(content[: data.draw(st.integers(0, len(content)))] if data.draw(st.booleans()) else content)
    try:
        assert len(index_events(event_recording.read(fuzzed))) <= len(EVENTS)
    except RecordingError as error:
        assert "\n" not in str(error)
    finally:
        file.write_bytes(whole)


def test_frames_of_16_bits_beside_blurred_ones_of_8_are_read_back(tmp_path: Path):
    """The white level is that of the frames of 16 bits."""
    folder = write_recording(tmp_path / "recording", frames=("frames", "blurred_frames"))
    for i in range(len(FRAME_TIMES)):
        Image.fromarray(image(i).squeeze().astype(np.uint16) * 15).save(folder / "frames" / f"{i}.png")
    convert_recording(folder, tmp_path / "new")
    before, after = read_recording(folder), read_recording(tmp_path / "new")
    for kind in ("frames", "blurred_frames"):
        np.testing.assert_array_equal(getattr(before, kind).image(0), getattr(after, kind).image(0))
    assert before.frames is not None and before.frames.white_level == 4095
