"""What writers write, read back by the readers, and by a loop that does what E-NeRF's reference code does."""

from __future__ import annotations

import json
import multiprocessing
import re
import subprocess
import time
import tracemalloc
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from decimal import Decimal
from itertools import pairwise
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import h5py
import numpy as np
import pytest
import torch
from known_points import reference_poses
from recordings import joined
from scipy.spatial.transform import Rotation

from enerf_ns.dataparsers.formats.registry import layouts, open_writer, read_recording
from enerf_ns.dataparsers.formats.writer import Setup, Writer, encode_tum
from enerf_ns.dataparsers.index.indexing import index_events
from enerf_ns.dataparsers.inspection.problems import find_problems
from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.dataparsers.recording.errors import FlagError, OutputError, RecordingError
from enerf_ns.dataparsers.recording.files import load_image
from enerf_ns.dataparsers.recording.recording import EventRecording, Events, Frames
from enerf_ns.dataparsers.recording.trajectory import Trajectory

LAYOUTS = layouts()
END = 333_333_347
"""ns; no whole microsecond."""

FRAME_TIMES = (np.arange(12) + 1) * 25_000_000 + 300
EXPOSURE = 10_000_400
THRESHOLDS = (0.2, 0.3)

CENTRED = Camera(40, 30, 35.0, 35.0, 20.0, 15.0)
RADTAN = Camera(640, 480, 560.8, 560.6, 313.0, 217.3, (-0.097, 0.214, -0.0047, -0.0042), "radtan")
RGB = Camera(46, 34, 50.5, 50.25, 22.0, 17.5, (-0.2, 0.1, 0.001, -0.002), "radtan")
FISHEYE = Camera(1280, 720, 1049.6, 1049.4, 634.7, 363.5, (-0.115, -0.062, 0.217, -0.235), "fisheye")
GREY = Camera(50, 48, 37.25, 37.5, 24.5, 23.0, (0.02, 0.002, 0.002, -0.001), "fisheye")
CAMERAS = {
    "esim": (CENTRED, CENTRED),
    "eds": (RADTAN, RGB),
    "tum_vie": (FISHEYE, GREY),
    "event_recording": (RGB, GREY),
}
"""Event and frame camera of each layout."""

CLOCK_START = {"esim": 0, "eds": 1000 * 10**9, "tum_vie": 0, "event_recording": 0}
IN_MICROSECONDS = ("eds", "tum_vie")


def extrinsics() -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_euler("xyz", [2, -5, 91], degrees=True).as_matrix()
    matrix[:3, 3] = [0.05, -0.02, 0.01]
    return matrix


def trajectory(num_poses: int = 301) -> Trajectory:
    """Positions and rotations that change fast, at times that are no whole microseconds."""
    times = np.linspace(0, END, num_poses).astype(np.int64)
    seconds = times * 1e-9
    positions = np.stack([np.sin(9 * seconds), 0.3 * np.cos(20 * seconds), seconds**2], axis=1)
    rotations = Rotation.from_euler("xyz", np.stack([np.sin(11 * seconds), seconds * 3, np.cos(7 * seconds)], axis=1))
    return Trajectory(times, positions, rotations.as_quat())


def setup_of(layout: str, **changes: Any) -> Setup:
    event_camera, frame_camera = CAMERAS[layout]
    setup = Setup(
        event_camera=event_camera,
        frame_camera=frame_camera,
        event_from_frame=np.eye(4) if layout == "esim" else extrinsics(),
        trajectory=trajectory(),
        frame_times=FRAME_TIMES,
        exposure=EXPOSURE,
        contrast_thresholds=THRESHOLDS,
        response="logarithm:0.001",
        settings={"scene": "carpet", "seed": 3},
    )
    return replace(setup, **changes)


def random_events(camera: Camera, count: int = 5000, seed: int = 0) -> Events:
    """Some of them at one time, some at the times of frames, the first and the last at the ends of the trajectory."""
    rng = np.random.default_rng(seed)
    times = np.concatenate([rng.integers(0, END + 1, count - 40), np.repeat(FRAME_TIMES, 3), [0, 0, END, END]])
    x, y = rng.integers(0, camera.width, count), rng.integers(0, camera.height, count)
    return Events(x.astype(np.uint16), y.astype(np.uint16), np.sort(times), rng.choice([-1, 1], count).astype(np.int8))


def part(events: Events, start: int, stop: int) -> Events:
    return Events(*(getattr(events, name)[start:stop] for name in "xytp"))


