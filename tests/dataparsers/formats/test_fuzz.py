"""Recordings of each layout, damaged at random: refused with one sentence, or read as plain NumPy, h5py and Python's
fractions read the same files; never a traceback of a library underneath, never a silent wrong reading."""

from __future__ import annotations

import json
import mmap
import os
import random
import re
import resource
import shutil
import signal
import struct
import tempfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from decimal import Decimal
from fractions import Fraction
from functools import cache, cached_property, partial
from pathlib import Path
from typing import Any, Literal

import h5py
import numpy as np
import psutil
import pytest
import test_dsec
import test_eds
import test_esim_npz
import test_event_recording
import test_eventnerf
import test_evimo2
import test_llff_events
import test_m3ed
import test_mvsec
import test_tum_vie
import test_vector
import torch
import yaml
from hypothesis import HealthCheck, given, note, settings
from hypothesis import strategies as st
from PIL import Image
from recordings import HEIGHT, WIDTH, joined, seconds, write_davis, write_esim
from scipy.spatial.transform import Rotation
from test_bad_input import contents, is_one_sentence

from enerf_ns.dataparsers.formats.registry import _read_folder, formats, read_recording
from enerf_ns.dataparsers.index.indexing import index_events
from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.dataparsers.recording.errors import RecordingError
from enerf_ns.dataparsers.recording.files import load_array
from enerf_ns.dataparsers.recording.hdf5_files import load_picture
from enerf_ns.dataparsers.recording.recording import EventRecording, Frames
from enerf_ns.dataparsers.recording.trajectory import Trajectory

# ------------------------------------------------------------------------------------------------- what is damaged


@dataclass(frozen=True)
class Plain:
    """What a layout's files hold, read without the code under test."""

    events: np.ndarray
    """x y t p, int64 [events, 4]; ns on the clock of the files, polarity as stored."""
    pose_times: np.ndarray
    """ns on the clock of the files."""
    poses: np.ndarray
    """Of the event camera, [poses, 4, 4]."""
    frame_times: np.ndarray
    """ns on the clock of the files."""
    stamps: np.ndarray
    """As stored, ns."""
    starts_at_zero: bool = True
    """Whether the recording's zero is that of the files, and not the earliest first stamp."""


@dataclass(frozen=True)
class Layout:
    """How a recording is written, and what may be said of its files. Files are matched by glob patterns."""

    format: str
    write: Callable[[Path], object]
    read_plain: Callable[[Path], Plain]
    optional: tuple[str, ...] = ()
    """Files without which there still is a recording."""
    lists_images: bool = False
    """Whether images that are not in a list are passed over."""


EVENTS = np.column_stack(
    [
        np.random.default_rng(0).permutation(np.arange(1200) % WIDTH),
        np.random.default_rng(1).permutation(np.arange(1200) % HEIGHT),
        np.linspace(1_000_001, 999_000_000, 1200).astype(np.int64),
        np.random.default_rng(2).integers(0, 2, 1200),
    ]
)
"""x y t (ns) p, over the poses of `recordings`."""


def write_eds(folder: Path, prepared: bool) -> None:
    scene = test_eds.plain_scene()
    test_eds.write_raw(folder, scene)
    if prepared:
        test_eds.prepare(folder, scene)
        test_eds.remove(folder, test_eds.POSES, test_eds.STAMPS, test_eds.OFFSET, "images")
    else:
        test_eds.write_camchain(folder / "camchain.yaml", scene.camchain)


def write_tum_vie(folder: Path, layout: str) -> None:
    scene = test_tum_vie.make_scene(
        *test_tum_vie.plain_calibration(), test_tum_vie.plain_poses(), "left", with_spots=False
    )
    columns = np.resize(scene.events[:, [0, 1, 3]], (1200, 3))
    times = np.linspace(scene.poses[0, 0] + 1000, scene.poses[-1, 0] - 1000, 1200).astype(np.int64)
    test_tum_vie.WRITERS[layout](folder, replace(scene, events=np.insert(columns, 2, times, axis=1)))


def write_small_esim(folder: Path) -> None:
    write_esim(folder, ("images", "images_corrupted"), depth=True)
    for file, rows in zip(sorted(folder.glob("events/*.npy")), np.array_split(EVENTS, 2), strict=True):
        np.save(file, rows.astype(np.float64))
    camera = {"width": WIDTH, "height": HEIGHT, "fx": 20.0, "fy": 21.0, "cx": 11.5, "cy": 8.5}
    about = {"contrast_thresholds": [0.2, 0.3], "depth_range": [0.5, 4.0], "camera": camera}
    (folder / "simulation.json").write_text(json.dumps(about))


def write_small_davis(folder: Path) -> None:
    write_davis(folder, zero=1_000_000_000)
    rows = (f"{seconds(1_000_000_000 + t)} {x} {y} {p}\n" for x, y, t, p in EVENTS.tolist())
    (folder / "events.txt").write_text("".join(rows))


def write_small_npz(folder: Path) -> None:
    test_esim_npz.write_npz(folder)
    test_esim_npz.write_views(folder / "views")


def write_bag(folder: Path) -> None:
    pytest.importorskip("rosbags", reason="rosbags is an optional extra of the project")
    import test_esim_bag  # here, since it skips where rosbags is not installed

    test_esim_bag.write_recording(folder)


def write_ros_bag(folder: Path, ros: int) -> None:
    pytest.importorskip("rosbags", reason="rosbags is an optional extra of the project")
    import test_ros_bag  # here, since it skips where rosbags is not installed

    test_ros_bag.write_bag(folder, test_ros_bag.Bag(ros, events=EVENTS))


def write_m3ed(folder: Path) -> None:
    test_m3ed.write_m3ed(folder, events=EVENTS)


def write_dsec(folder: Path) -> None:
    test_dsec.write_dsec(folder, events=EVENTS)
    for place in ("events", "images"):
        shutil.rmtree(folder / place / "right")


def write_e2nerf(folder: Path) -> None:
    pytest.importorskip("aedat", reason="aedat is an optional extra of the project")
    import test_e2nerf

    test_e2nerf.write_scene(folder)
    for file in (folder / "events.pt", *(image for image in folder.rglob("*.jpg") if int(image.stem) % 5)):
        file.unlink()  # that nobody reads


def write_own(folder: Path) -> None:
    camera = {**test_event_recording.CAMERA, "model": "radtan", "distortion": [-0.1, 0.02, 0.001, -0.002]}
    test_event_recording.write_recording(
        folder,
        ("frames", "blurred_frames"),
        depth=True,
        camera={**test_event_recording.CAMERA, "model": "lookup"},
        frame_camera={**camera, "event_camera_from_frame_camera": test_event_recording.MOUNTING.tolist()},
        contrast_thresholds=[0.2, 0.3],
        refractory_period_ns=1500,
        bayer_pattern="RGGB",
        depth_range=[1, 4.5],
    )
    for name, column in zip("xytp", EVENTS.T, strict=True):
        np.save(folder / f"events/{name}.npy", column.astype(np.load(folder / f"events/{name}.npy").dtype))
    rows, columns = np.mgrid[:HEIGHT, :WIDTH].astype(float)
    np.save(folder / "camera_directions.npy", np.dstack([(columns - 11.5) / 20.0, (rows - 8.5) / 21.0]))


# ----------------------------------------------------------------------------------------------- reading them plainly

NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)
NANOSECONDS = {"s": 10**9, "us": 1000, "ns": 1}


def is_number(cell: str) -> bool:
    return NUMBER.fullmatch(cell) is not None


def rows_of(path: Path) -> list[list[str]]:
    """The cells of a table, without comments and a line of names."""
    lines = path.read_text(encoding="utf-8-sig").splitlines()
    rows = [line.split() for line in lines if line.strip() and not line.startswith("#")]
    return rows[1:] if not any(map(is_number, rows[0])) else rows


def times_in(rows: list[list[str]], unit: str) -> np.ndarray:
    assert all(is_number(row[0]) for row in rows)
    return np.array([round(Fraction(row[0]) * NANOSECONDS[unit]) for row in rows], np.int64)


