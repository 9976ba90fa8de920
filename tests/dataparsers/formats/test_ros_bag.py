"""ROS bags of the drivers of event cameras, written here by rosbags from the drivers' public message definitions."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recordings import FRAME_TIMES, HEIGHT, POSE_TIMES, WIDTH, image, joined, poses
from test_event_files import evt3

from enerf_ns.dataparsers.formats.registry import read_recording
from enerf_ns.dataparsers.index.indexing import index_events
from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.dataparsers.recording.files import load_image

typesys = pytest.importorskip("rosbags.typesys", reason="rosbags is an optional extra of the project")

EPOCH = 1_700_000_000_000_000_000
"""Time of the clock of ROS at the recording's zero, ns."""

DEFINITIONS = {
    **{
        f"{package}/msg/{name}": text
        for package in ("dvs_msgs", "prophesee_event_msgs")
        for name, text in {
            "Event": "uint16 x\nuint16 y\ntime ts\nbool polarity",
            "EventArray": f"std_msgs/Header header\nuint32 height\nuint32 width\n{package}/Event[] events",
        }.items()
    },
    "event_camera_msgs/msg/EventPacket": (
        "std_msgs/Header header\nuint32 height\nuint32 width\nuint64 seq\nuint64 time_base\nstring encoding\n"
        "bool is_bigendian\nuint8[] events"
    ),
}

TRUE_EVENTS = np.column_stack(
    [
        np.random.default_rng(3).integers(0, WIDTH, 2000),
        np.random.default_rng(4).integers(0, HEIGHT, 2000),
        np.sort(np.random.default_rng(5).integers(1000, 999_000, 2000)) * 1000,
        np.random.default_rng(6).integers(0, 2, 2000),
    ]
)
"""x y t (ns, whole microseconds) p, over the poses of `recordings`."""

CAMERA = Camera(WIDTH, HEIGHT, 20.0, 21.0, 11.5, 8.5, (-0.1, 0.02, 0.001, -0.002), "radtan")


@dataclass(frozen=True)
class Bag:
    """What is written into a bag."""

    ros: int = 1
    kind: str = "dvs_msgs/msg/EventArray"
    encoding: str = "evt3"
    events: np.ndarray = field(default_factory=lambda: TRUE_EVENTS)
    per_message: int = 130
    sensor_start: int = 0
    """Time of the sensor's own clock at the recording's zero, ns."""
    delays: tuple[int, ...] = (300_000, 100_000, 2_000_000)
    """Of a message's stamp after its first event, ns, in turn."""
    images: str = "mono8"
    frames: tuple[str, ...] = ("/dvs/image_raw",)
    infos: tuple[tuple[str, int, int], ...] = (("/dvs/camera_info", WIDTH, HEIGHT),)
    events_topics: tuple[str, ...] = ("/dvs/events",)
    poses_topics: tuple[str, ...] = ("/pose",)
    poses_kind: str = "geometry_msgs/msg/PoseStamped"
    storage: str = "SQLITE3"
    definitions: bool = True
    frame_size: tuple[int, int] = (WIDTH, HEIGHT)
    matrix: np.ndarray = field(default_factory=lambda: np.array(CAMERA.matrix))


def make_store(ros: int) -> Any:
    store = typesys.get_typestore(typesys.Stores.ROS1_NOETIC if ros == 1 else typesys.Stores.ROS2_HUMBLE)
    for name, text in DEFINITIONS.items():
        store.register(typesys.get_types_from_msg(text, name))
    return store


