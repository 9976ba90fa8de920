"""Reads event files of Prophesee (EVT2, EVT2.1, EVT3, DAT) and iniVation (AEDAT4), which hold no poses or calibration.

The package `aedat` reads AEDAT4, and `evt3` reads EVT3; `pip install 'enerf-ns[event-files]'` installs both. EVT2,
EVT2.1 and DAT have words of a fixed size, which NumPy decodes.

Prophesee's formats: docs.prophesee.ai, "Data Encoding Formats" and "File Formats"; AEDAT 4.0: docs.inivation.com.
"""

from __future__ import annotations

import os
import struct
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any
from xml.etree import ElementTree

import numpy as np
from jaxtyping import Int64, Shaped

from enerf_ns.dataparsers.recording.errors import RecordingError
from enerf_ns.dataparsers.recording.files import LARGEST_TEXT, reading
from enerf_ns.dataparsers.recording.recording import Events

BYTES_AT_A_TIME = 2**18
"""Bytes that are read at once. A vector word of two bytes may hold twelve events."""

LARGEST_HEADER = 2**16
"""Largest number of bytes of the text at the start of a .raw or .dat file."""

AEDAT4_MAGIC = b"#!AER-DAT4.0\r\n"
DAT_EVENT_TYPES = (0x00, 0x0C)
"""Types of DAT files with events of contrast detection, which have the same layout."""

EVT2_TYPES = (0x0, 0x1, 0x8, 0xA, 0xE, 0xF)
EVT3_TYPES = (0x0, 0x2, 0x3, 0x4, 0x5, 0x6, 0x7, 0x8, 0xA, 0xE, 0xF)
"""Types of words in EVT3, as `EVT2_TYPES` in EVT2. Other types show that a file is damaged or has another encoding."""

WORD_BYTES = {"EVT2": 4, "EVT2.1": 8, "EVT3": 2, "DAT": 8}


@dataclass(frozen=True)
class FileFrame:
    """A frame of an event file."""

    begin: int
    """Begin of its exposure on the file's clock, ns."""
    end: int
    """End of its exposure. Where the file states no exposure, begin and end are the frame's stamp."""
    pixels: Shaped[np.ndarray, "height width *channels"]
    """Grey or RGB, uint8 or uint16."""


@dataclass(frozen=True)
class EventFile:
    """An event file that holds at least one event."""

    path: Path
    encoding: str
    """Encoding of the file: EVT2, EVT2.1, EVT3, DAT or AEDAT4."""
    size: tuple[int, int] | None
    """Width and height of the sensor in pixels, where the file states them."""
    start: int
    """Time of the first event on the file's clock, ns."""
    stream: Callable[[], Iterator[Events]]
    """Function that yields all events in pieces, as they are in the file: polarity 0 or 1, times in ns from the first
    event. It raises RecordingError if the file is damaged."""
    frames: Callable[[], Iterator[FileFrame]] | None = None
    """Function that yields all frames in the order of the file, and raises RecordingError if the file is damaged. None
    if it holds no stream of frames."""
    notes: tuple[str, ...] = ()
    """Sentences on what the file holds beside events, which is not read."""


def open_event_file(path: Path) -> EventFile:
    """Reads the header and the first event of a file.

    Args:
        path: The file; its content states the encoding.

    Raises:
        RecordingError: The file is missing, empty, cut off, damaged, in no known encoding or without events, or the
            package that reads it is not installed.
    """
    with reading(path, "an event file"), open(path, "rb") as file:
        num_bytes = path.stat().st_size
        begin = file.read(LARGEST_HEADER)
    if not begin:
        raise RecordingError(f"{path} is empty; an event file was expected.")
    if begin.startswith(b"#ROSBAG") or path.suffix in (".db3", ".mcap"):
        raise RecordingError(f"{path} is a ROS bag, which is read as a recording; give the folder that it lies in.")
    frames, notes = None, ()
    if begin.startswith(AEDAT4_MAGIC):
        encoding, (size, microseconds, frames, notes) = "AEDAT4", _open_aedat4(path)
    elif begin.startswith(b"%"):
        encoding, size, microseconds = _open_prophesee(path, begin, num_bytes)
    else:
        raise RecordingError(
            f"{path} begins with {begin[:12]!r}, but Prophesee's .raw (EVT2, EVT2.1, EVT3) and .dat files, which begin "
            f"with %, and AEDAT4 files, which begin with {AEDAT4_MAGIC[:-2]!r}, are known."
        )
    first = next((int(events.t[0]) for events in microseconds() if len(events)), None)
    if first is None:
        raise RecordingError(f"{path} holds no events; give a recording with some.")

    def stream() -> Iterator[Events]:
        for events in microseconds():
            yield Events(events.x, events.y, (events.t - first) * 1000, events.p)

    return EventFile(path, encoding, size, first * 1000, stream, frames, notes)


