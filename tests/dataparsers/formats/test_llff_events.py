"""Scenes with poses of LLFF and events.h5 are written here by NumPy from the documents of the layout, and read back."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import yaml
from recordings import HEIGHT, POSE_TIMES, WIDTH, image, joined, poses, write_image
from scipy.spatial.transform import Rotation

from enerf_ns.dataparsers.formats.registry import _read_folder, read_recording
from enerf_ns.dataparsers.index.indexing import index_events
from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.dataparsers.recording.errors import FlagError, RecordingError

FOCAL = 21.5
ZERO = 5_000_000
"""Time of the first pose, µs."""

EVENTS = np.column_stack(
    [
        np.random.default_rng(0).permutation(np.arange(1200) % WIDTH),
        np.random.default_rng(1).permutation(np.arange(1200) % HEIGHT),
        np.linspace(ZERO + 1000, ZERO + 999_000, 1200).astype(np.int64),
        np.random.default_rng(2).integers(0, 2, 1200),
    ]
)
"""x y t (µs) p."""

STAMPS = np.array([150_000, 350_000, 0, 550_000, 750_000, 0]) + ZERO
EXPOSURES = np.array([40_000, 20_000, 0, 50_000, 30_000, 0])
"""Of six pictures, µs; the third and the last are sharp."""

SHARP_POSES = [2, 9]
"""Poses of `recordings` at which the sharp pictures were taken."""


def turned(angle: float, shift: float) -> np.ndarray:
    """The poses of `recordings`, each turned about its x axis and shifted."""
    found = poses()
    found[:, 3:] = (Rotation.from_quat(found[:, 3:]) * Rotation.from_rotvec([angle, 0, 0])).as_quat()
    found[:, 1] += shift
    return found


def llff(found: np.ndarray, height: int = HEIGHT, focal: float = FOCAL) -> np.ndarray:
    """LLFF's rows of poses px py pz qx qy qz qw, as its documents state them: axes down, right, back."""
    rows = []
    for pose in found:
        right, down, forward = Rotation.from_quat(pose[3:]).as_matrix().T
        matrix = np.column_stack([down, right, -forward, pose[:3], [height, WIDTH, focal]])
        rows.append([*matrix.ravel(), 0.5, 4.0])
    return np.array(rows)


