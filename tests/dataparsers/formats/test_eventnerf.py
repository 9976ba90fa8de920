"""Scenes in EventNeRF's folders are written here by NumPy from the documents of the layout, and read back."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from recordings import HEIGHT, WIDTH, image, joined, poses, write_image
from scipy.spatial.transform import Rotation

from enerf_ns.dataparsers.formats.conversion import convert_recording
from enerf_ns.dataparsers.formats.registry import _read_folder, read_recording
from enerf_ns.dataparsers.index.indexing import index_events
from enerf_ns.dataparsers.recording.errors import FlagError, RecordingError

VIEWS = len(poses())
LAST = 1_000_000
"""Time of the last event, in the unit of the file."""

EVENTS = np.column_stack(
    [
        np.random.default_rng(0).permutation(np.arange(1200) % WIDTH),
        np.random.default_rng(1).permutation(np.arange(1200) % HEIGHT),
        np.linspace(1000, LAST, 1200).astype(np.int64),
        np.random.default_rng(2).choice([-1, 1], 1200),
    ]
)
"""x y t p."""

K = np.array([[20.0, 0, 12.5, 0], [0, 21, 9.25, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
RADIAL = -0.15, 0.02


def matrices() -> np.ndarray:
    """The poses of `recordings`, float64 [11, 4, 4]."""
    found = np.tile(np.eye(4), (VIEWS, 1, 1))
    found[:, :3, :3], found[:, :3, 3] = Rotation.from_quat(poses()[:, 3:]).as_matrix(), poses()[:, :3]
    return found


def write_matrix(path: Path, matrix: np.ndarray, rows: bool = False) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = matrix.tolist() if rows else [matrix.ravel().tolist()]
    path.write_text("\n".join(" ".join(map(repr, line)) for line in lines) + "\n")


def write_events(path: Path, events: np.ndarray, unit: float | None = None) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    x, y, t, p = events.T
    times = t if unit is None else t * unit
    np.savez_compressed(path, x=x.astype(np.int16), y=y.astype(np.int16), t=times, p=p.astype(np.int8))


def write_eventnerf(
    folder: Path,
    events: np.ndarray = EVENTS,
    unit: float | None = None,
    radial: tuple[float, float] | None = None,
    split: str = "train",
    pictures: bool = True,
    views: np.ndarray | None = None,
) -> Path:
    """As EventNeRF publishes it."""
    for view, pose in enumerate(matrices() if views is None else views):
        write_matrix(folder / split / f"pose/r_{view:05d}.txt", pose)
        with_radial = K if radial is None else np.vstack([K, [*radial, 0, 0]])
        write_matrix(folder / split / f"intrinsics/r_{view:05d}.txt", with_radial)
        if pictures:
            (folder / split / "rgb").mkdir(exist_ok=True)
            write_image(folder / split / f"rgb/r_{view:05d}.png", image(view, 3))
    write_events(folder / split / "events/test.npz", events, unit)
    return folder


TIMES = np.cumsum([7000, *np.random.default_rng(3).integers(50_000, 130_000, VIEWS - 1)])
"""Times of the views where E-3DGS's names state them, in the unit of the events."""


def write_e3dgs(folder: Path) -> Path:
    """As E-3DGS has it: times in names, one file of intrinsics, and pictures of validation views alone."""
    for view, (pose, time) in enumerate(zip(matrices(), TIMES.tolist(), strict=True)):
        write_matrix(folder / f"train/pose/{view}_cam_{time}.txt", pose, rows=True)
    write_matrix(folder / f"train/pose/usable_{TIMES[0]}.txt", np.eye(4))
    write_matrix(folder / "train/intrinsics/intrinsics.txt", K, rows=True)
    (folder / "train/intrinsics/radial_distortion.txt").write_text("-0.1 0.02 0 0\n")
    write_events(folder / "train/events/raw.npz", EVENTS[::-1])
    write_events(folder / "train/events/raw_undistorted.npz", EVENTS)
    for view in range(4):
        write_matrix(folder / f"validation/pose/{view:06d}_cam_{view}.txt", matrices()[2 * view], rows=True)
    (folder / "validation/rgb").mkdir()
    for view in (1, 3):
        write_image(folder / f"validation/rgb/{view:06d}.png", image(view, 3))
    return folder


def check_events(recording, ns_per_unit: float) -> None:
    found = joined(recording.stream_events())
    np.testing.assert_array_equal(np.column_stack([found.x, found.y, found.p]), EVENTS[:, [0, 1, 3]])
    np.testing.assert_allclose(found.t, EVENTS[:, 2] * ns_per_unit, rtol=0, atol=1)


