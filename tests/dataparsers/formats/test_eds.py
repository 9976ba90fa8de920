"""Recordings of EDS in both layouts, whose events and frames show points that are known to lie there."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest
import torch
import yaml
from known_points import points_seen, project, reference_poses, spot_centre, spots_image
from PIL import Image
from scipy.spatial.transform import Rotation

from enerf_ns.dataparsers.formats import eds
from enerf_ns.dataparsers.formats.hdf5_events import Hdf5Events
from enerf_ns.dataparsers.formats.registry import read_recording
from enerf_ns.dataparsers.index.indexing import index_events
from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.dataparsers.recording.errors import RecordingError
from enerf_ns.dataparsers.recording.files import load_image
from enerf_ns.dataparsers.recording.recording import EventRecording

SIZE = (640, 480)
EPOCH = 1_635_184_867_123_456
"""µs that the clock shows at the start of the trajectory."""

POSES, POSES_US = "stamped_groundtruth.txt", "stamped_groundtruth_us.txt"
STAMPS, STAMPS_US = "images_timestamps.txt", "images_timestamps_us.txt"
UNDISTORTED, MAP, INTRINSICS = "images_undistorted_calib0", "rectify_map_calib0.h5", "calib_undist_calib0.json"
OFFSET = "t_offset_us.txt"


@dataclass
class Scene:
    """What was in front of the cameras. Times are µs from the start of the trajectory."""

    poses: np.ndarray
    """Of the event camera, [poses, 8]: t_us px py pz qx qy qz qw."""
    camchain: dict
    events: np.ndarray
    """x y t p, int64 [events, 4]."""
    points: np.ndarray
    """World points that the events are of, [events, 3]."""
    stamps: np.ndarray
    """Of the frames, int64 [frames]."""
    spots: np.ndarray
    """World points that each frame shows as spots, [frames, spots, 3]."""
    pictures: list[np.ndarray]

    def lens(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Matrix and coefficients."""
        fx, fy, cx, cy = self.camchain[name]["intrinsics"]
        matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
        return matrix, np.array(self.camchain[name]["distortion_coeffs"])

    def event_poses(self, at: np.ndarray) -> np.ndarray:
        times = self.poses[:, 0].astype(np.int64) * 1000
        return reference_poses(times, self.poses[:, 1:4], self.poses[:, 4:], np.asarray(at) * 1000)

    def rgb_poses(self, at: np.ndarray) -> np.ndarray:
        """A point in RGB axes, times T_cn_cnm1, is in axes of the event camera, and times its pose in the world."""
        return self.event_poses(at) @ np.array(self.camchain["cam1"]["T_cn_cnm1"])


def make_scene(poses: np.ndarray, camchain: dict) -> Scene:
    rng = np.random.default_rng(3)
    pixels = np.stack([rng.integers(0, SIZE[0], 600), rng.integers(0, SIZE[1], 600)], axis=1)[np.arange(1200) % 600]
    times = np.sort(rng.integers(poses[0, 0] + 1, poses[-1, 0], len(pixels)))
    events = np.column_stack([pixels, times, rng.integers(0, 2, len(pixels))]).astype(np.int64)
    stamps = np.linspace(poses[3, 0], poses[-3, 0], 3).astype(np.int64)
    scene = Scene(poses, camchain, events, np.zeros((0, 3)), stamps, np.zeros((0, 0, 3)), [])
    matrix, distortion = scene.lens("cam1")
    scene.points = points_seen(pixels, rng.uniform(0.4, 3, len(pixels)), scene.event_poses(times), matrix, distortion)
    matrix, distortion = scene.lens("cam0")
    spots = []
    for pose in scene.rgb_poses(stamps):
        places = np.array([[90, 80], [550, 90], [300, 230], [100, 390], [540, 400]]) + rng.uniform(-9, 9, (5, 2))
        spots.append(points_seen(places, rng.uniform(0.4, 3, 5), np.tile(pose, (5, 1, 1)), matrix, distortion))
        scene.pictures.append(np.repeat(spots_image(places, *SIZE)[..., None], 3, axis=2))
    scene.spots = np.array(spots)
    return scene


def column(file: h5py.File, name: str) -> h5py.Dataset:
    dataset = file[name]
    assert isinstance(dataset, h5py.Dataset)
    return dataset