class Frame(NamedTuple):
    number: int
    time: int
    sharp: np.ndarray
    """uint8, as is the blurred frame."""
    blurred: np.ndarray | None
    depth: np.ndarray


def levels(brightness: np.ndarray) -> np.ndarray:
    return np.rint(255 * brightness).clip(0, 255).astype(np.uint8)


def kept(layout: str, events: Events) -> Events:
    """Those that are written: of EDS, in which the last frame must be later than the last event, not all."""
    return part(events, 0, int((events.t < FRAME_TIMES[-1] - 1000).sum())) if layout == "eds" else events


def frame_of(setup: Setup, number: int, channels: tuple[int, ...] = ()) -> Frame:
    """A frame of smooth pictures, and its depth; the first pixel of depth has none."""
    (sharp, blurred), depth = linear_of(setup, number, channels)
    exposed = None if blurred is None else levels(blurred)
    return Frame(number, int(setup.frame_times[number]), levels(sharp), exposed, depth)


def linear_of(
    setup: Setup, number: int, channels: tuple[int, ...] = ()
) -> tuple[tuple[np.ndarray, np.ndarray | None], np.ndarray]:
    """Linear brightness of a frame, sharp and blurred, and its depth."""
    camera, rng = setup.frame_camera, np.random.default_rng(number)
    shape = (camera.height, camera.width, *channels)
    sharp = cv2.GaussianBlur(rng.uniform(0, 1.1, shape), (0, 0), 2).reshape(shape)
    depth = rng.uniform(1 + 0.1 * number, 2 + 0.1 * number, shape[:2]).astype(np.float32)
    depth[0, 0] = 0
    blurred = cv2.GaussianBlur(sharp, (0, 0), 3).reshape(shape) if setup.exposure else None
    return (sharp, blurred), depth