def check_poses(recording) -> None:
    np.testing.assert_allclose(recording.trajectory.positions, poses()[:, :3], rtol=0, atol=1e-12)
    rotations = Rotation.from_quat(recording.trajectory.quaternions).as_matrix()
    np.testing.assert_allclose(rotations, matrices()[:, :3, :3], rtol=0, atol=1e-12)


@pytest.mark.parametrize("unit", [None, 1e-3 * (VIEWS - 1), 1e-6, 0.3], ids=["integers", "views", "1", "other"])
def test_synthetic_scene(tmp_path: Path, unit: float | None):
    """View i of N is at i / (N - 1) of the last time, whatever the unit is."""
    recording = read_recording(write_eventnerf(tmp_path / "lego", unit=unit))
    assert recording.format == "eventnerf" and recording.bayer_pattern == "RGGB" and recording.notes == ()
    np.testing.assert_array_equal(recording.trajectory.times, np.arange(VIEWS) * 1_000_000)
    check_poses(recording)
    check_events(recording, (VIEWS - 1) * 1e6 / LAST)
    assert recording.num_events == len(EVENTS)
    camera = recording.camera
    assert (camera.width, camera.height, camera.model) == (WIDTH, HEIGHT, "pinhole")
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (20, 21, 12.0, 8.75)  # whole numbers are centres of pixels
    frames = recording.frames
    assert frames is not None and frames.camera == camera and frames.trajectory is recording.trajectory
    np.testing.assert_array_equal(frames.times, recording.trajectory.times)
    np.testing.assert_allclose(frames.image(3), (image(3, 3) / 255) ** 2.2, rtol=1e-5)
    assert len(index_events(recording)) == len(EVENTS)


@pytest.mark.parametrize("name", ["perturbed", "deg=0.3_cm=2"])
def test_sets_of_poses(tmp_path: Path, name: str):
    """Views that are held out keep their poses."""
    folder = write_e3dgs(tmp_path / "scene")
    for file in (folder / "train/pose").glob("*_cam_*.txt"):
        pose = np.loadtxt(file)
        pose[:3, 3] += [0.02, 0, -0.01]
        write_matrix(folder / f"train/pose_{name}" / file.name, pose, rows=True)
    given, other = read_recording(folder), read_recording(folder, pose_set=name)
    np.testing.assert_array_equal(other.trajectory.times, given.trajectory.times)
    np.testing.assert_allclose(other.trajectory.positions, poses()[:, :3] + [0.02, 0, -0.01], rtol=0, atol=1e-12)
    assert given.held_out_frames is not None and other.held_out_frames is not None
    kept = other.held_out_frames.trajectory.positions
    np.testing.assert_array_equal(kept, given.held_out_frames.trajectory.positions)
    with pytest.raises(FlagError, match=rf"--pose-set uslam asks for pose_uslam, .*; give one of {name}, or leave it"):
        read_recording(folder, pose_set="uslam")


def test_the_duration_can_be_stated(tmp_path: Path):
    recording = read_recording(write_eventnerf(tmp_path / "lego"), duration_s=2.5)
    np.testing.assert_array_equal(recording.trajectory.times, np.arange(VIEWS) * 250_000_000)
    check_events(recording, 2500)


def test_rays_of_a_real_scene_are_distorted_as_in_eventnerf(tmp_path: Path):
    camera = read_recording(write_eventnerf(tmp_path / "sewing", radial=RADIAL, pictures=True)).camera
    assert camera.model == "lookup"
    directions = camera.pixel_directions()
    for row, column in ((0, 0), (3, 20), (17, 23)):
        x, y = (column + 0.5 - K[0, 2]) / K[0, 0], (row + 0.5 - K[1, 2]) / K[1, 1]
        d = 1 + RADIAL[0] * (x * x + y * y) + RADIAL[1] * (x * x + y * y) ** 2
        np.testing.assert_allclose(directions[row, column], [x / d, y / d, 1], rtol=1e-12)


