from __future__ import annotations

import json
import math
import pickle
import re
import tracemalloc
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from known_points import points_seen, reference_poses, spot_centre, spots_image
from PIL import Image
from recordings import joined
from scipy.spatial.transform import Rotation

from enerf_ns.dataparsers.formats import esim_npz
from enerf_ns.dataparsers.index.indexing import index_events
from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.dataparsers.recording.errors import RecordingError
from enerf_ns.dataparsers.recording.files import load_image
from enerf_ns.dataparsers.recording.recording import EventRecording

WIDTH, HEIGHT = 160, 120
MATRIX = np.array([[150.0, 0.0, 80.5], [0.0, 152.0, 58.5], [0.0, 0.0, 1.0]])
DISTORTIONS = {
    "": np.zeros(0),
    "plumb_bob": np.array([-0.2, 0.05, 0.001, -0.002]),
    "equidistant": np.array([-0.03, 0.01, -0.004, 0.001]),
}
MODELS: dict[str, Any] = {"": "pinhole", "plumb_bob": "radtan", "equidistant": "fisheye"}
NUM_EVENTS = 4000
NUM_VIEWS = 3
VIEW_ANGLE = 0.7


def trajectory() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times (ns), positions and quaternions xyzw of a shaky flight, camera to world."""
    rng = np.random.default_rng(1)
    times = 7_000_000_000 + np.cumsum(rng.integers(5_000_000, 15_000_000, 40))
    positions = np.cumsum(rng.normal(0, 0.02, (40, 3)), axis=0) + np.array([1.0, -2.0, 3.0])
    return times, positions, Rotation.from_rotvec(np.cumsum(rng.normal(0, 0.03, (40, 3)), axis=0)).as_quat()


def events() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(2)
    times = trajectory()[0]
    return {
        "position": rng.integers(0, (WIDTH, HEIGHT), (NUM_EVENTS, 2)).astype(np.uint16),
        "timestamp": np.sort(rng.integers(times[0], times[-1], NUM_EVENTS)),
        "polarity": rng.integers(0, 2, NUM_EVENTS).astype(bool),
    }


def poses() -> dict[str, np.ndarray]:
    return dict(zip(("T_wc_timestamp", "T_wc_position", "T_wc_orientation"), trajectory(), strict=True))


def calibration(model: str = "plumb_bob") -> dict[str, Any]:
    """With the types that Robust e-NeRF's script writes."""
    return {
        "intrinsics": MATRIX.astype(np.float32),
        "distortion_params": DISTORTIONS[model].astype(np.float32),
        "distortion_model": model,
        "img_height": np.array(HEIGHT, np.uint16),
        "img_width": np.array(WIDTH, np.uint16),
        "pos_contrast_threshold": np.array(0.375, np.float32),
        "neg_contrast_threshold": np.array(0.25, np.float32),
        "refractory_period": np.array(8_000_000),
        "bayer_pattern": "RGGB",
    }


def write_npz(folder: Path, model: str = "plumb_bob", save: Callable = np.savez) -> Path:
    folder.mkdir(parents=True)
    for name, arrays in zip(esim_npz.FILES, (events(), poses(), calibration(model)), strict=True):
        save(folder / name, **arrays)
    return folder


def view_poses() -> np.ndarray:
    """Camera to world in OpenGL axes, [NUM_VIEWS, 4, 4]: each looks at the origin from another side."""
    matrices = np.tile(np.eye(4), (NUM_VIEWS, 1, 1))
    for i, matrix in enumerate(matrices):
        matrix[:3, :3] = Rotation.from_euler("zx", [2.0 * i, 1.1 - 0.3 * i]).as_matrix()
        matrix[:3, 3] = 4.0 * matrix[:3, 2]
    return matrices