def write(
    layout: str,
    folder: Path,
    setup: Setup,
    events: Events,
    channels: tuple[int, ...] = (),
    step: int = 333,
    with_frames: bool = True,
) -> Writer:
    """As the simulator does: events in pieces, and a frame each time that its exposure is over."""
    folder.mkdir()
    closes = (setup.frame_times + setup.exposure // 2).tolist() if with_frames else []
    number = 0
    with open_writer(layout, folder, setup) as writer:
        for start in range(0, len(events), step):
            writer.add_events(part(events, start, start + step))
            writer.add_events(part(events, 0, 0))
            done = start + step >= len(events)
            while number < len(closes) and (done or closes[number] <= events.t[start + step]):
                writer.add_frame(*frame_of(setup, number, channels))
                number += 1
    return writer


def true_poses(setup: Setup, at: np.ndarray) -> np.ndarray:
    """Of the event camera, by SciPy."""
    path = setup.trajectory
    assert path is not None
    return reference_poses(path.times, path.positions, path.quaternions, at)


def written_times(layout: str, times: np.ndarray) -> np.ndarray:
    """On the clock of the files."""
    if layout in IN_MICROSECONDS:
        times = np.floor(times / 1000 + 0.5).astype(np.int64).clip(0, END // 1000) * 1000
    return times + CLOCK_START[layout]


@dataclass
class Written:
    layout: str
    folder: Path
    setup: Setup
    events: Events
    recording: EventRecording


@pytest.fixture(scope="module", params=LAYOUTS)
def written(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Written]:
    layout = request.param
    folder = tmp_path_factory.mktemp(layout) / "recording"
    setup = setup_of(layout)
    if layout == "event_recording":
        setup = replace(setup, refractory_period=1500, bayer_pattern="RGGB")
    events = random_events(setup.event_camera)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Writer, "events_held", 1000)
        write(layout, folder, setup, events)
    yield Written(layout, folder, setup, kept(layout, events), read_recording(folder))


def test_the_layout_is_recognised_and_its_reader_notes_nothing_lost(written: Written):
    assert written.recording.format == written.layout
    assert not [note for note in written.recording.notes if "left out" in note or "renormalised" in note]
    assert len(index_events(written.recording)) == len(written.events)


def test_events_are_read_back_in_their_order(written: Written):
    found = joined(written.recording.stream_events())
    for name in "xy":
        np.testing.assert_array_equal(getattr(found, name), getattr(written.events, name))
    np.testing.assert_array_equal(found.p > 0, written.events.p > 0)
    expected = written_times(written.layout, written.events.t) - CLOCK_START[written.layout]
    np.testing.assert_array_equal(found.t, expected)
    assert (np.abs(found.t - written.events.t) <= (1000 if written.layout in IN_MICROSECONDS else 0)).all()


def test_the_trajectory_read_back_is_the_one_rendered(written: Written):
    found = written.recording.trajectory
    events = joined(written.recording.stream_events())
    times = np.concatenate([FRAME_TIMES, events.t, np.linspace(found.start, found.end, 777).astype(np.int64)])
    poses = found.poses(torch.from_numpy(times)).numpy()
    np.testing.assert_allclose(poses, true_poses(written.setup, times)[:, :3], atol=1e-6)


def test_cameras_and_extrinsics_are_read_back(written: Written):
    recording, setup = written.recording, written.setup
    assert recording.camera == setup.event_camera
    assert recording.frames is not None and recording.frames.camera == setup.frame_camera
    times = recording.frames.times
    poses = recording.frames.trajectory.poses(torch.from_numpy(times)).numpy()
    np.testing.assert_allclose(poses, (true_poses(setup, times) @ setup.event_from_frame)[:, :3], atol=1e-6)


def frames_read(written: Written) -> tuple[Frames | None, Frames]:
    """Sharp frames, where the layout has a place for them, and blurred ones."""
    recording = written.recording
    assert recording.frames is not None
    if written.layout in IN_MICROSECONDS:
        return None, recording.frames
    assert recording.blurred_frames is not None
    return recording.frames, recording.blurred_frames


def test_exposures_are_read_back_where_the_layout_states_them(written: Written):
    sharp, blurred = frames_read(written)
    if written.layout == "eds":
        assert blurred.exposures is None
        return
    assert blurred.exposures is not None
    exact = EXPOSURE // 1000 * 1000 if written.layout == "tum_vie" else EXPOSURE
    assert blurred.exposures.tolist() == [exact] * len(FRAME_TIMES)
    if sharp:
        assert sharp.exposures is not None and not sharp.exposures.any()


def check_pixels(found: np.ndarray, expected: np.ndarray, file: Path) -> None:
    """Exactly but for rounding in JPEG, which is what TUM-VIE has."""
    off = np.abs(found.astype(int) - expected)
    assert off.max() == 0 or (file.suffix == ".jpg" and off.max() < 6 and off.mean() < 1)


def test_frames_and_depth_are_read_back(written: Written):
    sharp, blurred = frames_read(written)
    for frames in filter(None, (sharp, blurred)):
        assert np.abs(frames.times - FRAME_TIMES).max() <= (500 if written.layout in IN_MICROSECONDS else 0)
        assert len(frames.filenames) == len(FRAME_TIMES)
    sharp_files = sharp.filenames if sharp else tuple(sorted((written.folder / "sharp_images").iterdir()))
    for number in range(len(FRAME_TIMES)):
        frame = frame_of(written.setup, number)
        assert frame.blurred is not None
        for file, pixels in ((sharp_files[number], frame.sharp), (blurred.filenames[number], frame.blurred)):
            image = load_image(file)
            assert image.shape[2] == (3 if written.layout in ("esim", "eds") else 1)
            check_pixels(image, np.broadcast_to(pixels[..., None], image.shape), file)
        np.testing.assert_array_equal(np.load(written.folder / f"depth/{number:05d}.npy"), frame.depth)
    if sharp:
        assert sharp.depth_filenames is not None and len(sharp.depth_filenames) == len(FRAME_TIMES)


def test_the_truth_lies_beside_it(written: Written):
    truth = json.loads((written.folder / "simulation.json").read_text())
    depths = np.stack([frame_of(written.setup, number).depth for number in range(12)])
    nearest, farthest = float(depths[depths > 0].min()), float(depths.max())
    expected = {"scene": "carpet", "seed": 3, "contrast_thresholds": list(THRESHOLDS), "exposure_ns": EXPOSURE}
    expected |= {
        "num_events": len(written.events),
        "num_frames": 12,
        "response": "logarithm:0.001",
        "finished": True,
        "layout": written.layout,
    }
    expected |= {"clock_start_ns": CLOCK_START[written.layout], "depth_range": [nearest, farthest]}
    assert {key: truth[key] for key in expected} == expected
    assert truth["camera"]["fx"] == written.setup.event_camera.fx
    matrix = truth["frame_camera"]["event_camera_from_frame_camera"]
    np.testing.assert_array_equal(matrix, written.setup.event_from_frame)
    if written.layout not in IN_MICROSECONDS:
        assert written.recording.contrast_thresholds == THRESHOLDS
        assert written.recording.depth_range == (nearest, farthest)
    if written.layout == "event_recording":
        assert (written.recording.refractory_period, written.recording.bayer_pattern) == (1500, "RGGB")


def test_nothing_but_what_belongs_there_is_left(written: Written):
    assert not [path for path in written.folder.rglob("*") if path.name.startswith(".") or path.suffix == ".partial"]


OWN = r"simulation\.json|depth/\d{5}\.npy|sharp_images/\d{5}\.png"
PUBLISHED = {
    "esim": r"events/\d{5}\.npy|poses_all\.txt|poses_bounds\.npy|images(_corrupted)?/(\d{5}\.png|image_stamps_ns\.txt)",
    "eds": r"events\.h5|stamped_groundtruth\.txt|camchain\.yaml|images/frame_\d{10}\.png|images_timestamps\.txt",
    "tum_vie": r"camera-calibrationA\.json|mocap-imu-calibrationA\.json|\w+-events_left\.h5"
    r"|\w+-vi_gt_data/(mocap_data\.txt|left_images/(\d{5}\.jpg|image_(timestamps|exposures)_left\.txt)"
    r"|right_images/image_timestamps_right\.txt)",
}
"""Names of the files of each published layout, as the data sets and the code of E-NeRF have them."""


@pytest.mark.parametrize("written", PUBLISHED, indirect=True)
def test_files_have_the_names_of_the_published_layout(written: Written):
    names = {path.relative_to(written.folder).as_posix() for path in written.folder.rglob("*") if path.is_file()}
    assert not {name for name in names if not re.fullmatch(f"{PUBLISHED[written.layout]}|{OWN}", name)}
    if written.layout == "tum_vie":  # whose files the converter of Robust e-NeRF finds by these names
        pictures = written.folder.glob("*-vi_gt_data/left_images/*.jpg")
        assert [file.name for file in sorted(pictures)] == [f"{number:05d}.jpg" for number in range(len(FRAME_TIMES))]


@pytest.mark.parametrize("name", ["camera-calibrationA.json", "mocap-imu-calibrationA.json"])
@pytest.mark.parametrize("written", ["tum_vie"], indirect=True)
def test_calibration_has_the_entries_of_the_real_one(written: Written, shared_data: Path, name: str):
    real, found = (
        json.loads((folder / name).read_text())["value0"] for folder in (shared_data / "tum_vie", written.folder)
    )
    for key, value in found.items():
        assert key in real and type(value) is type(real[key])
        if isinstance(value, list):
            assert len(value) == len(real[key])
            assert all(type(one) is type(other) for one, other in zip(value, real[key], strict=True))
            assert not isinstance(value[0], dict) or value[0].keys() == real[key][0].keys()


@pytest.mark.parametrize("layout", LAYOUTS)
def test_how_events_are_handed_over_does_not_matter(tmp_path: Path, layout: str, monkeypatch: pytest.MonkeyPatch):
    setup = setup_of(layout)
    events = random_events(setup.event_camera, 600)
    monkeypatch.setattr(Writer, "events_held", 100)
    read = []
    for name, step in (("one", 1), ("some", 37), ("all", 600)):
        write(layout, tmp_path / name, setup, events, step=step)
        read.append(joined(read_recording(tmp_path / name).stream_events()))
    for other in read[1:]:
        for name in "xytp":
            np.testing.assert_array_equal(getattr(other, name), getattr(read[0], name))


@pytest.mark.parametrize("layout", LAYOUTS)
def test_frames_in_colour(tmp_path: Path, layout: str):
    setup = setup_of(layout, exposure=0)
    write(layout, tmp_path / "recording", setup, random_events(setup.event_camera), channels=(3,))
    recording = read_recording(tmp_path / "recording")
    assert recording.frames is not None and recording.blurred_frames is None
    for number, file in enumerate(recording.frames.filenames):
        check_pixels(load_image(file), frame_of(setup, number, (3,)).sharp, file)
    assert np.abs(recording.frames.times - FRAME_TIMES).max() <= (500 if layout in IN_MICROSECONDS else 0)
    assert not (tmp_path / "recording/sharp_images").exists()


@pytest.mark.parametrize("channels", [(), (3,)])
def test_high_dynamic_range(tmp_path: Path, channels: tuple[int, ...]):
    setup = setup_of("esim")
    with open_writer("esim", tmp_path, setup) as writer:
        for number in range(len(FRAME_TIMES)):
            linear, _ = linear_of(setup, number, channels)
            writer.add_frame(*frame_of(setup, number, channels), linear=linear)
    (sharp, blurred), _ = linear_of(setup, 7, channels)
    assert blurred is not None
    for folder, brightness in (("hdr", sharp), ("hdr_blurred", blurred)):
        assert len(list((tmp_path / folder).iterdir())) == 12
        array = np.load(tmp_path / folder / "00007.npy")
        assert array.dtype == np.float32
        np.testing.assert_array_equal(array, brightness.astype(np.float32))


def test_thresholds_of_pixels(tmp_path: Path):
    thresholds = np.random.default_rng(0).uniform(0.1, 0.3, (2, 30, 40))
    setup = setup_of("esim", pixel_thresholds=thresholds)
    write("esim", tmp_path / "new", setup, random_events(CENTRED))
    found = np.load(tmp_path / "new/thresholds.npy")
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, thresholds, atol=1e-7)