def write_raw(folder: Path, scene: Scene) -> Path:
    """As the data set is unpacked, without a calibration."""
    (folder / "images").mkdir(parents=True)
    with h5py.File(folder / "events.h5", "w") as file:
        for name, values, dtype in zip("xytp", scene.events.T, ("u2", "u2", "i8", "u1"), strict=True):
            offset = EPOCH if name == "t" else 0
            file.create_dataset(name, data=(values + offset).astype(dtype), maxshape=(None,), chunks=(500,))
    rows = []
    for time, *pose in scene.poses.tolist():
        time = EPOCH + int(time)
        rows.append(f"{time // 10**6}.{time % 10**6:06d} {' '.join(map(repr, pose))}\n")
    (folder / POSES).write_text("".join(rows))
    (folder / STAMPS).write_text("".join(f"{EPOCH + stamp}\n" for stamp in scene.stamps))
    for i, picture in enumerate(scene.pictures):
        Image.fromarray(picture).save(folder / f"images/frame_{i:010d}.png")
    return folder


def prepare(folder: Path, scene: Scene) -> Path:
    """What E-NeRF's preparation does to an unpacked folder, in place, with the same calls of NumPy and OpenCV."""
    poses, stamps = np.loadtxt(folder / POSES), np.loadtxt(folder / STAMPS)
    with h5py.File(folder / "events.h5", "r+") as file:
        times = column(file, "t")
        offset = int(min(times[0], poses[0, 0] * 1e6, stamps[0]))
        times[:] -= offset
        file["ms_to_idx"] = np.zeros(10, np.uint64)
    poses[:, 0] = poses[:, 0] * 1e6 - offset
    np.savetxt(folder / POSES_US, poses, header="#timestamp[us] px py pz qx qy qz qw")
    np.savetxt(folder / STAMPS_US, stamps - offset, fmt="%d")
    np.savetxt(folder / OFFSET, np.array([offset]))

    (matrix_rgb, distortion_rgb), (matrix, distortion) = scene.lens("cam0"), scene.lens("cam1")
    new_rgb, _ = cv2.getOptimalNewCameraMatrix(matrix_rgb, distortion_rgb, SIZE, alpha=0, newImgSize=SIZE)
    new, _ = cv2.getOptimalNewCameraMatrix(matrix, distortion, SIZE, alpha=0, newImgSize=SIZE)
    intrinsics = [{"fx": k[0, 0], "fy": k[1, 1], "cx": k[0, 2], "cy": k[1, 2]} for k in (new_rgb, new)]
    (folder / INTRINSICS).write_text(json.dumps({"intrinsics_undistorted": intrinsics}))
    (folder / UNDISTORTED).mkdir()
    for file in (folder / "images").iterdir():
        undistorted = cv2.undistort(cv2.imread(str(file)), matrix_rgb, distortion_rgb, newCameraMatrix=new_rgb)
        cv2.imwrite(str(folder / UNDISTORTED / file.name), undistorted)
    pixels = np.stack(np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))).reshape(2, -1).astype("float32")
    criteria = (cv2.TERM_CRITERIA_MAX_ITER | cv2.TERM_CRITERIA_EPS, 100, 0.001)
    places = cv2.undistortPointsIter(pixels, matrix, distortion, np.eye(3), new, criteria=criteria)
    with h5py.File(folder / MAP, "w") as file:
        file["rectify_map"] = places.reshape(SIZE[1], SIZE[0], 2).astype("<f4")
    return folder


def remove(folder: Path, *names: str) -> None:
    for name in names:
        shutil.rmtree(folder / name) if (folder / name).is_dir() else (folder / name).unlink()


@pytest.fixture(scope="module")
def scene(shared_data: Path) -> Scene:
    """With the real calibration, on a second of a real trajectory."""
    poses = np.loadtxt(shared_data / "eds/stamped_groundtruth_us_01_peanuts_light.txt")[2000:2150]
    poses[:, 0] -= poses[0, 0]
    return make_scene(poses, yaml.safe_load((shared_data / "eds/camchain.yaml").read_text()))