def poses_at(found: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Poses between those given, at stamps that are the poses' own or in the middle of two (µs)."""
    places = (times - ZERO) / 1e5
    positions = np.column_stack([np.interp(places, np.arange(11), column) for column in found[:, :3].T])
    one, other = np.floor(places).astype(int), np.ceil(places).astype(int)
    steps = (Rotation.from_quat(found[one, 3:]).inv() * Rotation.from_quat(found[other, 3:])).as_rotvec()
    middles = Rotation.from_quat(found[one, 3:]) * Rotation.from_rotvec(steps * (places - one)[:, None])
    return np.column_stack([positions, middles.as_quat()])


def write_poses(folder: Path, found: np.ndarray, name: str = "") -> None:
    of_pictures = poses_at(found, np.where(EXPOSURES > 0, STAMPS, ZERO))
    of_pictures[EXPOSURES == 0] = poses()[SHARP_POSES]
    np.save(folder / f"{name}poses_bounds.npy", llff(of_pictures))
    np.save(folder / f"all_{name}poses_bounds.npy", llff(found))


def write_events(path: Path, **columns: Any) -> None:
    x, y, t, p = EVENTS.T
    known = {"x": x.astype(np.uint16), "y": y.astype(np.uint16), "t": t, "p": p.astype(np.uint8)}
    with h5py.File(path, "w") as file:
        for name, column in (known | columns).items():
            file[name] = column


def write_llff_events(folder: Path) -> Path:
    """Blender and Gen3, with whole pixels."""
    (folder / "images_1").mkdir(parents=True)
    write_poses(folder, poses())
    np.save(folder / "all_timestamps.npy", ZERO + POSE_TIMES // 1000)
    for number in range(len(STAMPS)):
        write_image(folder / f"images_1/{number:02d}.png", image(number, 3))
    starts, ends = STAMPS - EXPOSURES // 2, STAMPS + EXPOSURES // 2
    stamps = {"timestamps": STAMPS, "timestamps_start": starts, "timestamps_end": ends}
    np.savez(folder / "images_1/timestamps.npz", **stamps)
    write_events(folder / "events.h5")
    return folder


def places() -> tuple[np.ndarray, np.ndarray]:
    """Where each pixel of the sensor lies in the pictures: turned and squeezed, float32 [height, width]."""
    rows, columns = np.mgrid[:HEIGHT, :WIDTH].astype(np.float64)
    x, y = columns - 11.5, rows - 8.5
    r2 = x**2 + y**2
    scale = 0.97 * (1 - 1.5e-4 * r2)
    angle = 0.01
    u = scale * (np.cos(angle) * x - np.sin(angle) * y) + 11.9
    v = scale * (np.sin(angle) * x + np.cos(angle) * y) + 8.2
    return u.astype(np.float32), v.astype(np.float32)


def write_rectified(folder: Path, with_map: bool) -> Path:
    """CDAVIS, whose map tells the pixels of the sensor, or Gen3 without a map."""
    write_llff_events(folder)
    u, v = places()
    x, y = EVENTS[:, 0], EVENTS[:, 1]
    write_events(folder / "events.h5", x=u[y, x], y=v[y, x])
    if with_map:
        np.savez(folder / "ev_map.npz", inv_mapx=u, inv_mapy=v)
    return folder


def directions_of(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """As the loader of the authors makes rays: half a pixel is added, and the middle of the picture is the axis."""
    return np.stack([(u + 0.5 - WIDTH / 2) / FOCAL, (v + 0.5 - HEIGHT / 2) / FOCAL], axis=-1)


def check_poses(recording, found: np.ndarray) -> None:
    np.testing.assert_allclose(recording.trajectory.positions, found[:, :3], rtol=0, atol=1e-12)
    expected = Rotation.from_quat(found[:, 3:]).as_matrix()
    np.testing.assert_allclose(Rotation.from_quat(recording.trajectory.quaternions).as_matrix(), expected, atol=1e-9)


@pytest.mark.parametrize("factor", [1, 1000], ids=["us", "ns"])
def test_scene_with_whole_pixels(tmp_path: Path, factor: int):
    folder = write_llff_events(tmp_path / "scene")
    write_events(folder / "events.h5", t=EVENTS[:, 2] * factor)
    recording = read_recording(folder)
    assert recording.format == "llff_events" and recording.bayer_pattern is None and recording.notes == ()
    np.testing.assert_array_equal(recording.trajectory.times, POSE_TIMES)
    check_poses(recording, poses())
    found = joined(recording.stream_events())
    np.testing.assert_array_equal(np.column_stack([found.x, found.y, found.t // 1000 + ZERO, found.p]), EVENTS)
    camera = recording.camera
    assert (camera.width, camera.height, camera.fx, camera.fy) == (WIDTH, HEIGHT, FOCAL, FOCAL)
    np.testing.assert_allclose(camera.pixel_directions()[..., :2], directions_of(*np.mgrid[:HEIGHT, :WIDTH][::-1]))
    assert recording.depth_range == (0.5, 4.0)
    blurred, held_out = recording.blurred_frames, recording.held_out_frames
    assert recording.frames is None and blurred is not None and held_out is not None
    assert [file.name for file in blurred.filenames] == ["00.png", "01.png", "03.png", "04.png"]
    np.testing.assert_array_equal(blurred.times, (STAMPS - ZERO)[EXPOSURES > 0] * 1000)
    assert blurred.exposures is not None
    np.testing.assert_array_equal(blurred.exposures, EXPOSURES[EXPOSURES > 0] * 1000)
    assert [file.name for file in held_out.filenames] == ["02.png", "05.png"]
    np.testing.assert_allclose(held_out.trajectory.positions, poses()[SHARP_POSES, :3], rtol=0, atol=1e-12)
    assert len(index_events(recording)) == len(EVENTS)


def test_events_that_a_map_moved_are_those_of_the_sensor(tmp_path: Path):
    recording = read_recording(write_rectified(tmp_path / "batteries", with_map=True))
    assert recording.bayer_pattern == "RGGB" and recording.camera.model == "lookup"
    found = joined(recording.stream_events())
    np.testing.assert_array_equal(np.column_stack([found.x, found.y]), EVENTS[:, :2])
    np.testing.assert_allclose(
        recording.camera.pixel_directions()[..., :2],
        directions_of(*(column.astype(np.float64) for column in places())),
        rtol=1e-12,
    )
    assert recording.blurred_frames is not None and recording.blurred_frames.camera.model == "pinhole"


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_events_between_pixels_keep_their_directions(tmp_path: Path, dtype: type):
    folder = write_rectified(tmp_path / "handheld", with_map=False)
    u, v = places()
    x, y = EVENTS[:, 0], EVENTS[:, 1]
    write_events(folder / "events.h5", x=u[y, x].astype(dtype), y=v[y, x].astype(dtype))
    recording = read_recording(folder)
    assert recording.bayer_pattern is None
    found = joined(recording.stream_events())
    seen = recording.camera.pixel_directions()[found.y, found.x, :2]
    np.testing.assert_allclose(seen, directions_of(u[y, x].astype(float), v[y, x].astype(float)), rtol=1e-12)
    pixels = {tuple(place): set() for place in np.unique(EVENTS[:, :2], axis=0).tolist()}
    for place, pixel in zip(EVENTS[:, :2].tolist(), np.column_stack([found.x, found.y]).tolist(), strict=True):
        pixels[tuple(place)].add(tuple(pixel))
    assert all(len(numbers) == 1 for numbers in pixels.values())  # each pixel of the sensor is one pixel
    assert len(set.union(*pixels.values())) == len(pixels)  # and another one
    steps = np.diff(recording.camera.pixel_directions()[..., 0], axis=1)
    assert (steps > 0).all()  # in the order of their places
    assert WIDTH - 1 <= recording.camera.width <= WIDTH + 3 and HEIGHT - 1 <= recording.camera.height <= HEIGHT + 3
    assert len(recording.notes) == 1 and "places between the pixels of the pictures" in recording.notes[0]


def test_floats_that_are_whole_are_pixels(tmp_path: Path):
    folder = write_llff_events(tmp_path / "scene")
    write_events(folder / "events.h5", x=EVENTS[:, 0].astype(np.float32), t=EVENTS[:, 2] + 0.25)
    recording = read_recording(folder)
    assert recording.camera.model == "pinhole"
    found = joined(recording.stream_events())
    np.testing.assert_array_equal(np.column_stack([found.x, found.y]), EVENTS[:, :2])
    assert found.x.dtype.kind == "i" and (np.diff(found.t) > 0).all()
    np.testing.assert_array_equal(found.t % 1000, (found.t[0] % 1000))


K = [[FOCAL + 0.1, 0, 11.3], [0, FOCAL - 0.2, 8.8], [0, 0, 1]]


@pytest.mark.parametrize(
    "content",
    [
        K,
        [*K[0], *K[1], *K[2]],
        [K[0][0], K[1][1], K[0][2], K[1][2]],
        {"K": K},
        {"camera_matrix": {"rows": 3, "cols": 3, "data": [*K[0], *K[1], *K[2]]}},
        {"fx": K[0][0], "fy": K[1][1], "cx": K[0][2], "cy": K[1][2]},
    ],
    ids=["rows", "nine numbers", "four numbers", "K", "camera_matrix", "fx fy cx cy"],
)
def test_intrinsics_of_gen3(tmp_path: Path, content: Any):
    """Events between pixels are seen where the matrix says, too."""
    folder = write_rectified(tmp_path / "handheld", with_map=False)
    (folder / "K.yaml").write_text(yaml.safe_dump(content))
    recording = read_recording(folder)
    frames = recording.blurred_frames
    assert frames is not None and frames.camera == Camera(WIDTH, HEIGHT, K[0][0], K[1][1], K[0][2], K[1][2])
    assert len(recording.notes) == 1 and "places between the pixels" in recording.notes[0]
    found = joined(recording.stream_events())
    seen = recording.camera.pixel_directions()[found.y, found.x, :2]
    u, v = (column[EVENTS[:, 1], EVENTS[:, 0]].astype(float) for column in places())
    expected = np.linalg.solve(np.array(K), np.stack([u, v, np.ones_like(u)]))[:2].T
    np.testing.assert_allclose(seen, expected, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize(
    ("content", "note", "focal_length"),
    [
        ("focal: 20\n", r"is that of poses_bounds\.npy, since .*K\.yaml lacks fx, which was expected", FOCAL),
        ("%YAML:1.0\nK: !!opencv-matrix\n", r"is that of poses_bounds\.npy, since .*K\.yaml.* cannot be read", FOCAL),
        ("[1, 2]", r"is that of poses_bounds\.npy, since .*but fx 0 cx 0 fy cy 0 0 1 was", FOCAL),
        ("[30, 30, 11, 8]", r"^K\.yaml states a focal length of 30\.0 pixels, which is used, and poses_bounds", 30),
    ],
    ids=["other keys", "another YAML", "two numbers", "another lens"],
)
def test_other_intrinsics_of_gen3_are_noted(tmp_path: Path, content: str, note: str, focal_length: float):
    folder = write_llff_events(tmp_path / "handheld")
    (folder / "K.yaml").write_text(content)
    recording = read_recording(folder)
    assert recording.camera.fx == focal_length
    assert len(recording.notes) == 1 and re.search(note, recording.notes[0])


def test_sets_of_poses(tmp_path: Path):
    """Sharp pictures keep the poses of poses_bounds.npy."""
    folder = write_llff_events(tmp_path / "scene")
    write_poses(folder, turned(0.02, 0.01), "uslam_")
    np.save(folder / "all_uslam_timestamps.npy", ZERO + POSE_TIMES // 1000 + 1000)
    write_poses(folder, turned(0.3, 0.1), "rot0.2_tran0.02_")
    uslam = read_recording(folder, pose_set="uslam")
    check_poses(uslam, turned(0.02, 0.01))
    assert (
        uslam.trajectory.start == 0 and joined(uslam.stream_events()).t[0] == 0
    )  # both 1 ms after the first true pose
    check_poses(read_recording(folder, pose_set="rot0.2_tran0.02"), turned(0.3, 0.1))
    assert uslam.held_out_frames is not None
    np.testing.assert_allclose(uslam.held_out_frames.trajectory.positions, poses()[SHARP_POSES, :3], atol=1e-12)
    with pytest.raises(FlagError, match=r"--pose-set mocap asks for .*; give one of rot0.2_tran0.02, uslam, or leave"):
        read_recording(folder, pose_set="mocap")


def test_poses_of_pictures_that_are_far_from_the_path_are_told(tmp_path: Path):
    folder = write_llff_events(tmp_path / "scene")
    rows = np.load(folder / "poses_bounds.npy")
    np.save(folder / "poses_bounds.npy", np.roll(rows, 1, axis=0))
    notes = read_recording(folder).notes
    assert len(notes) == 1 and "poses and stamps may not be of one clock" in notes[0]


def h5(name: str, change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Path], None]:
    def changed(folder: Path) -> None:
        with h5py.File(folder / "events.h5", "r+") as file:
            dataset: Any = file[name]
            column = dataset[...]
            del file[name]
            file[name] = change(column)

    return changed


def rows(name: str, change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Path], None]:
    return lambda folder: np.save(folder / name, change(np.load(folder / name)))


def set_value(place: Any, value: float) -> Callable[[np.ndarray], np.ndarray]:
    def changed(array: np.ndarray) -> np.ndarray:
        array[place] = value
        return array

    return changed


def stamps(name: str, change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Path], None]:
    def changed(folder: Path) -> None:
        with np.load(folder / "images_1/timestamps.npz") as file:
            columns = dict(file)
        columns[name] = change(columns[name])
        np.savez(folder / "images_1/timestamps.npz", **columns)

    return changed


BAD_INPUT: dict[str, tuple[Callable[[Path], object], str]] = {
    "rows of 15": (rows("poses_bounds.npy", lambda a: a[:, :15]), "poses_bounds.npy holds an array of shape (6, 15)"),
    "mirrored": (
        rows("all_poses_bounds.npy", lambda a: a * np.where(np.arange(17) % 5 == 0, -1, 1)),
        "all_poses_bounds.npy, row 1 holds a pose whose 3 x 3 part is no rotation",
    ),
    "not finite": (
        rows("all_poses_bounds.npy", set_value((3, 4), np.nan)),
        "all_poses_bounds.npy, row 4 holds a number",
    ),
    "a pose fewer": (rows("all_poses_bounds.npy", lambda a: a[:-1]), "holds 10 poses, 11 stamps in all_timestamps.npy"),
    "a picture fewer": (
        lambda folder: (folder / "images_1/05.png").unlink(),
        "images_1 holds 5 images, but",
    ),
    "pictures of another size": (
        rows("poses_bounds.npy", lambda a: a * np.where(np.arange(17) == 4, 2, 1)),
        "poses_bounds.npy states pictures of 24 x 36 pixels, but",
    ),
    "no stamps of pictures": (
        stamps("timestamps_end", lambda a: a[:-1]),
        "timestamps.npz holds timestamps_end as int64 of shape (5,)",
    ),
    "exposures exchanged": (
        stamps("timestamps_end", lambda a: a - 100_000),
        "timestamps.npz holds for picture 1 the exposure from 5130000 to 5070000 µs",
    ),
    "pictures exchanged": (
        lambda folder: [
            stamps(name, lambda a: a[::-1])(folder) for name in ("timestamps", "timestamps_start", "timestamps_end")
        ],
        "is not after the blurred picture before it",
    ),
    "events of another clock": (h5("t", lambda t: t + 10**9), "do not cover the events"),
    "x outside": (h5("x", set_value(7, WIDTH)), "event 8 holds x = 24, which lies outside the sensor"),
    "polarity 2": (h5("p", set_value(7, 2)), "event 8 holds polarity 2"),
    "place that is not finite": (
        h5("x", lambda x: set_value(7, np.nan)(x.astype(np.float32))),
        "event 8 holds a place that is not finite",
    ),
    "no map for an event": (
        lambda folder: (
            write_rectified(folder.parent / "other", True),
            (folder.parent / "other/ev_map.npz").rename(folder / "ev_map.npz"),
        ),
        "event 1 lies at (",
    ),
    "map of another size": (
        lambda folder: np.savez(folder / "ev_map.npz", inv_mapx=np.zeros((4, 4)), inv_mapy=np.zeros((4, 4))),
        "ev_map.npz holds inv_mapx as float64 of shape (4, 4), but numbers of shape (18, 24)",
    ),
    "map of one place": (
        lambda folder: np.savez(folder / "ev_map.npz", inv_mapx=np.zeros((18, 24)), inv_mapy=np.zeros((18, 24))),
        "ev_map.npz holds the same place for two pixels",
    ),
}


@pytest.mark.parametrize("name", BAD_INPUT)
def test_bad_input(tmp_path: Path, name: str):
    break_it, message = BAD_INPUT[name]
    folder = write_llff_events(tmp_path / "scene")
    break_it(folder)
    _read_folder.cache_clear()
    with pytest.raises(RecordingError) as caught:
        index_events(read_recording(folder))
    assert message in str(caught.value)


def test_events_at_any_place_are_refused(tmp_path: Path):
    """Such as events that were moved along an estimate of their motion."""
    folder = write_llff_events(tmp_path / "scene")
    x, y = np.random.default_rng(0).uniform(0, 17, (2, 5000)).astype(np.float32)
    write_events(folder / "events.h5", x=x, y=y, t=np.linspace(ZERO, ZERO + 999_000, 5000), p=np.arange(5000) % 2)
    with pytest.raises(
        RecordingError, match=r"events at more than 1,728 places, but those of the pixels of one sensor"
    ):
        read_recording(folder)