def test_without_poses_and_depth(tmp_path: Path):
    """As from a video: the recording can be read when somebody adds the poses."""
    setup = setup_of("event_recording", trajectory=None)
    folder = tmp_path / "new"
    folder.mkdir()
    with open_writer("event_recording", folder, setup) as writer:
        writer.add_events(random_events(RGB))
        writer.add_frame(*frame_of(setup, 0)[:-1])
    assert not (folder / "depth").exists() and writer.depth_range is None
    with pytest.raises(RecordingError, match=r"poses\.txt is missing"):
        read_recording(folder, "event_recording")
    (folder / "poses.txt").write_text(f"0 0 0 0 0 0 0 1\n{END} 1 0 0 0 0 0 1\n")
    assert len(index_events(read_recording(folder))) == 5000


# ------------------------------------------------------------------------------------- what others expect of layouts


def read_as_the_reference_code(folder: Path, corrupted: bool) -> list[np.ndarray]:
    """Loads and checks as the ESIM mode of E-NeRF's loader does; the events from each image to the next."""
    rows = np.load(folder / "poses_bounds.npy")
    assert rows.shape[1] == 17 and len(rows) > 10
    matrices = rows[:, :15].reshape(-1, 3, 5)
    for rotation in matrices[:, :, :3]:
        np.testing.assert_allclose(np.cross(rotation[:, 0], rotation[:, 1]), rotation[:, 2], atol=1e-9)
    height, width, focal_length = matrices[0, :, 4]
    assert (height, width, focal_length) == (30, 40, 35)
    poses = np.loadtxt(sorted(folder.glob("*poses_all*.txt"))[0], skiprows=1)
    assert poses.shape[1] == 8 and len(poses) > 100 and (np.diff(poses[:, 0]) > 0).all()
    np.testing.assert_allclose(np.linalg.norm(poses[:, 4:], axis=1), 1, atol=1e-9)
    images_folder = folder / ("images_corrupted" if corrupted else "images")
    stamps = np.loadtxt(images_folder / "image_stamps_ns.txt")
    images = sorted(images_folder.glob("*.png"))
    assert len(images) == len(stamps) and (np.diff(stamps) > 0).all()
    for file in images:
        image = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
        assert image is not None and image.shape == (height, width, 3)
    files = sorted(str(file) for file in (folder / "events").glob("*.npy"))
    windows = []
    for start, stop in [*pairwise(range(len(images))), (len(images) - 1, len(images))]:
        batch = np.concatenate([np.load(file) for file in files[start:stop]])
        assert batch.ndim == 2 and batch.shape[1] >= 4
        batch = batch[:, :4]
        if len(batch):
            assert set(np.unique(batch[:, 3])) <= {-1, 1}
            assert batch[:, 0].max() < 1280 and batch[:, 1].max() < 720 and batch[:, :2].min() >= 0
            assert (np.diff(batch[:, 2]) >= 0).all()
        windows.append(batch)
    return windows