def write_bag(folder: Path, bag: Bag = Bag()) -> Path:
    """Writes recording.bag, or a bag of ROS 2 in the folder itself."""
    from rosbags import rosbag1, rosbag2

    store = make_store(bag.ros)

    def new(name: str, **fields: Any) -> Any:
        return store.types[name](**fields)

    def header(time: int) -> Any:
        stamp = new("builtin_interfaces/msg/Time", sec=time // 10**9, nanosec=time % 10**9)
        return new("std_msgs/msg/Header", stamp=stamp, frame_id="cam", **({"seq": 7} if bag.ros == 1 else {}))

    messages: list[tuple[str, int, Any]] = []
    for topic in bag.events_topics:
        messages += [(topic, *pair) for pair in event_messages(bag, new, header)]
    for topic, width, height in bag.infos:
        region = new("sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
        parts = {"D": np.array(CAMERA.distortion), "K": bag.matrix.ravel(), "R": np.eye(3).ravel(), "P": np.zeros(12)}
        info = new(
            "sensor_msgs/msg/CameraInfo",
            header=header(EPOCH),
            width=width,
            height=height,
            distortion_model="plumb_bob",
            binning_x=0,
            binning_y=0,
            roi=region,
            **{name if bag.ros == 1 else name.lower(): part for name, part in parts.items()},
        )
        messages.append((topic, EPOCH, info))
    for topic in bag.frames:
        for i, time in enumerate((FRAME_TIMES + EPOCH).tolist()):
            width, height, step, data = encoded(bag.images, i, bag.frame_size)
            picture = new(
                "sensor_msgs/msg/Image",
                header=header(time),
                height=height,
                width=width,
                encoding=bag.images,
                is_bigendian=0,
                step=step,
                data=data,
            )
            messages.append((topic, time, picture))
    for topic in bag.poses_topics:
        for time, row in zip((POSE_TIMES + EPOCH).tolist(), poses().tolist(), strict=True):
            place = new("geometry_msgs/msg/Point", **dict(zip("xyz", row[:3], strict=True)))
            turn = new("geometry_msgs/msg/Quaternion", **dict(zip("xyzw", row[3:], strict=True)))
            pose = new("geometry_msgs/msg/Pose", position=place, orientation=turn)
            if bag.poses_kind.startswith("nav"):
                zero = new("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
                still = new("geometry_msgs/msg/Twist", linear=zero, angular=zero)
                message = new(
                    bag.poses_kind,
                    header=header(time),
                    child_frame_id="body",
                    pose=new("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=np.zeros(36)),
                    twist=new("geometry_msgs/msg/TwistWithCovariance", twist=still, covariance=np.zeros(36)),
                )
            elif bag.poses_kind.startswith("tf"):
                shift = new("geometry_msgs/msg/Vector3", **dict(zip("xyz", row[:3], strict=True)))
                moved = new("geometry_msgs/msg/Transform", translation=shift, rotation=turn)
                names = {"header": header(time), "child_frame_id": "dvs"}
                one = new("geometry_msgs/msg/TransformStamped", **names, transform=moved)
                message = new(bag.poses_kind, transforms=[one])
            else:
                message = new(bag.poses_kind, header=header(time), pose=pose)
            messages.append((topic, time, message))

    folder.mkdir(exist_ok=True, parents=True)
    if bag.ros == 1:
        writer = rosbag1.Writer(folder / "recording.bag")
        writer.chunk_threshold = 5_000
    else:
        storage = rosbag2.StoragePlugin[bag.storage]
        writer = rosbag2.Writer(folder / "bag", version=9 if bag.definitions else 8, storage_plugin=storage)
    serialize = store.serialize_ros1 if bag.ros == 1 else store.serialize_cdr
    with writer:
        connections = {}
        for topic, time, message in sorted(messages, key=lambda entry: entry[1]):
            kind = message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=store)
            writer.write(connections[topic], time, bytes(serialize(message, kind)))
    if bag.ros == 2:
        for file in (folder / "bag").iterdir():
            file.rename(folder / file.name)
        (folder / "bag").rmdir()
    return folder


def encoded(encoding: str, index: int, size: tuple[int, int]) -> tuple[int, int, int, np.ndarray]:
    """Width, height, bytes of a row, and the bytes of a frame, with three bytes of padding in each row."""
    pixels = true_image(encoding, index)
    if encoding in ("bgr8", "bgra8"):
        pixels = pixels[..., ::-1]
    if encoding == "bgra8":
        pixels = np.dstack([pixels, np.full(pixels.shape[:2], 9, np.uint8)])
    if size != (WIDTH, HEIGHT):
        pixels = np.resize(pixels, (size[1], size[0], pixels.shape[2]))
    rows = np.ascontiguousarray(pixels).view(np.uint8).reshape(len(pixels), -1)
    rows = np.pad(rows, ((0, 0), (0, 3)))
    return pixels.shape[1], pixels.shape[0], rows.shape[1], rows.ravel()


def true_image(encoding: str, index: int) -> np.ndarray:
    if encoding == "mono16":
        return image(index).astype(np.uint16) * 257
    return image(index, 1 if encoding == "mono8" else 3)


def event_messages(bag: Bag, new: Callable[..., Any], header: Callable[[int], Any]) -> list[tuple[int, Any]]:
    messages, recorded = [], 0
    size = {"height": HEIGHT, "width": WIDTH}
    pieces = [bag.events[i : i + bag.per_message] for i in range(0, len(bag.events), bag.per_message)]
    payloads = {"evt3": evt3_parts, "mono": mono_parts, "libcaer": libcaer_parts, "libcaer_cmp": libcaer_cmp_parts}
    parts = payloads.get(bag.encoding, mono_parts)(pieces, bag.sensor_start)
    for i, piece in enumerate(pieces):
        first = int(piece[0, 2]) + EPOCH
        stamp = first + bag.delays[i % len(bag.delays)]
        if bag.kind.endswith("EventPacket"):
            time_base, data = parts[i]
            about = {"seq": i, "time_base": time_base, "encoding": bag.encoding, "is_bigendian": False}
            message = new(bag.kind, header=header(stamp), **size, **about, events=np.frombuffer(data, np.uint8))
        else:
            clock = bag.sensor_start or EPOCH
            rows = [
                new(
                    bag.kind.replace("EventArray", "Event"),
                    x=x,
                    y=y,
                    ts=new("builtin_interfaces/msg/Time", sec=(t + clock) // 10**9, nanosec=(t + clock) % 10**9),
                    polarity=bool(p),
                )
                for x, y, t, p in piece.tolist()
            ]
            message = new(bag.kind, header=header(stamp), **size, events=rows)
        recorded = max(stamp, recorded)
        messages.append((recorded, message))
    return messages


Parts = list[tuple[int, bytes]]
"""time_base and bytes of each message."""


def evt3_parts(pieces: list[np.ndarray], start: int) -> Parts:
    """One stream of words, cut where the events of a message begin: a message need not begin with its time."""
    rows = [np.column_stack([piece[:, 2] + start, piece[:, [0, 1, 3]]]) for piece in pieces]
    rows = [np.column_stack([piece[:, 0] // 1000, piece[:, 1:]]) for piece in rows]
    ends = [0, *(len(evt3(np.concatenate(rows[: i + 1]), vectors=False)) for i in range(len(rows)))]
    stream = evt3(np.concatenate(rows), vectors=False)
    return [(0, stream[begin:end]) for begin, end in pairwise(ends)]


def mono_parts(pieces: list[np.ndarray], start: int) -> Parts:
    parts = []
    for piece in pieces:
        base = int(piece[0, 2])
        words = [(t - base) | x << 32 | y << 48 | p << 63 for x, y, t, p in piece.tolist()]
        parts.append((base + start, np.array(words, "<u8").tobytes()))
    return parts


def libcaer_parts(pieces: list[np.ndarray], start: int) -> Parts:
    """The low 31 bits of the time restart within the recording; time_base counts on in the message after it."""
    parts, period = [], 2**31 * 1000
    zero = EPOCH - period + 500_000_000
    for piece in pieces:
        base = zero + (int(piece[0, 2]) + EPOCH - zero) // period * period
        words = [
            ((1 | p << 1 | y << 2 | x << 17), ((t + EPOCH - zero) % period) // 1000) for x, y, t, p in piece.tolist()
        ]
        parts.append((base, np.array(words, "<u4").tobytes()))
    return parts


def libcaer_cmp_parts(pieces: list[np.ndarray], start: int) -> Parts:
    """Words of one event, and where rows of one column, time and polarity follow each other, vectors of 8."""
    parts = []
    for piece in pieces:
        base, words, latest = int(piece[0, 2]), [], None
        rows = piece.tolist()
        while rows:
            x, y, t, p = rows.pop(0)
            delta = (t - base) // 1000
            if latest != delta:
                latest = delta
                words += [0 << 12 | delta >> 12, 1 << 12 | delta & 0xFFF]
            words.append(2 << 12 | x)
            group = [y]
            while rows and rows[0][0] == x and rows[0][2:] == [t, p] and group[-1] < rows[0][1] < y + 16:
                group.append(rows.pop(0)[1])
            if len(group) == 1:
                words.append(3 << 12 | p << 11 | y)
                continue
            mask = sum(1 << (row - y) for row in group)
            words += [4 << 12 | p << 11 | y, 5 << 12 | mask & 0xFF, *([5 << 12 | mask >> 8] if mask >> 8 else [])]
        parts.append((base + EPOCH, np.array(words, "<u2").tobytes()))
    return parts


def check_is_truth(folder: Path, bag: Bag = Bag(), slower: int = 0, **options: Any) -> Any:
    """Reads a bag and compares all with what was written; `slower` is by how much its events come later, ns."""
    recording = read_recording(folder, **options)
    assert recording.format == "ros_bag"
    events = joined(recording.stream_events())
    found = np.column_stack([events.x, events.y, events.t, events.p]).astype(np.int64)
    zero = min(int(POSE_TIMES[0]), int(bag.events[0, 2]) + slower)
    np.testing.assert_array_equal(found, bag.events + np.array([0, 0, slower - zero, 0]))
    assert len(index_events(recording)) == len(bag.events)
    np.testing.assert_array_equal(recording.trajectory.times, POSE_TIMES - zero)
    np.testing.assert_array_equal(recording.trajectory.positions, poses()[:, :3])
    np.testing.assert_allclose(recording.trajectory.quaternions, poses()[:, 3:], atol=1e-15)
    assert recording.camera == CAMERA
    if bag.frames:
        frames = recording.frames
        assert frames is not None and frames.camera == CAMERA and frames.trajectory is recording.trajectory
        np.testing.assert_array_equal(frames.times, FRAME_TIMES - zero)
        for i, file in enumerate(frames.filenames):
            np.testing.assert_array_equal(load_image(file), true_image(bag.images, i))
            assert not file.is_relative_to(folder)
    return recording


VERSIONS = {
    "ROS 1": Bag(),
    "ROS 2": Bag(ros=2),
    "ROS 2 mcap": Bag(ros=2, storage="MCAP"),
    "ROS 2 without definitions": Bag(ros=2, definitions=False),
}


@pytest.mark.parametrize("kind", ["dvs_msgs/msg/EventArray", "prophesee_event_msgs/msg/EventArray"])
@pytest.mark.parametrize("version", VERSIONS)
def test_arrays_of_events(tmp_path: Path, version: str, kind: str):
    bag = replace(VERSIONS[version], kind=kind)
    assert list(check_is_truth(write_bag(tmp_path / "bag", bag), bag).notes) == []


@pytest.mark.parametrize("ros", [1, 2])
@pytest.mark.parametrize("per_message", [1, 2, 3, 7])
def test_messages_of_few_events(tmp_path: Path, ros: int, per_message: int):
    """Whose alignment differs from that of the second event on."""
    bag = Bag(ros, events=TRUE_EVENTS[:40], per_message=per_message)
    check_is_truth(write_bag(tmp_path / "bag", bag), bag)


PACKETS = {
    **{name: Bag(2, "event_camera_msgs/msg/EventPacket", name) for name in ("evt3", "mono", "libcaer", "libcaer_cmp")},
    "evt3 of ROS 1": Bag(1, "event_camera_msgs/msg/EventPacket", "evt3"),
}


@pytest.mark.parametrize("name", PACKETS)
def test_packets_of_events(tmp_path: Path, name: str):
    """The sensor's clock wraps within the recording, and its events come by the smallest delay of a message late."""
    bag = replace(PACKETS[name], sensor_start=(2**24 - 300_000) * 1000)
    has_own_clock = bag.encoding in ("evt3", "mono")
    recording = check_is_truth(write_bag(tmp_path / "bag", bag), bag, slower=100_000 * has_own_clock)
    assert len(recording.notes) == has_own_clock
    if has_own_clock:
        assert re.search(r"by adding 1\d+\.\d+ s, the smallest delay of 16 messages; the largest is 1\.9 ms more\.",
                         recording.notes[0])  # fmt: skip
