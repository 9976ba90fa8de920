"""Sequences of EVIMO2, written by NumPy and pickle from the data set's documents, whose events show known points."""

from __future__ import annotations

import copy
import os
import pickle
import time
import zipfile
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from known_points import points_seen, reference_poses
from recordings import joined
from scipy.spatial.transform import Rotation

from enerf_ns.dataparsers.formats.evimo2 import read
from enerf_ns.dataparsers.formats.plain_pickle import loads
from enerf_ns.dataparsers.formats.registry import read_recording
from enerf_ns.dataparsers.index import index_cache
from enerf_ns.dataparsers.index.indexing import index_events
from enerf_ns.dataparsers.recording.errors import RecordingError

WIDTH, HEIGHT = 64, 48
NUM_EVENTS = 1200
LENS = {"fx": 60.0, "fy": 61.0, "cx": 31.0, "cy": 24.5, "k1": 0.108, "k2": -0.154, "k3": 0.0, "k4": 0.0}
TANGENTIAL = {"p1": 0.01, "p2": -0.004}
SIZE = {"res_x": WIDTH, "res_y": HEIGHT}
META = {**LENS, **TANGENTIAL, **SIZE, "dist_model": "radtan", "ros_time_offset": 1606265321.445115}


def trajectory() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times (s), positions and quaternions xyzw, 200 a second, camera to world, with a gap of 0.3 s."""
    times = 2.0 + np.arange(260) / 200
    times = np.concatenate([times[:120], times[180:]]).round(6)
    phase = times - 2.0
    positions = np.column_stack([0.4 * phase, 0.1 * np.sin(5 * phase), 0.05 * np.cos(7 * phase)]).round(6)
    turns = np.column_stack([0.2 * np.sin(3 * phase), 0.3 * phase, 0.1 * phase])
    return times, positions, Rotation.from_rotvec(turns).as_quat()


@dataclass
class Scene:
    """What is written. Times are seconds; polarities are as stored."""

    t: np.ndarray
    xy: np.ndarray
    p: np.ndarray
    times: np.ndarray = field(default_factory=lambda: trajectory()[0])
    positions: np.ndarray = field(default_factory=lambda: trajectory()[1])
    quaternions: np.ndarray = field(default_factory=lambda: trajectory()[2])
    meta: dict[str, Any] = field(default_factory=lambda: copy.deepcopy(META))
    objects: dict[str, np.ndarray] = field(
        default_factory=lambda: {"5": np.array([0.1, 0.2, 1.5]), "12": np.array([-0.3, 0.0, 2.0])}
    )
    """Where each object stands in the world, metres."""

    def pose(self, position: np.ndarray, quaternion: np.ndarray, time: float) -> dict:
        x, y, z, w = quaternion.tolist()
        place = dict(zip("xyz", position.tolist(), strict=True))
        return {"pos": {"q": {"w": w, "x": x, "y": y, "z": z}, "rpy": {"r": 0.0}, "t": place}, "ts": time}

    def dictionary(self) -> dict[str, Any]:
        instants = []
        for number, time_ in enumerate(self.times.tolist()):
            turn = Rotation.from_quat(self.quaternions[number])
            instant: dict[str, Any] = {"id": 18446744073709551615, "ts": time_}
            instant["cam"] = self.pose(self.positions[number], self.quaternions[number], time_)
            for name, place in self.objects.items():
                seen = turn.inv().apply(place - self.positions[number])
                instant[name] = self.pose(seen, turn.inv().as_quat(), time_)
            instants.append(instant)
        instants.insert(60, {"id": 7, "ts": float(self.times[60] - 1e-3)})  # one without a pose
        imu = {"/prophesee/left/imu": [{"angular_velocity": {"x": 0.1}, "ts": 2.0}]}
        cam = copy.deepcopy(instants[0]["cam"])
        frames: list[dict[str, Any]] = [{"ts": 2.0, "id": 1765, "cam": cam, "gt_frame": "depth_mask_1765.png"}]
        frames += [{"ts": 2.0 + i / 60, "id": 1765 + i} for i in range(1, 30)]
        return {"frames": frames, "full_trajectory": instants, "imu": imu, "meta": self.meta}


def make_scene() -> Scene:
    rng = np.random.default_rng(0)
    times = np.sort(rng.uniform(2.001, 3.29, NUM_EVENTS)).round(7)
    places = np.column_stack([rng.permutation(np.arange(NUM_EVENTS) % side) for side in (WIDTH, HEIGHT)])
    return Scene(times, places.astype(np.uint16), rng.integers(0, 2, NUM_EVENTS).astype(np.uint8))


def write_info(folder: Path, scene: Scene, value: object = None) -> None:
    lens = scene.meta
    matrix = np.array([[lens["fx"], 0, lens["cx"]], [0, lens["fy"], lens["cy"]], [0, 0, 1.0]])
    coefficients = np.array([lens[name] for name in ("k1", "k2", "k3", "k4")])
    meta: Any = np.array(scene.dictionary() if value is None else value, dtype=object)
    index = np.zeros(5, np.uint32)
    np.savez(folder / "dataset_info.npz", index=index, discretization=0.01, K=matrix, D=coefficients, meta=meta)


def write_evimo2(folder: Path, scene: Scene | None = None, dtype: type = np.float64, column: bool = False) -> Path:
    scene = make_scene() if scene is None else scene
    folder.mkdir(parents=True)
    np.save(folder / "dataset_events_t.npy", scene.t.astype(dtype)[:, None] if column else scene.t.astype(dtype))
    np.save(folder / "dataset_events_xy.npy", scene.xy)
    np.save(folder / "dataset_events_p.npy", scene.p[:, None] if column else scene.p)
    write_info(folder, scene)
    np.savez_compressed(folder / "dataset_depth.npz", **{f"depth_{i:010d}": depth_map(i) for i in DEPTH_MAPS})
    return folder


DEPTH_MAPS = (0, 7, 24)
"""Places in meta["frames"] with depth."""


def depth_map(number: int) -> np.ndarray:
    """Millimetres; 0 without depth."""
    depth = np.random.default_rng(number).integers(300, 2000, (HEIGHT, WIDTH)).astype(np.uint16)
    depth[:5] = 0
    return depth


def place_of(camera: str, above: Path) -> Path:
    return above / camera / "sfm" / "eval" / "scene_03_00_000000"


@pytest.mark.parametrize("camera", ["samsung_mono", "left_camera", "right_camera"])
@pytest.mark.parametrize("column", [False, True])
def test_events_are_what_was_written(tmp_path: Path, camera: str, column: bool):
    scene = make_scene()
    recording = read(write_evimo2(place_of(camera, tmp_path), scene, column=column))
    for _ in range(2):
        found = joined(recording.stream_events())
        np.testing.assert_array_equal(np.stack([found.x, found.y], axis=1), scene.xy)
        np.testing.assert_array_equal(found.t, np.rint(scene.t * 1e9))
        np.testing.assert_array_equal(found.p > 0, scene.p == (0 if camera == "samsung_mono" else 1))
    assert recording.num_events == NUM_EVENTS


def test_the_event_camera_may_be_named(tmp_path: Path):
    scene, folder = make_scene(), write_evimo2(tmp_path / "scene")
    with pytest.raises(RecordingError, match=r"lies in no folder samsung_mono, .* by --event-camera\.$"):
        read(folder)
    np.testing.assert_array_equal(joined(read(folder, "samsung_mono").stream_events()).p, scene.p == 0)
    np.testing.assert_array_equal(joined(read(folder, "left_camera").stream_events()).p, scene.p == 1)


def test_the_stored_index_of_one_camera_is_not_that_of_another(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("ENERF_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(index_cache, "CACHED_FROM", 1)
    scene = make_scene()
    folder = write_evimo2(tmp_path / "scene", scene)
    of_one = [index_events(read_recording(folder, event_camera=name)) for name in ("left_camera", "samsung_mono")]
    assert len(of_one[0]) == len(of_one[1]) and len(list((tmp_path / "cache").iterdir())) == 2
    assert of_one[0].num_positive + of_one[1].num_positive == len(of_one[0]) != 2 * of_one[0].num_positive


@pytest.mark.parametrize("model", ["radtan", "radtan with k3", "equidistant"])
def test_events_are_seen_where_the_points_are(tmp_path: Path, model: str):
    """By SciPy and OpenCV, within 0.01 pixel; of radtan with p1 and p2, which the array D lacks."""
    scene = make_scene()
    fisheye = {"dist_model": "equidistant", "k1": -0.03, "k2": 0.01, "k3": -0.004, "k4": 0.001}
    scene.meta |= {"radtan": {}, "radtan with k3": {"k3": 0.05}, "equidistant": fisheye}[model]
    lens = scene.meta
    recording = read(write_evimo2(place_of("left_camera", tmp_path), scene))
    times = np.rint(scene.times * 1e9).astype(np.int64)
    found = joined(recording.stream_events())
    inside = ~recording.trajectory.in_gaps(found.t)
    poses = reference_poses(times, scene.positions, scene.quaternions, np.rint(scene.t * 1e9))
    names = ("k1", "k2", "k3", "k4") if model == "equidistant" else ("k1", "k2", "p1", "p2", "k3")
    points = points_seen(
        scene.xy.astype(float),
        np.random.default_rng(3).uniform(0.5, 5, NUM_EVENTS),
        poses,
        np.array([[lens["fx"], 0, lens["cx"]], [0, lens["fy"], lens["cy"]], [0, 0, 1]]),
        [lens[name] for name in names],
        "fisheye" if model == "equidistant" else "radtan",
    )
    camera_to_world = recording.trajectory.poses(torch.from_numpy(found.t)).numpy()
    seen = np.einsum("nji,nj->ni", camera_to_world[:, :, :3], points - camera_to_world[:, :, 3])
    directions = recording.camera.pixel_directions()[found.y, found.x]
    error = np.linalg.norm(seen[:, :2] / seen[:, 2:] - directions[:, :2], axis=1) * recording.camera.fx
    assert inside.sum() > NUM_EVENTS / 2 and error[inside].max() < 0.01


def test_instants_without_poses_are_a_gap(tmp_path: Path):
    scene = make_scene()
    recording = read(write_evimo2(place_of("left_camera", tmp_path), scene))
    np.testing.assert_array_equal(recording.trajectory.times, np.rint(scene.times * 1e9))
    (gap,) = recording.trajectory.gaps
    assert gap[1] - gap[0] == 305_000_000
    kept = recording.selected(None, False, keep_pose_gaps=True)
    assert len(recording.stretches) == 2 and len(kept.stretches) == 1
    assert len(index_events(recording)) == NUM_EVENTS


@pytest.mark.parametrize("by_id", [False, True])
def test_depth_maps_are_metres_at_their_instants(tmp_path: Path, by_id: bool):
    """Against OpenCV's map of the pixels without distortion."""
    folder = write_evimo2(place_of("left_camera", tmp_path))
    if by_id:
        np.savez(folder / "dataset_depth.npz", **{f"depth_{1765 + i:010d}": depth_map(i) for i in DEPTH_MAPS})
    maps = read(folder).depth_maps
    assert maps is not None
    np.testing.assert_array_equal(maps.times, [round((2.0 + i / 60) * 1e9) for i in DEPTH_MAPS])
    matrix = np.array([[LENS["fx"], 0, LENS["cx"]], [0, LENS["fy"], LENS["cy"]], [0, 0, 1]])
    lens = np.array([LENS["k1"], LENS["k2"], *TANGENTIAL.values()])
    new = maps.picture_camera.matrix
    x, y = cv2.initUndistortRectifyMap(matrix, lens, np.eye(3), new, (WIDTH, HEIGHT), cv2.CV_32FC1)
    for number, place in enumerate(DEPTH_MAPS):
        expected = cv2.remap(depth_map(place), x, y, cv2.INTER_NEAREST) / 1000
        found = maps.depth(number)
        assert found is not None
        np.testing.assert_allclose(found, expected, rtol=1e-6)
    (folder / "dataset_depth.npz").unlink()
    assert read(folder).depth_maps is None