@pytest.mark.parametrize("num_poses", [2, 3, 60, 100, 101, 301])
def test_esim_passes_the_checks_of_the_reference_code(tmp_path: Path, num_poses: int):
    setup = setup_of("esim", trajectory=trajectory(num_poses))
    events = random_events(CENTRED)
    write("esim", tmp_path / "new", setup, events)
    for corrupted in (False, True):
        windows = read_as_the_reference_code(tmp_path / "new", corrupted)
        assert len(windows) == len(FRAME_TIMES)
        np.testing.assert_array_equal(np.concatenate(windows), np.stack([getattr(events, c) for c in "xytp"], axis=1))
        for number, window in enumerate(windows):
            assert number == 0 or (window[:, 2] > FRAME_TIMES[number]).all()
            assert number == 11 or (window[:, 2] <= FRAME_TIMES[number + 1]).all()
    read = read_recording(tmp_path / "new").trajectory
    times = np.linspace(0, END, 500).astype(np.int64)
    found = read.poses(torch.from_numpy(times)).numpy()
    np.testing.assert_allclose(found, true_poses(setup, times)[:, :3], atol=1e-9)
    assert set(setup.trajectory.times) <= set(read.times)  # type: ignore[union-attr]


def test_bounds_are_those_of_the_depth_and_poses_those_of_the_frames(tmp_path: Path):
    setup = setup_of("esim")
    writer = write("esim", tmp_path / "new", setup, random_events(CENTRED))
    rows = np.load(tmp_path / "new/poses_bounds.npy")
    np.testing.assert_array_equal(rows[:, 15:], np.tile(writer.depth_range, (12, 1)))  # type: ignore[arg-type]
    llff, poses = rows[:, :15].reshape(12, 3, 5), true_poses(setup, FRAME_TIMES)
    down, right, back = np.moveaxis(llff[:, :, :3], 2, 0)
    np.testing.assert_allclose(np.stack([right, down, -back], axis=2), poses[:, :3, :3], atol=1e-9)
    np.testing.assert_allclose(llff[:, :, 3], poses[:, :3, 3], atol=1e-9)