def seen_in_view(points: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Pixels of points in a view, by the definition of NeRF's synthetic scenes: y up, z backwards, angle_x wide."""
    seen = (points - pose[:3, 3]) @ pose[:3, :3]
    focal_length = 0.5 * WIDTH / math.tan(0.5 * VIEW_ANGLE)
    return np.stack(
        [
            0.5 * WIDTH - focal_length * seen[:, 0] / seen[:, 2] - 0.5,
            0.5 * HEIGHT + focal_length * seen[:, 1] / seen[:, 2] - 0.5,
        ],
        axis=1,
    )


VIEW_POINTS = np.array([[0.6, 0.4, 0.2], [-0.8, 0.4, -0.3], [0.1, -0.9, 0.6]])


def write_views(folder: Path, split: str = "test", mode: str = "RGB", named: str = "./{split}/r_{i}") -> Path:
    """Views with a white spot where each of VIEW_POINTS is seen."""
    (folder / split).mkdir(parents=True)
    frames = []
    for i, pose in enumerate(view_poses()):
        image = Image.fromarray(spots_image(seen_in_view(VIEW_POINTS, pose), WIDTH, HEIGHT)).convert(mode)
        image.save(folder / split / f"r_{i}.png")
        (folder / split / f"r_{i}_depth_0000.exr").touch()
        frames.append({"file_path": named.format(split=split, i=i), "transform_matrix": pose.tolist()})
    (folder / f"transforms_{split}.json").write_text(json.dumps({"camera_angle_x": VIEW_ANGLE, "frames": frames}))
    return folder


def check_events(recording: EventRecording) -> None:
    written = events()
    for _ in range(2):
        found = joined(recording.stream_events())
        np.testing.assert_array_equal(np.stack([found.x, found.y], axis=1), written["position"])
        np.testing.assert_array_equal(found.p, written["polarity"])
        np.testing.assert_array_equal(found.t, written["timestamp"])
        assert found.t.dtype == np.int64


def check_reprojection(recording: EventRecording, model: str) -> None:
    """The ray of each event passes through the point that was seen there, by SciPy and OpenCV, within 0.05 pixel."""
    found = joined(recording.stream_events())
    pixels = np.stack([found.x, found.y], axis=1).astype(float)
    depths = np.random.default_rng(3).uniform(0.5, 5.0, len(found))
    reference = reference_poses(*trajectory(), at=found.t)
    points = points_seen(pixels, depths, reference, MATRIX, DISTORTIONS[model], MODELS[model])
    camera_to_world = recording.trajectory.poses(torch.from_numpy(found.t)).numpy()
    seen = np.einsum("nji,nj->ni", camera_to_world[:, :, :3], points - camera_to_world[:, :, 3])
    directions = recording.camera.pixel_directions()[found.y, found.x]
    error = np.linalg.norm(seen[:, :2] / seen[:, 2:] - directions[:, :2], axis=1) * recording.camera.fx
    assert error.max() < 0.05


@pytest.mark.parametrize("model", list(MODELS))
@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_reads_what_was_written(tmp_path: Path, model: str, save: Callable):
    recording = esim_npz.read(write_npz(tmp_path / "easy", model, save))
    check_events(recording)
    check_reprojection(recording, model)
    times, positions, quaternions = trajectory()
    np.testing.assert_array_equal(recording.trajectory.times, times)
    np.testing.assert_array_equal(recording.trajectory.positions, positions)
    np.testing.assert_allclose(recording.trajectory.quaternions, quaternions, atol=1e-15)
    distortion = tuple(float(value) for value in DISTORTIONS[model].astype(np.float32))
    assert recording.camera == Camera(WIDTH, HEIGHT, 150.0, 152.0, 80.5, 58.5, distortion, MODELS[model])
    assert recording.contrast_thresholds == (0.375, 0.25)
    assert recording.refractory_period == 8_000_000
    assert recording.bayer_pattern == "RGGB"
    assert recording.frames is recording.blurred_frames is recording.held_out_frames is None
    assert recording.num_events == NUM_EVENTS
    assert list(recording.notes) == []
    assert len(index_events(recording)) == NUM_EVENTS


@pytest.mark.parametrize(
    "types",
    [
        {"position": "<i8", "timestamp": ">i8", "polarity": "u1"},
        {"position": ">u2", "timestamp": "<u8", "polarity": "<i4"},
        {"position": "u1", "timestamp": "<i8", "polarity": "i1"},
    ],
)
def test_any_whole_numbers(tmp_path: Path, types: dict[str, str]):
    folder = write_npz(tmp_path / "easy")
    np.savez(folder / "raw_events.npz", **{name: column.astype(types[name]) for name, column in events().items()})
    check_events(esim_npz.read(folder))


def test_a_grey_sensor_and_what_the_script_for_tum_vie_writes(tmp_path: Path):
    folder = write_npz(tmp_path / "easy")
    grey = {"bayer_pattern": "", "refractory_period": np.array(1375, np.float32), "distortion_model": b"plumb_bob"}
    np.savez(folder / "camera_calibration.npz", **calibration() | grey)
    recording = esim_npz.read(folder)
    assert recording.bayer_pattern is None
    assert recording.refractory_period == 1375 and isinstance(recording.refractory_period, int)
    check_reprojection(recording, "plumb_bob")


def test_distortion_of_zero_is_a_pinhole_camera_but_for_fisheye(tmp_path: Path):
    folder = write_npz(tmp_path / "easy")
    for name, model in (("plumb_bob", "pinhole"), ("equidistant", "fisheye")):
        zeros = {"distortion_params": np.zeros(4), "distortion_model": name}
        np.savez(folder / "camera_calibration.npz", **calibration() | zeros)
        assert esim_npz.read(folder).camera.model == model


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_events_are_read_in_pieces(tmp_path: Path, save: Callable, monkeypatch: pytest.MonkeyPatch):
    folder = write_npz(tmp_path / "easy", save=save)
    recording = esim_npz.read(folder)
    for at_a_time in (1999, 2000, NUM_EVENTS, 2**20):
        monkeypatch.setattr(esim_npz, "EVENTS_AT_A_TIME", at_a_time)
        assert [len(piece) for piece in recording.stream_events()] == [
            min(at_a_time, NUM_EVENTS - start) for start in range(0, NUM_EVENTS, at_a_time)
        ]
        check_events(recording)

    num_events = 300_000
    data = {
        "position": np.zeros((num_events, 2), np.uint16),
        "timestamp": np.arange(num_events),
        "polarity": np.zeros(num_events, bool),
    }
    save(folder / "raw_events.npz", **data)
    monkeypatch.setattr(esim_npz, "EVENTS_AT_A_TIME", 10_000)
    recording = esim_npz.read(folder)
    tracemalloc.start()
    assert sum(len(piece) for piece in recording.stream_events()) == num_events
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 4 * num_events


def test_a_file_that_was_exchanged_is_noticed(tmp_path: Path):
    folder = write_npz(tmp_path / "easy")
    recording = esim_npz.read(folder)
    np.savez(folder / "raw_events.npz", **{name: column[:-1] for name, column in events().items()})
    with pytest.raises(RecordingError, match=r"raw_events.npz held 4,000 events and holds 3,999 now"):
        next(recording.stream_events())


def test_poses_out_of_order_and_twice_are_mended(tmp_path: Path):
    folder = write_npz(tmp_path / "easy")
    times, positions, quaternions = trajectory()
    order = np.r_[:10, 12, 11, 10, 13:40, 20, 30]
    times = times[order]
    times[-1] += 900
    np.savez(
        folder / "camera_poses.npz",
        T_wc_timestamp=times,
        T_wc_position=positions[order],
        T_wc_orientation=1.0001 * quaternions[order],
    )
    recording = esim_npz.read(folder)
    assert [re.sub(r"to [\d.e-]+ and", "to X and", note) for note in recording.notes] == [
        "42 of 42 quaternions in camera_poses.npz were off norm 1 by up to X and are renormalised.",
        "The poses in camera_poses.npz go back in time 3 times and are sorted.",
        "2 of 42 poses in camera_poses.npz follow another one within 1 µs and are left out.",
    ]
    np.testing.assert_array_equal(recording.trajectory.times, trajectory()[0])
    check_reprojection(recording, "plumb_bob")


def test_a_pose_a_nanosecond_from_another_bends_no_curve(tmp_path: Path):
    """ESIM states a pose for each sample of the inertial sensor and for each image; where the two all but coincide,
    stamps of whole nanoseconds leave the velocity between them open."""
    folder = write_npz(tmp_path / "easy")
    times, positions, quaternions = trajectory()
    velocity = reference_poses(times, positions, quaternions, times[20:21] + 10**6)[0, :3, 3] - positions[20]
    np.savez(
        folder / "camera_poses.npz",
        T_wc_timestamp=np.insert(times, 21, times[20] + 1),
        T_wc_position=np.insert(positions, 21, positions[20] + 2e-6 * velocity, axis=0),
        T_wc_orientation=np.insert(quaternions, 21, quaternions[20], axis=0),
    )
    check_reprojection(esim_npz.read(folder), "plumb_bob")


@pytest.mark.parametrize("beside", [False, True])
@pytest.mark.parametrize("split", ["test", "val"])
@pytest.mark.parametrize("mode", ["RGB", "RGBA", "L"])
@pytest.mark.parametrize("named", ["./{split}/r_{i}", "{split}/r_{i}.png"])
def test_views_show_known_points(tmp_path: Path, beside: bool, split: str, mode: str, named: str):
    folder = write_npz(tmp_path / "scene" / "easy")
    views = write_views((folder.parent if beside else folder) / "views", split, mode, named)
    recording = esim_npz.read(folder)
    frames = recording.held_out_frames
    assert frames is not None and recording.frames is None
    assert frames.filenames == tuple(views / split / f"r_{i}.png" for i in range(NUM_VIEWS))
    assert frames.times.tolist() == [0, 10**9, 2 * 10**9]
    assert frames.camera.model == "pinhole"
    for file, pose in zip(
        frames.filenames, frames.trajectory.poses(torch.from_numpy(frames.times)).numpy(), strict=True
    ):
        for point in VIEW_POINTS:
            seen = pose[:, :3].T @ (point - pose[:, 3])
            pixel = (frames.camera.matrix @ (seen / seen[2]))[:2]
            assert np.linalg.norm(spot_centre(load_image(file), pixel) - pixel) < 0.05
    assert list(recording.notes) == []


def test_views_with_intrinsics(tmp_path: Path):
    folder = write_npz(tmp_path / "easy")
    path = write_views(folder / "views", "val") / "transforms_val.json"
    content = json.loads(path.read_text())
    del content["camera_angle_x"]
    path.write_text(json.dumps(content | {"intrinsics": MATRIX.tolist()}))
    frames = esim_npz.read(folder).held_out_frames
    assert frames is not None and frames.camera == Camera(WIDTH, HEIGHT, 150.0, 152.0, 80.5, 58.5)


def test_test_views_come_before_validation_views(tmp_path: Path):
    folder = write_npz(tmp_path / "easy")
    for split in ("train", "val", "test"):
        write_views(folder / "views", split)
    frames = esim_npz.read(folder).held_out_frames
    assert frames is not None and frames.filenames[0].parent.name == "test"


def edit_views(edit: Callable[[dict], object]) -> Callable[[Path], None]:
    def edited(folder: Path) -> None:
        path = folder / "views/transforms_test.json"
        content = json.loads(path.read_text())
        edit(content)
        path.write_text(json.dumps(content))

    return edited


@pytest.mark.parametrize(
    ("change", "note"),
    [
        (
            edit_views(lambda content: content.update(frames=content["frames"][:1])),
            "lists 1 views, but at least 2",
        ),
        (lambda folder: (folder / "views/transforms_test.json").rename(folder / "x"), "holds neither transforms_test"),
        (lambda folder: [file.unlink() for file in folder.glob("views/test/*.png")], "none is there as .png or .jpg"),
    ],
)
def test_views_that_cannot_serve_are_left_out_with_a_note(tmp_path: Path, change: Callable, note: str):
    folder = write_npz(tmp_path / "easy")
    write_views(folder / "views")
    change(folder)
    recording = esim_npz.read(folder)
    assert recording.held_out_frames is None
    assert len(recording.notes) == 1 and note in recording.notes[0]


def save(name: str, **changes: object) -> Callable[[Path], None]:
    """Saves a file again with other arrays, of which None stands for none."""
    written = {"raw_events.npz": events, "camera_poses.npz": poses, "camera_calibration.npz": calibration}[name]()

    def saved(folder: Path) -> None:
        np.savez(folder / name, **{key: value for key, value in (written | changes).items() if value is not None})

    return saved


def cut(name: str, share: float) -> Callable[[Path], object]:
    def truncated(folder: Path) -> None:
        data = (folder / name).read_bytes()
        (folder / name).write_bytes(data[: int(share * len(data))])

    return truncated


def rewrite(name: str, array: str, change: Callable[[bytes], bytes]) -> Callable[[Path], None]:
    """Changes the bytes of one array in an .npz file, which stays a whole zip file."""

    def rewritten(folder: Path) -> None:
        with zipfile.ZipFile(folder / name) as archive:
            members = {entry: archive.read(entry) for entry in archive.namelist()}
        with zipfile.ZipFile(folder / name, "w") as archive:
            for entry, data in members.items():
                archive.writestr(entry, change(data) if entry == f"{array}.npy" else data)

    return rewritten


def flip(name: str, array: str) -> Callable[[Path], None]:
    """Changes a byte in the middle of an array without its checksum."""

    def flipped(folder: Path) -> None:
        data = bytearray((folder / name).read_bytes())
        with zipfile.ZipFile(folder / name) as archive:
            info = archive.getinfo(f"{array}.npy")
        data[info.header_offset + 30 + info.file_size // 2] ^= 0x55
        (folder / name).write_bytes(data)

    return flipped


def write(name: str, data: bytes) -> Callable[[Path], object]:
    return lambda folder: (folder / name).write_bytes(data)


def changed(array: np.ndarray, index: object, value: object) -> np.ndarray:
    array = array.copy()
    array[index] = value  # type: ignore[index]
    return array


EVENTS_FILE, POSES_FILE, CALIBRATION_FILE = esim_npz.FILES
TIMES, POSITIONS, QUATERNIONS = trajectory()

BAD_INPUT = {
    "no events": (lambda folder: (folder / EVENTS_FILE).unlink(), "raw_events.npz is missing; an .npz file"),
    "no poses": (lambda folder: (folder / POSES_FILE).unlink(), "camera_poses.npz is missing; an .npz file"),
    "no calibration": (lambda folder: (folder / CALIBRATION_FILE).unlink(), "camera_calibration.npz is missing; an"),
    "events empty": (write(EVENTS_FILE, b""), "raw_events.npz is empty; an .npz file"),
    "events no zip": (write(EVENTS_FILE, b"hello" * 99), "raw_events.npz cannot be read as an .npz file of NumPy ("),
    "events a pickle": (write(EVENTS_FILE, pickle.dumps({"position": 1})), "cannot be read as an .npz file of NumPy"),
    "events cut": (cut(EVENTS_FILE, 0.7), "raw_events.npz cannot be read as an .npz file of NumPy (File is not a"),
    "poses cut": (cut(POSES_FILE, 0.5), "camera_poses.npz cannot be read as an .npz file of NumPy (File is not a"),
    "calibration cut": (cut(CALIBRATION_FILE, 0.9), "camera_calibration.npz cannot be read as an .npz file of NumPy"),
    "positions cut": (rewrite(EVENTS_FILE, "position", lambda data: data[:-5]), "does not fill its 15,995 bytes"),
    "header cut": (rewrite(EVENTS_FILE, "position", lambda data: data[:40]), "raw_events.npz cannot be read as an"),
    "header garbled": (
        rewrite(EVENTS_FILE, "timestamp", lambda data: data.replace(b"descr", b"de(cr")),
        "raw_events.npz cannot be read as an .npz file of NumPy",
    ),
    "length garbled": (
        rewrite(EVENTS_FILE, "timestamp", lambda data: data.replace(b"(4000,)", b"(-400,)")),
        "does not fill its 32,000 bytes",
    ),
    "another version": (
        rewrite(EVENTS_FILE, "timestamp", lambda data: data[:6] + b"\x03" + data[7:]),
        "the array timestamp is of version (3, 0)",
    ),
    "times damaged": (flip(EVENTS_FILE, "timestamp"), "raw_events.npz cannot be read as an .npz file of NumPy (Bad C"),
    "positions missing": (
        save(EVENTS_FILE, position=None),
        "raw_events.npz lacks the array position, and holds polarity, timestamp;",
    ),
    "quaternions missing": (save(POSES_FILE, T_wc_orientation=None), "camera_poses.npz lacks the array T_wc_orient"),
    "threshold missing": (save(CALIBRATION_FILE, neg_contrast_threshold=None), "lacks the array neg_contrast_"),
    "times in seconds": (
        save(EVENTS_FILE, timestamp=events()["timestamp"] * 1e-9),
        "raw_events.npz holds timestamp as float64 of shape (4000,), but integers of shape (n) were expected",
    ),
    "positions float": (save(EVENTS_FILE, position=np.zeros((NUM_EVENTS, 2))), "position as float64 of shape (4000,"),
    "positions flat": (save(EVENTS_FILE, position=np.zeros(8000, int)), "position as int64 of shape (8000,), but"),
    "positions of three": (
        save(EVENTS_FILE, position=np.zeros((NUM_EVENTS, 3), int)),
        "position as int64 of shape (4000, 3), but integers of shape (n, 2) were expected",
    ),
    "positions by column": (
        save(EVENTS_FILE, position=np.asfortranarray(events()["position"])),
        "holds position column by column (Fortran order)",
    ),
    "polarity text": (save(EVENTS_FILE, polarity=np.full(NUM_EVENTS, "on")), "polarity as <U2 of shape (4000,), but"),
    "polarity pickled": (
        save(EVENTS_FILE, polarity=np.array([None] * NUM_EVENTS)),
        "raw_events.npz holds polarity as pickled Python objects, which are never loaded",
    ),
    "model pickled": (
        save(CALIBRATION_FILE, distortion_model=np.array({"a": 1})),
        "camera_calibration.npz holds distortion_model as pickled Python objects, which are never loaded",
    ),
    "polarity short": (
        save(EVENTS_FILE, polarity=np.zeros(3999, bool)),
        "holds 4,000 positions, 4,000 timestamps, 3,999 polarities, but as many of each",
    ),
    "no event": (
        save(EVENTS_FILE, position=np.zeros((0, 2), int), timestamp=np.zeros(0, int), polarity=np.zeros(0, bool)),
        "raw_events.npz holds no events",
    ),
    "time huge": (
        save(EVENTS_FILE, timestamp=events()["timestamp"].astype(np.uint64) + np.uint64(2**63)),
        "ns, which is beyond 146 years",
    ),
    "time backwards": (
        save(EVENTS_FILE, timestamp=changed(events()["timestamp"], 7, 1)),
        "raw_events.npz, event 8 goes back in time",
    ),
    "x outside": (
        save(EVENTS_FILE, position=changed(events()["position"], (5, 0), WIDTH)),
        "raw_events.npz, event 6 holds x = 160, which lies outside the sensor of 160 x 120 pixels",
    ),
    "polarity 3": (
        save(EVENTS_FILE, polarity=changed(events()["polarity"].astype(int), 3, 3)),
        "raw_events.npz, event 4 holds polarity 3",
    ),
    "events in microseconds": (
        save(EVENTS_FILE, timestamp=events()["timestamp"] // 1000),
        "the times of events (raw_events.npz) look like microseconds, but nanoseconds were expected, so multiply them",
    ),
    "poses in microseconds": (
        save(POSES_FILE, T_wc_timestamp=TIMES // 1000),
        "the times of poses (camera_poses.npz) look like microseconds, but nanoseconds were expected, so multiply them",
    ),
    "poses in seconds": (
        save(POSES_FILE, T_wc_timestamp=TIMES // 10**9),
        "holds 40 poses, but 39 of them follow another one within 1 µs; give one pose for each time, and times in nano",
    ),
    "pose times float": (save(POSES_FILE, T_wc_timestamp=TIMES * 1e-9), "T_wc_timestamp as float64 of shape (40,)"),
    "one pose": (
        save(POSES_FILE, T_wc_timestamp=TIMES[:1], T_wc_position=POSITIONS[:1], T_wc_orientation=QUATERNIONS[:1]),
        "camera_poses.npz holds 1 poses, but at least 2",
    ),
    "pose times too many": (
        save(POSES_FILE, T_wc_timestamp=np.r_[TIMES, TIMES[-1] + 10**7]),
        "holds 41 times, 40 positions, 40 orientations, but as many of each",
    ),
    "rotations of matrices": (
        save(POSES_FILE, T_wc_orientation=Rotation.from_quat(QUATERNIONS).as_matrix()),
        "T_wc_orientation as float64 of shape (40, 3, 3), but numbers of shape (n, 4)",
    ),
    "position NaN": (
        save(POSES_FILE, T_wc_position=changed(POSITIONS, (4, 1), np.nan)),
        "camera_poses.npz, pose 5, holds the position [",
    ),
    "quaternion not unit": (
        save(POSES_FILE, T_wc_orientation=changed(QUATERNIONS, 6, 1.0)),
        "camera_poses.npz, pose 7, holds a quaternion of norm 2, but rotations are unit quaternions",
    ),
    "threshold negative": (
        save(CALIBRATION_FILE, neg_contrast_threshold=-0.25),
        "holds the contrast thresholds 0.375 (of on events) and -0.25 (of off events), but both must be from",
    ),
    "threshold NaN": (save(CALIBRATION_FILE, pos_contrast_threshold=np.nan), "thresholds nan (of on events) and 0.25"),
    "threshold text": (save(CALIBRATION_FILE, pos_contrast_threshold="0.2"), "pos_contrast_threshold as <U3 of"),
    "refractory period negative": (save(CALIBRATION_FILE, refractory_period=-1), "refractory period -1 ns, but from 0"),
    "refractory period NaN": (save(CALIBRATION_FILE, refractory_period=np.nan), "refractory period nan ns, but a"),
    "Bayer pattern of wrong letters": (
        save(CALIBRATION_FILE, bayer_pattern="RGXB"),
        "holds the Bayer pattern 'RGXB', but four letters of R, G and B, the colours",
    ),
    "Bayer pattern too short": (save(CALIBRATION_FILE, bayer_pattern="RGB"), "the Bayer pattern 'RGB', but four"),
    "Bayer pattern of numbers": (save(CALIBRATION_FILE, bayer_pattern=[0, 1, 1, 2]), "bayer_pattern as int64 of shape"),
    "unknown distortion": (
        save(CALIBRATION_FILE, distortion_model="fov"),
        "holds the distortion model 'fov', but plumb_bob (radtan) or equidistant (fisheye) was expected",
    ),
    "three coefficients": (
        save(CALIBRATION_FILE, distortion_params=np.array([0.1, 0.2, 0.3])),
        "holds the distortion (0.1, 0.2, 0.3) of the model radtan, but finite numbers k1 k2 p1 p2 and perhaps",
    ),
    "coefficient NaN": (save(CALIBRATION_FILE, distortion_params=np.full(4, np.nan)), "(nan, nan, nan, nan) of the"),
    "no such lens": (save(CALIBRATION_FILE, distortion_params=[-3.0, 0, 0, 0]), "0.0, 0.0, 0.0), which fits no lens"),
    "sensor without width": (save(CALIBRATION_FILE, img_width=0), "holds a camera of 0 x 120 pixels, but whole"),
    "part of a pixel": (save(CALIBRATION_FILE, img_height=120.5), "holds a camera of 160 x 120.5 pixels, but whole"),
    "focal length negative": (save(CALIBRATION_FILE, intrinsics=MATRIX * [[-1], [1], [1]]), "focal lengths -150 and"),
    "intrinsics not a matrix": (
        save(CALIBRATION_FILE, intrinsics=np.array([150.0, 152.0, 80.5, 58.5])),
        "intrinsics as float64 of shape (4,), but numbers of shape (3, 3)",
    ),
    "intrinsics transposed": (save(CALIBRATION_FILE, intrinsics=MATRIX.T), "whose last row is [80.5, 58.5, 1.0], but"),
    "views no JSON": (write("views/transforms_test.json", b"{"), "transforms_test.json cannot be read as JSON ("),
    "views a list": (write("views/transforms_test.json", b"[]"), "transforms_test.json holds a list, but a JSON"),
    "views of numbers": (write("views/transforms_test.json", b'{"frames": [1, 2]}'), "lacks frames[0].transform_m"),
    "views without angle": (
        edit_views(lambda content: content.pop("camera_angle_x")),
        "transforms_test.json lacks camera_angle_x, which was expected",
    ),
    "views of an angle in degrees": (
        edit_views(lambda content: content.update(camera_angle_x=40)),
        "holds camera_angle_x = 40, but the angle of view in radians",
    ),
    "view without pose": (
        edit_views(lambda content: content["frames"][1].pop("transform_matrix")),
        "lacks frames[1].transform_matrix, which was expected",
    ),
    "view of a ragged pose": (
        edit_views(lambda content: content["frames"][1].update(transform_matrix=[[1, 2], [3]])),
        "holds frames[1].transform_matrix = [[1, 2], [3]], but a matrix of 4 x 4 numbers was",
    ),
    "view of no rotation": (
        edit_views(lambda content: content["frames"][2].update(transform_matrix=(2 * np.eye(4)).tolist())),
        "frames[2].transform_matrix whose upper left 3 x 3 part is no rotation, since it is off orthonormal by 3",
    ),
    "view mirrored": (
        edit_views(lambda content: content["frames"][2].update(transform_matrix=np.diag([1, 1, -1, 1]).tolist())),
        "frames[2].transform_matrix whose upper left 3 x 3 part is no rotation, since it is off orthonormal by 0",
    ),
    "view missing": (
        lambda folder: (folder / "views/test/r_1.png").unlink(),
        'transforms_test.json holds frames[1].file_path = "./test/r_1", but a .png or .jpg in',
    ),
    "view without name": (
        edit_views(lambda content: content["frames"][0].pop("file_path")),
        "transforms_test.json lacks frames[0].file_path, which was expected",
    ),
    "view no image": (write("views/test/r_1.png", b"hello"), "r_1.png cannot be read as an image"),
    "view of another size": (
        lambda folder: Image.new("RGB", (20, 10)).save(folder / "views/test/r_2.png"),
        "r_2.png has 20 x 10 pixels, but 160 x 120 of its camera were expected",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", list(BAD_INPUT))
def test_bad_input_gives_one_clear_sentence(tmp_path: Path, name: str):
    break_it, message = BAD_INPUT[name]
    folder = write_npz(tmp_path / "easy")
    write_views(folder / "views")
    break_it(folder)
    with pytest.raises(RecordingError) as error:
        len(index_events(esim_npz.read(folder)))
    text = str(error.value)
    assert message in text and str(folder) in text
    assert text.endswith(".") and "\n" not in text and not re.search(r"[a-z\d)]\. [A-Z]", text)


@pytest.mark.parametrize("compressed", [False, True])
def test_a_file_damaged_anywhere_gives_a_clear_sentence_or_what_was_written(tmp_path: Path, compressed: bool):
    """Bytes at random places of each file; the checksums of zip notice what its headers do not."""
    folder = write_npz(tmp_path / "easy", "", np.savez_compressed if compressed else np.savez)
    rng = np.random.default_rng(4)
    for name in esim_npz.FILES:
        data = (folder / name).read_bytes()
        for _ in range(60):
            damaged = bytearray(data)
            start = int(rng.integers(len(data)))
            damaged[start : start + 3] = rng.bytes(3)
            (folder / name).write_bytes(damaged)
            try:
                recording = esim_npz.read(folder)
                check_events(recording)
            except RecordingError as error:
                assert name in str(error)
            else:
                np.testing.assert_array_equal(recording.trajectory.times, TIMES)
                assert recording.camera.fx == 150.0 and recording.bayer_pattern == "RGGB"
        (folder / name).write_bytes(data)