def test_poses_of_the_wrong_direction_are_named(tmp_path: Path):
    """By objects that stand still."""
    scene = make_scene()
    turns = Rotation.from_quat(scene.quaternions)
    inverse = copy.copy(scene)
    inverse.positions, inverse.quaternions = -turns.inv().apply(scene.positions), turns.inv().as_quat()
    folder = write_evimo2(place_of("left_camera", tmp_path), scene)
    written = inverse.dictionary()
    for instant, right in zip(written["full_trajectory"], scene.dictionary()["full_trajectory"], strict=True):
        instant.update({name: right[name] for name in scene.objects if name in right})
    write_info(folder, scene, written)
    with pytest.raises(RecordingError, match=r"2 objects stand still .* only if they lead from the world to the cam"):
        read(folder)


def test_objects_that_move_are_noted(tmp_path: Path):
    scene = make_scene()
    folder = write_evimo2(place_of("left_camera", tmp_path), scene)
    assert read(folder).notes == ()
    written = scene.dictionary()
    for number, instant in enumerate(written["full_trajectory"]):
        if "12" in instant:
            instant["12"]["pos"]["t"]["x"] += 0.002 * number
    write_info(folder, scene, written)
    assert read(folder).notes[0].startswith("1 of 2 objects (12) move by up to 0.1")


