"""Events from the messages of ROS drivers of event cameras.

    dvs_msgs/EventArray, prophesee_event_msgs/EventArray   one structure an event; times of ROS
    event_camera_msgs/EventPacket                          bytes in one of the encodings
        evt3          Prophesee's EVT 3.0; the sensor's own clock, microseconds in 24 bits
        mono          8 bytes an event: 32 bits ns after time_base, x 16, y 15, polarity 1; the sensor's own clock
        libcaer       8 bytes an event: valid 1, polarity 1, y 15, x 15 bits, then 31 bits µs after time_base
        libcaer_cmp   2 bytes a word, type in the upper 4 bits: 0 and 1 upper and lower 12 bits of time (µs after
                      time_base), 2 x, 3 an event at y (11 bits) with polarity, 4 base of y with polarity, 5 eight
                      pixels from the base on

Sources: the definitions of these messages; github.com/ros-event-camera/event_camera_msgs, README, and
event_camera_codecs, README and decoders. By these, the times of libcaer begin at ROS's when the driver starts.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from enerf_ns.dataparsers.formats.event_files import evt3_decoder
from enerf_ns.dataparsers.formats.json_values import in_words
from enerf_ns.dataparsers.formats.ros_bags import messages_on
from enerf_ns.dataparsers.recording.errors import RecordingError, shortened
from enerf_ns.dataparsers.recording.recording import Events

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader
    from rosbags.interfaces import Connection

ARRAY_TYPES = ("dvs_msgs/msg/EventArray", "prophesee_event_msgs/msg/EventArray")
PACKET_TYPES = ("event_camera_msgs/msg/EventPacket", "event_array_msgs/msg/EventArray")
MESSAGE_TYPES = (*ARRAY_TYPES, *PACKET_TYPES)

EVENT_FIELDS = [("x", "uint16"), ("y", "uint16"), ("ts", "Time"), ("polarity", "bool")]
"""Fields of an event of the first two messages, which are read as bytes."""

EVENT = np.dtype([("x", "<u2"), ("y", "<u2"), ("s", "<u4"), ("ns", "<u4"), ("polarity", "u1")])
"""An event as ROS 1 serializes it: 13 bytes."""

ALIGNED_EVENT = np.dtype(
    {
        "names": ["x", "y", "s", "ns", "polarity"],
        "formats": ["<u2", "<u2", "<i4", "<u4", "u1"],
        "offsets": [0, 2, 6, 10, 14],
        "itemsize": 16,
    }
)
"""An event as ROS 2 serializes it, but for the first one of a message, whose x and y stand 2 bytes later."""

LITTLE_ENDIAN = 1
"""Second byte of a message of ROS 2 whose numbers have their lowest byte first."""


@dataclass(frozen=True)
class EventMessage:
    """The events of a message."""

    stamp: int
    """Stamp of the message, ns on the clock of ROS."""
    size: tuple[int, int]
    """Width and height of the sensor, pixels; may be (0, 0) where the driver does not state them."""
    events: Events
    """With times in ns, on the clock of ROS or that of the sensor."""
    has_own_clock: bool
    """Whether the times of the events are known to be those of the sensor's own clock."""


def read_events(path: Path, bag: AnyReader, connections: list[Connection]) -> Iterator[EventMessage]:
    """Yields the messages of one topic. Their events are decoded one message after the other.

    Args:
        path: The bag, for error messages.
        bag: Its reader.
        connections: Those of the topic, with messages of one of the `MESSAGE_TYPES`.

    Raises:
        RecordingError: A message is damaged, or has an encoding that is not known.
    """
    decoders: dict[str, Callable[[np.ndarray, int], Events]] = {}
    for connection in connections:
        if connection.msgtype in ARRAY_TYPES:
            _check_definition(path, bag, connection.msgtype)
    for connection, data in messages_on(bag, connections):
        where = f"{path} holds a message on {connection.topic}"
        if connection.msgtype in ARRAY_TYPES:
            stamp, size, rows = (parse_aligned_array if bag.is2 else parse_array)(where, connection.msgtype, data)
            yield EventMessage(stamp, size, as_events(rows), has_own_clock=False)
            continue
        packet: Any = bag.deserialize(data, connection.msgtype)
        name = str(packet.encoding)
        if name not in decoders:
            decoders[name] = _decoder(path, where, name)
        if len(packet.events) % WORD_BYTES[name] or packet.is_bigendian:
            order = "big-endian words" if packet.is_bigendian else f"{len(packet.events):,} bytes"
            raise RecordingError(
                f"{where} with {order} of {name}, but little-endian words of {WORD_BYTES[name]} bytes were expected; "
                "record it again."
            )
        stamp = packet.header.stamp.sec * 10**9 + packet.header.stamp.nanosec
        events = decoders[name](np.ascontiguousarray(packet.events, np.uint8), int(packet.time_base))
        yield EventMessage(stamp, (packet.width, packet.height), events, has_own_clock=name in OWN_CLOCKS)


def parse_array(where: str, kind: str, data: bytes) -> tuple[int, tuple[int, int], np.ndarray]:
    """Returns stamp (ns), size of the sensor (width, height) and `EVENT` rows of an EventArray of ROS 1.

    Its bytes are u32 seq, u32 s, u32 ns, u32 length of the name of the frame, the name, u32 height, u32 width, u32
    number of events, and the events.

    Args:
        where: The subject of an error, such as "FILE holds a message on TOPIC".
        kind: The type of the message.
        data: The message.

    Raises:
        RecordingError: The bytes are no such message.
    """
    try:
        _, s, ns, length = struct.unpack_from("<IIII", data)
        height, width, count = struct.unpack_from("<III", data, 16 + length)
    except struct.error:
        s, ns, length, height, width, count = 0, 0, 0, 0, 0, -1
    start = 28 + length
    if len(data) != start + count * EVENT.itemsize:
        raise _no_array(where, kind, data)
    return s * 10**9 + ns, (width, height), np.frombuffer(data, EVENT, count, start)