def stamps_in(folder: Path, pattern: str, unit: str) -> np.ndarray:
    """Of the one file that matches, if it has images."""
    file = next(folder.glob(pattern), None)
    return times_in(rows_of(file), unit) if file else np.zeros(0, np.int64)


def poses_in(path: Path, unit: str) -> tuple[np.ndarray, np.ndarray]:
    """Times, and matrices [poses, 4, 4]."""
    rows = rows_of(path)
    assert all(len(row) == 8 and all(map(is_number, row)) for row in rows)
    values = np.array([[float(cell) for cell in row[1:]] for row in rows])
    return times_in(rows, unit), matrices(values[:, :3], values[:, 3:])


def matrices(positions: np.ndarray, quaternions: np.ndarray) -> np.ndarray:
    found = np.tile(np.eye(4), (len(positions), 1, 1))
    found[:, :3, :3] = Rotation.from_quat(quaternions).as_matrix()
    found[:, :3, 3] = positions
    return found


def hdf5_events(path: Path) -> np.ndarray:
    with h5py.File(path, "r") as file:
        group: Any = file["events"] if "events" in file else file
        columns = [group[name][...].astype(np.int64) for name in "xytp"]
    return np.stack(columns, axis=1) * [1, 1, 1000, 1]


def plain_eds(folder: Path, prepared: bool) -> Plain:
    unit, suffix = ("us", "_us") if prepared else ("s", "")
    stamps = stamps_in(folder, f"images_timestamps{suffix}.txt", "us")
    poses = poses_in(folder / f"stamped_groundtruth{suffix}.txt", unit)
    return Plain(hdf5_events(folder / "events.h5"), *poses, stamps, stamps, starts_at_zero=prepared)


def plain_tum_vie(folder: Path, raw: bool) -> Plain:
    data = folder / "mocap-desk2-vi_gt_data" if raw else folder
    stamps = stamps_in(data, "left_images*/image_timestamps_left.txt", "us")
    exposures = stamps_in(data, "left_images*/image_exposures_left.txt", "us")
    cameras, markers = (
        json.loads((folder / name).read_text(encoding="utf-8-sig"))["value0"]
        for name in (
            ("camera-calibrationA.json", "mocap-imu-calibrationA.json")
            if raw
            else ("calib_undist.json", "mocap-imu-calib.json")
        )
    )
    mount = np.linalg.inv(test_tum_vie.matrix_of(markers["T_imu_marker"])) @ test_tum_vie.matrix_of(
        cameras["T_imu_cam"][2]
    )
    times, poses = poses_in(data / "mocap_data.txt", "us")
    events = hdf5_events(folder / "mocap-desk2-events_left.h5")
    middles = stamps + exposures // 2 if len(exposures) else stamps
    return Plain(events, times, poses @ mount, middles, stamps, starts_at_zero=False)


def plain_esim(folder: Path) -> Plain:
    pieces = [np.load(file) for file in sorted(folder.glob("events/*.npy"))]
    events = np.concatenate(
        [np.array([[round(v) for v in row] for row in piece[:, :4].tolist()]).reshape(-1, 4) for piece in pieces]
    )
    stamps = stamps_in(folder, "images/image_stamps_ns.txt", "ns")
    return Plain(events, *poses_in(folder / "0_poses_all.txt", "ns"), stamps, stamps)


def plain_davis(folder: Path) -> Plain:
    rows = [line.split() for line in (folder / "events.txt").read_text().split("\n") if line.strip()]
    columns = [[int(Fraction(row[i])) for row in rows] for i in (1, 2, 3)]
    events = np.column_stack([*columns[:2], times_in(rows, "s"), columns[2]])
    stamps = stamps_in(folder, "images.txt", "s")
    return Plain(events, *poses_in(folder / "groundtruth.txt", "s"), stamps, stamps, starts_at_zero=False)


def plain_npz(folder: Path) -> Plain:
    with np.load(folder / "raw_events.npz") as file:
        events = np.column_stack([file["position"], file["timestamp"], file["polarity"]]).astype(np.int64)
    with np.load(folder / "camera_poses.npz") as file:
        poses = matrices(file["T_wc_position"], file["T_wc_orientation"])
        return Plain(events, file["T_wc_timestamp"].astype(np.int64), poses, *np.zeros((2, 0), np.int64))


def plain_bag(folder: Path) -> Plain:
    from test_esim_bag import STORE, esim_bag, rosbag1

    events, times, poses = [], [], []
    with rosbag1.Reader(folder / "esim.bag") as bag:
        for connection, _, data in bag.messages():
            message = STORE.deserialize_ros1(data, connection.msgtype)
            if connection.topic == esim_bag.EVENTS:
                events += [(e.x, e.y, e.ts.sec * 10**9 + e.ts.nanosec, e.polarity) for e in message.events]
            elif connection.topic == esim_bag.POSES:
                times.append(message.header.stamp.sec * 10**9 + message.header.stamp.nanosec)
                p, q = message.pose.position, message.pose.orientation
                poses.append((p.x, p.y, p.z, q.x, q.y, q.z, q.w))
    rows = np.array(poses)
    none = np.zeros(0, np.int64)
    return Plain(np.array(events, np.int64), np.array(times), matrices(rows[:, :3], rows[:, 3:]), none, none)


def plain_evimo2(folder: Path) -> Plain:
    """Of a camera that is not inverted."""
    t, xy, p = (np.load(folder / f"dataset_events_{name}.npy") for name in ("t", "xy", "p"))
    with np.load(folder / "dataset_info.npz", allow_pickle=True) as file:
        meta = file["meta"].item()
    rows = []
    for instant in meta["full_trajectory"]:
        if instant.get("cam") is not None:
            place, turn = (instant["cam"]["pos"][name] for name in "tq")
            rows.append([instant["cam"]["ts"], *(place[i] for i in "xyz"), *(turn[i] for i in "xyzw")])
    poses, none = np.array(rows), np.zeros(0, np.int64)
    events = np.column_stack([xy, np.rint(t.astype(np.float64) * 1e9).astype(np.int64), p]).astype(np.int64)
    return Plain(events, np.rint(poses[:, 0] * 1e9).astype(np.int64), matrices(poses[:, 1:4], poses[:, 4:]), none, none)


def plain_mvsec(folder: Path) -> Plain:
    def nanoseconds(seconds: np.ndarray) -> np.ndarray:
        return np.array([round(Fraction(time) * 10**9) for time in seconds.tolist()], np.int64)

    name = next(folder.glob("*_data.hdf5")).name.removesuffix("_data.hdf5")
    with h5py.File(folder / f"{name}_data.hdf5", "r") as file:
        left: Any = file["davis/left"]
        rows, stamps = left["events"][...], nanoseconds(left["image_raw_ts"][...]) if "image_raw" in left else []
    with h5py.File(folder / f"{name}_gt.hdf5", "r") as file:
        left = file["davis/left"]
        times, poses = nanoseconds(left["pose_ts"][...]), left["pose"][...]
        begins = nanoseconds(left["depth_image_raw_ts"][:1]) if "depth_image_raw" in left else np.zeros(0, np.int64)
    events = np.column_stack([rows[:, [0, 1, 3]].astype(np.int64), nanoseconds(rows[:, 2])])[:, [0, 1, 3, 2]]
    stamps = np.array(stamps, np.int64)
    return Plain(events, times, poses, stamps, np.array([min([*stamps[:1], *begins])]), starts_at_zero=False)