EventStream = Callable[[], Iterator[Events]]
"""Function that yields the events in pieces, with times in microseconds on the file's clock."""


def _open_prophesee(path: Path, begin: bytes, num_bytes: int) -> tuple[str, tuple[int, int] | None, EventStream]:
    """Returns encoding, sensor size and events of a .raw or .dat file."""
    about, start = _prophesee_header(begin)
    name, *options = about.get("format", "").split(";")
    stated = {**about, **dict(option.split("=", 1) for option in options if "=" in option)}
    encoding = {"EVT2": "EVT2", "EVT21": "EVT2.1", "EVT3": "EVT3"}.get(name)
    if "format" not in about:
        encoding = {"2.0": "EVT2", "2.1": "EVT2.1", "3.0": "EVT3"}.get(about.get("evt", ""))
    if encoding is None and "evt" not in about and "format" not in about and "data" in about:
        encoding = "DAT"
        kind, kind_bytes = begin[start : start + 2].ljust(2, b"\xff")
        start += 2
        if about.get("version") != "2" or kind not in DAT_EVENT_TYPES or kind_bytes != WORD_BYTES["DAT"]:
            raise RecordingError(
                f"{path} is a DAT file of version {about.get('version', 'unknown')} with events of type {kind} and "
                f"{kind_bytes} bytes, but version 2 with contrast detection events (type 0 or 12, 8 bytes) is known."
            )
    if encoding is None:
        found = name or f"evt {about['evt']}" if name or "evt" in about else "no encoding"
        raise RecordingError(f"{path} states {found}, but EVT2, EVT2.1, EVT3 and DAT are known.")
    word = WORD_BYTES[encoding]
    if (num_bytes - start) % word:
        raise RecordingError(
            f"{path} ends in the middle of a word of {encoding}, which has {word} bytes; copy it again from its source."
        )
    if "endianness" not in stated and encoding == "EVT2.1":
        order = _evt21_order(path, begin[start:])
    else:
        order = stated.get("endianness", "little")
    if order != "little" and (order != "legacy" or encoding != "EVT2.1"):
        raise RecordingError(f"{path} states the endianness {order}, but little was expected; record it so.")
    decode = {"EVT2": _decode_evt2, "EVT2.1": _decode_evt21, "EVT3": _decode_evt3, "DAT": _decode_dat}[encoding]
    if encoding == "EVT3":
        _import("evt3", path)

    def events() -> Iterator[Events]:
        types = {"EVT2": "<u4", "EVT2.1": "<u8", "EVT3": "<u2", "DAT": "<u8"}
        words = _read_words(path, start, num_bytes, np.dtype(types[encoding]))
        if order == "legacy":
            words = (piece >> np.uint64(32) | piece << np.uint64(32) for piece in words)
        return decode(path, words)

    return encoding, _sensor_size(path, stated), events


def _prophesee_header(begin: bytes) -> tuple[dict[str, str], int]:
    """Returns the values of the lines that begin with % by keyword in lower case, and the end of these lines."""
    about: dict[str, str] = {}
    start = 0
    while begin.startswith(b"%", start) and b"\n" in begin[start:]:
        end = begin.index(b"\n", start)
        keyword, _, value = begin[start + 1 : end].decode("latin-1").strip().partition(" ")
        about[keyword.lower()] = value.strip()
        start = end + 1
        if keyword == "end":
            break
    return about, start


def _sensor_size(path: Path, stated: dict[str, str]) -> tuple[int, int] | None:
    width, _, height = stated.get("geometry", "").partition("x")
    width, height = stated.get("width", width), stated.get("height", height)
    if not width and not height:
        return None
    if not (width.isdecimal() and height.isdecimal() and 0 < int(width) < 2**16 and 0 < int(height) < 2**16):
        raise RecordingError(
            f"{path} states a sensor of {width} x {height}, but whole pixels from 1 to 65535 were expected."
        )
    return int(width), int(height)


def _read_words(path: Path, start: int, stop: int, kind: np.dtype) -> Iterator[Shaped[np.ndarray, " words"]]:
    """Yields bytes start to stop of a file as words; bytes that were appended later are not read."""
    try:
        with open(path, "rb") as file:
            file.seek(start)
            while start < stop:
                piece = file.read(min(BYTES_AT_A_TIME, stop - start))
                start += len(piece)
                if len(piece) % kind.itemsize or not piece:
                    raise RecordingError(f"{path} became shorter while it was read; read it again.")
                yield np.frombuffer(piece, kind)
    except OSError as error:
        raise RecordingError(f"{path} cannot be read ({error}); copy it again from its source.") from error