def test_the_sensor_of_a_scene_without_pictures(tmp_path: Path):
    folder = write_eventnerf(tmp_path / "r", pictures=False, split="train1")
    for file in (folder / "train1/intrinsics").iterdir():
        write_matrix(file, K * [[10, 1, 14, 1], [1, 10, 14, 1], [1] * 4, [1] * 4])
    recording = read_recording(folder)
    assert (recording.camera.width, recording.camera.height) == (346, 260) and not recording.has_frames
    write_eventnerf(folder, split="train2")
    with pytest.raises(RecordingError, match=r"holds train1, train2 with events, but one was expected; .* --split"):
        read_recording(folder, duration_s=3.0)  # a setting that was not read before
    assert read_recording(folder, split="train2").camera.width == WIDTH
    with pytest.raises(FlagError, match=r"--split train is none of .* give one of train1, train2"):
        read_recording(folder, split="train")


def test_scene_of_e_3dgs(tmp_path: Path):
    """Times come from the names, numbers of which are not padded; pictures are of validation views."""
    recording = read_recording(write_e3dgs(tmp_path / "scene"))
    ns_per_unit = (VIEWS - 1) * 1e6 / (TIMES[-1] - TIMES[0])
    np.testing.assert_allclose(recording.trajectory.times, TIMES * ns_per_unit, rtol=0, atol=1)
    check_poses(recording)
    check_events(recording, ns_per_unit)
    assert recording.frames is None and recording.bayer_pattern == "RGGB" and recording.camera.model == "pinhole"
    held_out = recording.held_out_frames
    assert held_out is not None and [file.name for file in held_out.filenames] == ["000001.png", "000003.png"]
    np.testing.assert_allclose(held_out.trajectory.positions, poses()[[2, 6], :3], rtol=0, atol=1e-12)
    assert [note.split(",")[0] for note in recording.notes] == [
        "Of 2 files of events",
        "radial_distortion.txt is not used",
    ]


@pytest.mark.parametrize("step", [1, -1], ids=["RGB", "BGR"])
def test_mask_of_colours(tmp_path: Path, step: int):
    folder = write_e3dgs(tmp_path / "scene")
    mask = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    mask[0::2, 0::2, 0], mask[0::2, 1::2, 1], mask[1::2, 0::2, 1], mask[1::2, 1::2, 2] = 255, 255, 255, 255
    write_image(folder / "train/intrinsics/color_mask_undistorted.png", mask[..., ::step])
    assert read_recording(folder).bayer_pattern == "RGGB"
    mask[5, 6] = 255, 255, 0
    write_image(folder / "train/intrinsics/color_mask_undistorted.png", mask[..., ::step])
    _read_folder.cache_clear()
    recording = read_recording(folder)
    assert recording.bayer_pattern is None
    assert any("are read as those of a grey sensor" in note for note in recording.notes)


@pytest.mark.parametrize(("size", "first"), [(200, 0), (300, 1)])
def test_a_burst_at_the_start_is_left_out(tmp_path: Path, size: int, first: int):
    """As of a simulator that begins with a black picture: 20 times the 12 events of a step, or more."""
    views = np.tile(np.eye(4), (101, 1, 1))
    views[:, 0, 3] = np.linspace(0, 1, 101)
    burst = np.column_stack([np.arange(size) % WIDTH, np.arange(size) % HEIGHT, np.full(size, 500), np.ones(size)])
    events = np.concatenate([burst.astype(np.int64), EVENTS])
    recording = read_recording(write_eventnerf(tmp_path / "lego", events, views=views))
    np.testing.assert_array_equal(recording.trajectory.times, np.arange(first, 101) * 1_000_000)
    assert recording.frames is not None and len(recording.frames.times) == 101 - first
    assert [note.split(":")[0] for note in recording.notes] == ["The stream begins with a burst"] * first
    assert len(joined(recording.stream_events())) == len(events)


def test_conversion_keeps_camera_colours_and_gamma(tmp_path: Path):
    source = read_recording(write_eventnerf(tmp_path / "sewing", radial=RADIAL))
    convert_recording(source.path, tmp_path / "own")
    copy = read_recording(tmp_path / "own")
    assert copy.camera == source.camera and copy.bayer_pattern == "RGGB"
    np.testing.assert_array_equal(copy.camera.pixel_directions(), source.camera.pixel_directions())
    assert source.frames is not None and copy.frames is not None and copy.frames.gamma == 2.2
    np.testing.assert_array_equal(copy.frames.image(4), source.frames.image(4))
    one, other = joined(source.stream_events()), joined(copy.stream_events())
    np.testing.assert_array_equal(one.t, other.t)


def change(name: str, change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Path], None]:
    def changed(folder: Path) -> None:
        with np.load(folder / "train/events/test.npz") as file:
            columns = dict(file)
        columns[name] = change(columns[name])
        np.savez(folder / "train/events/test.npz", **columns)

    return changed