def plain_vector(folder: Path) -> Plain:
    name = next(folder.glob("*.hdf5")).name.removesuffix(".synced.left_event.hdf5")
    path = folder / f"{name}.synced.left_event.hdf5"
    with h5py.File(path, "r") as file:
        offset = int(np.asarray(file["t_offset"]).item()) * 1000 if "t_offset" in file else 0
    body, joint = (
        yaml.safe_load((folder / file).read_text(encoding="utf-8-sig"))
        for file in ("camera_mocap_extrinsic_results1.yaml", "small_scale_joint_camera_extrinsic_results.yaml")
    )
    matrices = [np.array(body["cam0"]["T_cam_body"]).reshape(4, 4), np.array(joint["cam2"]["T_cam0_cam2"])]
    mount = np.linalg.inv(matrices[0]) @ matrices[1].reshape(4, 4)
    times, poses = poses_in(folder / f"{name}.synced.gt.txt", "s")
    stamps = folder / f"{name}.synced.left_camera/timestamp.txt"
    rows = rows_of(stamps) if stamps.exists() else []
    opens, closes = (times_in([row[i:] for row in rows], "s") for i in (0, 1))
    events = hdf5_events(path) + np.array([0, 0, offset, 0])
    return Plain(events, times, poses @ mount, opens + (closes - opens) // 2, opens, starts_at_zero=False)


def plain_ros_bag(folder: Path, ros: int) -> Plain:
    """By the types of the messages, each of which has one topic; on the clock of ROS."""
    from rosbags.highlevel import AnyReader
    from test_ros_bag import make_store

    events, times, poses, stamps = [], [], [], []
    path = folder if (folder / "metadata.yaml").exists() else next(folder.glob("*.bag" if ros == 1 else "*.db3"))
    with AnyReader([path], default_typestore=make_store(ros)) as bag:
        for connection, _, data in bag.messages():
            message: Any = bag.deserialize(data, connection.msgtype)
            stamp = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
            if connection.msgtype.endswith("EventArray"):
                events += [(e.x, e.y, e.ts.sec * 10**9 + e.ts.nanosec, e.polarity) for e in message.events]
            elif connection.msgtype.endswith("PoseStamped"):
                times.append(stamp)
                p, q = message.pose.position, message.pose.orientation
                poses.append((p.x, p.y, p.z, q.x, q.y, q.z, q.w))
            elif connection.msgtype.endswith("Image"):
                stamps.append(stamp)
    rows, frames = np.array(poses), np.array(stamps, np.int64)
    found = matrices(rows[:, :3], rows[:, 3:])
    return Plain(np.array(events, np.int64), np.array(times), found, frames, frames, starts_at_zero=False)


def plain_m3ed(folder: Path) -> Plain:
    with h5py.File(folder / "seq_data.h5") as file:
        columns = [file[f"prophesee/left/{name}"][...].astype(np.int64) for name in "xytp"]  # type: ignore[index]
        stamps = file["ovc/ts"][...].astype(np.int64) * 1000  # type: ignore[index]
    with h5py.File(folder / "seq_pose_gt.h5") as file:
        times, moved = np.asarray(file["ts"], np.int64), np.asarray(file["Cn_T_C0"])
        poses = np.linalg.inv(moved)
        poses[:, :3, :3] = Rotation.from_matrix(poses[:, :3, :3]).as_matrix()  # the closest rotations
    return Plain(np.stack(columns, axis=1) * [1, 1, 1000, 1], times * 1000, poses, stamps, stamps)


def plain_dsec(folder: Path) -> Plain:
    with h5py.File(folder / "events/left/events.h5") as file:
        offset = int(file["t_offset"][()])  # type: ignore[index]
    events = hdf5_events(folder / "events/left/events.h5") + np.array([0, 0, 1000 * offset, 0])
    exposures = folder / "images/left/exposure_timestamps.txt"
    if exposures.exists():
        rows = [re.split(r"[,\s]+", line.strip()) for line in exposures.read_text().splitlines()[1:] if line.strip()]
        spans = np.array([[int(Fraction(cell) * 1000) for cell in row] for row in rows])
        middles = spans[:, 0] + (spans[:, 1] - spans[:, 0]) // 2
    else:
        middles = stamps_in(folder, "images/timestamps.txt", "us")
    return Plain(events, *poses_in(folder / "poses.txt", "s"), middles, middles, starts_at_zero=False)


def plain_e2nerf(folder: Path) -> Plain:
    import aedat
    from test_e2nerf import VIEWS

    events, exposures = [], []
    for packet in aedat.Decoder(folder / "lego.aedat4"):
        if "events" in packet:
            rows = packet["events"]
            events.append(np.column_stack([rows["x"], rows["y"], rows["t"] * 1000, rows["on"]]).astype(np.int64))
        if "frame" in packet:
            exposures.append([packet["frame"]["exposure_begin_t"] * 1000, packet["frame"]["exposure_end_t"] * 1000])
    views = np.array(exposures[: 10 * VIEWS : 10], np.int64)
    llff = np.load(folder / "poses_bounds.npy")[:, :15].reshape(-1, 3, 5).astype(np.float64)
    turns = np.stack([llff[..., 1], llff[..., 0], -llff[..., 2]], axis=-1)
    poses = matrices(llff[..., 3], Rotation.from_matrix(turns).as_quat())
    times, none = (views[:, :1] + 25_001_000 * np.arange(5)).ravel(), np.zeros(0, np.int64)
    return Plain(np.concatenate(events), times, poses, none, none, starts_at_zero=False)


def plain_own(folder: Path) -> Plain:
    events = np.column_stack([np.load(folder / f"events/{name}.npy").astype(np.int64) for name in "xytp"])
    stamps = stamps_in(folder, "frames/stamps_ns.txt", "ns")
    return Plain(events, *poses_in(folder / "poses.txt", "ns"), stamps, stamps)


def plain_eventnerf(folder: Path) -> Plain:
    files = sorted((folder / "train/pose").glob("*.txt"))
    cells = [file.read_text(encoding="utf-8-sig").split() for file in files]
    assert all(len(row) == 16 and all(map(is_number, row)) for row in cells)
    poses = np.array(cells, np.float64).reshape(-1, 4, 4)
    poses[:, :3, :3] = Rotation.from_matrix(poses[:, :3, :3]).as_matrix()
    with np.load(folder / "train/events/test.npz") as file:
        x, y, t, p = (file[name].astype(np.int64) for name in "xytp")
    times = np.arange(len(files)) * 1_000_000
    t = np.array([round(Fraction(int(time) * int(times[-1]), int(t.max()))) for time in t])
    return Plain(np.column_stack([x, y, t, p]), times, poses, times, times)


def plain_llff_events(folder: Path) -> Plain:
    rows, times = (
        np.load(folder / "all_poses_bounds.npy"),
        np.load(folder / "all_timestamps.npy").astype(np.int64) * 1000,
    )
    matrix = rows[:, :15].reshape(-1, 3, 5)
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    axes = np.stack([matrix[:, :, 1], matrix[:, :, 0], -matrix[:, :, 2]], axis=2)
    poses[:, :3, :3], poses[:, :3, 3] = Rotation.from_matrix(axes).as_matrix(), matrix[:, :, 3]
    events, order = hdf5_events(folder / "events.h5"), np.argsort(times, kind="stable")
    if events[-1, 2] > 30 * times.max():  # whole nanoseconds
        events[:, 2] //= 1000
    return Plain(events, times[order], poses[order], *np.zeros((2, 0), np.int64), starts_at_zero=False)


LAYOUTS = {
    "eds_raw": Layout("eds", partial(write_eds, prepared=False), partial(plain_eds, prepared=False), ("*.yaml",)),
    "eds_prepared": Layout(
        "eds",
        partial(write_eds, prepared=True),
        partial(plain_eds, prepared=True),
        ("rectify_map_calib0.h5",),
    ),
    "tum_vie_raw": Layout(
        "tum_vie",
        partial(write_tum_vie, layout="raw"),
        partial(plain_tum_vie, raw=True),
        ("image_exposures_left.txt",),
    ),
    "tum_vie_prepared": Layout(
        "tum_vie",
        partial(write_tum_vie, layout="prepared"),
        partial(plain_tum_vie, raw=False),
        ("image_exposures_left.txt", "calibration.json"),
    ),
    "esim": Layout("esim", write_small_esim, plain_esim, ("simulation.json", "0000?.npy")),
    "davis": Layout("davis", write_small_davis, plain_davis, ("images.txt",), lists_images=True),
    "esim_npz": Layout("esim_npz", write_small_npz, plain_npz, ("transforms_test.json",), lists_images=True),
    "esim_bag": Layout("esim_bag", write_bag, plain_bag, ("esim.conf",)),
    "eventnerf": Layout("eventnerf", test_eventnerf.write_eventnerf, plain_eventnerf),
    "llff_events": Layout("llff_events", test_llff_events.write_llff_events, plain_llff_events),
    "evimo2_left_camera": Layout("evimo2", test_evimo2.write_evimo2, plain_evimo2, ("dataset_depth.npz",)),
    "mvsec": Layout("mvsec", test_mvsec.write_mvsec, plain_mvsec),
    "vector": Layout("vector", test_vector.write_vector, plain_vector),
    **{
        f"ros_bag_{ros}": Layout(
            "ros_bag", partial(write_ros_bag, ros=ros), partial(plain_ros_bag, ros=ros), ("metadata.yaml",)
        )
        for ros in (1, 2)
    },
    "m3ed": Layout("m3ed", write_m3ed, plain_m3ed),
    "dsec": Layout("dsec", write_dsec, plain_dsec, ("timestamps.txt", "exposure_timestamps.txt", "rectify_map.h5")),
    "e2nerf": Layout("e2nerf", write_e2nerf, plain_e2nerf, lists_images=True),
    "event_recording": Layout("event_recording", write_own, plain_own),
}

# ----------------------------------------------------------------------------------------------------------- damage

Outcome = Literal["refused", "refused or the same", "the same", "refused or plain"]
"""What must become of a damaged recording: "the same" is what it was undamaged, "plain" what plain reading gives."""

Draw = Callable[[st.SearchStrategy], Any]

TABLES, TREES, ARRAYS, IMAGES = (
    (".txt", ".conf"),
    (".json", ".yaml"),
    (".npy", ".npz", ".h5", ".hdf5"),
    (".png", ".jpg"),
)
WITH_CHECKSUMS = (".npz", ".png")

KINDS_OF_TABLES = {
    "poses": ("*groundtruth*", "*poses*", "mocap_data.txt", "*.gt.txt"),
    "stamps": (
        *("image_stamps*", "image*_timestamps*", "timestamps.txt", "stamps_ns.txt", "images.txt", "timestamp.txt"),
    ),
    "events": ("events.txt",),
    "exposures": ("image_exposures*",),
    "others": ("*",),
}

NO_NUMBERS = ("nan", "inf", "1e400", "abc", "½", "٣", "1_0", "0x10", "1,5", "--1", "1e", "", "\0")
ODD_NUMBERS = ("-1", "0", "1e300", "1e-300", "-0", "999999999999999999999", "9" * 5000, "0." + "3" * 4000, "0.1", "2e9")
NO_VALUES = ("abc", "two\nlines", "\ud800", "x" * 10**5, [], {}, [1], True, float("nan"), float("inf"), [[[]]])
ODD_VALUES = (-1, 0, 1e-300, 1e300, 10**30, 2**31, 0.5)

OPTIONAL_KEYS = (
    *("camera", "frame_camera", "event_camera_from_frame_camera", "contrast_thresholds", "depth_range"),
    *("refractory_period_ns", "bayer_pattern"),
)
LISTS_OF_ANY_LENGTH = ("frames", "distortion", "data")

WITH_FLOATS = ("eventnerf", "llff_events")
"""Formats whose columns of events may be floats."""
OF_ANY_UNIT = "t of any unit"
TIMES, SECONDS_OF_EVENTS = ("t", "ts", "timestamp", "T_wc_timestamp", OF_ANY_UNIT), ("dataset_events_t",)
COORDINATES, POLARITIES = ("x", "y", "position", "dataset_events_xy"), ("p", "polarity", "dataset_events_p")
NOT_READ = ("index", "discretization")
ARRAYS_OF_ANY_LENGTH = ("rows", "poses_bounds", "distortion_params")

OUTSIDE = (-1, 1280, 2**16 + 3, 2**31 + 3, 2**32 + 3, 2**40, -(2**32) + 3)
NO_TIMES = (2**62, 2**63 - 1, -(2**62), -(2**63))
NO_POLARITIES = (2, -3, 2**32 + 1, 2**62)


def matches(path: Path, patterns: tuple[str, ...]) -> bool:
    return any(path.match(pattern) for pattern in patterns)


def damage_file(draw: Draw, layout: Layout, path: Path) -> Outcome:
    """Any file as a whole, or as bytes."""
    content = path.read_bytes()
    kinds = ["removed", "empty", "cut", "overwritten", "appended", "a folder", "shuffled", "bits flipped", "zeros"]
    kind = draw(st.sampled_from([*kinds, "another file"]))
    note(kind)
    if kind == "removed":
        path.unlink()
        return "refused or plain" if matches(path, layout.optional) else "refused"
    if kind == "a folder":
        path.unlink()
        path.mkdir()
        return "refused"
    if kind == "empty":
        path.write_bytes(b"")
        return "refused or plain" if path.suffix == ".conf" else "refused"
    if kind == "cut":
        path.write_bytes(content[: draw(st.integers(1, len(content) - 1))])
        if path.suffix in IMAGES:
            return "refused or the same"
        return "refused or plain" if path.suffix in (*TABLES, ".yaml") else "refused"
    if kind in ("shuffled", "bits flipped"):
        seed, new = draw(st.integers(0, 10**6)), bytearray(content)
        if kind == "shuffled":
            parts = [content[i : i + 16] for i in range(0, len(content), 16)]
            new = b"".join(random.Random(seed).sample(parts, len(parts)))
        for place in random.Random(seed).choices(range(8 * len(content)), k=20 * (kind == "bits flipped")):
            new[place // 8] ^= 1 << place % 8  # type: ignore[index]
        path.write_bytes(new)
        return "refused or the same" if path.suffix in WITH_CHECKSUMS else "refused or plain"
    if kind == "zeros":
        path.write_bytes(bytes(len(content)))
        return "refused or plain" if path.suffix == ".conf" else "refused"
    if kind == "another file":
        others = [
            other for other in sorted(path.parents[0].iterdir()) if other.is_file() and other.suffix != path.suffix
        ]
        path.write_bytes(draw(st.sampled_from(others)).read_bytes() if others else b"another")
        return "refused or plain" if path.suffix == ".conf" else "refused"
    if kind == "overwritten":
        start, new = draw(st.integers(0, len(content) - 1)), draw(st.binary(min_size=1, max_size=4))
        path.write_bytes((content[:start] + new + content[start + len(new) :])[: len(content)])
        return "refused or the same" if path.suffix in WITH_CHECKSUMS else "refused or plain"
    path.write_bytes(content + draw(st.binary(min_size=1, max_size=40)))
    return "refused or plain" if path.suffix in TABLES + TREES else "refused or the same"


def damage_table(draw: Draw, layout: Layout, path: Path) -> Outcome:
    """A line, a cell or the times of a text file."""
    lines = path.read_text(encoding="utf-8").splitlines()
    numbers = [i for i, line in enumerate(lines) if line.strip() and not line.startswith("#")]
    table = next(kind for kind, patterns in KINDS_OF_TABLES.items() if matches(path, patterns))
    kinds = ["no number", "odd number", "line dropped", "line doubled", "column dropped"]
    kinds += ["lines swapped", "scaled"] * (table in ("poses", "stamps", "events"))
    kinds += ["scaled"] * (table == "exposures") + ["no rotation"] * (table == "poses")
    kinds += ["axes swapped"] * (table == "events")
    kind, row = draw(st.sampled_from(kinds)), draw(st.sampled_from(numbers))
    cells = lines[row].split()
    column = draw(st.integers(0, len(cells) - 1))
    note(f"{kind}: line {row + 1}, column {column + 1}")
    refused: Outcome = "refused" if path.suffix == ".txt" else "refused or plain"
    without_header: Outcome = "refused or plain" if path.name == "images.txt" and row == 0 else refused
    if kind in ("no number", "odd number"):
        cells[column] = draw(st.sampled_from(NO_NUMBERS if kind == "no number" else ODD_NUMBERS))
        note(repr(cells[column]))
        lines[row] = " ".join(cells)
        outcome = without_header if kind == "no number" else "refused or plain"
    elif kind == "line dropped":
        del lines[row]
        outcome = "refused" if table in ("stamps", "exposures") and not layout.lists_images else "refused or plain"
    elif kind == "line doubled":
        lines.insert(row, lines[row])
        outcome = "refused or plain" if table in ("events", "others") else "refused"
    elif kind == "column dropped":
        lines[row] = " ".join(cells[:column] + cells[column + 1 :])
        outcome = without_header
    elif kind == "lines swapped":
        other = draw(st.sampled_from([i for i in numbers if lines[i].split()[0] != cells[0]]))
        lines[row], lines[other] = lines[other], lines[row]
        outcome = refused
    elif kind == "no rotation":
        lines[row] = " ".join([*cells[:4], *(repr(1.01 * float(cell)) for cell in cells[4:])])
        outcome = refused
    elif kind == "axes swapped":
        lines = ["{0} {2} {1} {3}".format(*line.split()) for line in lines]
        outcome = refused
    else:
        factor = draw(st.sampled_from(["1000", "1e-6", "1e6", *["1e-3"] * (table != "exposures")]))
        note(factor)
        for i in numbers:
            first, *rest = lines[i].split()
            lines[i] = " ".join([f"{Decimal(first) * Decimal(factor):f}", *rest])
        outcome = refused
    path.write_text("".join(f"{line}\n" for line in lines), encoding="utf-8")
    return outcome


def places_in(tree: object, above: tuple = ()) -> Iterator[tuple]:
    """Where the values of a tree of JSON or YAML lie."""
    entries = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ()
    for key, value in entries:
        yield (*above, key)
        yield from places_in(value, (*above, key))


def damage_tree(draw: Draw, layout: Layout, path: Path) -> Outcome:
    """A value of JSON or YAML."""
    load, dump = (yaml.safe_load, yaml.safe_dump) if path.suffix == ".yaml" else (json.loads, json.dumps)
    tree: Any = load(path.read_text(encoding="utf-8"))
    outcome = damage_value(draw, tree)
    path.write_text(dump(tree), encoding="utf-8")
    return outcome


def damage_value(draw: Draw, tree: Any) -> Outcome:
    """One of nested values."""
    *above, key = draw(st.sampled_from(list(places_in(tree))))
    inside = tree
    for step in above:
        inside = inside[step]
    kind = draw(st.sampled_from(["no value", "odd value", "null", "removed", "doubled"]))
    note(f"{[*above, key]}: {kind}")
    outcome: Outcome = "refused or plain" if above[-1:] == ["topic_metadata"] else "refused or the same"
    if kind == "no value":
        inside[key] = draw(st.sampled_from(NO_VALUES))
    elif kind == "odd value":
        inside[key] = draw(st.sampled_from(ODD_VALUES))
        outcome = "refused or plain"
    elif kind == "null":
        inside[key] = None
        outcome = "refused or plain" if key in OPTIONAL_KEYS else outcome
    elif isinstance(inside, list):
        inside[key : key + 1] = [inside[key]] * 2 * (kind == "doubled")
        outcome = "refused or plain" if above[-1] in LISTS_OF_ANY_LENGTH else outcome
    elif kind == "removed":
        del inside[key]
        outcome = "refused or plain" if key in OPTIONAL_KEYS else outcome
    elif isinstance(inside[key], (int, float)):
        inside[key] *= 2
        outcome = "refused or plain"
    note(repr(inside)[:200])
    return outcome


def kinds_of_damage(name: str, array: np.ndarray) -> list[str]:
    """What may be done to an array of this name."""
    kinds = ["another type"] + ["one more", "one fewer", "none"] * (array.ndim > 0) + ["transposed"] * (array.ndim > 1)
    kinds += ["other byte order"] * (array.dtype.kind in "iuf" and array.dtype.itemsize > 1)
    if name == "rows":
        kinds += ["x", "t", "p", "part of a pixel", "not finite", "scaled", "unsorted", "axes swapped", "wider type"]
    elif name in TIMES:
        kinds += ["t", "scaled", "unsorted", "wider type"]
    elif name in COORDINATES:
        kinds += ["x", "wider type"] + ["axes swapped"] * (array.ndim > 1)
    elif name in POLARITIES:
        kinds += ["p", "wider type"]
    elif array.dtype.kind == "f":
        kinds += ["scaled", "unsorted"] * (name in SECONDS_OF_EVENTS)
        kinds += ["not finite"] + ["no rotation"] * (name == "T_wc_orientation")
        kinds += ["axes swapped"] * (name == "rectify_map")
    return kinds


def damage_array(draw: Draw, name: str, array: np.ndarray, floats: bool = False) -> tuple[np.ndarray, Outcome]:
    """The array of a name, of which "rows" are events x y t p. Whether the columns of events may be floats."""
    is_whole = name in TIMES + COORDINATES + POLARITIES
    kind = draw(st.sampled_from(kinds_of_damage(name, array)))
    place = tuple(draw(st.integers(0, size - 1)) for size in array.shape)
    note(f"{name}: {kind} at {place}")
    changed = array.copy()
    if kind == "another type":
        types = ["c16", "S8"] + ["f8", "f4"] * (is_whole and not floats)
        return np.array(5) if array.dtype.kind in "US" else array.astype(draw(st.sampled_from(types))), "refused"
    if kind == "wider type":
        return array.astype(draw(st.sampled_from(["<i8", ">i8"]))), "the same"
    if kind == "other byte order":
        return array.astype(array.dtype.newbyteorder()), "the same"
    if kind == "none":
        return array[:0], "refused or plain" if name in ARRAYS_OF_ANY_LENGTH else "refused"
    if kind in ("one more", "one fewer"):
        changed = np.append(array, array[-1:], axis=0) if kind == "one more" else array[:-1]
        return changed, "refused or plain" if name in ARRAYS_OF_ANY_LENGTH else "refused"
    if kind == "transposed":
        return array.T, "refused"
    if kind == "axes swapped":
        return array[..., [1, 0, 2, 3] if name == "rows" else [1, 0]], "refused"
    if kind == "unsorted":
        other = draw(st.sampled_from([i for i in range(len(array)) if i != place[0]]))
        changed[[place[0], other]] = changed[[other, place[0]]]
        return changed, "refused or plain" if name == "T_wc_timestamp" else "refused"
    if kind == "scaled":
        factor = draw(st.sampled_from([Fraction(1000), Fraction(1, 1000), Fraction(1, 10**6)]))
        note(str(factor))
        times = changed[:, 2] if name == "rows" else changed
        times[...] = times * factor.numerator // factor.denominator
        return changed, "refused or plain" if name in ("rows", OF_ANY_UNIT) else "refused"  # rows are one of two files
    if kind == "no rotation":
        changed[place[0]] *= 1.01
        return changed, "refused"
    if kind == "not finite":
        changed[place] = draw(st.sampled_from([np.nan, np.inf]))
        return changed, "refused or the same" if name == "poses_bounds" else "refused"
    if kind == "part of a pixel":
        changed[place[0], draw(st.sampled_from([0, 1, 3]))] += 0.5
        return changed, "refused"
    value = draw(st.sampled_from({"x": OUTSIDE, "t": NO_TIMES, "p": NO_POLARITIES}[kind]))
    note(str(value))
    changed = array.astype(draw(st.sampled_from(["i8"] if is_whole else ["i8", "f8"])))
    changed[place if is_whole else (place[0], {"x": 0, "t": 2, "p": 3}[kind])] = value
    return changed, "refused"


def damage_arrays(draw: Draw, layout: Layout, path: Path) -> Outcome:
    """An array of a file that holds arrays, or which of them is which."""
    if path.suffix == ".npy":
        is_rows = layout.format == "esim" and path.parent.name == "events"
        array, outcome = damage_array(draw, "rows" if is_rows else path.stem, np.load(path))
        np.save(path, array)
        return "refused or plain" if path.parent.name == "depth" else outcome  # of which the shape is looked at
    if path.suffix == ".npz":
        with np.load(path, allow_pickle=True) as file:
            arrays = dict(file)
        name, is_removed = draw(st.sampled_from(sorted(arrays))), draw(st.sampled_from([False] * 9 + [True]))
        called = OF_ANY_UNIT if (layout.format, name) == ("eventnerf", "t") else name
        if arrays[name].dtype.hasobject:
            tree = arrays.pop(name).item()
            damage_value(draw, tree)
            array, outcome = np.array(tree, dtype=object), "refused or plain"
        else:
            array, outcome = damage_array(draw, called, arrays.pop(name), layout.format in WITH_FLOATS)
        np.savez(path, **arrays, **{} if is_removed else {name: array})
        if name in NOT_READ or path.name == "dataset_depth.npz":
            return "refused or the same"
        return "refused" if is_removed else outcome
    with h5py.File(path, "r+") as file:
        if "davis/left" in file:
            return damage_mvsec(draw, file["davis/left"])
        group: Any = next((file[name] for name in ("events", "prophesee/left") if name in file), file)
        names = ("x", "y", "t", "p", "rectify_map", "ts", "Cn_T_C0")
        name = draw(st.sampled_from([name for name in names if name in group]))
        kind = draw(st.sampled_from(["removed", *["exchanged"] * (name in "xy"), *["changed"] * 8]))
        note(f"{name}: {kind}")
        if kind == "exchanged":
            for old, new in ("xz", "yx", "zy"):
                group.move(old, new)
            return "refused"
        array = group[name][...]
        del group[name]
        if kind == "removed":
            return "refused"
        is_llff = layout.format == "llff_events"  # which guesses the unit
        called = OF_ANY_UNIT if is_llff and name == "t" else name
        group[name], outcome = damage_array(draw, called, array, is_llff)
        return outcome


def damage_mvsec(draw: Draw, group: Any) -> Outcome:
    """A dataset of one of the two files, of which "rows" are events x y t p."""
    name = draw(st.sampled_from(sorted({"events", "image_raw", "image_raw_ts", "pose", "pose_ts"} & set(group))))
    array = group[name][...]
    del group[name]
    if draw(st.sampled_from([False] * 9 + [True])):
        return "refused or plain" if name == "image_raw" else "refused"
    if name == "events":
        array = array.astype(np.float64)
    kind = {"events": "rows", "pose_ts": "seconds", "image_raw_ts": "seconds"}.get(name, name)
    group[name], outcome = damage_array(draw, kind, array)
    return "refused or plain" if name in ("image_raw_ts", "pose_ts", "pose", "image_raw", "events") else outcome


def damage_image(draw: Draw, layout: Layout, path: Path) -> Outcome:
    """Size or name of an image."""
    kind = draw(st.sampled_from(["larger", "turned", "renamed", "copied"]))
    note(kind)
    if kind == "renamed":
        path.rename(path.with_suffix(".bak"))
    elif kind == "copied":
        shutil.copy(path, path.with_stem("zzz"))
        return "the same" if layout.lists_images else "refused"
    else:
        with Image.open(path) as image:
            width, height = image.size
            image.resize((width + 1, height) if kind == "larger" else (width // 2, height * 2)).save(path)
    return "refused"


DAMAGE_TO = {TABLES: damage_table, TREES: damage_tree, ARRAYS: damage_arrays, IMAGES: damage_image}


def damage(draw: Draw, layout: Layout, folder: Path) -> Outcome:
    """Changes one file in one way, and says what must become of the recording."""
    files = [path for path in sorted(folder.rglob("*")) if path.is_file() and path.stat().st_size]
    name = draw(st.sampled_from(sorted({"image" if file.suffix in IMAGES else file.name for file in files})))
    path = draw(st.sampled_from([file for file in files if name in (file.name, "image" * (file.suffix in IMAGES))]))
    note(str(path.relative_to(folder)))
    content = path.read_bytes()
    path.unlink()  # it is a link to the undamaged file
    path.write_bytes(content)
    if path.name in ("x.npy", "y.npy") and draw(st.sampled_from([False] * 9 + [True])):
        note("x and y exchanged")
        for old, new in ("xz", "yx", "zy"):
            (path.parent / f"{old}.npy").rename(path.parent / f"{new}.npy")
        return "refused"
    damage_content = next((damage for kinds, damage in DAMAGE_TO.items() if path.suffix in kinds), damage_file)
    return draw(st.sampled_from([damage_file, damage_content]))(draw, layout, path)


# --------------------------------------------------------------------------------------------------------- checking


@dataclass
class Template:
    """A recording that nothing was done to."""

    layout: Layout
    folder: Path

    @cached_property
    def recording(self) -> EventRecording:
        return read_recording(self.folder, self.layout.format)

    @cached_property
    def facts(self) -> dict[str, Any]:
        return facts(self.recording)


def kinds_of_frames(recording: EventRecording) -> list[Frames | None]:
    return [recording.frames, recording.blurred_frames, recording.held_out_frames]


def facts(recording: EventRecording) -> dict[str, Any]:
    """Everything that a recording states, but for its path and its notes."""

    def of_trajectory(trajectory: Trajectory) -> tuple:
        return trajectory.times, trajectory.positions, trajectory.quaternions

    def of_frames(frames: Frames | None) -> tuple | None:
        if frames is None:
            return None
        inside = [recording.path in file.parents for file in frames.filenames]  # others are kept in the cache
        names = [
            str(file.relative_to(recording.path)) if of_folder else file.name
            for file, of_folder in zip(frames.filenames, inside, strict=True)
        ]
        pictures = [load_picture(file) for file in frames.filenames]
        depth = [load_array(file) for file in frames.depth_filenames or ()]
        return names, frames.times, frames.numbers, frames.camera, of_trajectory(frames.trajectory), pictures, depth

    events = joined(recording.stream_events())
    return {
        "events": np.stack([events.x, events.y, events.t, events.p], axis=1).astype(np.int64),
        "index": [getattr(index_events(recording), name).numpy() for name in ("times", "positives", "offsets")],
        "camera": (recording.camera, recording.camera.directions),
        "trajectory": of_trajectory(recording.trajectory),
        "frames": [of_frames(frames) for frames in kinds_of_frames(recording)],
        "sensor": (recording.contrast_thresholds, recording.refractory_period, recording.bayer_pattern),
        "depth_range": recording.depth_range,
    }


def is_same(camera: Camera, other: Camera) -> bool:
    if camera.directions is None or other.directions is None:
        return camera == other
    return camera == other and np.array_equal(camera.directions, other.directions)


def check_camera(camera: Camera) -> None:
    directions = camera.pixel_directions()
    assert directions.shape == (camera.height, camera.width, 3) and np.isfinite(directions).all()
    picture = np.zeros((camera.height, camera.width, 3), np.uint8)
    assert camera.undistort(picture).shape == picture.shape
    assert np.isfinite(camera.matrix).all() and np.isfinite(camera.undistorted().matrix).all()


def check_trajectory(trajectory: Trajectory) -> None:
    assert (np.diff(trajectory.times) > 0).all()
    times = np.sort(np.concatenate([trajectory.times, trajectory.times[:-1] + np.diff(trajectory.times) // 2]))
    poses = trajectory.poses(torch.from_numpy(times)).numpy()
    assert np.isfinite(poses).all()
    rotations = poses[..., :3]
    products = rotations @ rotations.transpose(0, 2, 1)
    np.testing.assert_allclose(products, np.broadcast_to(np.eye(3), products.shape), rtol=0, atol=1e-9)
    assert (np.linalg.det(rotations) > 0).all()


def check_index(recording: EventRecording, rows: np.ndarray) -> None:
    """The index holds the events within the poses, but for hot pixels."""
    camera, trajectory, index = recording.camera, recording.trajectory, index_events(recording)
    x, y, t, p = rows.T
    assert ((x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)).all()
    assert (np.diff(t) >= 0).all()
    assert set(p.tolist()) <= {0, 1} or set(p.tolist()) <= {-1, 1}
    used = (t >= trajectory.start) & (t <= trajectory.end)
    used &= ~np.isin(y * camera.width + x, index.hot_pixels.numpy())
    expected = np.stack([x, y, t, np.where(p > 0, 1, -1)], axis=1)[used]
    events = index.events()
    found = np.stack([events.x, events.y, events.t, events.p], axis=1).astype(np.int64)
    np.testing.assert_array_equal(found[np.lexsort(found.T)], expected[np.lexsort(expected.T)])
    assert len(found) == len(rows) or any("events" in sentence for sentence in index_events(recording).notes)


def check_plain(recording: EventRecording, rows: np.ndarray, plain: Plain) -> None:
    """Against what plain reading gives."""
    zero = 0
    if not plain.starts_at_zero:
        zero = min(plain.events[0, 2], plain.pose_times[0], *plain.stamps[:1])
    assert recording.zero == zero
    assert recording.num_events in (None, len(rows)) and len(rows) == len(plain.events)
    np.testing.assert_array_equal(rows[:, [0, 1, 3]], plain.events[:, [0, 1, 3]])
    assert np.abs(rows[:, 2] - (plain.events[:, 2] - zero)).max() <= 1

    trajectory = recording.trajectory
    used = np.isin(plain.pose_times - zero, trajectory.times)
    if not used.all() or (np.diff(plain.pose_times) <= 0).any():
        assert any("poses" in sentence for sentence in recording.notes)
    _, first = np.unique(plain.pose_times[used], return_index=True)
    np.testing.assert_array_equal(trajectory.times, plain.pose_times[used][first] - zero)
    poses = plain.poses[used][first]
    np.testing.assert_allclose(trajectory.positions, poses[:, :3, 3], rtol=1e-9, atol=1e-9)
    rotations = Rotation.from_quat(trajectory.quaternions).as_matrix()
    np.testing.assert_allclose(rotations, poses[:, :3, :3], rtol=0, atol=1e-9)

    times = plain.frame_times - zero
    covered = times[(times >= trajectory.start) & (times <= trajectory.end)]
    found = np.zeros(0, np.int64) if recording.frames is None else recording.frames.times
    np.testing.assert_array_equal(found, covered)


def check_frames(recording: EventRecording, undamaged: EventRecording) -> None:
    """What became fewer is noted."""
    found, expected = (
        sum(len(frames.times) for frames in kinds_of_frames(one)[:2] if frames) for one in (recording, undamaged)
    )
    assert found >= expected or any(re.search("frames|images", sentence) for sentence in recording.notes)


SECONDS, BYTES = 30.0, 2 * 10**9
"""Processor time and memory that reading a small recording never takes, whatever is wrong with it."""


class TakesTooLong(BaseException):
    """Is no error that a reader turns into a sentence."""


@contextmanager
def within_limits() -> Iterator[None]:
    """Fails where the block takes more than `SECONDS`, or more than `BYTES` beyond what the process holds before.

    Of Linux, the largest memory is asked for, which is set back first. Four times as much cannot be had at all.
    """

    def late(*_: object) -> None:
        raise TakesTooLong(f"more than {SECONDS} s of processor time")

    before = signal.signal(signal.SIGPROF, late)
    held, limits = psutil.Process().memory_info(), resource.getrlimit(resource.RLIMIT_AS)
    clear, status = Path("/proc/self/clear_refs"), Path("/proc/self/status")
    if clear.exists():
        clear.write_text("5")
    resource.setrlimit(resource.RLIMIT_AS, (held.vms + 4 * BYTES, limits[1]))
    signal.setitimer(signal.ITIMER_PROF, SECONDS)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        resource.setrlimit(resource.RLIMIT_AS, limits)
        signal.signal(signal.SIGPROF, before)
    if clear.exists() and (peak := re.search(r"VmHWM:\s+(\d+) kB", status.read_text())):
        assert 1024 * int(peak[1]) - held.rss < BYTES


def read_or_refuse(folder: Path, format: str) -> tuple[EventRecording, dict[str, Any]] | None:
    """A recording and its facts, or None where it is refused with one sentence that says where."""
    _read_folder.cache_clear()  # of cameras with tables of megabytes
    try:
        with within_limits():
            recording = read_recording(folder, format)
            return recording, facts(recording)
    except RecordingError as error:
        note(str(error)[:2000])
        assert is_one_sentence(str(error))
        assert str(folder) in str(error)
    return None


def check_damaged(template: Template, draw: Draw) -> None:
    layout = template.layout
    with tempfile.TemporaryDirectory(dir=template.folder.parent) as above:
        folder = Path(above) / "recording"
        shutil.copytree(template.folder, folder, copy_function=os.link)
        outcome = damage(draw, layout, folder)
        note(f"must be {outcome}")
        before = contents(folder)
        found = read_or_refuse(folder, layout.format)
        found_by_itself = read_or_refuse(folder, "auto")
        assert contents(folder) == before
        if found is None:
            assert found_by_itself is None and outcome != "the same"
            return
        recording, found_facts = found
        assert outcome != "refused"
        assert found_by_itself is None or found_by_itself[0].format == layout.format
        if outcome != "refused or plain":
            np.testing.assert_equal(found_facts, template.facts)
        undamaged = template.recording
        kinds = zip([recording, *kinds_of_frames(recording)], [undamaged, *kinds_of_frames(undamaged)], strict=True)
        for one, other in kinds:
            if one is not None:
                check_trajectory(one.trajectory)
                if other is None or not is_same(one.camera, other.camera):
                    check_camera(one.camera)
        check_frames(recording, undamaged)
        check_index(recording, found_facts["events"])
        check_plain(recording, found_facts["events"], layout.read_plain(folder))


@pytest.fixture(scope="module")
def templates(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Template]:
    @cache
    def write(name: str) -> Template:
        folder = tmp_path_factory.mktemp(name) / "template"
        LAYOUTS[name].write(folder)
        return Template(LAYOUTS[name], folder)

    return write


@pytest.fixture(scope="module", params=LAYOUTS)
def template(request: pytest.FixtureRequest, templates: Callable[[str], Template]) -> Template:
    return templates(request.param)


FUZZ = settings(deadline=None, derandomize=True, database=None, suppress_health_check=[HealthCheck.too_slow])


def test_all_formats_are_damaged():
    """A new format needs a layout here."""
    assert {layout.format for layout in LAYOUTS.values()} == {format.name for format in formats()}


@pytest.mark.parametrize("fault", ["time", "memory"])
def test_limits_are_noticed(monkeypatch: pytest.MonkeyPatch, fault: str):
    """Else the tests below could not fail."""
    monkeypatch.setitem(within_limits.__wrapped__.__globals__, "SECONDS", 0.2)
    monkeypatch.setitem(within_limits.__wrapped__.__globals__, "BYTES", 10**8)
    with pytest.raises((TakesTooLong, AssertionError)), within_limits():
        if fault == "memory":  # of its own; `np.ones` may be given what is free within the heap
            np.frombuffer(mmap.mmap(-1, 2 * 10**8), dtype=np.uint8).fill(1)
        while fault == "time":
            pass


def test_undamaged(template: Template):
    recording, rows = template.recording, template.facts["events"]
    for one in (recording, *kinds_of_frames(recording)):
        if one is not None:
            check_camera(one.camera)
            check_trajectory(one.trajectory)
    check_index(recording, rows)
    check_plain(recording, rows, template.layout.read_plain(template.folder))
    assert read_recording(template.folder).format == template.layout.format
    assert all(place.exists() for place, _ in recording.times_in.values())  # errors name them


@settings(FUZZ, max_examples=30)
@given(data=st.data())
def test_damaged(template: Template, data: st.DataObject):
    check_damaged(template, data.draw)


@pytest.mark.exhaustive
@settings(FUZZ, max_examples=200)
@given(data=st.data())
def test_damaged_in_many_ways(template: Template, data: st.DataObject):
    check_damaged(template, data.draw)


# ------------------------------------------------------------------------------------ what was found and is mended now


def edit(name: str, old: str, new: str) -> Callable[[Path], None]:
    """Replaces the first occurrence of a text."""

    def edited(folder: Path) -> None:
        text = (folder / name).read_text(encoding="utf-8")
        assert old in text
        (folder / name).write_text(text.replace(old, new, 1), encoding="utf-8")

    return edited


def change(name: str, *keys: str | int, value: object) -> Callable[[Path], None]:
    """Sets a value of a JSON file."""

    def changed(folder: Path) -> None:
        tree = json.loads((folder / name).read_text(encoding="utf-8"))
        inside = tree
        for key in keys[:-1]:
            inside = inside[key]
        inside[keys[-1]] = value
        (folder / name).write_text(json.dumps(tree), encoding="utf-8")

    return changed


def write(name: str, content: bytes) -> Callable[[Path], object]:
    return lambda folder: (folder / name).write_bytes(content)


def patch(name: str, old: bytes, new: bytes) -> Callable[[Path], object]:
    return lambda folder: (folder / name).write_bytes((folder / name).read_bytes().replace(old, new, 1))


def scale_stamps(name: str, factor: float) -> Callable[[Path], object]:
    return lambda folder: np.savetxt(folder / name, np.loadtxt(folder / name) * factor)


def save_rows(value: int) -> Callable[[Path], None]:
    """Events as whole numbers, one x of which is replaced."""

    def saved(folder: Path) -> None:
        rows = np.load(folder / "events/00000.npy").astype(np.int64)
        rows[5, 0] = value
        np.save(folder / "events/00000.npy", rows)

    return saved


def flip_byte(name: str) -> Callable[[Path], None]:
    """A byte within the pixels of a PNG."""

    def flipped(folder: Path) -> None:
        content = bytearray((folder / name).read_bytes())
        content[content.index(b"IDAT") + 100] ^= 0xFF
        (folder / name).write_bytes(content)

    return flipped


def write_huge_image(folder: Path) -> None:
    """A PNG that states so many pixels that Pillow refuses it with an error of its own."""
    header = b"IHDR" + struct.pack(">IIBBBBB", 60000, 60000, 8, 0, 0, 0, 0)
    chunk = struct.pack(">I", 13) + header + struct.pack(">I", zlib.crc32(header))
    (folder / "images/00001.png").write_bytes(b"\x89PNG\r\n\x1a\n" + chunk)


def steep_directions(folder: Path) -> None:
    directions = np.load(folder / "camera_directions.npy")
    directions[3, 4, 0] = 1e300
    np.save(folder / "camera_directions.npy", directions)


FOUND: dict[str, tuple[str, Callable[[Path], object], str]] = {
    "PNG with another byte": ("esim", flip_byte("images/00001.png"), "00001.png cannot be read as an image"),
    "PNG of 3.6 gigapixels": ("esim", write_huge_image, "00001.png cannot be read as an image"),
    "header without an end": ("esim", patch("events/00000.npy", b"}", b" "), "cannot be read as a NumPy array"),
    "header of bytes": ("esim", patch("events/00000.npy", b" 'shape'", b"b'shape'"), "cannot be read as a NumPy array"),
    "zip without contents": ("esim", write("events/00000.npy", b"PK\x03\x04" + bytes(99)), "cannot be read as a NumPy"),
    "x that wraps": ("esim", save_rows(2**32 + 3), "event 6 holds x = 4.29497e+09, where a whole number"),
    "stamps in µs": (
        "esim",
        scale_stamps("images/image_stamps_ns.txt", 1e-3),
        "frames (image_stamps_ns.txt) look like micro",
    ),
    "stamps in ps": ("esim", scale_stamps("images_corrupted/image_stamps_ns.txt", 1e3), "3 frames within 600 s"),
    "truth for a number": (
        "esim",
        change("simulation.json", "camera", "cx", value=True),
        "camera.cx = true, but a number was expected",
    ),
    "lines in a value": (
        "esim",
        change("simulation.json", "camera", value="two\nlines"),
        "lacks camera.width, which was expected",
    ),
    "huge number": ("esim", change("simulation.json", "depth_range", 1, value=10**400), "holds depth_range = [0.5, 1"),
    "focal lengths in mm": (
        "esim",
        change("simulation.json", "camera", "fx", value=0.02),
        "fits no lens; state",
    ),
    "nested too deeply": ("esim", write("simulation.json", b"[" * 100_000), "cannot be read as JSON"),
    "underscore": ("davis", edit("groundtruth.txt", " 0.1 ", " 0_1 "), "holds '0_1' where a finite number"),
    "digit of another script": ("davis", edit("groundtruth.txt", " 0.1 ", " ٣ "), "holds '٣' where a finite number"),
    "position of 1e300 m": ("davis", edit("groundtruth.txt", " 0.1 ", " 1e300 "), "line 2, holds the position [1e+300"),
    "another folder in line 1": ("davis", edit("images.txt", "images/", "imagos/"), "line 1 lists"),
    "a camera more": (
        "tum_vie_raw",
        change("camera-calibrationA.json", "value0", "resolution", value=[[1024, 1024]] * 3 + [[1280, 720]] * 2),
        "but a list of 4 was expected",
    ),
    "an undistorted camera more": (
        "eds_prepared",
        change(test_eds.INTRINSICS, "intrinsics_undistorted", value=[{"fx": 9, "fy": 9, "cx": 9, "cy": 9}] * 3),
        "but a list of 2 was expected",
    ),
    "undistorted camera without width": (
        "eds_prepared",
        change(test_eds.INTRINSICS, "intrinsics_undistorted", 0, "fx", value=1e-300),
        "focal lengths 1e-300 and",
    ),
    "no distortion model": (
        "eds_raw",
        edit("camchain.yaml", "distortion_model: radtan", "distortion_model: null"),
        "lacks cam0.distortion_model",
    ),
    "direction of 1e300": ("event_recording", steep_directions, "in which x / z and y / z reach 1e+300"),
    "truth for a threshold": (
        "event_recording",
        change("recording.json", "contrast_thresholds", 0, value=True),
        "holds contrast_thresholds = [true, 0.3]",
    ),
    "line in the name of an array": (
        "esim_npz",
        lambda folder: np.savez(folder / "camera_poses.npz", **{"T_wc\nposition": np.zeros(3)}),
        "holds T_wc?position;",
    ),
    "truth for an angle": (
        "esim_npz",
        change("views/transforms_test.json", "camera_angle_x", value=True),
        "camera_angle_x = true",
    ),
    "truth in a pose": (
        "esim_npz",
        change("views/transforms_test.json", "frames", 0, "transform_matrix", 3, 3, value=True),
        "but a matrix of 4 x 4 numbers was expected",
    ),
    "coefficient of 2^31": (
        "tum_vie_raw",
        change("camera-calibrationA.json", "value0", "intrinsics", 2, "intrinsics", "k1", value=2**31),
        "which leaves no picture without distortion",
    ),
    "text for a calibration": (
        "tum_vie_prepared",
        change("calibration.json", "value0", value="abc"),
        "lacks value0.intrinsics",
    ),
    "calibration without intrinsics": (
        "tum_vie_prepared",
        change("calibration.json", "value0", "intrinsics", value=None),
        "lacks value0.intrinsics",
    ),
    "name of 3000 letters": (
        "davis",
        edit("images.txt", "images/", "x" * 3000),
        "which cannot be opened (File name too long)",
    ),
}


@pytest.mark.parametrize("name", FOUND)
def test_what_was_found_is_refused(templates: Callable[[str], Template], tmp_path: Path, name: str):
    layout, damage_it, message = FOUND[name]
    template = templates(layout)
    folder = shutil.copytree(template.folder, tmp_path / "recording")
    damage_it(folder)
    with pytest.raises(RecordingError) as caught:
        facts(read_recording(folder, template.layout.format))
    assert message in str(caught.value)
    assert is_one_sentence(str(caught.value)) and str(folder) in str(caught.value)


def test_whole_numbers_keep_all_their_digits(tmp_path: Path):
    """Nanoseconds since 1970 do not fit into floating point."""
    write_small_esim(tmp_path / "esim")
    epoch = 1_700_000_000_123_456_789
    for file in (tmp_path / "esim/events").iterdir():
        np.save(file, np.load(file).astype(np.int64) + np.array([0, 0, epoch, 0]))
    times, poses = rows_of(tmp_path / "esim/0_poses_all.txt"), tmp_path / "esim/0_poses_all.txt"
    poses.write_text("".join(" ".join([str(int(t) + epoch), *rest]) + "\n" for t, *rest in times))
    found = joined(read_recording(tmp_path / "esim").stream_events())
    np.testing.assert_array_equal(found.t, EVENTS[:, 2] + epoch)


@pytest.mark.parametrize(
    ("break_it", "sentence"),
    [
        (lambda folder: (folder / "images.txt").unlink(), "There is a folder images/ but no images.txt"),
        (edit("images.txt", "1.150000000", "soon"), "1 of 3 images are not listed in images.txt"),
    ],
)
def test_frames_that_davis_does_not_list_are_noted(tmp_path: Path, break_it: Callable[[Path], object], sentence: str):
    write_small_davis(tmp_path / "davis")
    break_it(tmp_path / "davis")
    notes = read_recording(tmp_path / "davis").notes
    assert len(notes) == 1 and notes[0].startswith(sentence)
