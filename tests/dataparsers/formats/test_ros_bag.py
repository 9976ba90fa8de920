"""ROS bags of the drivers of event cameras, written here by rosbags from the drivers' public message definitions."""

from __future__ import annotations

import json
import os
import re
import shutil
import sys
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from io import BytesIO
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image
from recordings import FRAME_TIMES, HEIGHT, POSE_TIMES, TRUE_EVENTS, WIDTH, image, joined, poses
from scipy.spatial.transform import Rotation
from test_bad_input import is_one_sentence
from test_event_files import evt3

from enerf_ns.dataparsers.formats import ros_bag, ros_events
from enerf_ns.dataparsers.formats.pose_files import GivenPoses, PoseFlags
from enerf_ns.dataparsers.formats.registry import read_recording
from enerf_ns.dataparsers.index.indexing import index_events
from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.dataparsers.recording.errors import FlagError, OutputError, RecordingError
from enerf_ns.dataparsers.recording.files import load_image
from enerf_ns.dataparsers.recording.recording import Frames

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
    compressed: tuple[str, ...] = ()
    """Topics of frames as PNG."""
    infos: tuple[tuple[str, int, int], ...] = (("/dvs/camera_info", WIDTH, HEIGHT),)
    events_topics: tuple[str, ...] = ("/dvs/events",)
    poses_topics: tuple[str, ...] = ("/pose",)
    poses_kind: str = "geometry_msgs/msg/PoseStamped"
    storage: str = "SQLITE3"
    definitions: bool = True
    frame_size: tuple[int, int] = (WIDTH, HEIGHT)
    matrix: np.ndarray = field(default_factory=lambda: np.array(CAMERA.matrix))
    packets: tuple[tuple[int, bytes], ...] | None = None
    """Stamps and bytes of packets, in place of those of `events`."""
    event_text: str = DEFINITIONS["dvs_msgs/msg/Event"]


def make_store(ros: int, event_text: str = DEFINITIONS["dvs_msgs/msg/Event"]) -> Any:
    store = typesys.get_typestore(typesys.Stores.ROS1_NOETIC if ros == 1 else typesys.Stores.ROS2_HUMBLE)
    tf = {} if ros == 2 else {"tf2_msgs/msg/TFMessage": "geometry_msgs/TransformStamped[] transforms"}
    for name, text in {**DEFINITIONS, **tf, "dvs_msgs/msg/Event": event_text}.items():
        store.register(typesys.get_types_from_msg(text, name))
    return store