def parse_aligned_array(where: str, kind: str, data: bytes) -> tuple[int, tuple[int, int], np.ndarray]:
    """Returns what `parse_array` does of a message of ROS 2 (CDR).

    After four bytes on the encoding stand i32 s, u32 ns, u32 length of the name of the frame, the name, u32 height, u32
    width, u32 number of events, and the events. Numbers are aligned to their own size.
    """
    try:
        s, ns, length = struct.unpack_from("<iII", data, 4)
        start = 16 + length + -length % 4
        height, width, count = struct.unpack_from("<III", data, start)
    except struct.error:
        s, ns, start, height, width, count = 0, 0, 0, 0, 0, -1
    start += 12
    end = start + 16 * count - 3 if count else start
    if count < 0 or not end <= len(data) < end + 4 or data[1] != LITTLE_ENDIAN:
        raise _no_array(where, kind, data)
    rows = np.zeros(16 * count, np.uint8)
    if count:
        rows[:4] = np.frombuffer(data, np.uint8, 4, start)
        rows[6:-1] = np.frombuffer(data, np.uint8, 16 * count - 7, start + 4)
    return s * 10**9 + ns, (width, height), rows.view(ALIGNED_EVENT)


def as_events(rows: np.ndarray) -> Events:
    """Returns the events of rows of `EVENT` or `ALIGNED_EVENT`."""
    return Events(rows["x"], rows["y"], rows["s"].astype(np.int64) * 10**9 + rows["ns"], rows["polarity"])


def _no_array(where: str, kind: str, data: bytes) -> RecordingError:
    kind = kind.replace("/msg/", "/")
    return RecordingError(f"{where} whose {len(data):,} bytes are no {kind}; copy it again from its source.")


def _check_definition(path: Path, bag: AnyReader, kind: str) -> None:
    """Checks the definition of an event that the bag holds, since events are read without it."""
    name = kind.replace("EventArray", "Event")
    fields = bag.typestore.fielddefs[name][1]
    found = [
        (field, str(about[1][0] if int(about[0]) == 1 else about[1]).rsplit("/", 1)[-1]) for field, about in fields
    ]
    if found != EVENT_FIELDS:
        raise RecordingError(
            f"{path} defines {name} as {in_words([' '.join(field[::-1]) for field in found])}, but "
            f"{in_words([' '.join(field[::-1]) for field in EVENT_FIELDS])} was expected; convert it to dvs_msgs."
        )


def _decoder(path: Path, where: str, name: str) -> Callable[[np.ndarray, int], Events]:
    """Returns the function from the bytes of a message and its time_base (ns) to its events."""
    if name == "evt3":
        decode = evt3_decoder(path)

        def decoded(data: np.ndarray, time_base: int) -> Events:
            events = decode(data.view("<u2"))
            return Events(events.x, events.y, events.t * 1000, events.p)

        return decoded
    if name not in DECODERS:
        raise RecordingError(
            f"{where} in the encoding {shortened(name)!r}, but {in_words(['evt3', *DECODERS])} are known; republish it "
            "as dvs_msgs by event_camera_tools."
        )
    return DECODERS[name]


def _decode_mono(data: np.ndarray, time_base: int) -> Events:
    words = data.view("<u8")
    t = time_base + (words & np.uint64(2**32 - 1)).astype(np.int64)
    address = (words >> np.uint64(32)).astype(np.int64)
    return Events(address & 0xFFFF, address >> 16 & 0x7FFF, t, address >> 31)


def _decode_libcaer(data: np.ndarray, time_base: int) -> Events:
    address, low = data.view("<u4").reshape(-1, 2).astype(np.int64).T
    turns = np.cumsum(np.diff(low, prepend=low[:1]) < 0)
    t = time_base + (low + turns * 2**31) * 1000
    return Events(address >> 17 & 0x7FFF, address >> 2 & 0x7FFF, t, address >> 1 & 1)


def _decode_libcaer_cmp(data: np.ndarray, time_base: int) -> Events:
    words = data.view("<u2").astype(np.int64)
    kinds, values = words >> 12, words & 0xFFF
    number = np.arange(len(words))

    def latest(kind: int) -> np.ndarray:
        """Value of the latest word of a type at each word, 0 before the first one."""
        at = np.maximum.accumulate(np.where(kinds == kind, number, -1))
        return np.where(at >= 0, values[at], 0)

    time, x = latest(0) << 12 | latest(1), latest(2) & 0x7FF
    bases = np.maximum.accumulate(np.where(kinds == 4, number, 0))
    vectors = np.cumsum(kinds == 5)
    base = (latest(4) & 0x7FF) + 8 * (vectors - vectors[bases] - 1) if len(words) else values
    polarity = np.where(kinds == 3, values, latest(4)) >> 11
    fired = (values[:, None] >> np.arange(8) & 1) * (kinds == 5)[:, None]
    fired[:, 0] |= kinds == 3
    word, pixel = np.nonzero(fired)
    y = np.where(kinds == 3, values & 0x7FF, base)[word] + pixel
    return Events(x[word], y, time_base + time[word] * 1000, polarity[word])


DECODERS = {"mono": _decode_mono, "libcaer": _decode_libcaer, "libcaer_cmp": _decode_libcaer_cmp}
WORD_BYTES = {"evt3": 2, "mono": 8, "libcaer": 8, "libcaer_cmp": 2}
OWN_CLOCKS = ("evt3", "mono")
"""Encodings whose times are the sensor's. The others begin at ROS's clock when the driver starts."""
