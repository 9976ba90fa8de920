"""Reader for ROS bags of the drivers of DAVIS and Prophesee cameras, ROS 1 and ROS 2.

    *.bag, or metadata.yaml with *.db3 or *.mcap    one bag, in the folder or in a folder within it, with the topics
        events          dvs_msgs/EventArray, prophesee_event_msgs/EventArray or event_camera_msgs/EventPacket
        frames          sensor_msgs/Image or, without them, sensor_msgs/CompressedImage (optional)
        calibration     sensor_msgs/CameraInfo (optional)
        poses           geometry_msgs/PoseStamped, nav_msgs/Odometry and others, or tf (see `ros_poses`): the event
                        camera's, camera to world, OpenCV axes, metres
    camera.json         camera and, perhaps, frame_camera as in recording.json (optional): used in place of CameraInfo

Names of topics are free. CameraInfo and frames belong to the events if they have the same namespace: /dvs/image_raw and
/dvs/camera_info belong to /dvs/events. Frames are those of the event camera if they have its size, as with a DAVIS. The
stamp of a frame is taken for the middle of its exposure, which drivers leave open; `enerf inspect` measures it.

Events of the encodings evt3 and mono have the sensor's own clock. It is put on that of ROS by the smallest difference
between the stamp of a message, which is when its first bytes arrived, and the time of its first event. Other events are
on the clock of ROS; if they lie more than `LARGEST_DELAY` from the stamps of their messages, the sensor's is assumed.

The frames are written to the cache once. The reader reads the bag for poses; events are read when they are needed.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any, Optional, Tuple  # noqa: UP035 - tyro reads these annotations on Python 3.10

import cv2
import numpy as np

from enerf_ns.dataparsers.formats.event_recording import read_cameras
from enerf_ns.dataparsers.formats.format import Format, FormatOptions
from enerf_ns.dataparsers.formats.json_values import in_words
from enerf_ns.dataparsers.formats.kept_frames import keep_frames
from enerf_ns.dataparsers.formats.pose_files import GivenPoses, NamedFrames
from enerf_ns.dataparsers.formats.robust_enerf import checked_camera, listed
from enerf_ns.dataparsers.formats.ros_bags import messages_on, open_bag
from enerf_ns.dataparsers.formats.ros_events import MESSAGE_TYPES, EventMessage, read_events
from enerf_ns.dataparsers.formats.ros_poses import PoseFlagNames, read_bag
from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.dataparsers.recording.errors import FlagError, RecordingError, shortened
from enerf_ns.dataparsers.recording.files import files_in
from enerf_ns.dataparsers.recording.recording import EVENTS_AT_A_TIME, EventRecording, Events, Frames
from enerf_ns.dataparsers.recording.trajectory import Trajectory

FILES = ("*.bag", "*.db3", "*.mcap", "*/*.db3", "*/*.mcap", "metadata.yaml")

IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"

POSE_FLAGS = PoseFlagNames(
    "--bag-poses", "--bag-tf", ", or give poses as --poses of enerf convert, or none yet by its --without-poses"
)

LARGEST_DELAY = 10**9
"""Largest time between an event and the stamp of its message, ns, if both are on one clock."""

MESSAGES_OF_CLOCK = 1000
"""Number of messages from which the clock of the sensor is found."""

ENCODINGS: dict[str, tuple[str, int, int | None]] = {
    "mono8": ("u1", 1, None),
    "8UC1": ("u1", 1, None),
    "mono16": ("u2", 1, None),
    "16UC1": ("u2", 1, None),
    "rgb8": ("u1", 3, None),
    "bgr8": ("u1", 3, cv2.COLOR_BGR2RGB),
    "8UC3": ("u1", 3, cv2.COLOR_BGR2RGB),
    "rgba8": ("u1", 4, cv2.COLOR_RGBA2RGB),
    "bgra8": ("u1", 4, cv2.COLOR_BGRA2RGB),
    "8UC4": ("u1", 4, cv2.COLOR_BGRA2RGB),
    "bayer_rggb8": ("u1", 1, cv2.COLOR_BayerRGGB2RGB),
    "bayer_bggr8": ("u1", 1, cv2.COLOR_BayerBGGR2RGB),
    "bayer_gbrg8": ("u1", 1, cv2.COLOR_BayerGBRG2RGB),
    "bayer_grbg8": ("u1", 1, cv2.COLOR_BayerGRBG2RGB),
}
"""Type, number of channels and conversion to RGB of the encodings of images."""


@dataclass(frozen=True)
class RosBagOptions(FormatOptions):
    """Options of a ROS bag."""

    bag_events: Optional[str] = None  # noqa: UP045
    """Topic of the events, where there are several."""
    bag_frames: Optional[str] = None  # noqa: UP045
    """Topic of the frames, where there are several."""
    bag_poses: Optional[str] = None  # noqa: UP045
    """Topic of the poses, where there are several."""
    bag_tf: Optional[Tuple[str, str]] = None  # noqa: UP006, UP045
    """Names of two frames of tf, the world and the event camera, whose poses are used."""


def read(
    folder: Path,
    poses: GivenPoses | None = None,
    bag_events: str | None = None,
    bag_frames: str | None = None,
    bag_poses: str | None = None,
    bag_tf: tuple[str, str] | None = None,
) -> EventRecording:
    """Reads everything but the events, which are read when they are needed.

    The recording's zero of time is the earliest first stamp among events, frames and poses.

    Args:
        folder: The folder with the files that the module describes.
        poses: Poses in place of those of the bag, on the clock of ROS.
        bag_events, bag_frames, bag_poses, bag_tf: As in `RosBagOptions`.

    Raises:
        RecordingError: The bag is missing or cannot be used, or rosbags is not installed.
        FlagError: A topic must be chosen, or is not in the bag.
    """
    path, notes = _find_bag(folder), []
    topics = _topics(path)
    events_topic = _chosen(path, topics, MESSAGE_TYPES, "events", bag_events)
    size, first, offset = _read_clock(path, events_topic, notes)
    cameras_file = folder / "camera.json"
    if cameras_file.exists():
        camera, frame_camera, mounting = read_cameras(cameras_file)
        if size not in ((camera.width, camera.height), (0, 0)):
            raise RecordingError(
                f"{cameras_file} is the calibration of {camera.width} x {camera.height} pixels, but the events are of "
                f"{size[0]} x {size[1]}; give the calibration for this resolution."
            )
    else:
        camera, mounting = _read_camera(path, topics, events_topic, size), np.eye(4)
        frame_camera = camera
    frames_topic = _choose_frames(path, topics, events_topic, bag_frames, notes)
    is_own = frame_camera is not camera or bag_frames is not None
    is_own |= frames_topic is not None and _namespace(frames_topic) == _namespace(events_topic)
    files, frame_times = _read_frames(path, frames_topic, frame_camera, is_own, notes)
    named = [NamedFrames(files, frame_times, mounting)]
    poses_file, unit = (path, "ns") if poses is None else (poses.path, poses.unit)
    rows = read_bag(path, bag_poses, bag_tf, notes, POSE_FLAGS) if poses is None else poses.rows(named, notes)
    zero = int(min(first, rows[0][0], *frame_times[:1]))
    trajectory = Trajectory(rows[0] - zero, *rows[1:])
    of_frames = trajectory if frame_camera is camera else trajectory.of_mounted(mounting)
    return EventRecording(
        path=folder,
        format="ros_bag",
        camera=camera,
        trajectory=trajectory,
        stream_events=lambda: _stream_events(path, events_topic, offset, zero),
        event_files=_files_of(path),
        zero=zero,
        frames=Frames(files, frame_times - zero, frame_camera, of_frames) if files else None,
        notes=tuple(notes),
        times_in={"events": (path, "ns"), "poses": (poses_file, unit), "frames": (path, "ns")},
    )


def _find_bag(folder: Path) -> Path:
    """Returns the one bag of a folder: a .bag file, the folder with metadata.yaml, or a .db3 or .mcap file."""
    found = files_in(folder, "*.bag")
    if (folder / "metadata.yaml").exists():
        found.append(folder)
    else:
        found += files_in(folder, "*.db3", "*.mcap")
    found += sorted({file.parent for file in files_in(folder, "*/*.db3", "*/*.mcap")})
    if len(found) != 1:
        names = listed(place.name for place in found)
        raise RecordingError(
            f"{folder} holds {len(found)} ROS bags ({names}), but one was expected; give each bag a folder of its own, "
            "and merge a bag that was recorded in parts."
        )
    return found[0]


def _files_of(path: Path) -> tuple[Path, ...]:
    return tuple(files_in(path, "*.db3", "*.mcap")) if path.is_dir() else (path,)


def _topics(path: Path) -> dict[str, str]:
    """Returns the type of the messages on each topic."""
    with open_bag(path) as bag:
        return {connection.topic: connection.msgtype for connection in bag.connections}


def _chosen(path: Path, topics: dict[str, str], kinds: tuple[str, ...], what: str, chosen: str | None) -> str:
    """Returns the chosen topic, or the only one of these types."""
    able = sorted(topic for topic, kind in topics.items() if kind in kinds)
    if not able:
        names = " or ".join(kind.replace("/msg/", "/") for kind in kinds[:3])
        raise RecordingError(
            f"{path} holds no {what} as {names}, but the topics {listed(topics)}; record the driver's topic of {what} "
            "as well."
        )
    if chosen not in able if chosen else len(able) > 1:
        found = f"no {what} on {chosen}" if chosen else f"{len(able)} topics with {what}"
        raise FlagError(f"{path} holds {found}; give --bag-{what} as one of {listed(able)}.")
    return chosen or able[0]


def _namespace(topic: str) -> str:
    return _uncompressed(topic).rpartition("/")[0]


def _uncompressed(topic: str) -> str:
    """Returns the topic of the images that a topic has compressed."""
    return topic.removesuffix("/compressed")


def _event_messages(path: Path, topic: str) -> Iterator[EventMessage]:
    with open_bag(path) as bag:
        connections = [connection for connection in bag.connections if connection.topic == topic]
        yield from read_events(path, bag, connections)


def _read_clock(path: Path, topic: str, notes: list[str]) -> tuple[tuple[int, int], int, int]:
    """Returns the size of the sensor, the time of the first event on ROS's clock (ns), and what is added to times."""
    messages = [
        (message.size, message.stamp, int(message.events.t[0]), message.has_own_clock)
        for message in islice(
            filter(lambda message: len(message.events), _event_messages(path, topic)), MESSAGES_OF_CLOCK
        )
    ]
    if not messages:
        raise RecordingError(f"{path} holds no events on {topic}; give a recording with some.")
    delays = [stamp - first for _, stamp, first, _ in messages]
    (size, _, first, has_own_clock), offset = messages[0], 0
    if has_own_clock or abs(delays[0]) > LARGEST_DELAY:
        offset = min(delays)
        notes.append(
            f"The events on {topic} have the clock of the sensor, which is put on that of ROS by adding "
            f"{offset * 1e-9:.6f} s, the smallest delay of {len(delays):,} messages; the largest is "
            f"{(max(delays) - offset) * 1e-6:.3g} ms more."
        )
    return size, first + offset, offset