def _check_types(path: Path, types: Shaped[np.ndarray, " words"], known: tuple[int, ...], encoding: str) -> None:
    """Raises RecordingError if a word has a type that the encoding lacks."""
    is_known = np.zeros(16, bool)
    is_known[list(known)] = True
    good = is_known[types]
    if not good.all():
        raise RecordingError(
            f"{path} holds a word of type {types[np.argmin(good)]:#x}, which {encoding} has not; it is damaged, or of "
            "another encoding than it states; copy it again from its source."
        )


class _Clock:
    """Times of words from a counter that restarts after `period`."""

    def __init__(self, period: int):
        self.period, self.last, self.passed = period, 0, 0

    def unwrap(self, times: Int64[np.ndarray, " words"]) -> Int64[np.ndarray, " words"]:
        """Returns times that continue where the counter restarted."""
        if not len(times):
            return times
        periods = self.passed + np.cumsum(np.diff(times, prepend=self.last) < -self.period // 2)
        self.last, self.passed = int(times[-1]), int(periods[-1])
        return times + periods * self.period


def _decode_dat(path: Path, pieces: Iterator[np.ndarray]) -> Iterator[Events]:
    """Yields events of DAT words: bits 0 to 31 time in microseconds, 32 to 45 x, 46 to 59 y, 60 to 63 polarity."""
    clock = _Clock(2**32)
    for words in pieces:
        address = (words >> np.uint64(32)).astype(np.int64)
        t = clock.unwrap((words & np.uint64(2**32 - 1)).astype(np.int64))
        yield Events(address & 0x3FFF, address >> 14 & 0x3FFF, t, address >> 28)


def _decode_evt2(path: Path, pieces: Iterator[np.ndarray]) -> Iterator[Events]:
    """Yields events of EVT2 words: bits 28 to 31 type, 22 to 27 lowest bits of time, 11 to 21 x, 0 to 10 y."""
    clock, high = _Clock(2**28), -1
    for words in pieces:
        kinds = words >> 28
        _check_types(path, kinds, EVT2_TYPES, "EVT2")
        highs, high = _high_times(clock, kinds == 0x8, (words & 0xFFFFFFF).astype(np.int64), high)
        events = (kinds <= 0x1) & (highs >= 0)
        words, highs = words[events].astype(np.int64), highs[events]
        yield Events(words >> 11 & 0x7FF, words & 0x7FF, highs << 6 | words >> 22 & 0x3F, words >> 28)


def _decode_evt21(path: Path, pieces: Iterator[np.ndarray]) -> Iterator[Events]:
    """Yields events of EVT2.1 words: the upper 32 bits as in EVT2, one lower bit for each of 32 pixels from x on."""
    clock, high = _Clock(2**28), -1
    for pair in pieces:
        words = (pair >> np.uint64(32)).astype(np.int64)
        kinds = words >> 28
        _check_types(path, kinds, EVT2_TYPES, "EVT2.1")
        highs, high = _high_times(clock, kinds == 0x8, words & 0xFFFFFFF, high)
        vectors = (kinds <= 0x1) & (highs >= 0)
        words, highs = words[vectors], highs[vectors]
        fired = np.unpackbits(pair[vectors].astype("<u4")[:, None].view(np.uint8), axis=1, bitorder="little")
        row, pixel = np.nonzero(fired)
        words, highs = words[row], highs[row]
        yield Events((words >> 11 & 0x7FF) + pixel, words & 0x7FF, highs << 6 | words >> 22 & 0x3F, words >> 28)


def _high_times(
    clock: _Clock, states: np.ndarray, values: Int64[np.ndarray, " words"], before: int
) -> tuple[Int64[np.ndarray, " words"], int]:
    """Returns the upper bits of the time at each word and after the last one; -1 before the first stated time."""
    stated = np.concatenate([[before], clock.unwrap(values[states])])
    return stated[np.cumsum(states)], int(stated[-1])


def _evt21_order(path: Path, words: bytes) -> str:
    """Returns the byte order of EVT2.1 words if the file does not state it, from the type in words of time."""
    halves = np.frombuffer(words[: len(words) // 8 * 8], "<u4").reshape(-1, 2)
    is_time = (halves >> 28 == 0x8) & (halves[:, ::-1] == 0)
    legacy, little = is_time.sum(axis=0)
    if legacy == little:
        raise RecordingError(
            f"{path} does not state the endianness of its EVT2.1 words, and the words do not show it; record it with "
            "software that states it."
        )
    return "little" if little > legacy else "legacy"


def _decode_evt3(path: Path, pieces: Iterator[np.ndarray]) -> Iterator[Events]:
    decode = evt3_decoder(path)
    for words in pieces:
        yield decode(words)


def evt3_decoder(path: Path) -> Callable[[np.ndarray], Events]:
    """Returns a function that decodes one piece of EVT3 words (<u2) after the other; times in microseconds.

    The time counter has 24 bits, which restart after 16.8 s. The function counts on. It holds events back until the
    first word of time. It raises RecordingError at a word that EVT3 has not.

    Raises:
        RecordingError: The package evt3 is not installed.
    """
    decoder = _import("evt3", path).Decoder()

    def decode(words: np.ndarray) -> Events:
        _check_types(path, words >> 12, EVT3_TYPES, "EVT3")
        events = decoder.feed(words.tobytes())
        return Events(events.x, events.y, events.t.astype(np.int64), events.p)

    return decode


def _open_aedat4(
    path: Path,
) -> tuple[tuple[int, int], EventStream, Callable[[], Iterator[FileFrame]] | None, tuple[str, ...]]:
    """Returns sensor size, events and frames of an AEDAT4 file, and a sentence on frames that are not read."""
    aedat = _import("aedat", path)
    _check_aedat4(path)
    streams = _guarded(path, lambda: aedat.Decoder(path).id_to_stream())
    sensors = [number for number, stream in streams.items() if stream["type"] == "events"]
    cameras = [number for number, stream in streams.items() if stream["type"] == "frame"]
    if len(sensors) != 1:
        raise RecordingError(
            f"{path} holds {len(sensors)} streams of events, but one was expected; export the one that is wanted."
        )

    def packets(number: int, content: str) -> Iterator[Any]:
        decoder = _guarded(path, lambda: aedat.Decoder(path))
        while (packet := _guarded(path, lambda: next(decoder, None))) is not None:
            if packet["stream_id"] == number and content in packet:
                yield packet[content]

    def events() -> Iterator[Events]:
        for rows in packets(sensors[0], "events"):
            yield Events(rows["x"], rows["y"], rows["t"].astype(np.int64), rows["on"])

    def frames() -> Iterator[FileFrame]:
        for frame in packets(cameras[0], "frame"):
            begin, end = int(frame["exposure_begin_t"]), int(frame["exposure_end_t"])
            if not 0 < begin <= end:  # not stated
                begin = end = int(frame["t"])
            pixels = frame["pixels"]
            yield FileFrame(begin * 1000, end * 1000, pixels[..., :3] if pixels.ndim == 3 else pixels)

    notes = ()
    if len(cameras) > 1:
        notes = (f"{path.name} holds {len(cameras)} streams of frames, of which none is read; export the one wanted.",)
    sensor = streams[sensors[0]]
    return (int(sensor["width"]), int(sensor["height"])), events, frames if len(cameras) == 1 else None, notes


def _check_aedat4(path: Path) -> None:
    """Raises RecordingError if parts of an AEDAT4 file are not where it states. The package would end the process.

    The header is a FlatBuffer, whose tables refer to fields by offsets, with an XML document. Then packets follow, each
    after its stream's number and its size in bytes.
    """
    try:
        with open(path, "rb") as file:
            file.seek(len(AEDAT4_MAGIC))
            (length,) = struct.unpack("<I", file.read(4))
            if length > LARGEST_TEXT:
                raise ValueError(f"it states a header of {length:,} bytes")
            header = file.read(length)
            (table,) = struct.unpack_from("<I", header)
            fields = table - struct.unpack_from("<i", header, table)[0]
            field = (
                struct.unpack_from("<H", header, fields + 6)[0]
                if struct.unpack_from("<H", header, fields)[0] > 6
                else 0
            )
            end = struct.unpack_from("<q", header, table + field)[0] if field else -1
            ElementTree.fromstring(header[header.index(b"<dv") :].rstrip(b"\0"))
            num_bytes = path.stat().st_size
            if end == -1:
                end = num_bytes
            place = file.tell()
            if not place <= end <= num_bytes:
                raise ValueError("it is cut off")
            while place < end:
                file.seek(place)
                _, size = struct.unpack("<ii", file.read(8))
                place += 8 + size
                if size <= 0 or place > end:
                    raise ValueError("it is cut off")
    except (OSError, ValueError, struct.error, ElementTree.ParseError) as error:
        raise RecordingError(f"{path} is damaged ({error}); copy it again from its source.") from error


def _guarded(path: Path, call: Callable):
    """Returns the result of a reader in Rust; its panics are no `Exception`, and go to standard error."""
    sys.stderr.flush()
    stderr, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)
    try:
        return call()
    except BaseException as error:
        if isinstance(error, (KeyboardInterrupt, SystemExit)):
            raise
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise RecordingError(f"{path} is damaged ({reason}); copy it again from its source.") from error
    finally:
        os.dup2(stderr, 2)
        os.close(stderr)
        os.close(nowhere)


def _import(name: str, path: Path) -> ModuleType:
    try:
        return import_module(name)
    except ImportError as error:
        raise RecordingError(
            f"{path} is read by the package {name}, which is not installed; run: pip install 'enerf-ns[event-files]'"
        ) from error
