"""Reader for the text format of the UZH event-camera dataset, recorded with a DAVIS240C, and of other DAVIS cameras.

    events.txt        t x y p, one event a line; seconds, pixels, polarity 0 or 1
    groundtruth.txt   t px py pz qx qy qz qw, one pose a line; camera to world, OpenCV axes, metres
    calib.txt         fx fy cx cy k1 k2 p1 p2 k3
    images.txt        t path, one frame a line (optional, with the images that it lists)

Mueggler et al., "The event-camera dataset and simulator", International Journal of Robotics Research 36(2), 2017.
"""

from __future__ import annotations

from codecs import BOM_UTF8
from collections.abc import Iterator
from decimal import Decimal, InvalidOperation
from math import hypot
from pathlib import Path

import numpy as np
from jaxtyping import Shaped

from enerf_ns.dataparsers.compiled import compiled
from enerf_ns.dataparsers.formats.format import Format
from enerf_ns.dataparsers.formats.pose_files import GivenPoses, NamedFrames, poses_of
from enerf_ns.dataparsers.formats.text_tables import parse_numbers, parse_times, read_rows
from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.dataparsers.recording.errors import RecordingError, shortened
from enerf_ns.dataparsers.recording.files import LONGEST_LINE, check_image_sizes, files_in, image_size, of_file, reading
from enerf_ns.dataparsers.recording.recording import EventRecording, Events, Frames
from enerf_ns.dataparsers.recording.trajectory import Trajectory

FILES = ("events.txt", "groundtruth.txt", "calib.txt")

SIZES = ((240, 180), (346, 260), (128, 128))
"""Width and height in pixels of DAVIS240C, DAVIS346 and DVS128. Without frames, which state the size, the principal
point tells the sensor."""

OFF_MIDDLE = 0.15
"""Largest distance of the principal point from the middle of a sensor, as a share of its sides."""

EVENT_COLUMNS = "t_s x y p"
BYTES_AT_A_TIME = 2**22

MOST_DIGITS = 100
"""Most digits of a number of an event."""


def read(folder: Path, poses: GivenPoses | None = None) -> EventRecording:
    """Reads everything but the events, which are read when they are needed.

    The recording's zero of time is the earliest first stamp among events, frames and poses.

    Args:
        folder: The folder with the files that the module describes.
        poses: Poses in place of groundtruth.txt.

    Raises:
        RecordingError: A file is missing, empty or cannot be used.
    """
    notes: list[str] = []
    events_file = folder / "events.txt"
    frame_files, frame_times = _read_frame_list(folder, notes)
    named = [NamedFrames(frame_files, frame_times)]
    poses_file, unit = (folder / "groundtruth.txt", "s") if poses is None else (poses.path, poses.unit)
    pose_times, positions, quaternions = poses_of(poses_file, unit, poses, named, notes)
    first_stamps = [_first_event_time(events_file), pose_times[0], *frame_times[:1]]
    zero = int(min(first_stamps))
    num_bytes = events_file.stat().st_size

    camera = _read_camera(folder / "calib.txt", image_size(frame_files[0]) if frame_files else None)
    check_image_sizes(frame_files, camera.width, camera.height)
    if (camera.width, camera.height) != SIZES[0] and not frame_files:
        notes.append(
            f"The sensor is taken to have {camera.width} x {camera.height} pixels, as the principal point in calib.txt "
            "tells, since no frame states its size."
        )
    trajectory = Trajectory(pose_times - zero, positions, quaternions)
    return EventRecording(
        path=folder,
        format="davis",
        camera=camera,
        trajectory=trajectory,
        stream_events=lambda: _stream_events(events_file, num_bytes, zero),
        event_files=(events_file,),
        zero=zero,
        frames=Frames(frame_files, frame_times - zero, camera, trajectory) if frame_files else None,
        notes=tuple(notes),
        locate_event=lambda index: f"{events_file}, line {index + 1}",
        times_in={
            "events": (events_file, "s"),
            "poses": (poses_file, unit),
            "frames": (folder / "images.txt", "s"),
        },
    )