def _stream_events(path: Path, topic: str, offset: int, zero: int) -> Iterator[Events]:
    held: list[Events] = []
    for message in _event_messages(path, topic):
        events = message.events
        if not len(events):
            continue
        delay = message.stamp - int(events.t[0]) - offset
        if abs(delay) > LARGEST_DELAY:
            raise RecordingError(
                f"{path} holds a message on {topic} whose first event lies {delay * 1e-9:.3f} s from its stamp, "
                f"{message.stamp} ns, unlike those before, as if the clock of the sensor was set or messages are lost; "
                "cut the bag there."
            )
        held.append(Events(events.x, events.y, events.t + (offset - zero), events.p))
        if sum(map(len, held)) >= EVENTS_AT_A_TIME:
            yield _joined(held)
            held = []
    if held:
        yield _joined(held)


def _joined(held: list[Events]) -> Events:
    return Events(*(np.concatenate([getattr(piece, name) for piece in held]) for name in "xytp"))


def _read_camera(path: Path, topics: dict[str, str], events_topic: str, size: tuple[int, int]) -> Camera:
    """Returns the camera of the events by CameraInfo: of their namespace, or else the only one of their size."""
    infos: dict[str, Any] = {}
    with open_bag(path) as bag:
        for topic in (topic for topic, kind in topics.items() if kind == CAMERA_INFO):
            connections = [connection for connection in bag.connections if connection.topic == topic]
            for _, data in islice(messages_on(bag, connections), 1):
                infos[topic] = bag.deserialize(data, CAMERA_INFO)
    stated = {
        topic: info for topic, info in infos.items() if _matrix(info).any()
    }  # drivers send zeros if they know none
    own = [info for topic, info in stated.items() if _namespace(topic) == _namespace(events_topic)]
    if len(own) != 1:
        own = [info for info in stated.values() if (info.width, info.height) == size]
    if len(own) != 1:
        found = listed(f"{topic} ({info.width} x {info.height})" for topic, info in stated.items())
        raise RecordingError(
            f"{path} holds no calibration of the camera of {events_topic}, {size[0]} x {size[1]} pixels, in CameraInfo "
            f"(of others: {found}); add camera.json beside the bag, as docs/formats.md shows."
        )
    (info,) = own
    if size not in ((info.width, info.height), (0, 0)):
        raise RecordingError(
            f"{path} holds a calibration for {info.width} x {info.height} pixels, but events of a sensor of "
            f"{size[0]} x {size[1]}; give the calibration of this resolution as camera.json."
        )
    distortion = np.asarray(getattr(info, "d", None) if hasattr(info, "d") else info.D, np.float64)
    return checked_camera(path, info.width, info.height, _matrix(info), info.distortion_model, distortion)