def test_coarse_times_are_noted(tmp_path: Path):
    scene = make_scene()
    scene.t, scene.times = scene.t + 30, scene.times + 30
    folder = write_evimo2(place_of("left_camera", tmp_path), scene, np.float32)
    recording = read(folder)
    assert recording.notes[0].startswith("The times of the events are stored as float32, in steps of 3.8 µs at 33.2")
    np.testing.assert_array_equal(
        joined(recording.stream_events()).t, np.rint(scene.t.astype(np.float32).astype(np.float64) * 1e9)
    )


def saved(name: str, change: Callable[[np.ndarray], Any]) -> Callable[[Path], None]:
    def save(folder: Path) -> None:
        file = folder / f"dataset_events_{name}.npy"
        np.save(file, change(np.load(file)))

    return save


def value_at(number: int, value: Any) -> Callable[[np.ndarray], np.ndarray]:
    def put(array: np.ndarray) -> np.ndarray:
        array[number] = value
        return array

    return put


def stated(*keys: str | int, value: Any) -> Callable[[Path], None]:
    def state(folder: Path) -> None:
        scene = make_scene()
        written: Any = scene.dictionary()
        inside = written
        for key in keys[:-1]:
            inside = inside[key]
        inside[keys[-1]] = value
        write_info(folder, scene, written)

    return state