def test_hdf5_files_are_those_of_the_data_sets(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(Writer, "events_held", 700)
    for layout, name, group, filters in (
        ("eds", "events.h5", "", []),
        ("tum_vie", "simulated-events_left.h5", "events/", [32001]),
    ):
        setup = setup_of(layout)
        events = random_events(setup.event_camera)
        write(layout, tmp_path / layout, setup, events)
        count = len(kept(layout, events))
        with h5py.File(tmp_path / layout / name) as file:
            for column, dtype in zip("xytp", ("u2", "u2", "i8", "u1"), strict=True):
                dataset = file[group + column]
                assert isinstance(dataset, h5py.Dataset) and dataset.dtype == dtype and len(dataset) == count
                properties = dataset.id.get_create_plist()
                assert [properties.get_filter(i)[0] for i in range(properties.get_nfilters())] == filters
            times = np.asarray(file[group + "t"])
            assert set(np.asarray(file[group + "p"])) == {0, 1}
            assert ("ms_to_idx" in file) == (layout == "tum_vie")
            indices = np.asarray(file["ms_to_idx"]) if layout == "tum_vie" else np.zeros(0)
        if layout == "tum_vie":
            assert len(indices) == times[-1] // 1000 + 1
            assert indices.tolist() == [(times < 1000 * ms).sum() for ms in range(len(indices))]
        with h5py.File(tmp_path / layout / name, "r+") as file:  # as the preparation of EDS does, in place
            file[group + "t"][:] = times - times[0]  # type: ignore[index]


# --------------------------------------------------------------------------------------------------------- broken off


def check_what_is_left(layout: str, folder: Path, setup: Setup, events: Events, at_least: int = 1) -> tuple[int, int]:
    """That a recording can be read and holds nothing but what was given; how many events and frames it holds."""
    recording = read_recording(folder)
    found = joined(recording.stream_events())
    assert len(found) >= at_least
    np.testing.assert_array_equal(found.t, written_times(layout, events.t[: len(found)]) - CLOCK_START[layout])
    for name in "xy":
        np.testing.assert_array_equal(getattr(found, name), getattr(events, name)[: len(found)])
    num_frames = 0
    if recording.frames is not None:
        num_frames = len(recording.frames.filenames)
        for number, file in enumerate(recording.frames.filenames):
            frame = frame_of(setup, number)
            shown = frame.blurred if layout in IN_MICROSECONDS else frame.sharp
            assert shown is not None
            check_pixels(load_image(file)[..., 0], shown, file)
            np.testing.assert_array_equal(np.load(folder / f"depth/{number:05d}.npy"), frame.depth)
    assert not list(folder.rglob("*.partial"))
    return len(found), num_frames


@pytest.mark.parametrize("layout", LAYOUTS)
def test_an_interrupted_recording_holds_all_that_was_added(tmp_path: Path, layout: str):
    setup, folder = setup_of(layout), tmp_path / "new"
    events = random_events(setup.event_camera)
    folder.mkdir()
    with pytest.raises(KeyboardInterrupt), open_writer(layout, folder, setup) as writer:
        writer.add_events(part(events, 0, 1234))
        for number in range(3):
            writer.add_frame(*frame_of(setup, number))
        writer.add_events(part(events, 1234, 3000))
        raise KeyboardInterrupt
    assert check_what_is_left(layout, folder, setup, events) == (3000, 3)
    assert json.loads((folder / "simulation.json").read_text())["finished"] is False
    problems = [problem.what for problem in find_problems(read_recording(folder))]
    assert "The simulation of this recording was stopped before its end." in problems


def write_and_wait(layout: str, folder: Path, written: Connection) -> None:
    Writer.events_held = 500
    setup = setup_of(layout)
    events = random_events(setup.event_camera)
    writer = open_writer(layout, folder, setup)
    for start in range(0, 3000, 300):
        writer.add_events(part(events, start, start + 300))
    for number in range(4):
        writer.add_frame(*frame_of(setup, number))
    written.send(True)
    time.sleep(600)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_killed_process_leaves_what_it_wrote(tmp_path: Path, layout: str):
    setup, folder = setup_of(layout), tmp_path / "new"
    folder.mkdir()
    context = multiprocessing.get_context("spawn")
    reading, writing = context.Pipe(duplex=False)
    child = context.Process(target=write_and_wait, args=(layout, folder, writing))
    child.start()
    assert reading.poll(120) and reading.recv()
    child.kill()
    child.join()
    assert check_what_is_left(layout, folder, setup, random_events(setup.event_camera)) == (3000, 4)


@pytest.mark.parametrize("layout", ["eds", "tum_vie"])
def test_an_interruption_between_two_columns(tmp_path: Path, layout: str, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(Writer, "events_held", 500)
    setup, folder = setup_of(layout), tmp_path / "new"
    events = random_events(setup.event_camera)
    folder.mkdir()
    resize = h5py.Dataset.resize

    def interrupted(dataset: h5py.Dataset, size: tuple[int]) -> None:
        if dataset.name is not None and dataset.name.endswith("t") and size == (1000,):
            monkeypatch.undo()
            raise KeyboardInterrupt
        resize(dataset, size)

    monkeypatch.setattr(h5py.Dataset, "resize", interrupted)
    with pytest.raises(KeyboardInterrupt), open_writer(layout, folder, setup) as writer:
        writer.add_events(part(events, 0, 500))
        writer.add_events(part(events, 500, 1000))
    assert check_what_is_left(layout, folder, setup, events)[0] == 1000


def write_until_it_fails(layout: str, folder: Path, setup: Setup, events: Events, with_frames: bool) -> str:
    """The message of the error."""
    with pytest.raises(OutputError) as caught:
        write(layout, folder, setup, events, with_frames=with_frames)
    return str(caught.value)


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Callable[[int], Path]]:
    """A function from KiB to an empty disk of that size."""
    disks: list[Path] = []

    def mount(size: int) -> Path:
        disk = tmp_path / f"disk{size}"
        disk.mkdir()
        try:
            subprocess.run(
                ["mount", "-t", "tmpfs", "-o", f"size={size}k", "tmpfs", disk], capture_output=True, check=True
            )
        except (OSError, subprocess.CalledProcessError):
            pytest.skip("this user may not mount a small disk")
        disks.append(disk)
        return disk

    yield mount
    for disk in disks:
        subprocess.run(["umount", "--lazy", disk], check=True)  # readers keep files open


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("with_frames", [True, False], ids=["frames", "events"])
def test_what_was_written_before_the_disk_was_full_can_be_read(
    layout: str, with_frames: bool, small_disk: Callable[[int], Path], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(Writer, "events_held", 1000)
    setup = setup_of(layout)
    camera = setup.frame_camera
    large = Camera(200, 150, 175.0, 175.0, 100.0, 75.0, camera.distortion, camera.model)
    setup = replace(setup, frame_camera=large, event_camera=large if layout == "esim" else setup.event_camera)
    events = random_events(setup.event_camera, 60_000 if with_frames else 200_000)
    left = []
    for size in (700, 777, 810, 900):
        folder = small_disk(size) / "new"
        message = write_until_it_fails(layout, folder, setup, events, with_frames)
        assert str(folder) in message and "No space left on device" in message and "\n" not in message
        left.append(check_what_is_left(layout, folder, setup, events))
    assert left[-1][0] >= left[0][0] > 1000
    assert left[-1][1] > 0 or not with_frames


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_file_that_may_not_grow_any_more(tmp_path: Path, layout: str, monkeypatch: pytest.MonkeyPatch):
    """As a full disk, for users who cannot mount one."""
    resource = pytest.importorskip("resource")
    monkeypatch.setattr(Writer, "events_held", 1000)
    setup, folder = setup_of(layout), tmp_path / "new"
    events = random_events(setup.event_camera, 60_000)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, hard))
    try:
        message = write_until_it_fails(layout, folder, setup, events, with_frames=False)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert str(folder) in message and "File too large" in message
    assert check_what_is_left(layout, folder, setup, events, 1000)[0] < 60_000