def header_of(store: Any) -> Callable[[int], Any]:
    def header(time: int) -> Any:
        stamp = store.types["builtin_interfaces/msg/Time"](sec=time // 10**9, nanosec=time % 10**9)
        kind = store.types["std_msgs/msg/Header"]
        return kind(stamp=stamp, frame_id="cam", **({"seq": 7} if "seq" in kind.__annotations__ else {}))

    return header


def write_bag(folder: Path, bag: Bag = Bag()) -> Path:
    """Writes recording.bag, or a bag of ROS 2 in the folder itself."""
    from rosbags import rosbag1, rosbag2

    store = make_store(bag.ros, bag.event_text)

    def new(name: str, **fields: Any) -> Any:
        return store.types[name](**fields)

    header = header_of(store)
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
    for topic in bag.compressed:
        for i, time in enumerate((FRAME_TIMES + EPOCH).tolist()):
            data, format = BytesIO(), f"{bag.images}; png compressed {bag.images.replace('rgb', 'bgr')}"
            Image.fromarray(true_image(bag.images, i).squeeze()).save(data, "PNG")
            pixels = np.frombuffer(data.getvalue(), np.uint8)
            picture = new("sensor_msgs/msg/CompressedImage", header=header(time), format=format, data=pixels)
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
    if encoding == "yuv422":
        return WIDTH, HEIGHT, 2 * WIDTH, np.zeros(2 * WIDTH * HEIGHT, np.uint8)
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
    if bag.packets is not None:
        about = {"seq": 0, "time_base": 0, "encoding": bag.encoding, "is_bigendian": False}
        return [
            (stamp, new(bag.kind, header=header(stamp), **size, **about, events=np.frombuffer(data, np.uint8)))
            for stamp, data in bag.packets
        ]
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


def slow_evt3(words: list[int]) -> list[tuple[int, int, int, int]]:
    """t (µs) x y p, word by word from Prophesee's description of EVT 3.0: a time word sets 12 of 24 bits, Y is kept, an
    X is an event, and after a base of vectors each vector moves the base on by its length."""
    found, high, low, turns, y, base, polarity = [], None, 0, 0, 0, 0, 0
    for word in words:
        kind, value = word >> 12, word & 0xFFF
        if kind == 0x8:
            turns += high is not None and value < high
            high = value
        elif kind == 0x6:
            low = value
        elif kind == 0x0:
            y = value & 0x7FF
        elif kind == 0x3:
            base, polarity = value & 0x7FF, value >> 11
        pixels: list[tuple[int, int]] = []
        if kind == 0x2:
            pixels = [(value & 0x7FF, value >> 11)]
        elif kind in (0x4, 0x5):
            length = 12 if kind == 0x4 else 8
            pixels = [(base + i, polarity) for i in range(length) if value >> i & 1]
            base += length
        if high is not None:
            time = turns << 24 | high << 12 | low
            found += [(time, x, y, p) for x, p in pixels]
    return found


@pytest.mark.parametrize("seed", range(4))
def test_evt3_against_a_loop_over_its_words(tmp_path: Path, seed: int):
    """Messages are cut anywhere, so that rows, bases of vectors and times of one hold in the next one."""
    rng = np.random.default_rng(seed)
    words, time = [0x8FFD, 0x6000, 0x0003], 0xFFD000
    for _ in range(900):
        kind = rng.choice([0x0, 0x2, 0x3, 0x4, 0x5, 0x6, 0x8, 0xA], p=[0.1, 0.3, 0.1, 0.1, 0.1, 0.2, 0.05, 0.05])
        value = int(rng.integers(4096))
        if kind in (0x6, 0x8):
            time += int(rng.integers(1, 2000))
            words += [0x8 << 12 | time >> 12 & 0xFFF, 0x6 << 12 | time & 0xFFF]
        elif kind == 0x0:
            words.append(int(rng.integers(HEIGHT)))
        elif kind in (0x2, 0x3):
            words.append(int(kind) << 12 | value & 0x800 | int(rng.integers(WIDTH)))
        else:
            words.append(int(kind) << 12 | (value & 0xFF if kind == 0x5 else value))
    truth = slow_evt3(words)
    cuts = [0, *sorted(rng.choice(np.arange(4, len(words)), 30, replace=False).tolist()), len(words)]
    pieces = [np.array(words[begin:end], "<u2").tobytes() for begin, end in pairwise(cuts)]
    firsts = [len(slow_evt3(words[:begin])) for begin in cuts[:-1]]
    stamps = [EPOCH + (truth[min(first, len(truth) - 1)][0] - truth[0][0]) * 1000 for first in firsts]
    monkey = Bag(1, "event_camera_msgs/msg/EventPacket", frames=())
    folder = write_bag(tmp_path / "bag", replace(monkey, packets=tuple(zip(stamps, pieces, strict=True))))
    events = joined(ros_bag.read(folder).stream_events())
    found = np.column_stack([events.t // 1000, events.x, events.y, events.p])
    expected = np.array(truth) - [truth[0][0], 0, 0, 0]
    np.testing.assert_array_equal(found, expected)
    assert np.diff(expected[:, 0]).min() >= 0 and truth[-1][0] > 2**24


@pytest.mark.parametrize("encoding", ["mono8", "mono16", "rgb8", "bgr8", "bgra8"])
@pytest.mark.parametrize("ros", [1, 2])
def test_frames_of_each_encoding(tmp_path: Path, encoding: str, ros: int):
    bag = Bag(ros, images=encoding)
    check_is_truth(write_bag(tmp_path / "bag", bag), bag)


def test_a_colour_filter_is_undone(tmp_path: Path):
    """Of one colour, which interpolation keeps."""
    message = SimpleNamespace(width=4, height=4, encoding="bayer_rggb8", is_bigendian=0, step=4)
    message.data = np.array([[200, 100] * 2, [100, 50] * 2] * 2, np.uint8).ravel()
    pixels = ros_bag._pixels("bag holds an image", message)
    assert pixels.shape == (4, 4, 3) and (pixels == [200, 100, 50]).all()


def frames_of(folder: Path) -> Frames:
    frames = ros_bag.read(folder).frames
    assert frames is not None
    return frames


def test_frames_are_kept_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    folder = write_bag(tmp_path / "bag")
    first = frames_of(folder)
    states = [file.stat().st_mtime_ns for file in first.filenames]
    again = frames_of(folder)
    assert again.filenames == first.filenames
    assert [file.stat().st_mtime_ns for file in again.filenames] == states
    os.utime(folder / "recording.bag", ns=(5, 5))
    assert frames_of(folder).filenames[0].parent != first.filenames[0].parent
    monkeypatch.setenv("ENERF_CACHE", str(folder / "recording.bag"))
    with pytest.raises(OutputError, match=r"^The frames of .*recording\.bag cannot be written to the cache \("):
        ros_bag.read(folder)


@pytest.mark.parametrize("lost", ["stamps_ns.npy", "000001.png"])
def test_kept_frames_of_which_a_file_is_lost_are_written_again(tmp_path: Path, lost: str):
    folder = write_bag(tmp_path / "bag")
    first = frames_of(folder)
    pictures = [file.read_bytes() for file in first.filenames]
    (first.filenames[0].parent / lost).unlink()
    again = frames_of(folder)
    np.testing.assert_array_equal(again.times, first.times)
    assert [file.read_bytes() for file in again.filenames] == pictures


def test_topics_are_chosen(tmp_path: Path):
    bag = Bag(
        events_topics=("/dvs/events", "/right/events"),
        frames=("/a/image_raw", "/b/image_raw"),
        poses_topics=("/pose", "/odometry"),
    )
    folder = write_bag(tmp_path / "bag", bag)
    with pytest.raises(FlagError, match=r"2 topics with events; give --bag-events as one of /dvs/events, /right"):
        ros_bag.read(folder)
    with pytest.raises(FlagError, match=r"no events on /none; give --bag-events as one of /dvs/events, /right"):
        ros_bag.read(folder, bag_events="/none")
    with pytest.raises(FlagError, match=r"2 topics with poses; give --bag-poses as one of /odometry and /pose\."):
        ros_bag.read(folder, bag_events="/dvs/events")
    chosen: dict[str, Any] = {"bag_events": "/right/events", "bag_poses": "/odometry"}
    recording = ros_bag.read(folder, **chosen)
    assert recording.frames is None
    assert "several topics of them; give --bag-frames as one of /a/image_raw, /b/image_raw." in recording.notes[0]
    check_is_truth(folder, bag, **chosen, bag_frames="/b/image_raw")


def test_frames_beside_the_events_are_preferred(tmp_path: Path):
    bag = Bag(frames=("/rendering", "/dvs/image_raw"))
    check_is_truth(write_bag(tmp_path / "bag", bag), bag)


@pytest.mark.parametrize("ros", [1, 2])
@pytest.mark.parametrize("kind", ["nav_msgs/msg/Odometry", "tf2_msgs/msg/TFMessage"])
def test_other_messages_of_poses(tmp_path: Path, kind: str, ros: int):
    bag = Bag(ros, poses_kind=kind, poses_topics=("/tf" if kind.startswith("tf") else "/odometry",))
    folder = write_bag(tmp_path / "bag", bag)
    if kind.startswith("tf"):
        with pytest.raises(FlagError, match="holds 0 topics with poses; give --bag-tf WORLD CAMERA, two frames of"):
            ros_bag.read(folder)
        with pytest.raises(FlagError, match="--bag-poses and --bag-tf were both given"):
            ros_bag.read(folder, bag_poses="/pose", bag_tf=("cam", "dvs"))
        check_is_truth(folder, bag, bag_tf=("cam", "dvs"))
    else:
        check_is_truth(folder, bag)


def test_poses_from_a_file(tmp_path: Path):
    folder = write_bag(tmp_path / "bag", Bag(poses_topics=()))
    with pytest.raises(FlagError, match=r"0 topics with poses; record one of .*, or give poses as --poses of"):
        ros_bag.read(folder)
    with pytest.raises(RecordingError, match=r"holds no tf, but --bag-tf names two of its frames"):
        ros_bag.read(folder, bag_tf=("a", "b"))
    rows = zip((POSE_TIMES + EPOCH).tolist(), poses().tolist(), strict=True)
    (tmp_path / "poses.txt").write_text("".join(f"{t} {' '.join(map(repr, pose))}\n" for t, pose in rows))
    check_is_truth(folder, poses=GivenPoses(tmp_path / "poses.txt", PoseFlags(poses_unit="ns")))


def camera_json(camera: Camera = CAMERA, **others: Any) -> dict[str, Any]:
    names = ("width", "height", "fx", "fy", "cx", "cy", "model")
    return {**{name: getattr(camera, name) for name in names}, "distortion": list(camera.distortion), **others}


def test_calibration_from_a_file(tmp_path: Path):
    bag = Bag(infos=())
    folder = write_bag(tmp_path / "bag", bag)
    with pytest.raises(
        RecordingError, match=r"of /dvs/events, 24 x 18 pixels, in CameraInfo \(of others: none\); add ca"
    ):
        ros_bag.read(folder)
    (folder / "camera.json").write_text(json.dumps({"camera": camera_json()}))
    check_is_truth(folder, bag)
    (folder / "camera.json").write_text(json.dumps({"camera": camera_json(width=25)}))
    with pytest.raises(RecordingError, match=r"camera\.json is the calibration of 25 x 18 pixels, but .* of 24 x 18;"):
        ros_bag.read(folder)


def test_calibration_of_a_driver_that_knows_none(tmp_path: Path):
    folder = write_bag(tmp_path / "bag", Bag(matrix=np.zeros((3, 3))))
    with pytest.raises(RecordingError, match=r"holds no calibration of the camera of /dvs/events"):
        ros_bag.read(folder)


@pytest.mark.parametrize(
    ("infos", "message"),
    [
        (
            (("/dvs/camera_info", 240, 180),),
            "a calibration for 240 x 180 pixels, but events of a sensor of 24 x 18",
        ),
        ((("/a/camera_info", 240, 180), ("/b/info", 640, 480)), r"\(of others: /a/camera_info \(240 x 180\), /b/info"),
        ((("/a/camera_info", WIDTH, HEIGHT), ("/b/info", WIDTH, HEIGHT)), "holds no calibration of the camera of"),
    ],
)
def test_calibration_of_another_camera(tmp_path: Path, infos: tuple, message: str):
    folder = write_bag(tmp_path / "bag", Bag(infos=infos))
    with pytest.raises(RecordingError, match=message):
        ros_bag.read(folder)


def test_the_only_calibration_of_this_size(tmp_path: Path):
    bag = Bag(infos=(("/calibration/info", WIDTH, HEIGHT), ("/frames/info", 640, 480)))
    check_is_truth(write_bag(tmp_path / "bag", bag), bag)


def test_frames_of_another_camera(tmp_path: Path):
    """They are used once the pose of their camera is stated."""
    folder = write_bag(tmp_path / "bag", Bag(frames=("/rgb/image_raw",), images="rgb8", frame_size=(32, 20)))
    recording = ros_bag.read(folder)
    assert recording.frames is None
    assert "The frames of 32 x 20 pixels on /rgb/image_raw are not used, since" in recording.notes[0]
    mounting = np.eye(4)
    mounting[:3, 3] = [0.1, 0.0, 0.02]
    other = Camera(32, 20, 30.0, 30.0, 15.5, 9.5)
    about = camera_json(other, event_camera_from_frame_camera=mounting.tolist())
    (folder / "camera.json").write_text(json.dumps({"camera": camera_json(), "frame_camera": about}))
    recording = ros_bag.read(folder)
    frames = recording.frames
    assert recording.camera == CAMERA and frames is not None and frames.camera == other
    turn = Rotation.from_quat(recording.trajectory.quaternions)
    expected = recording.trajectory.positions + turn.apply(mounting[:3, 3])
    np.testing.assert_allclose(frames.trajectory.positions, expected, atol=1e-12)


def test_frames_of_the_size_of_the_events_elsewhere_are_not_theirs(tmp_path: Path):
    recording = ros_bag.read(write_bag(tmp_path / "bag", Bag(frames=("/webcam/image_raw",))))
    assert recording.frames is None and "are not known to be of the camera of 24 x 18" in recording.notes[0]


def test_arrays_on_the_clock_of_the_sensor(tmp_path: Path):
    """The header alone has the clock of ROS."""
    bag = Bag(sensor_start=77_000_000_000)
    recording = check_is_truth(write_bag(tmp_path / "bag", bag), bag, slower=100_000)
    assert "have the clock of the sensor" in recording.notes[0]


BAD_BAGS: dict[str, tuple[Bag, Callable[[Path], object], str]] = {
    "no events": (
        Bag(events_topics=()),
        lambda folder: None,
        "holds no events as dvs_msgs/EventArray or prophesee_event_msgs/EventArray or event_camera_msgs/EventPacket, "
        "but the topics /dvs/camera_info, /dvs/image_raw, /pose; record",
    ),
    "a message without events": (
        Bag(1, "event_camera_msgs/msg/EventPacket", packets=((EPOCH, b"\x01\x80\x00\x60"),)),
        lambda folder: None,
        "holds no events on /dvs/events; give a recording with some",
    ),
    "another encoding": (
        Bag(2, "event_camera_msgs/msg/EventPacket", "evt4"),
        lambda folder: None,
        "in the encoding 'evt4', but evt3, mono, libcaer and libcaer_cmp are known; republish it as dvs_msgs",
    ),
    "frames of another encoding": (
        Bag(images="yuv422"),
        lambda folder: None,
        "holds an image on /dvs/image_raw in the encoding 'yuv422', but mono8, 8UC1,",
    ),
    "two bags": (
        Bag(),
        lambda folder: shutil.copy(folder / "recording.bag", folder / "other.bag"),
        "holds 2 ROS bags (other.bag, recording.bag), but one was expected",
    ),
    "no bag in it": (
        Bag(),
        lambda folder: (folder / "recording.bag").write_bytes(b"hello"),
        "recording.bag cannot be read as a ROS bag (it does not begin with #ROSBAG V2.0)",
    ),
    "a clock that jumps": (
        Bag(1, "event_camera_msgs/msg/EventPacket", "mono", delays=(0,) * 9 + (3_000_000_000,)),
        lambda folder: None,
        "whose first event lies 3.000 s from its stamp",
    ),
    "words of half a length": (
        Bag(1, "event_camera_msgs/msg/EventPacket", packets=((EPOCH, b"\x01\x80\x00\x60\x03"),)),
        lambda folder: None,
        "with 5 bytes of evt3, but little-endian words of 2 bytes were expected",
    ),
    "a word that EVT3 lacks": (
        Bag(1, "event_camera_msgs/msg/EventPacket", packets=((EPOCH, b"\x01\x80\x00\x90"),)),
        lambda folder: None,
        "holds a word of type 0x9, which EVT3 has not",
    ),
    "another definition": (
        Bag(event_text="uint16 y\nuint16 x\ntime ts\nbool polarity"),
        lambda folder: None,
        "defines dvs_msgs/msg/Event as uint16 y, uint16 x, Time ts and bool polarity, but uint16 x, uint16 y,",
    ),
}


@pytest.mark.parametrize("name", BAD_BAGS)
def test_bad_bags_give_one_sentence(tmp_path: Path, name: str):
    bag, break_it, message = BAD_BAGS[name]
    folder = write_bag(tmp_path / "bag", bag)
    break_it(folder)
    with pytest.raises(RecordingError) as error:
        len(index_events(read_recording(folder)))
    assert message in str(error.value)
    assert str(folder) in str(error.value) and is_one_sentence(str(error.value))


def test_a_message_of_ros_2_that_is_damaged(tmp_path: Path):
    """Its number of events is one too large, or its numbers have their highest byte first."""
    store, bag = make_store(2), Bag(2, events=TRUE_EVENTS[:3])
    (_, message), *_ = event_messages(bag, lambda name, **fields: store.types[name](**fields), header_of(store))
    data = bytes(store.serialize_cdr(message, bag.kind))
    where, kind = "bag holds a message on /events", bag.kind
    assert len(ros_events.parse_aligned_array(where, kind, data)[2]) == 3
    place = data.index(np.array([HEIGHT, WIDTH, 3], "<u4").tobytes()) + 8
    for broken in (data[:place] + b"\x04" + data[place + 1 :], data[:1] + b"\0" + data[2:], data[:-5], data[:10], b""):
        with pytest.raises(RecordingError, match=rf"whose {len(broken)} bytes are no dvs_msgs/EventArray; copy"):
            ros_events.parse_aligned_array(where, kind, broken)


@pytest.mark.slow
def test_without_rosbags_the_error_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    folder = write_bag(tmp_path / "bag")
    monkeypatch.setitem(sys.modules, "rosbags.highlevel", None)
    with pytest.raises(RecordingError, match=r"pip install 'enerf-ns\[bag\]'\."):
        ros_bag.read(folder)


@pytest.mark.parametrize("ros", [1, 2])
@pytest.mark.parametrize("images", ["mono8", "rgb8", "mono16"])
def test_compressed_frames_are_read_where_there_are_no_others(tmp_path: Path, images: str, ros: int):
    bag = Bag(ros=ros, images=images, frames=(), compressed=("/dvs/image_raw/compressed",))
    recording = check_is_truth(write_bag(tmp_path / "compressed", bag), bag)
    assert [load_image(file).tolist() for file in recording.frames.filenames] == [
        true_image(images, i).tolist() for i in range(len(FRAME_TIMES))
    ]
    both = replace(bag, frames=("/dvs/image_raw",))
    assert check_is_truth(write_bag(tmp_path / "both", both), both).notes == ()


def test_a_mosaic_of_bayer_in_png_is_in_colour(tmp_path: Path):
    bag = Bag(images="bayer_rggb8", frames=(), compressed=("/dvs/image_raw/compressed",))
    mosaic = np.tile(np.array([[200, 100], [100, 50]], np.uint8), (HEIGHT // 2, WIDTH // 2))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys.modules[__name__], "true_image", lambda *_: mosaic)
        folder = write_bag(tmp_path / "bag", bag)
    frames = read_recording(folder).frames
    assert frames is not None
    np.testing.assert_array_equal(load_image(frames.filenames[0])[4, 4], [200, 100, 50])


def test_what_is_no_compressed_picture_is_one_sentence(tmp_path: Path):
    bag = Bag(frames=(), compressed=("/dvs/image_raw/compressed",))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Image.Image, "save", lambda image, file, kind: file.write(b"RVL"))
        folder = write_bag(tmp_path / "bag", bag)
    with pytest.raises(RecordingError, match="which is no picture in JPEG or PNG; republish it") as error:
        read_recording(folder)
    assert is_one_sentence(str(error.value))