def _matrix(info: Any) -> np.ndarray:
    return np.asarray(info.k if hasattr(info, "k") else info.K, np.float64).reshape(3, 3)


def _choose_frames(
    path: Path, topics: dict[str, str], events_topic: str, chosen: str | None, notes: list[str]
) -> str | None:
    """Returns the topic of the frames: the chosen one, the only one, or the only one beside the events."""
    whole = [topic for topic, kind in topics.items() if kind == IMAGE]
    compressed = [topic for topic, kind in topics.items() if kind == COMPRESSED and "Depth" not in topic]
    able = [*whole, *(topic for topic in compressed if _uncompressed(topic) not in whole)]
    beside = [topic for topic in able if _namespace(topic) == _namespace(events_topic)]
    if chosen is not None:
        return _chosen(path, topics, (IMAGE, COMPRESSED), "frames", chosen)
    if len(able) > 1 and len(beside) != 1:
        notes.append(
            f"No frames are used, since {path.name} holds several topics of them; give --bag-frames as one of "
            f"{listed(able)}."
        )
        return None
    return beside[0] if len(beside) == 1 else able[0] if able else None


def _read_frames(
    path: Path, topic: str | None, camera: Camera, is_own: bool, notes: list[str]
) -> tuple[tuple[Path, ...], np.ndarray]:
    """Returns files and times (ns on ROS's clock) of the frames on a topic; none if they are not of this camera."""
    none = (), np.zeros(0, np.int64)
    if topic is None:
        return none
    first = next(_images(path, topic), None)
    if first is None:
        notes.append(f"{path.name} holds no message on {topic}, so no frame is used.")
        return none
    height, width = first[1].shape[:2]
    if (width, height) != (camera.width, camera.height) or not is_own:
        notes.append(
            f"The frames of {width} x {height} pixels on {topic} are not used, since they are not known to be of the "
            f"camera of {camera.width} x {camera.height} pixels; state their camera as frame_camera in camera.json."
        )
        return none
    return keep_frames(_files_of(path)[0], topic, partial(_images, path, topic, (width, height)))


