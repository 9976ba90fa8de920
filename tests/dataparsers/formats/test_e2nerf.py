"""Real scenes of E2NeRF, written here from the code that made the data set, with AEDAT4 by its schema."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import aedat4_files
import numpy as np
import pytest
from aedat4_files import events_packet, frame_packet
from recordings import image, joined, write_image
from scipy.spatial.transform import Rotation
from test_bad_input import is_one_sentence

from enerf_ns.dataparsers.formats import e2nerf
from enerf_ns.dataparsers.formats.registry import read_recording
from enerf_ns.dataparsers.index.indexing import index_events
from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.dataparsers.recording.errors import RecordingError

pytest.importorskip("aedat", reason="aedat is an optional extra of the project")

WIDTH, HEIGHT, FOCAL_LENGTH = 24, 18, 25.0
START, PERIOD, EXPOSURE = 1_600_000_000_000_000, 110_000, 100_000
"""Clock at the first frame, time from frame to frame, and exposure, µs."""
VIEWS = 3
NUM_FRAMES = 10 * (VIEWS - 1) + 4
SPAN = 10 * (VIEWS - 1) * PERIOD + EXPOSURE
"""Time from the first exposure to the end of the last view's, µs."""

TRUE_EVENTS = np.column_stack(
    [
        np.random.default_rng(3).integers(0, WIDTH, 1500),
        np.random.default_rng(4).integers(0, HEIGHT, 1500),
        START + np.sort(np.random.default_rng(5).integers(1000, SPAN, 1500)),
        np.random.default_rng(6).integers(0, 2, 1500),
    ]
)
"""x y t (µs on the clock of the recording) p."""


def aedat4(events: np.ndarray, exposure: int = EXPOSURE, frames: int = NUM_FRAMES) -> bytes:
    packets = []
    for number in range(frames):
        start = START + number * PERIOD
        packets.append((1, frame_packet(start, start + exposure, np.zeros((HEIGHT, WIDTH), np.uint8))))
        within = events[(events[:, 2] >= start) & (events[:, 2] < start + PERIOD)]
        if len(within):
            packets.append((0, events_packet(within[:, [2, 0, 1, 3]])))
    return aedat4_files.aedat4((WIDTH, HEIGHT), ["EVTS", "FRME"], packets)


def true_poses() -> tuple[np.ndarray, np.ndarray]:
    """Times (µs) and camera-to-world matrices [5 views, 4, 4], OpenCV axes."""
    times = np.concatenate([START + 10 * view * PERIOD + 25_001 * np.arange(5) for view in range(VIEWS)])
    share = (times - times[0]) / SPAN
    found = np.tile(np.eye(4), (len(times), 1, 1))
    found[:, :3, :3] = Rotation.from_rotvec(np.outer(share, [0.1, 0.5, -0.2])).as_matrix()
    found[:, :3, 3] = np.outer(share, [1.0, 0.2, 0.1])
    return times, found


def write_scene(folder: Path, events: np.ndarray = TRUE_EVENTS, **options: Any) -> Path:
    (folder / "images").mkdir(parents=True)
    (folder / "lego.aedat4").write_bytes(aedat4(events, **options))
    _, matrices = true_poses()
    llff = np.stack([matrices[:, :3, 1], matrices[:, :3, 0], -matrices[:, :3, 2], matrices[:, :3, 3]], axis=-1)
    size = np.tile(np.array([HEIGHT, WIDTH, FOCAL_LENGTH])[:, None], (len(llff), 1, 1))
    bounds = np.column_stack([np.linspace(1.2, 1.0, len(llff)), np.linspace(4.0, 5.0, len(llff))])
    np.save(folder / "poses_bounds.npy", np.column_stack([np.dstack([llff, size]).reshape(-1, 15), bounds]))
    (folder / "events.pt").write_bytes(b"a tensor of counts, which nobody reads")
    for number in range(5 * VIEWS):  # four of five are deblurred ones
        pixels = np.full_like(image(number, 3), 15 * number)
        write_image(folder / f"images/{number:03d}.jpg", pixels)
    return folder