def other_matrix(folder: Path) -> None:
    scene = make_scene()
    written = copy.deepcopy(scene.dictionary())
    scene.meta["fx"] = 66.0
    write_info(folder, scene, written)


def saved_depth(name: str, depth: np.ndarray) -> Callable[[Path], None]:
    return lambda folder: np.savez(folder / "dataset_depth.npz", **{name: depth})


BAD: dict[str, tuple] = {
    "depth of another size": (saved_depth("depth_1", np.zeros((4, 5), np.uint16)), "depth_1 of shape (4, 5), but"),
    "depth in colour": (saved_depth("depth_1", np.zeros((4, 5, 3), np.uint16)), "uint16 of shape (4, 5, 3), but num"),
    "depth of objects": (saved_depth("depth_1", np.array([[None]])), "holds a picture as object of shape (1, 1)"),
    "depth without an instant": (saved_depth("depth_99", depth_map(0)), "depth map depth_99, but meta.frames holds 30"),
    "no times": (lambda folder: (folder / "dataset_events_t.npy").unlink(), "dataset_events_t.npy is missing"),
    "whole times": (saved("t", lambda t: t.astype(int)), "_t.npy holds int64 of shape (1200,), but one number of sec"),
    "fewer places": (saved("xy", lambda xy: xy[:-1]), "1,199 dataset_events_xy.npy"),
    "places in rows": (saved("xy", lambda xy: xy.T), "xy.npy holds uint16 of shape (2, 1200)"),
    "no events": (
        lambda folder: [saved(name, lambda a: a[:0])(folder) for name in ("t", "xy", "p")],
        "holds no events",
    ),
    "times as polarity": (saved("p", value_at(4, 29)), "event 5 holds 29, but 0 or 1 was expected; download the file"),
    "a time that is none": (saved("t", value_at(7, np.nan)), "event 8 holds nan, but finite seconds were expected"),
    "a model": (stated("meta", "dist_model", value="kb8"), 'holds meta.meta.dist_model = "kb8"'),
    "no tangential part": (stated("meta", "p1", value=None), "lacks meta.meta.p1"),
    "another K": (other_matrix, "holds K and D that differ from fx"),
    "no trajectory": (stated("full_trajectory", value=[]), "holds 0 poses of the camera"),
    "a pose without a turn": (
        stated("full_trajectory", 3, "cam", "pos", value={"t": {"x": 0, "y": 0, "z": 0}}),
        "holds in meta.full_trajectory[3] no pose of cam",
    ),
    "a pose of text": (stated("full_trajectory", 3, "cam", "ts", value="2.0"), "[3] no pose of cam, but ts, pos.t"),
    "an instant of text": (stated("full_trajectory", 3, value="2.0"), "[3] no pose of cam"),
    "times that go back": (stated("full_trajectory", 3, "cam", "ts", value=2.0), "pose 4 of the camera has the time"),
    "no rotation": (
        stated("full_trajectory", 3, "cam", "pos", "q", value=dict.fromkeys("wxyz", 1.0)),
        "pose 4 of the camera, holds a quaternion of norm 2",
    ),
    "a number beyond floats": (stated("full_trajectory", 3, "cam", "ts", value=10**400), "[3] no pose of cam"),
    "a name of another type": (stated("full_trajectory", 3, value={5: 1, "cam": 2}), "[3] no pose of cam"),
    "3 million poses": (stated("full_trajectory", value=[None] * 3_000_000), "holds 3,000,000 instants"),
    "meta of text": (lambda folder: write_info(folder, make_scene(), "text"), "holds meta as object of shape ()"),
}