@pytest.fixture(scope="module")
def layouts(scene: Scene, shared_data: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The recording as unpacked, as prepared in place, and as prepared without what the preparation was made from."""
    above = tmp_path_factory.mktemp("layouts")
    raw = write_raw(above / "raw", scene)
    shutil.copy(shared_data / "eds/camchain.yaml", raw)
    both = prepare(shutil.copytree(raw, above / "both"), scene)
    prepared = shutil.copytree(both, above / "prepared")
    remove(prepared, POSES, STAMPS, "images", "camchain.yaml")
    return {"raw": raw, "both": both, "prepared": prepared}


@pytest.fixture(scope="module")
def recordings(layouts: dict[str, Path]) -> dict[str, EventRecording]:
    return {layout: eds.read(folder) for layout, folder in layouts.items()}


LAYOUTS = pytest.mark.parametrize("layout", ["raw", "both", "prepared"])


def all_events(recording: EventRecording) -> np.ndarray:
    pieces = [np.stack([piece.x, piece.y, piece.t, piece.p], axis=1) for piece in recording.stream_events()]
    return np.concatenate(pieces).astype(np.int64)


def seen_from(poses: torch.Tensor, points: np.ndarray) -> np.ndarray:
    """x / z and y / z of points in the axes of cameras at these poses."""
    rotations, centres = poses.numpy()[..., :3], poses.numpy()[..., 3]
    seen = np.einsum("...ji,...j->...i", rotations, points - centres)
    assert (seen[..., 2] > 0).all()
    return seen[..., :2] / seen[..., 2:]


@LAYOUTS
def test_the_format_is_found(layouts: dict[str, Path], layout: str):
    assert read_recording(layouts[layout]).format == "eds"


@LAYOUTS
def test_all_events_are_read(recordings: dict[str, EventRecording], scene: Scene, layout: str):
    recording = recordings[layout]
    assert recording.num_events == len(scene.events)
    np.testing.assert_array_equal(all_events(recording), scene.events * [1, 1, 1000, 1])


@LAYOUTS
def test_points_are_where_the_events_are(recordings: dict[str, EventRecording], scene: Scene, layout: str):
    recording = recordings[layout]
    events = all_events(recording)
    rays = recording.camera.pixel_directions()[events[:, 1], events[:, 0], :2]
    expected = seen_from(recording.trajectory.poses(torch.tensor(events[:, 2].copy())), scene.points)
    focal_lengths = np.array(scene.camchain["cam1"]["intrinsics"][:2])
    assert np.abs((rays - expected) * focal_lengths).max() < 0.05


@LAYOUTS
def test_points_are_where_the_rgb_camera_sees_them_at_the_times_of_events(
    recordings: dict[str, EventRecording], scene: Scene, layout: str
):
    frames = recordings[layout].frames
    assert frames is not None
    times = scene.events[:, 2]
    inside = np.flatnonzero(frames.trajectory.covers(times * 1000))
    found = seen_from(frames.trajectory.poses(torch.from_numpy(times[inside] * 1000)), scene.points[inside])
    truth = project(scene.points[inside], scene.rgb_poses(times[inside]), np.diag([766.0, 767.0, 1.0]))
    assert len(inside) > 1000
    assert np.abs(found * [766.0, 767.0] - truth).max() < 0.05


@LAYOUTS
def test_points_are_where_the_frames_show_them(recordings: dict[str, EventRecording], scene: Scene, layout: str):
    frames = recordings[layout].frames
    assert frames is not None
    np.testing.assert_array_equal(frames.times, scene.stamps * 1000)
    pinhole = frames.camera.undistorted()
    poses = frames.trajectory.poses(torch.from_numpy(frames.times))
    for file, pose, points in zip(frames.filenames, poses, scene.spots, strict=True):
        image = frames.camera.undistort(load_image(file))
        expected = seen_from(pose, points) * [pinhole.fx, pinhole.fy] + [pinhole.cx, pinhole.cy]
        found = np.array([spot_centre(image, place) for place in expected])
        assert np.linalg.norm(found - expected, axis=1).max() < 0.05


@pytest.mark.parametrize("layout", ["both", "prepared"])
def test_the_layouts_give_the_same_rays(recordings: dict[str, EventRecording], layout: str):
    raw, prepared = recordings["raw"], recordings[layout]
    assert raw.camera.model == "radtan" and prepared.camera.model == "lookup"
    np.testing.assert_allclose(prepared.camera.pixel_directions(), raw.camera.pixel_directions(), atol=4e-6)
    assert prepared.camera.undistorted() == raw.camera.undistorted()
    assert raw.frames is not None and prepared.frames is not None
    np.testing.assert_array_equal(prepared.frames.times, raw.frames.times)
    assert prepared.frames.camera == raw.frames.camera.undistorted()
    for file, other in zip(raw.frames.filenames, prepared.frames.filenames, strict=True):
        np.testing.assert_array_equal(load_image(other), raw.frames.camera.undistort(load_image(file)))
    times = torch.linspace(1_000_000, 980_000_000, 200).long()
    for one, other in (
        (raw.trajectory, prepared.trajectory),
        (raw.frames.trajectory, prepared.frames.trajectory),
    ):
        np.testing.assert_allclose(other.poses(times), one.poses(times), atol=2e-6)  # stamps were rounded to 1/4 µs


def test_an_undistorted_picture_of_events_shows_the_same_in_both_layouts(recordings: dict[str, EventRecording]):
    raw, prepared = recordings["raw"].camera, recordings["prepared"].camera
    places = np.array([[60.3, 50.2], [320.7, 240.4], [570.1, 60.6], [80.8, 420.9], [590.5, 430.2]])
    image = spots_image(places, *SIZE)[..., None]
    for place in places:
        near = cv2.undistortPointsIter(
            place.reshape(1, 1, 2), raw.matrix, np.array(raw.distortion), np.eye(3), raw.undistorted().matrix,
            (cv2.TERM_CRITERIA_COUNT, 100, 0),
        )[0, 0]  # fmt: skip
        for camera in (raw, prepared):
            assert np.linalg.norm(spot_centre(camera.undistort(image), near) - near) < 0.05


def test_reading_changes_nothing(layouts: dict[str, Path]):
    def state(folder: Path) -> dict:
        files = sorted(path for path in folder.rglob("*") if path.is_file())
        return {file: (hashlib.sha256(file.read_bytes()).digest(), file.stat().st_mtime_ns) for file in files}

    for folder in layouts.values():
        before = state(folder)
        all_events(eds.read(folder))
        assert state(folder) == before


def test_the_published_calibration_is_the_real_one(layouts: dict[str, Path], shared_data: Path, tmp_path: Path):
    raw = shutil.copytree(layouts["raw"], tmp_path / "raw")
    with_camchain = eds.read(raw)
    remove(raw, "camchain.yaml")
    published = eds.read(raw)
    assert list(with_camchain.notes) == []
    assert list(published.notes) == [
        "The published calibration of EDS is used, since there is no Kalibr camchain (*camchain*.yaml) in raw or in a "
        "calibration folder beside it."
    ]
    assert published.camera == with_camchain.camera
    assert published.frames is not None and with_camchain.frames is not None
    assert published.frames.camera == with_camchain.frames.camera
    np.testing.assert_array_equal(published.frames.trajectory.positions, with_camchain.frames.trajectory.positions)


def plain_scene() -> Scene:
    """A slide along x while turning about y, 100 poses a second, with cameras of simple numbers."""
    angles, zero = np.linspace(0, 0.3, 101) / 2, np.zeros(101)
    poses = np.column_stack([np.arange(101) * 10_000, angles, zero, zero, zero, np.sin(angles), zero, np.cos(angles)])
    extrinsics = np.eye(4)
    extrinsics[:3, :3] = Rotation.from_rotvec([0.01, -0.02, 0.03]).as_matrix()
    extrinsics[:3, 3] = [0.1, 0.02, -0.03]
    common = {"camera_model": "pinhole", "distortion_model": "radtan", "resolution": list(SIZE)}
    return make_scene(
        poses,
        {
            "cam0": {**common, "intrinsics": [700.0, 701.0, 300.0, 230.0], "distortion_coeffs": [-0.3, 0.1, 0.0, 0.0]},
            "cam1": {
                **common,
                "intrinsics": [550.0, 551.0, 310.0, 220.0],
                "distortion_coeffs": [-0.1, 0.1, 0.001, 0.002],
                "T_cn_cnm1": extrinsics.tolist(),
            },
        },
    )


@pytest.fixture(scope="module")
def plain() -> Scene:
    return plain_scene()


@pytest.fixture(scope="module")
def templates(plain: Scene, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    above = tmp_path_factory.mktemp("templates")
    raw = write_raw(above / "raw", plain)
    write_camchain(raw / "camchain.yaml", plain.camchain)
    prepared = prepare(shutil.copytree(raw, above / "prepared"), plain)
    return {"raw": raw, "prepared": prepared}


@pytest.fixture
def raw(templates: dict[str, Path], tmp_path: Path) -> Path:
    """As unpacked, with a camchain."""
    return shutil.copytree(templates["raw"], tmp_path / "eds")


@pytest.fixture
def prepared(templates: dict[str, Path], tmp_path: Path) -> Path:
    """The same, prepared in place."""
    return shutil.copytree(templates["prepared"], tmp_path / "eds")


def write_camchain(path: Path, camchain: dict) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(yaml.safe_dump(camchain))


def shift_events(folder: Path, shift: int, part: slice = slice(None)) -> None:
    with h5py.File(folder / "events.h5", "r+") as file:
        times = column(file, "t")[:]
        times[part] += shift
        column(file, "t")[:] = times


def error_of(folder: Path) -> str:
    """What reading the folder, its index included, ends with."""
    with pytest.raises(RecordingError) as caught:
        index_events(eds.read(folder))
    message = str(caught.value)
    assert "\n" not in message and message.endswith(".")
    return message


def focal_lengths(recording: EventRecording) -> tuple[float, float]:
    assert recording.frames is not None
    return recording.frames.camera.fx, recording.camera.fx


@pytest.mark.parametrize(
    "place",
    ["eds/camchain.yaml", "eds/16-camchain-imucam.yaml", "calibration/camchain.yaml", "16_Calib/00/x_camchain.yaml"],
)
def test_a_camchain_in_the_folder_or_in_a_calibration_folder_beside_it(
    raw: Path, tmp_path: Path, plain: Scene, place: str
):
    remove(raw, "camchain.yaml")
    write_camchain(tmp_path / place, plain.camchain)
    recording = eds.read(raw)
    assert focal_lengths(recording) == (700.0, 550.0)
    assert list(recording.notes) == (
        [] if place.startswith("eds/") else [f"The calibration is read from {tmp_path / place}."]
    )


def test_of_several_camchains_the_nearest_and_first_is_used(raw: Path, tmp_path: Path, plain: Scene):
    places = ["eds/camchain.yaml", "a_calib/camchain.yaml", "b_calib/a-camchain.yaml", "b_calib/b-camchain.yaml"]
    for number, place in enumerate([*places, "a_calib/a/camchain.yaml"]):
        plain.camchain["cam1"]["intrinsics"][0] = 550.0 + number
        write_camchain(tmp_path / place, plain.camchain)
    plain.camchain["cam1"]["intrinsics"][0] = 550.0
    for number, place in enumerate(places):
        assert focal_lengths(eds.read(raw)) == (700.0, 550.0 + number)
        (tmp_path / place).unlink()
    assert focal_lengths(eds.read(raw)) == (700.0, 554.0)


SWAPPED_HINTS = {
    "comments": ("cam0: # the event camera", "cam1: # This is the RGB camera"),
    "topics": ("cam0:\n  rostopic: /dvs/image_reconstructed", "cam1:\n  rostopic: /rgb"),
    "flip": ("cam0:", "cam1:\n  flip: True"),
}


@pytest.mark.parametrize("hints", SWAPPED_HINTS.values(), ids=SWAPPED_HINTS)
def test_the_event_camera_may_be_the_first_in_the_camchain(raw: Path, plain: Scene, hints: tuple[str, str]):
    expected = eds.read(raw)
    rgb, event = dict(plain.camchain["cam0"]), dict(plain.camchain["cam1"])
    rgb["T_cn_cnm1"] = np.linalg.inv(event.pop("T_cn_cnm1")).tolist()
    text = yaml.safe_dump({"cam0": event, "cam1": rgb})
    for name, hint in zip(("cam0:", "cam1:"), hints, strict=True):
        text = text.replace(name, hint)
    (raw / "camchain.yaml").write_text(text)
    found = eds.read(raw)
    assert found.camera == expected.camera
    assert found.frames is not None and expected.frames is not None
    assert found.frames.camera == expected.frames.camera
    np.testing.assert_allclose(found.frames.trajectory.positions, expected.frames.trajectory.positions, atol=1e-12)


def test_a_camchain_that_calls_both_the_event_camera(raw: Path):
    text = (raw / "camchain.yaml").read_text()
    (raw / "camchain.yaml").write_text(text.replace("cam0:", "cam0: # events").replace("cam1:", "cam1: # events"))
    assert "names both cam0 and cam1 as the event camera" in error_of(raw)


@pytest.mark.parametrize(
    ("model", "coefficients", "camera"),
    [
        (
            "radtan",
            [-0.1, "1e-05", 0, 0.0],
            Camera(*SIZE, 550.0, 551.0, 310.0, 220.0, (-0.1, 1e-5, 0.0, 0.0), "radtan"),
        ),
        ("equidistant", [0.1, 0, 0, 0], Camera(*SIZE, 550.0, 551.0, 310.0, 220.0, (0.1, 0.0, 0.0, 0.0), "fisheye")),
        ("none", [], Camera(*SIZE, 550.0, 551.0, 310.0, 220.0)),
    ],
)
def test_the_distortion_models_of_kalibr(raw: Path, plain: Scene, model: str, coefficients: list, camera: Camera):
    entry = {**plain.camchain["cam1"], "distortion_model": model, "distortion_coeffs": coefficients}
    write_camchain(raw / "camchain.yaml", {**plain.camchain, "cam1": entry})
    assert eds.read(raw).camera == camera


def test_as_unpacked_zero_is_the_earliest_first_stamp(raw: Path):
    shift_events(raw, -5000, slice(0, 1))
    recording = eds.read(raw)
    first = next(recording.stream_events()).t
    start = Hdf5Events(raw / "events.h5").first_time
    assert first[0] == 0
    assert recording.trajectory.start == EPOCH * 1000 - start > 0


def test_prepared_in_place_the_prepared_files_are_used(prepared: Path):
    recording = eds.read(prepared)
    assert recording.camera.model == "lookup"
    assert recording.frames is not None and recording.frames.filenames[0].parent.name == UNDISTORTED
    assert list(recording.notes) == [
        f"Of {POSES} and {POSES_US}, {POSES_US} is used, which is on the clock of events.h5."
    ]


def test_prepared_but_for_the_events_the_unpacked_files_are_used(prepared: Path):
    shift_events(prepared, EPOCH)
    remove(prepared, OFFSET)
    recording = eds.read(prepared)
    assert recording.camera.model == "radtan"
    assert recording.trajectory.start == 0
    assert recording.frames is not None and recording.frames.filenames[0].parent.name == "images"
    assert recording.frames.times[0] == 30_000_000
    assert list(recording.notes) == [f"Of {POSES} and {POSES_US}, {POSES} is used, which is on the clock of events.h5."]


def test_an_interrupted_conversion_of_the_events_is_noticed(prepared: Path):
    shift_events(prepared, EPOCH, slice(600, None))
    assert f"events.h5 holds times of the clock of {POSES} and of {POSES_US}" in error_of(prepared)


def test_an_offset_of_another_recording_is_noticed(prepared: Path):
    (prepared / OFFSET).write_text(f"{EPOCH + 17}\n")
    message = error_of(prepared)
    assert f"{OFFSET} states {EPOCH + 17} µs" in message and f"{EPOCH} µs apart" in message
    (prepared / OFFSET).write_text("none of this\nis a number\n")
    assert f"{OFFSET}, line " in error_of(prepared)


@pytest.mark.parametrize("stamps", [STAMPS_US, STAMPS])
def test_raw_images_beside_prepared_events(prepared: Path, stamps: str):
    """Whichever file of stamps is on the clock of the events is used."""
    remove(prepared, UNDISTORTED)
    if stamps == STAMPS:
        remove(prepared, STAMPS)
        (prepared / STAMPS_US).rename(prepared / STAMPS)
    recording = eds.read(prepared)
    assert recording.camera.model == "lookup"
    assert recording.frames is not None
    assert recording.frames.camera.model == "radtan"
    assert recording.frames.filenames[0].parent.name == "images"
    assert recording.frames.times[0] == 30_000_000


def test_prepared_events_without_a_rectify_map(prepared: Path):
    remove(prepared, MAP)
    recording = eds.read(prepared)
    assert recording.camera.model == "radtan"
    assert recording.frames is not None and recording.frames.camera.model == "pinhole"


def test_prepared_without_frames_needs_no_calibration(prepared: Path):
    remove(prepared, UNDISTORTED, "images", STAMPS, STAMPS_US, POSES, "camchain.yaml")
    recording = eds.read(prepared)
    assert recording.frames is None and list(recording.notes) == []


def test_no_images(raw: Path):
    remove(raw, "images")
    recording = eds.read(raw)
    assert recording.frames is None
    (note,) = recording.notes
    assert note == f"There are stamps of images, but no folder images/ or {UNDISTORTED}/, so no frame is used."
    remove(raw, STAMPS)
    recording = eds.read(raw)
    assert recording.frames is None and list(recording.notes) == []


def test_what_is_appended_later_does_not_count(raw: Path, plain: Scene):
    recording = eds.read(raw)
    with h5py.File(raw / "events.h5", "r+") as file:
        for name in "xytp":
            dataset = column(file, name)
            last = dataset[-1]
            dataset.resize((2000,))
            dataset[len(plain.events) :] = last
    assert len(all_events(recording)) == len(plain.events) == len(index_events(recording))
    assert eds.read(raw).num_events == 2000


def edit(name: str, change: Callable[[list[str]], object]) -> Callable[[Path], None]:
    """Changes the lines of a text file, in their list."""

    def damage(folder: Path) -> None:
        lines = (folder / name).read_text().splitlines()
        change(lines)
        (folder / name).write_text("".join(f"{line}\n" for line in lines))

    return damage


def rescale(lines: list[str], factor: float, rows: slice) -> None:
    """Multiplies the times of some rows."""
    for i in range(len(lines))[rows]:
        cells = lines[i].split()
        if cells[0] != "#":
            lines[i] = " ".join([f"{float(cells[0]) * factor:.9f}", *cells[1:]])


def in_camchain(name: str, key: str, value: object) -> Callable[[Path], None]:
    def damage(folder: Path) -> None:
        camchain = yaml.safe_load((folder / "camchain.yaml").read_text())
        camchain[name][key] = value
        write_camchain(folder / "camchain.yaml", camchain)

    return damage


def write(name: str, content: bytes | str) -> Callable[[Path], object]:
    return lambda folder: (folder / name).write_bytes(content.encode() if isinstance(content, str) else content)


def image(size: tuple[int, int]) -> Callable[[Path], object]:
    return lambda folder: Image.new("RGB", size).save(folder / "images/frame_0000000001.png")


def cut(name: str, share: float) -> Callable[[Path], object]:
    def damage(folder: Path) -> None:
        content = (folder / name).read_bytes()
        (folder / name).write_bytes(content[: int(len(content) * share)])

    return damage


def without(*names: str) -> Callable[[Path], None]:
    return lambda folder: remove(folder, *names)


def no_images(folder: Path) -> None:
    for file in (folder / "images").iterdir():
        file.unlink()


def turn(matrix: np.ndarray) -> list:
    return np.block([[matrix, np.zeros((3, 1))], [np.zeros((1, 3)), np.ones((1, 1))]]).tolist()


RAW_FAULTS: dict[str, tuple[Callable[[Path], object], str]] = {
    "no events": (without("events.h5"), "events.h5 is missing"),
    "truncated events": (cut("events.h5", 0.6), "events.h5 cannot be read as an HDF5 file"),
    "no poses": (without(POSES), f"holds neither {POSES} (t_s px py pz qx qy qz qw) nor {POSES_US}"),
    "empty poses": (write(POSES, ""), f"{POSES} is empty"),
    "poses in us": (edit(POSES, lambda lines: rescale(lines, 1e6, slice(None))), "which is beyond 146 years"),
    "one pose in us": (edit(POSES, lambda lines: rescale(lines, 1e6, slice(50, 51))), "which is beyond 146 years"),
    "poses in ks": (edit(POSES, lambda lines: rescale(lines, 1e-3, slice(None))), "does not fit together"),
    "late poses": (edit(POSES, lambda lines: rescale(lines, 1.01, slice(50, None))), "which does not fit together"),
    "events in ns": (lambda folder: shift_events(folder, 999 * EPOCH), "which is beyond 146 years"),
    "events of another day": (lambda folder: shift_events(folder, 86400 * 10**6), "must be on one clock"),
    "stamps in s": (edit(STAMPS, lambda lines: rescale(lines, 1e-6, slice(None))), "look like seconds, but micro"),
    "no stamps": (without(STAMPS), f"holds 3 images, but {STAMPS} and {STAMPS_US} are missing"),
    "a stamp too few": (edit(STAMPS, lambda lines: lines.pop()), "holds 3 images, but "),
    "an image too few": (without("images/frame_0000000001.png"), "holds 2 images, but "),
    "no image": (no_images, "images holds 0 images, but "),
    "stamps that stand": (edit(STAMPS, lambda lines: lines.__setitem__(1, lines[0])), f"{STAMPS}, line 2 has the time"),
    "a small image": (image((346, 260)), "has 346 x 260 pixels, but 640 x 480"),
    "no picture": (write("images/frame_0000000001.png", b"\x89PNG"), "frame_0000000001.png cannot be read as an image"),
    "camchain of bytes": (write("camchain.yaml", b"\xff\xfe\x00cam0"), "cannot be read as a Kalibr camchain"),
    "camchain with a tab": (write("camchain.yaml", "cam0:\n\tcamera_model: omni\n"), "camchain.yaml, line 2, cannot"),
    "camchain unclosed": (write("camchain.yaml", "cam0: {fx: 1\n\ncam1: 2"), "camchain.yaml, line 3, cannot"),
    "camchain of OpenCV": (write("camchain.yaml", "%YAML:1.0\n---\nK: !!opencv-matrix\n"), "cannot be read as YAML"),
    "camchain of a list": (write("camchain.yaml", "- cam0\n- cam1\n"), "camchain.yaml lacks cam0, which was expected"),
    "empty camchain": (write("camchain.yaml", ""), "camchain.yaml lacks cam0, which was"),
    "one camera": (write("camchain.yaml", "cam0: {camera_model: pinhole}\n"), "lacks cam0.distortion_model, which was"),
    "omni": (in_camchain("cam0", "camera_model", "omni"), 'holds cam0.camera_model = "omni", but one of pinhole'),
    "fov": (in_camchain("cam1", "distortion_model", "fov"), 'holds cam1.distortion_model = "fov", but one of'),
    "three intrinsics": (in_camchain("cam1", "intrinsics", [1.0, 2.0, 3.0]), "cam1.intrinsics = [1.0, 2.0, 3.0]"),
    "words": (in_camchain("cam1", "intrinsics", "fx fy cx cy"), 'holds cam1.intrinsics = "fx fy cx cy", but 4'),
    "nan": (in_camchain("cam0", "distortion_coeffs", [0, 0, 0, float("nan")]), "distortion_coeffs = [0, 0, 0, NaN]"),
    "fx below 0": (in_camchain("cam0", "intrinsics", [-700, 700, 320, 240]), "cam0, holds the focal lengths -700"),
    "half a pixel": (in_camchain("cam0", "resolution", [640.5, 480]), "cam0, holds a camera of 640.5 x 480 pixels"),
    "another sensor": (in_camchain("cam1", "resolution", [346, 260]), "calibrates an event camera of 346 x 260"),
    "another RGB": (in_camchain("cam0", "resolution", [512, 384]), "has 640 x 480 pixels, but 512 x 384"),
    "no lens": (in_camchain("cam1", "distortion_coeffs", [-4, 0, 0, 0]), "which fits no lens"),
    "no RGB lens": (in_camchain("cam0", "distortion_coeffs", [-4, 0, 0, 0]), "which fits no lens"),
    "no extrinsics": (in_camchain("cam1", "T_cn_cnm1", None), "lacks cam1.T_cn_cnm1, which was expected"),
    "3 x 4": (in_camchain("cam1", "T_cn_cnm1", np.eye(3, 4).tolist()), "but a matrix of 4 x 4 numbers was expected"),
    "stretched": (in_camchain("cam1", "T_cn_cnm1", turn(1.01 * np.eye(3))), "T_cn_cnm1 whose upper left 3 x 3 part is"),
    "mirrored": (in_camchain("cam1", "T_cn_cnm1", turn(np.diag([1, 1, -1]))), "T_cn_cnm1 whose upper left 3 x 3 part"),
    "column by column": (
        in_camchain("cam1", "T_cn_cnm1", (np.eye(4) + np.diag([0.1], -3)).tolist()),
        "cam1.T_cn_cnm1 whose last row is [0.1",
    ),
}  # fmt: skip


@pytest.mark.parametrize(("damage", "message"), RAW_FAULTS.values(), ids=RAW_FAULTS)
def test_a_fault_in_an_unpacked_recording(raw: Path, damage: Callable[[Path], object], message: str):
    damage(raw)
    assert message in error_of(raw)


PREPARED_FAULTS: dict[str, tuple[Callable[[Path], object], str]] = {
    "poses in s": (edit(POSES_US, lambda lines: rescale(lines, 1e-6, slice(None))), "look like seconds, but micro"),
    "poses in ns": (edit(POSES_US, lambda lines: rescale(lines, 1e3, slice(None))), "which does not fit together"),
    "late poses in ns": (edit(POSES_US, lambda lines: rescale(lines, 1e3, slice(50, None))), "does not fit together"),
    "one pose in s": (edit(POSES_US, lambda lines: rescale(lines, 1e-6, slice(50, 51))), "line 51 has the time"),
    "no intrinsics": (without(INTRINSICS), f"{INTRINSICS} is missing"),
    "no JSON": (write(INTRINSICS, "{"), f"{INTRINSICS} cannot be read as JSON"),
    "a list": (write(INTRINSICS, "[1, 2]"), f"{INTRINSICS} holds a list, but a JSON object"),
    "one camera": (
        write(INTRINSICS, '{"intrinsics_undistorted": [{"fx": 1, "fy": 1, "cx": 1, "cy": 1}]}'),
        f"{INTRINSICS} holds intrinsics_undistorted = [{{",
    ),
    "no number": (
        write(INTRINSICS, '{"intrinsics_undistorted": [0, {"fx": "wide", "fy": 1, "cx": 1, "cy": 1}]}'),
        f'{INTRINSICS} holds intrinsics_undistorted[1].fx = "wide", but a number was expected',
    ),
    "nan": (
        write(INTRINSICS, '{"intrinsics_undistorted": [0, {"fx": NaN, "fy": 1, "cx": 1, "cy": 1}]}'),
        f"{INTRINSICS} holds intrinsics_undistorted[1].fx = NaN, but a number was expected",
    ),
    "truncated map": (cut(MAP, 0.5), f"{MAP} cannot be read as an HDF5 file with a rectify map (Unable"),
    "no map in it": (cut(MAP, 0), f"{MAP} is empty"),
    "an image too few": (without(f"{UNDISTORTED}/frame_0000000001.png"), f"{UNDISTORTED} holds 2 images, but "),
}  # fmt: skip


@pytest.mark.parametrize(("damage", "message"), PREPARED_FAULTS.values(), ids=PREPARED_FAULTS)
def test_a_fault_in_a_prepared_recording(prepared: Path, damage: Callable[[Path], object], message: str):
    remove(prepared, POSES)
    damage(prepared)
    assert message in error_of(prepared)
