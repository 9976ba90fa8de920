"""Reader for the ROS bags of Robust e-NeRF's version of the simulator ESIM, as its data set is published.

    esim.bag        ROS 1, with the topics
        /cam0/events        dvs_msgs/EventArray
        /cam0/pose          geometry_msgs/PoseStamped: camera to world, OpenCV axes, metres
        /cam0/camera_info   sensor_msgs/CameraInfo
    esim.conf       the simulator's flags, one a line (optional): contrast_threshold_pos, contrast_threshold_neg,
                    refractory_period_ns and simulate_color_events, which means the Bayer pattern RGGB
    views/          as in `esim_npz` (optional)

Stamps are nanoseconds from the simulation's zero. All poses are used: the simulator states the exact pose at each
sample of its inertial sensor and at each rendered image. Robust e-NeRF uses only the poses of the inertial sensor,
which are equally spaced, since it interpolates linearly.

The reader reads the whole bag once to find the poses. Only one chunk of the bag is in memory at a time.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from enerf_ns.dataparsers.formats.format import Format
from enerf_ns.dataparsers.formats.json_values import shown
from enerf_ns.dataparsers.formats.robust_enerf import (
    checked_camera,
    checked_trajectory,
    listed,
    read_views,
    whole_nanoseconds,
)
from enerf_ns.dataparsers.formats.ros_bags import MAGIC
from enerf_ns.dataparsers.formats.ros_events import as_events, parse_array
from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.dataparsers.recording.errors import RecordingError
from enerf_ns.dataparsers.recording.files import of_file, read_text, reading
from enerf_ns.dataparsers.recording.recording import EVENTS_AT_A_TIME, EventRecording, Events
from enerf_ns.dataparsers.recording.trajectory import Trajectory

FILES = ("esim.bag", "esim.conf")

EVENTS, POSES, CAMERA = "/cam0/events", "/cam0/pose", "/cam0/camera_info"

MESSAGE_TYPES = {
    EVENTS: "dvs_msgs/msg/EventArray",
    POSES: "geometry_msgs/msg/PoseStamped",
    CAMERA: "sensor_msgs/msg/CameraInfo",
}

COLOUR = "simulate_color_events"

DEFAULT_FLAGS = {
    "contrast_threshold_pos": "1.0",
    "contrast_threshold_neg": "1.0",
    "refractory_period_ns": "0",
    COLOUR: "false",
}
"""Values that the simulator uses for flags that esim.conf does not state."""

TRUTH = {**dict.fromkeys(("1", "t", "true", "y", "yes"), True), **dict.fromkeys(("0", "f", "false", "n", "no"), False)}


def read(folder: Path) -> EventRecording:
    """Reads everything but the events, which are read when they are needed.

    Args:
        folder: The folder with the files that the module describes.

    Raises:
        RecordingError: A file is missing, empty or cannot be used, or rosbags is not installed.
    """
    notes: list[str] = []
    path = folder / "esim.bag"
    trajectory = _read_trajectory(path, notes)
    camera = _read_camera(path)
    contrast_thresholds, refractory_period, bayer_pattern = None, 0, None
    flags_file = folder / "esim.conf"
    if flags_file.exists():
        contrast_thresholds, refractory_period, bayer_pattern = _read_flags(flags_file)
        if flags_file.stat().st_size == 0:
            notes.append(
                "esim.conf is empty, so contrast thresholds of 1 are used, which are the simulator's defaults."
            )
    else:
        notes.append(
            "There is no esim.conf, so contrast thresholds and refractory period are not known, and the sensor is "
            "assumed to be grey."
        )
    views = read_views(folder, notes)
    with of_file(flags_file):
        return EventRecording(
            path=folder,
            format="esim_bag",
            camera=camera,
            trajectory=trajectory,
            stream_events=lambda: _stream_events(path),
            event_files=(path,),
            held_out_frames=views,
            contrast_thresholds=contrast_thresholds,
            refractory_period=refractory_period,
            bayer_pattern=bayer_pattern,
            notes=tuple(notes),
            times_in={"events": (path, "ns"), "poses": (path, "ns")},
        )


def _messages(path: Path, topic: str) -> Iterator[Any]:
    """Yields the messages of a topic in order of time: events as serialized bytes, other messages as objects."""
    try:
        from rosbags.rosbag1 import Reader
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise RecordingError(
            f"{path} is a ROS bag, for which the package rosbags is missing; pip install 'enerf-ns[bag]'."
        ) from error
    with reading(path, "a ROS 1 bag"), open(path, "rb") as file:
        if b"\n" not in (start := file.read(len(MAGIC))) or start[:9] != MAGIC[:9]:
            raise ValueError(f"it does not begin with {MAGIC[:-1].decode()}")
    store = get_typestore(Stores.ROS1_NOETIC)
    with reading(path, "a ROS 1 bag"), Reader(path) as bag:
        connections = [connection for connection in bag.connections if connection.topic == topic]
        if not connections:
            found = listed({connection.topic for connection in bag.connections})
            raise RecordingError(f"{path} lacks the topic {topic}, and holds {found}; record it as well.")
        for connection in connections:
            if connection.msgtype != MESSAGE_TYPES[topic]:
                raise RecordingError(
                    f"{path} holds messages of type {listed([connection.msgtype])} on {topic}, but "
                    f"{MESSAGE_TYPES[topic]} was expected."
                )
        for connection, _, data in bag.messages(connections):
            if connection.topic != topic:
                raise ValueError(f"its index takes a message on {connection.topic} for one on {topic}")
            yield data if topic == EVENTS else store.deserialize_ros1(data, connection.msgtype)


def _read_trajectory(path: Path, notes: list[str]) -> Trajectory:
    times, poses = [], []
    for message in _messages(path, POSES):
        stamp, position, orientation = message.header.stamp, message.pose.position, message.pose.orientation
        times.append(stamp.sec * 10**9 + stamp.nanosec)
        poses.append((position.x, position.y, position.z, orientation.x, orientation.y, orientation.z, orientation.w))
    values = np.array(poses).reshape(-1, 7)
    return checked_trajectory(path, np.array(times, np.int64), values[:, :3], values[:, 3:], notes)


def _read_camera(path: Path) -> Camera:
    info = next(_messages(path, CAMERA), None)
    if info is None:
        raise RecordingError(f"{path} holds no message on {CAMERA}, but the camera's calibration was expected.")
    events = next(_messages(path, EVENTS), None)
    if events is None:
        raise RecordingError(f"{path} holds no events; give a recording with some.")
    (width, height), _ = _parse_events(path, events)
    if (width, height) != (info.width, info.height):
        raise RecordingError(
            f"{path} holds a calibration for {info.width} x {info.height} pixels, but events of a sensor of "
            f"{width} x {height}; give the calibration of the recording's own resolution."
        )
    return checked_camera(path, width, height, info.K.reshape(3, 3), info.distortion_model, info.D)


def _parse_events(path: Path, data: bytes) -> tuple[tuple[int, int], np.ndarray]:
    """Returns the size of the sensor (width, height) and the events of a message."""
    return parse_array(f"{path} holds a message on {EVENTS}", MESSAGE_TYPES[EVENTS], data)[1:]


def _stream_events(path: Path) -> Iterator[Events]:
    held, num_held = [], 0
    for message in _messages(path, EVENTS):
        _, events = _parse_events(path, message)
        held.append(events)
        num_held += len(events)
        if num_held >= EVENTS_AT_A_TIME:
            yield _joined(held)
            held, num_held = [], 0
    if num_held:
        yield _joined(held)


def _joined(held: list[np.ndarray]) -> Events:
    return as_events(np.concatenate(held))


def _read_flags(path: Path) -> tuple[tuple[float, float], int, str | None]:
    """Returns contrast thresholds, refractory period and Bayer pattern from flags; the last one of a name counts."""
    lines = read_text(path, "flags of ESIM").splitlines()
    flags = dict(DEFAULT_FLAGS)
    for number, line in enumerate(map(str.strip, lines), 1):
        if line and line[0] not in "-#":
            raise RecordingError(f"{path}, line {number} is {shown(line)}, but a flag, as --NAME=VALUE, was expected.")
        name, _, value = line.lstrip("-").replace(" ", "=", 1).partition("=")
        if line.startswith("-") and name.removeprefix("no") == COLOUR:
            flags[COLOUR] = "false" if name.startswith("no") else value or "true"
        elif line.startswith("-"):
            flags[name] = value
    numbers = []
    for name in list(DEFAULT_FLAGS)[:3]:
        try:
            numbers.append(float(flags[name]))
        except ValueError as error:
            raise RecordingError(f"{path} holds --{name}={flags[name]}, where a number was expected.") from error
    colour = TRUTH.get(flags[COLOUR].lower())
    if colour is None:
        raise RecordingError(f"{path} holds --{COLOUR}={flags[COLOUR]}, where true or false was expected.")
    on, off, refractory_period = numbers
    return (on, off), whole_nanoseconds(path, refractory_period), "RGGB" if colour else None


FORMAT = Format(
    name="esim_bag",
    command="esim-bag",
    description="Events in esim.bag of Robust e-NeRF's simulated sequences.",
    files=FILES,
    read=read,
)