@pytest.mark.parametrize("layout", LAYOUTS)
def test_memory_does_not_grow_with_the_events(tmp_path: Path, layout: str):
    setup, folder = setup_of(layout), tmp_path / "new"
    folder.mkdir()
    count = 20_000
    peaks = []
    with open_writer(layout, folder, setup) as writer:
        tracemalloc.start()
        for start in range(0, 100 * count, count):
            times = 3_000_000 + 140 * np.arange(start, start + count)
            writer.add_events(Events(np.arange(count) % 30, np.arange(count) % 20, times, np.ones(count, np.int8)))
            peaks.append(tracemalloc.get_traced_memory()[0])
        tracemalloc.stop()
    assert writer.num_events == 2_000_000
    assert max(peaks) < 0.1 * 2_000_000 * (3 * 8 + 1)


# ---------------------------------------------------------------------------------------------------------- bad input


@pytest.mark.parametrize(
    ("layout", "changes", "message"),
    [
        ("esim", dict(frame_camera=GREY), "esim holds one camera for events and frames"),
        ("esim", dict(event_from_frame=extrinsics()), "esim holds one camera for events and frames"),
        ("esim", dict(event_camera=replace(CENTRED, cx=19.5), frame_camera=replace(CENTRED, cx=19.5)), r"width / 2"),
        (
            "esim",
            dict(event_camera=replace(CENTRED, fy=36.0), frame_camera=replace(CENTRED, fy=36.0)),
            "esim holds one",
        ),
        ("esim", dict(event_camera=RGB, frame_camera=RGB), "without distortion"),
        ("esim", dict(frame_times=FRAME_TIMES[:10]), "esim needs at least 11 frames, but 10 were asked for"),
        ("eds", dict(event_camera=CENTRED), "eds holds events of 640 x 480 pixels, but 40 x 30 were asked for"),
        ("eds", dict(frame_camera=replace(RGB, distortion=(0.1, 0, 0, 0, 0))), "but one of 5 of radtan was asked for"),
        ("tum_vie", dict(event_camera=RADTAN), "tum_vie holds events of 1280 x 720 pixels"),
        ("tum_vie", dict(frame_camera=RGB), "tum_vie holds cameras of the model fisheye, but one of radtan"),
        (
            "event_recording",
            dict(frame_camera=replace(CENTRED, model="lookup", directions=np.zeros((30, 40, 2)))),
            "no table of directions",
        ),
        ("event_recording", dict(event_from_frame=np.diag([1.0, 1, -1, 1])), "their rotation is no rotation"),
    ],
)
def test_what_a_layout_cannot_hold_is_refused(tmp_path: Path, layout: str, changes: dict, message: str):
    with pytest.raises(FlagError, match=message) as caught:
        open_writer(layout, tmp_path, setup_of(layout, **changes))
    assert str(caught.value).endswith(".") and "\n" not in str(caught.value)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("zero", [0, -1_000_000_001, 1_468_939_802_123_456_789])
def test_text_of_poses_states_the_clock_of_the_files_to_the_nanosecond(zero: int):
    times = np.array([-5, 0, 7, 3_000_000_000])
    poses = Trajectory(times, np.zeros((4, 3)), np.tile([0.0, 0.0, 0.0, 1.0], (4, 1)))
    _, *lines = encode_tum(poses, zero).decode().splitlines()
    assert [Decimal(line.split()[0]) * 10**9 - zero for line in lines] == times.tolist()
