"""Opens ROS bags of both versions by the package rosbags."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from enerf_ns.dataparsers.recording.errors import RecordingError
from enerf_ns.dataparsers.recording.files import LARGEST_TEXT, check_is_file, files_in, reading

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader
    from rosbags.interfaces import Connection

MAGIC = b"#ROSBAG V2.0\n"
"""First line of a bag of ROS 1. rosbags reads a line of any length before it compares it."""

EVENT_ARRAY = "std_msgs/Header header\nuint32 height\nuint32 width\n{}/Event[] events"
EVENT_PACKET = (
    "std_msgs/Header header\nuint32 height\nuint32 width\nuint64 seq\nuint64 time_base\nstring encoding\n"
    "bool is_bigendian\nuint8[] events"
)
EVENT_TYPES = {
    **{
        f"{package}/msg/{name}": text
        for package in ("dvs_msgs", "prophesee_event_msgs")
        for name, text in (
            ("Event", "uint16 x\nuint16 y\nbuiltin_interfaces/Time ts\nbool polarity"),
            ("EventArray", EVENT_ARRAY.format(package)),
        )
    },
    "event_camera_msgs/msg/EventPacket": EVENT_PACKET,
    "event_array_msgs/msg/EventArray": EVENT_PACKET,
}
"""Definitions of the messages of event cameras. Bags of ROS 2 before 2023 hold no definitions."""


@contextmanager
def open_bag(path: Path) -> Iterator[AnyReader]:
    """Yields a reader of rosbags. Errors of the block about a damaged file become one sentence.

    Args:
        path: File of ROS 1 (.bag), or folder or file of ROS 2 (.db3, .mcap).

    Raises:
        RecordingError: The bag is missing or damaged, or rosbags is not installed.
    """
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    except ImportError as error:
        raise RecordingError(
            f"{path} is a ROS bag, for which the package rosbags is missing; pip install 'enerf-ns[bag]'."
        ) from error
    store = get_typestore(Stores.ROS2_HUMBLE)
    for name, text in EVENT_TYPES.items():
        store.register(get_types_from_msg(text, name))
    is_folder = path.is_dir()
    for part in files_in(path, "*.db3", "*.mcap") if is_folder else ():
        check_is_file(part, "a part of a ROS bag")
    with reading(path / "metadata.yaml" if is_folder else path, "a ROS bag", LARGEST_TEXT if is_folder else None):
        if path.suffix == ".bag":
            with open(path, "rb") as file:
                if b"\n" not in (start := file.read(len(MAGIC))) or start[:9] != MAGIC[:9]:
                    raise ValueError(f"it does not begin with {MAGIC[:-1].decode()}")
        with AnyReader([path], default_typestore=store) as bag:
            for connection in bag.connections:
                if not (isinstance(connection.topic, str) and isinstance(connection.msgtype, str)):
                    raise ValueError(f"it names a topic {connection.topic!r} of type {connection.msgtype!r}")
            yield bag


def messages_on(bag: AnyReader, connections: Collection[Connection]) -> Iterator[tuple[Connection, bytes]]:
    """Yields the serialized messages of some connections in the order in which they were recorded.

    Raises:
        ValueError: The index of the bag is damaged.
    """
    topics = {connection.topic for connection in connections}
    for connection, _, data in bag.messages(connections) if connections else ():
        if connection.topic not in topics:
            raise ValueError(f"its index takes a message on {connection.topic} for one on {' and '.join(topics)}")
        yield connection, data