def test_a_scene_is_read_as_it_was_written(tmp_path: Path):
    recording = read_recording(write_scene(tmp_path / "scene"))
    assert recording.format == "e2nerf"
    assert recording.camera == Camera(WIDTH, HEIGHT, FOCAL_LENGTH, FOCAL_LENGTH, 11.5, 8.5)
    assert recording.depth_range == (1.0, 5.0) and len(recording.notes) == 1
    events = joined(recording.stream_events())
    found = np.column_stack([events.x, events.y, events.t // 1000 + START, events.p])
    np.testing.assert_array_equal(found, TRUE_EVENTS)
    times, matrices = true_poses()
    np.testing.assert_array_equal(recording.trajectory.times, (times - START) * 1000)
    np.testing.assert_allclose(recording.trajectory.positions, matrices[:, :3, 3], atol=1e-12)
    turns = Rotation.from_quat(recording.trajectory.quaternions).as_matrix()
    np.testing.assert_allclose(turns, matrices[:, :3, :3], atol=1e-12)
    frames = recording.blurred_frames
    assert recording.frames is None and frames is not None and frames.exposures is not None
    assert [file.name for file in frames.filenames] == ["000.jpg", "005.jpg", "010.jpg"]
    assert frames.exposed.tolist() == [[10**7 * 110 * view, 10**7 * 110 * view + 10**8] for view in range(VIEWS)]
    assert recording.knows_poses(frames).all() and len(recording.trajectory.gaps) == VIEWS - 1
    assert len(index_events(recording)) == len(TRUE_EVENTS)


def test_an_exposure_longer_than_its_poses_is_cut(tmp_path: Path):
    frames = e2nerf.read(write_scene(tmp_path / "scene", exposure=EXPOSURE + 5000)).blurred_frames
    assert frames is not None and frames.exposures is not None and (frames.exposures == 100_004_000).all()


def without(*names: str) -> Callable[[Path], None]:
    def removed(folder: Path) -> None:
        for name in names:
            (folder / name).unlink()

    return removed


def one_more_pose(folder: Path) -> None:
    rows = np.load(folder / "poses_bounds.npy")
    np.save(folder / "poses_bounds.npy", np.append(rows, rows[-1:], axis=0))


def scaled(place: tuple, factor: float) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        rows = np.load(folder / "poses_bounds.npy")
        rows[place] *= factor
        np.save(folder / "poses_bounds.npy", rows)

    return change


BAD: dict[str, tuple[dict[str, Any], Callable[[Path], Any], str]] = {
    "counts alone": (
        {},
        without("lego.aedat4"),
        "holds no .aedat4 file and events.pt, which counts events without their times; put the recording of the scene",
    ),
    "poses alone": ({}, without("lego.aedat4", "events.pt"), "holds no .aedat4 file with events; put the recording"),
    "a synthetic scene": (
        {},
        lambda folder: (folder / "lego.aedat4").rename(folder / "transform_train.json"),
        "is a synthetic scene of E2NeRF, whose views were simulated one by one, so that no events lie between them",
    ),
    "two recordings": (
        {},
        lambda folder: (folder / "other.aedat4").write_bytes(b""),
        "holds lego.aedat4, other.aedat4, but one .aedat4 file was expected",
    ),
    "no poses": ({}, without("poses_bounds.npy"), "poses_bounds.npy is missing"),
    "a pose more": ({}, one_more_pose, "holds an array of shape (16, 17), but (5 for each view, 17) was expected"),
    "another size": ({}, scaled((0, 9), 2), "states pictures of 48 x 18 pixels, but"),
    "no rotation": ({}, scaled((7, 0), 1.5), "holds in row 7 a pose whose rotation is no rotation, since it is off"),
    "other exposures": ({"exposure": 40_000}, lambda folder: None, "states an exposure of 40.0 ms for view 0, but its"),
    "fewer frames": (
        {"frames": 15},
        lambda folder: None,
        "holds 15 frames, but 3 views are every tenth of at least 21",
    ),
    "a blurred frame fewer": (
        {},
        without("images/005.jpg"),
        "holds 2 blurred frames (000, 005, ...), but poses_bounds.npy",
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_scenes_give_one_sentence(tmp_path: Path, name: str):
    options, break_it, message = BAD[name]
    folder = write_scene(tmp_path / "scene", **options)
    break_it(folder)
    with pytest.raises(RecordingError) as error:
        len(index_events(e2nerf.read(folder)))
    assert message in str(error.value)
    assert str(folder) in str(error.value) and is_one_sentence(str(error.value))