def text(name: str, content: str) -> Callable[[Path], object]:
    return lambda folder: (folder / "train" / name).write_text(content)


def set_value(index: int, value: float) -> Callable[[np.ndarray], np.ndarray]:
    def changed(column: np.ndarray) -> np.ndarray:
        column = column.astype(np.float64)
        column[index] = value
        return column

    return changed


BAD_INPUT: dict[str, tuple[Callable[[Path], object], str]] = {
    "one pose": (
        lambda folder: (
            [file.unlink() for file in (folder / "train/pose").glob("r_000[01][1-9].txt")]
            + [(folder / "train/pose/r_00010.txt").unlink()]
        ),
        "holds 1 poses (.txt), but from 2",
    ),
    "pose of 12 numbers": (text("pose/r_00004.txt", "1 " * 12), "r_00004.txt holds 12 numbers, but a pose of 4 x 4"),
    "pose that scales": (
        text("pose/r_00004.txt", "2 0 0 0 0 2 0 0 0 0 2 0 0 0 0 1"),
        "r_00004.txt holds a pose whose upper left 3 x 3 part is no rotation",
    ),
    "pose with a word": (
        text("pose/r_00004.txt", "1 0 0 x 0 1 0 0 0 0 1 0 0 0 0 1"),
        "r_00004.txt, line 1 holds 'x' where a finite number",
    ),
    "pose by columns": (
        text("pose/r_00004.txt", "1 0 0 0 0 1 0 0 0 0 1 0 3 0 0 1"),
        "whose last row is [3.0, 0.0, 0.0, 1.0]",
    ),
    "view without a pose": (
        lambda folder: (folder / "train/pose/r_00004.txt").unlink(),
        "whose names end in 0 to 10, which are times unless they count by 1, but the events of test.npz lie from 1000",
    ),
    "last pose missing": (
        lambda folder: (folder / "train/pose/r_00010.txt").unlink(),
        "holds 11 files of intrinsics (.txt), but one for each of 10 poses",
    ),
    "intrinsics of another view": (
        text("intrinsics/r_00004.txt", "22 0 12.5 0 0 21 9.25 0 0 0 1 0 0 0 0 1"),
        "r_00004.txt holds other intrinsics than r_00000.txt",
    ),
    "two files of events": (
        lambda folder: write_events(folder / "train/events/other.npz", EVENTS),
        "holds 2 files .npz, of which 0 have undistort",
    ),
    "x between pixels": (change("x", set_value(7, 3.5)), "test.npz, event 8 holds x = 3.5, where a whole number"),
    "x that wraps": (change("x", set_value(7, 2**32 + 3)), "test.npz, event 8 holds x = 4.29497e+09, where a whole"),
    "x outside": (change("x", set_value(7, WIDTH)), "test.npz, event 8 holds x = 24, which lies outside the sensor"),
    "t that is no number": (change("t", set_value(7, np.nan)), "test.npz, event 8 holds t = nan"),
    "polarity 2": (change("p", set_value(7, 2)), "test.npz, event 8 holds polarity 2"),
    "clock of another zero": (
        change("t", lambda t: t + 10**12),
        "test.npz holds times from 1e+12 to 1e+12, but times from about 0 on were expected",
    ),
    "clock that runs before": (
        change("t", lambda t: np.append(t[:-1] / 100, t[-1])),
        "holds 1,199 of 1,200 events before the second of 11 views",
    ),
    "columns of two lengths": (change("y", lambda y: y[1:]), "holds 1,200 x, 1,199 y"),
    "no column p": (
        lambda folder: np.savez(folder / "train/events/test.npz", x=EVENTS[:, 0], y=EVENTS[:, 1], t=EVENTS[:, 2]),
        "test.npz lacks the array p",
    ),
}


@pytest.mark.parametrize("name", BAD_INPUT)
def test_bad_input(tmp_path: Path, name: str):
    break_it, message = BAD_INPUT[name]
    folder = write_eventnerf(tmp_path / "lego")
    break_it(folder)
    with pytest.raises(RecordingError) as caught:
        index_events(read_recording(folder))
    assert message in str(caught.value)


def test_a_lens_that_folds_the_picture_is_refused(tmp_path: Path):
    with pytest.raises(RecordingError, match=r"holds the distortion k1 = -3 and k2 = 0, which fits no lens"):
        read_recording(write_eventnerf(tmp_path / "lego", radial=(-3.0, 0.0)))