def _images(path: Path, topic: str, size: tuple[int, int] | None = None) -> Iterator[tuple[int, np.ndarray]]:
    """Yields stamps (ns) and pixels, [height, width, 1 or 3], uint8 or uint16, of the frames on a topic."""
    with open_bag(path) as bag:
        connections = [connection for connection in bag.connections if connection.topic == topic]
        for connection, data in messages_on(bag, connections):
            message: Any = bag.deserialize(data, connection.msgtype)
            where = f"{path} holds an image on {topic}"
            pixels = _pixels(where, message) if connection.msgtype == IMAGE else _decompressed(where, message)
            height, width = pixels.shape[:2]
            if size not in (None, (width, height)):
                raise RecordingError(f"{where} of {width} x {height} pixels after others of {size}; give one camera.")
            yield message.header.stamp.sec * 10**9 + message.header.stamp.nanosec, pixels


def _pixels(where: str, message: Any) -> np.ndarray:
    name = str(message.encoding)
    if name not in ENCODINGS:
        raise RecordingError(
            f"{where} in the encoding {shortened(name)!r}, but {in_words([*ENCODINGS])} are known; republish it as one."
        )
    kind, channels, conversion = ENCODINGS[name]
    dtype = np.dtype(kind).newbyteorder(">" if message.is_bigendian else "<")
    row = message.width * channels * dtype.itemsize
    if not (0 < row <= message.step and message.height and len(message.data) == message.step * message.height):
        raise RecordingError(
            f"{where} of {message.width} x {message.height} pixels of {name} in {len(message.data):,} bytes, which do "
            "not fit together; copy it again from its source."
        )
    rows = np.asarray(message.data, np.uint8).reshape(message.height, message.step)[:, :row]
    pixels = np.ascontiguousarray(rows).view(dtype).astype(dtype.newbyteorder("="))
    pixels = pixels.reshape(message.height, message.width, channels)
    return pixels if conversion is None else cv2.cvtColor(pixels, conversion)


def _decompressed(where: str, message: Any) -> np.ndarray:
    """Returns the pixels of a JPEG or PNG, whose encoding the message names before a semicolon."""
    with suppress(cv2.error):
        pixels = cv2.imdecode(np.asarray(message.data, np.uint8), cv2.IMREAD_UNCHANGED)
        if pixels is not None and pixels.dtype in (np.uint8, np.uint16):
            if pixels.ndim == 3:
                return cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB if pixels.shape[2] == 3 else cv2.COLOR_BGRA2RGB)
            conversion = ENCODINGS.get(str(message.format).partition(";")[0].strip(), (None, 1, None))[2]
            return pixels[..., None] if conversion is None else cv2.cvtColor(pixels, conversion)
    raise RecordingError(
        f"{where} in the format {shortened(str(message.format))!r}, which is no picture in JPEG or PNG; republish it "
        "as sensor_msgs/Image."
    )


FORMAT = Format(
    name="ros_bag",
    command="rosbag-events",
    description="Events, frames and poses in a ROS bag of the drivers of DAVIS and Prophesee cameras.",
    files=FILES,
    read=read,
    options=RosBagOptions,
    takes_poses=True,
)
