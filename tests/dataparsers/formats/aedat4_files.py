"""AEDAT4 files, written here by their schema.

A FlatBuffer starts with where its table lies, and the table with how far before it its list of fields lies, which says
where in the table each field is.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable, Sequence

import numpy as np

OPENCV_TYPES = {("uint8", 1): 0, ("uint16", 1): 2, ("uint8", 3): 16, ("uint16", 3): 18, ("uint8", 4): 24}


def aedat4(
    size: tuple[int, int],
    streams: Sequence[str],
    packets: Iterable[tuple[int, bytes]],
    compress: Callable | None = None,
) -> bytes:
    """The file, without a table at its end.

    Args:
        size: Width and height that the header states of each stream.
        streams: Type of each stream, such as EVTS and FRME.
        packets: Number of the stream, and FlatBuffer, of each packet.
        compress: That of LZ4.
    """
    nodes = "".join(
        f'<node name="{i}" path="/mainloop/Recorder/outInfo/{i}/"><attr key="compression" type="string">NONE</attr>'
        f'<attr key="typeIdentifier" type="string">{kind}</attr><node name="info" path="/info/"><attr key="sizeX" '
        f'type="int">{size[0]}</attr><attr key="sizeY" type="int">{size[1]}</attr></node></node>'
        for i, kind in enumerate(streams)
    )
    about = f'<dv version="2.0"><node name="outInfo" path="/mainloop/Recorder/outInfo/">{nodes}</node></dv>'.encode()
    fields = struct.pack("<5H", 10, 24, 4, 8, 16)  # sizes of this and of the table; then of three fields, where
    table = struct.pack("<iiqI", 24 - 8, compress is not None, -1, 24 - 16)  # then where data and text lie
    text = struct.pack("<I", len(about)) + about + b"\0"
    header = struct.pack("<I", 24) + b"IOHE" + fields.ljust(16, b"\0") + table.ljust(24, b"\0") + text
    parts = [b"#!AER-DAT4.0\r\n", struct.pack("<I", len(header)), header]
    for stream, buffer in packets:
        content = (compress or bytes)(struct.pack("<I", len(buffer)) + buffer)
        parts += [struct.pack("<ii", stream, len(content)), content]
    return b"".join(parts)


def events_packet(rows: np.ndarray, kind: str = "EVTS") -> bytes:
    """One field, a vector of structures. Rows are t (microseconds), x, y, polarity 0 or 1."""
    structs = b"".join(struct.pack("<qhh?3x", *row) for row in rows.tolist())
    fields, table = struct.pack("<3H", 6, 8, 4), struct.pack("<iI", 16 - 8, 28 - 20)
    head = struct.pack("<I", 16) + kind.encode() + fields.ljust(8, b"\0") + table.ljust(12, b"\0")
    return head + struct.pack("<I", len(rows)) + structs


def frame_packet(begin: int, end: int, pixels: np.ndarray, stamp: int | None = None) -> bytes:
    """Stamps (of the frame, its begin and end, and the exposure), OpenCV's type, size, place and pixels (BGR).

    Args:
        begin, end: The exposure, microseconds.
        pixels: (height, width) or (height, width, channels) in RGB or RGBA.
        stamp: That of the frame. Default: the middle of the exposure.
    """
    stamp = (begin + end) // 2 if stamp is None else stamp
    channels = 1 if pixels.ndim == 2 else pixels.shape[2]
    if channels > 1:
        pixels = np.concatenate([pixels[..., 2::-1], pixels[..., 3:]], axis=-1)
    offsets = (8, 16, 24, 32, 40, 4, 48, 50, 52, 54, 56)
    fields = struct.pack("<13H", 26, 60, *offsets).ljust(36, b"\0")
    kind, (height, width) = OPENCV_TYPES[pixels.dtype.name, channels], pixels.shape[:2]
    table = struct.pack("<ib3x5q4hI", 44 - 8, kind, stamp, begin, end, begin, end, width, height, 0, 0, 4)
    content = pixels.tobytes()
    return struct.pack("<I", 44) + b"FRME" + fields + table + struct.pack("<I", len(content)) + content
