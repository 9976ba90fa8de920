"""Frames in a ROS bag, none of which can be read without those before it, are kept as files in the cache."""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Int64, Shaped

from enerf_ns.dataparsers.recording.cache import cache_entry
from enerf_ns.dataparsers.recording.errors import OutputError, RecordingError
from enerf_ns.dataparsers.recording.files import encode_png, load_array, partial_of

LAYOUT = 1
"""Version of the pictures. It grows when their content changes."""

STAMPS = "stamps_ns.npy"


def keep_frames(
    source: Path, name: str, frames: Callable[[], Iterator[tuple[int, Shaped[np.ndarray, "height width channels"]]]]
) -> tuple[tuple[Path, ...], Int64[np.ndarray, " frames"]]:
    """Returns the files (PNG) and stamps of frames, which are written to the cache unless all of them are there.

    The name of their folder is a hash of the source, its size and its time of modification.

    Args:
        source: The file that holds them.
        name: What distinguishes them from other frames of the file, such as a topic.
        frames: Function that yields stamps (ns), and pixels in grey or RGB, uint8 or uint16. It is only called if the
            frames are not kept yet.

    Raises:
        RecordingError: The stamps do not increase.
        OutputError: The cache cannot be written.
    """
    state = source.stat()
    made_from = repr((LAYOUT, str(source.resolve()), state.st_size, state.st_mtime_ns, name))
    try:
        folder = cache_entry(f"frames-{hashlib.sha256(made_from.encode()).hexdigest()[:32]}")
        if folder.exists() and not _is_whole(folder):
            shutil.rmtree(folder)
        if not folder.exists():
            _write(folder, source, name, frames())
    except OSError as error:
        raise OutputError(
            f"The frames of {source} cannot be written to the cache ({error.strerror or error}); make room, or set "
            "ENERF_CACHE to another folder."
        ) from error
    stamps = load_array(folder / STAMPS)
    return tuple(folder / _file_name(i) for i in range(len(stamps))), stamps


def _write(folder: Path, source: Path, name: str, frames: Iterator[tuple[int, np.ndarray]]) -> None:
    folder.parent.mkdir(parents=True, exist_ok=True)
    partial = partial_of(folder)
    partial.mkdir()
    try:
        stamps: list[int] = []
        for stamp, pixels in frames:
            if stamps and stamp <= stamps[-1]:
                raise RecordingError(
                    f"{source} holds a frame on {name} at {stamp} ns after one at {stamps[-1]} ns, but frames must be "
                    "in time order; record it again."
                )
            (partial / _file_name(len(stamps))).write_bytes(encode_png(pixels))
            stamps.append(stamp)
        np.save(partial / STAMPS, np.array(stamps, np.int64))
        try:
            partial.rename(folder)
        except OSError:
            if not (folder / STAMPS).exists():  # otherwise another process was faster
                raise
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def _is_whole(folder: Path) -> bool:
    """Returns whether no file is missing, as after a program that removes old files."""
    files = {file.name for file in folder.iterdir()}
    return STAMPS in files and all(_file_name(i) in files for i in range(len(load_array(folder / STAMPS))))


def _file_name(number: int) -> str:
    return f"{number:06d}.png"