def _read_frame_list(folder: Path, notes: list[str]) -> tuple[tuple[Path, ...], np.ndarray]:
    path = folder / "images.txt"
    if not path.exists():
        if (folder / "images").is_dir():
            notes.append("There is a folder images/ but no images.txt with the stamps of frames, so no frame is used.")
        return (), np.zeros(0, np.int64)
    rows, numbers = read_rows(path, "t_s path")
    files = tuple(folder / row[1] for row in rows)
    if not any(file.parent.is_dir() for file in files):
        notes.append(f"images.txt lists {len(files)} frames, but there is no folder {files[0].parent.name}/ of images.")
        return (), np.zeros(0, np.int64)
    for file, number in zip(files, numbers, strict=True):
        if ".." in file.parts or not file.is_relative_to(folder):
            raise RecordingError(f"{path}, line {number} lists {file}, which lies outside {folder}; copy it there.")
        if not file.is_file():
            raise RecordingError(f"{path}, line {number} lists {file}, which is missing; add it or drop the line.")
    found = set(files_in(files[0].parent, f"*{files[0].suffix}"))
    unlisted = len(found.difference(files))
    if unlisted:
        notes.append(f"{unlisted} of {len(found)} images are not listed in images.txt and are not used.")
    return files, parse_times(path, [row[0] for row in rows], numbers, "s", "frames")


def _read_camera(path: Path, size: tuple[int, int] | None) -> Camera:
    rows, numbers = read_rows(path, "fx fy cx cy k1 k2 p1 p2 k3")
    fx, fy, cx, cy, *distortion = parse_numbers(path, rows, numbers)[0].tolist()
    model = "radtan" if any(distortion) else "pinhole"
    if size is None:
        off_middle = {sides: hypot(cx / sides[0] - 0.5, cy / sides[1] - 0.5) for sides in SIZES}
        likeliest = min(SIZES, key=off_middle.__getitem__)
        size = likeliest if off_middle[likeliest] < OFF_MIDDLE else SIZES[0]
    width, height = size
    with of_file(f"{path} (fx fy cx cy k1 k2 p1 p2 k3)"):
        return Camera(width, height, fx, fy, cx, cy, tuple(distortion) if any(distortion) else (), model)


def _first_event_time(path: Path) -> int:
    with reading(path, f"a file of events ({EVENT_COLUMNS})"), open(path, "rb") as file:
        line = file.readline(LONGEST_LINE).removeprefix(BOM_UTF8)
    if not line.strip():
        raise RecordingError(f"{path} is empty; events ({EVENT_COLUMNS}) were expected.")
    columns = tuple(np.empty(1, dtype) for dtype in (np.int64, np.int32, np.int32, np.int32))
    if compiled(_parse_lines)(np.frombuffer(line, np.uint8), *columns) == 0:
        raise _bad_line(path, 1, line)
    return int(columns[0][0])


def _stream_events(path: Path, num_bytes: int, zero: int) -> Iterator[Events]:
    """Yields the events in the first `num_bytes` bytes of the file, times in nanoseconds from `zero`."""
    text = np.memmap(path, np.uint8, mode="r")[:num_bytes]
    end = _end_of_lines(text)
    start = len(BOM_UTF8) if text[: len(BOM_UTF8)].tobytes() == BOM_UTF8 else 0
    parse, num_events = compiled(_parse_lines), 0
    while start < end:
        stop = min(start + BYTES_AT_A_TIME, end)
        rest, is_whole, _ = text[stop : min(stop + LONGEST_LINE, end)].tobytes().partition(b"\n")
        if len(rest) == LONGEST_LINE:
            line = num_events + np.count_nonzero(text[start:stop] == ord("\n")) + 1
            raise RecordingError(
                f"{path}, line {line} has more than {LONGEST_LINE:,} letters, but {EVENT_COLUMNS} was expected."
            )
        stop += len(rest) + len(is_whole)
        piece = np.asarray(text[start:stop])
        num_lines = np.count_nonzero(piece == ord("\n")) + (piece[-1] != ord("\n"))
        t, x, y, p = (np.empty(num_lines, dtype) for dtype in (np.int64, np.int32, np.int32, np.int32))
        parsed = parse(piece, t, x, y, p)
        if parsed < num_lines:
            line = piece.tobytes().split(b"\n", parsed + 1)[parsed]
            raise _bad_line(path, num_events + parsed + 1, line)
        yield Events(x, y, t - zero, p)
        num_events += parsed
        start = stop


