"""Undistorted frames as files that any program can open, kept in the cache."""

from __future__ import annotations

import hashlib
import os
from dataclasses import fields
from pathlib import Path

from rich import get_console
from rich.progress import track

from enerf_ns.dataparsers.recording.cache import cache_entry
from enerf_ns.dataparsers.recording.errors import OutputError
from enerf_ns.dataparsers.recording.files import encode_png, write_whole
from enerf_ns.dataparsers.recording.hdf5_files import file_of
from enerf_ns.dataparsers.recording.picture_depth import in_8_bits
from enerf_ns.dataparsers.recording.recording import Frames

LAYOUT = 2
"""Version of the pictures. It grows when their content changes."""


def write_pictures(frames: Frames) -> list[Path]:
    """Writes the pictures of frames to the cache, and returns their files: PNG of 8 bits, grey or colour.

    The name of their folder is a hash of the recording's folder and the camera. A file has the name of its frame and
    its time of modification. If both agree, it is up to date and not written again.

    Raises:
        RecordingError: A frame is missing or cannot be decoded.
        OutputError: A file cannot be written.
    """
    try:
        places = [_place(frames, source) for source in frames.filenames]
    except OSError as error:
        raise OutputError(
            f"The undistorted pictures cannot be written ({error.strerror}); set ENERF_CACHE to a folder for them."
        ) from error
    missing = [i for i, place in enumerate(places) if not _is_current(place, frames.filenames[i])]
    for i in track(
        missing, "Writing undistorted pictures", transient=True, disable=not missing or not get_console().is_terminal
    ):
        picture, state = in_8_bits(frames.picture(i)), file_of(frames.filenames[i]).stat()
        try:
            write_whole(places[i], encode_png(picture))
            os.utime(places[i], ns=(state.st_mtime_ns, state.st_mtime_ns))
        except OSError as error:
            raise OutputError(
                f"The undistorted pictures cannot be written to {places[i].parent} ({error.strerror or error}); make "
                "room, or set ENERF_CACHE to another folder."
            ) from error
    return places


def _place(frames: Frames, source: Path) -> Path:
    camera, directions = frames.camera, frames.camera.directions
    lens = [getattr(camera, field.name) for field in fields(camera) if field.name != "directions"]
    made_from = repr(
        (LAYOUT, str(source.parent.resolve()), lens, frames.downscale_factor, frames.white_level, frames.gamma)
    ).encode()
    table = b"" if directions is None else directions.tobytes()
    return cache_entry(f"pictures-{hashlib.sha256(made_from + table).hexdigest()[:32]}") / f"{source.stem}.png"


def _is_current(place: Path, source: Path) -> bool:
    source = file_of(source)
    return place.exists() and source.exists() and place.stat().st_mtime_ns == source.stat().st_mtime_ns