@pytest.mark.parametrize("name", BAD)
def test_what_is_wrong_is_said(tmp_path: Path, name: str):
    break_it, message = BAD[name]
    folder = write_evimo2(place_of("left_camera", tmp_path))
    break_it(folder)
    with pytest.raises(RecordingError) as caught:
        joined(read(folder).stream_events())
    assert message in str(caught.value) and str(folder) in str(caught.value)


# ------------------------------------------------------------------------------------------------------ the pickle


class Command:
    def __init__(self, path: Path):
        self.path = path

    def __reduce__(self) -> tuple:
        return os.system, (f"touch {self.path}",)


def shape_of(elements: int) -> bytes:
    """An array of numbers that claims so many."""
    claimed = b"\x8a\x06" + elements.to_bytes(6, "little") + b"\x85"
    content = pickle.dumps(np.zeros(3), 3)
    assert content.count(b"K\x03\x85") == 1
    return content.replace(b"K\x03\x85", claimed)


HOSTILE = {
    "calls": (None, "names posix.system, which is not run"),
    "lists in lists": (b"\x80\x04" + b"]" * 10**6 + b"a" * (10**6 - 1) + b".", "nests values deeper than 10,000"),
    "tuples in tuples": (b"\x80\x04)" + b"\x85" * 10**6 + b".", "but one pickled dict was expected"),
    "10^12 numbers": (shape_of(10**12), "an array of shape (1000000000000,), but of 3 values"),
    "a place in memory of 2^32": (b"\x80\x04Nr\xff\xff\xff\xff]a.", "a pickle that is damaged"),
    "a list in itself": (b"\x80\x04]q\x00h\x00a.", "holds a list or dict in two places"),
    "40 million dicts": (
        b"\x80\x04]" + (b"(" + b"}" * 1000 + b"e") * 40_000 + b".",
        "more than 16,777,216 instructions",
    ),
    "text of 2^62 letters": (b"\x80\x04\x8d" + (2**62).to_bytes(8, "little") + b"a.", "a pickle that is cut off"),
    "an instance": (b"(S'touch x'\nios\nsystem\n.", "with the instruction 0x53"),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_pickles_are_refused(tmp_path: Path, name: str):
    content, message = HOSTILE[name]
    content = pickle.dumps(Command(tmp_path / "ran")) if content is None else content
    folder = write_evimo2(place_of("left_camera", tmp_path))
    path = folder / "dataset_info.npz"
    with np.load(path, allow_pickle=True) as file:
        arrays = {name: file[name] for name in ("K", "D")}
    np.savez(path, **arrays)
    header = b"{'descr': '|O', 'fortran_order': False, 'shape': (), }".ljust(117) + b"\n"
    with zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("meta.npy", b"\x93NUMPY\x01\x00\x76\x00" + header + content)
    start = time.process_time()
    with pytest.raises(RecordingError, match=f"^{path} ") as caught:
        read(folder)
    assert message in str(caught.value)
    assert time.process_time() - start < 30 and not (tmp_path / "ran").exists()


@pytest.mark.parametrize("protocol", [2, 3, 4, 5])
def test_plain_pickles_are_read(protocol: int):
    plain = {
        "numbers": [0, 255, 256, 70_000, -1, -(2**31), 2**64 - 1, -(2**80), 0.5, float("inf"), True, False, None],
        "text": ["", "x", "µ" * 300, "x", "y" * 70_000],
        "tuples": ((), (1,), (1, 2), (1, 2, 3), (1, 2, 3, (4,))),
        "long": list(range(5000)),
        "wide": {str(i): {i: [i]} for i in range(3000)},
    }
    assert loads(pickle.dumps(plain, protocol)) == plain


@pytest.mark.parametrize("protocol", [3, 4])
def test_arrays_and_numbers_of_numpy_are_read(protocol: int):
    arrays = [np.arange(6.0).reshape(2, 3), np.arange(6, dtype=">i2").reshape(2, 3).T, np.array([True, False])]
    content = {"arrays": arrays, "numbers": [np.float64(2.5), np.int32(-3)], "objects": np.array([{"a": 1}, None])}
    found = loads(pickle.dumps(content, protocol))
    for one, other in zip(found["arrays"], arrays, strict=True):
        np.testing.assert_array_equal(one, other)
        assert one.dtype == other.dtype
    assert found["numbers"] == [2.5, -3] and found["objects"] == [{"a": 1}, None]