def _end_of_lines(text: Shaped[np.ndarray, " bytes"]) -> int:
    """Returns the number of bytes without the white space at the end."""
    end = len(text)
    while end:
        last = text[max(end - BYTES_AT_A_TIME, 0) : end].tobytes()
        if kept := last.rstrip(b" \t\r\n"):
            return end - len(last) + len(kept)
        end -= len(last)
    return 0


def _bad_line(path: Path, number: int, line: bytes) -> RecordingError:
    cells = line.decode(errors="replace").split()
    if len(cells) != 4:
        return RecordingError(f"{path}, line {number} has {len(cells)} columns, but 4 were expected: {EVENT_COLUMNS}.")
    for cell, expected in zip(cells, ("a time in seconds", *["a whole number"] * 3), strict=True):
        try:
            value = Decimal(cell)
            good = (
                len(cell) <= MOST_DIGITS
                and value.is_finite()
                and abs(value) < 2**31
                and (expected != "a whole number" or value == int(value))
            )
        except InvalidOperation:
            good = False
        if not good:
            return RecordingError(f"{path}, line {number} holds {shortened(cell)!r} where {expected} was expected.")
    found = shortened(" ".join(cells))
    return RecordingError(f"{path}, line {number} holds {found!r}, but {EVENT_COLUMNS} was expected.")


def _parse_lines(text, t, x, y, p):
    """Fills one row for each line of `text` (ASCII bytes), and returns the number of rows before the first bad line.

    Numbers may have a sign, a decimal point and an exponent. Times become exact nanoseconds, without floats.
    """
    i = 0
    for row in range(len(t)):
        for column in range(4):
            while i < len(text) and (text[i] == 32 or text[i] == 9):
                i += 1
            negative = i < len(text) and text[i] == 45  # -
            if i < len(text) and (text[i] == 43 or text[i] == 45):
                i += 1
            mantissa, num_digits, significant = np.uint64(0), 0, 0
            power = 9 if column == 0 else 0
            after_point = False
            while i < len(text):
                if 48 <= text[i] <= 57:
                    num_digits += 1
                    if num_digits > MOST_DIGITS:
                        return row
                    if significant < 19:
                        mantissa = mantissa * np.uint64(10) + np.uint64(text[i] - 48)
                        significant += mantissa > 0
                        power -= after_point
                    else:
                        power += not after_point
                elif text[i] == 46 and not after_point:
                    after_point = True
                else:
                    break
                i += 1
            if num_digits == 0:
                return row
            if i < len(text) and (text[i] == 101 or text[i] == 69):  # e, E
                i += 1
                below_one = i < len(text) and text[i] == 45
                if i < len(text) and (text[i] == 43 or text[i] == 45):
                    i += 1
                exponent, num_digits = 0, 0
                while i < len(text) and 48 <= text[i] <= 57 and num_digits < 4:
                    exponent = exponent * 10 + (text[i] - 48)
                    num_digits += 1
                    i += 1
                if num_digits == 0:
                    return row
                power += -exponent if below_one else exponent
            while power > 0 and mantissa > 0:
                if mantissa > np.uint64(2**58):
                    return row
                mantissa *= np.uint64(10)
                power -= 1
            while power < 0 and mantissa > 0:
                if column > 0 and mantissa % np.uint64(10) > 0:
                    return row
                mantissa //= np.uint64(10)
                power += 1
            if mantissa >= np.uint64(2**62 if column == 0 else 2**31):
                return row
            value = -np.int64(mantissa) if negative else np.int64(mantissa)
            if column == 0:
                t[row] = value
            elif column == 1:
                x[row] = value
            elif column == 2:
                y[row] = value
            else:
                p[row] = value
            if i < len(text) and text[i] != 32 and text[i] != 9 and text[i] != 13 and text[i] != 10:
                return row
        while i < len(text) and text[i] != 10:
            if text[i] != 32 and text[i] != 9 and text[i] != 13:
                return row
            i += 1
        i += 1
    return len(t)


FORMAT = Format(
    name="davis",
    command="davis-events",
    description="Events in the text format of the UZH event-camera dataset.",
    files=FILES,
    read=read,
    takes_poses=True,
)
