"""A recording of an event camera, whatever format it was read from: events, frames, cameras and poses on one clock.

A format is a module with `FILES`, the glob patterns that its folders are recognised by, and `read(folder)`; adding one
means writing that module and naming it in `read_recording`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int, Int64, UInt8
from PIL import Image

if TYPE_CHECKING:
    from enerf_ns.dataparsers.calibration import Camera
    from enerf_ns.dataparsers.trajectory import Trajectory


class RecordingError(ValueError):
    """Input that cannot be used. The message is one sentence: which file, what was found, what was expected."""


@dataclass(frozen=True)
class Events:
    """Brightness changes in time order, one array a column."""

    x: Int[np.ndarray, " events"]
    """Columns, uint16."""
    y: Int[np.ndarray, " events"]
    """Rows, uint16."""
    t: Int64[np.ndarray, " events"]
    """Nanoseconds, never decreasing."""
    p: Int[np.ndarray, " events"]
    """Polarity, int8: +1 where it became brighter, -1 where it became darker."""

    def __len__(self) -> int:
        return len(self.t)


@dataclass(frozen=True)
class Frames:
    """Pictures, one file each, with the camera that took them."""

    filenames: tuple[Path, ...]
    times: Int64[np.ndarray, " frames"]
    """Nanoseconds, strictly increasing: the middle of the exposure."""
    camera: Camera
    trajectory: Trajectory
    """Of the camera of the frames."""
    depth_filenames: tuple[Path, ...] | None = None
    """.npy files, float32 [height, width]: depth along the optical axis in metres, 0 where nothing was hit."""

    def subset(self, indices: Int[np.ndarray, " chosen"]) -> Frames:
        """The frames at the given indices only."""
        depth = self.depth_filenames and tuple(self.depth_filenames[i] for i in indices)
        return replace(
            self,
            filenames=tuple(self.filenames[i] for i in indices),
            times=self.times[indices],
            depth_filenames=depth,
        )


@dataclass(eq=False)
class EventRecording:
    """What a reader found in a folder. Frames outside the poses are dropped at once, events when they are read."""

    path: Path
    format: str
    camera: Camera
    """Of the events."""
    trajectory: Trajectory
    """Of the event camera."""
    load_events: Callable[[], Events]
    """Reads the events as they are in the files: columns of any integer type, polarity {0, 1} or ±1 or bool."""
    frames: Frames | None = None
    """Sharp frames."""
    blurred_frames: Frames | None = None
    """The same instants, blurred by motion."""
    contrast_thresholds: tuple[float, float] | None = None
    """Of on and of off events, above 0, where the recording knows them."""
    depth_range: tuple[float, float] | None = None
    """Nearest and farthest depth in metres, where the recording knows them."""
    notes: list[str] = field(default_factory=list)
    """What was dropped or renormalised, one sentence each."""
    locate_event: Callable[[int], str] | None = None
    """File and line of event number i of `load_events`, for error messages."""

    def __post_init__(self) -> None:
        self.frames = self._covered(self.frames, "frames")
        self.blurred_frames = self._covered(self.blurred_frames, "blurred frames")

    @property
    def has_frames(self) -> bool:
        """Whether there are frames of any kind."""
        return self.frames is not None or self.blurred_frames is not None

    def __deepcopy__(self, memo: dict) -> EventRecording:
        """The recording itself: it is read-only and large, and Nerfstudio copies what it hands to data sets."""
        return self

    @cached_property
    def events(self) -> Events:
        """All events between the first and the last pose, checked; polarity ±1. Read at first access.

        Raises:
            RecordingError: No events, a coordinate outside the sensor, time that goes backwards, a polarity other than
                {0, 1} or ±1, no events within the poses, or fewer than two events at every pixel.
        """
        events = self.load_events()
        self._check(events)
        start, end = self.trajectory.start, self.trajectory.end
        kept = slice(np.searchsorted(events.t, start, side="left"), np.searchsorted(events.t, end, side="right"))
        x = events.x[kept].astype(np.uint16, copy=False)
        y = events.y[kept].astype(np.uint16, copy=False)
        t, p = events.t[kept], (events.p[kept] > 0).view(np.int8) * np.int8(2) - np.int8(1)
        if len(t) == 0:
            raise RecordingError(
                f"The poses of {self.path} do not cover the events, which lie from {_seconds(events.t[0])} to "
                f"{_seconds(events.t[-1])} while the poses lie from {_seconds(start)} to {_seconds(end)}; both must be "
                "on one clock."
            )
        self._note_dropped(len(events) - len(t), len(events), "events")
        if np.bincount(y * np.int64(self.camera.width) + x).max() < 2:
            raise RecordingError(
                f"{self.path} holds {len(t):,} events within the poses and never two at one pixel, but learning needs "
                "pixels with at least two; give a longer recording."
            )
        return Events(x, y, t, p)

    def _check(self, events: Events) -> None:
        if len(events) == 0:
            raise RecordingError(f"{self.path} holds no events; give a recording with some.")
        for name, column, size in (("x", events.x, self.camera.width), ("y", events.y, self.camera.height)):
            if column.min() < 0 or column.max() >= size:
                bad = int(np.argmax((column < 0) | (column >= size)))
                raise RecordingError(
                    f"{self._locate(bad)} holds {name} = {column[bad]}, which lies outside the sensor of "
                    f"{self.camera.width} x {self.camera.height} pixels ({name} from 0 to {size - 1})."
                )
        backwards = events.t[1:] < events.t[:-1]
        if backwards.any():
            bad = int(np.argmax(backwards)) + 1
            raise RecordingError(
                f"{self._locate(bad)} goes back in time from {_seconds(events.t[bad - 1])} to {_seconds(events.t[bad])}"
                ", but events must be in time order; sort them."
            )
        polarities = events.p.view(np.int8) if events.p.dtype == bool else events.p
        bad = (polarities < -1) | (polarities > 1) if polarities.min() < -1 or polarities.max() > 1 else np.array([])
        if polarities.min() == -1 and not bad.any():
            bad = polarities == 0
        if bad.any():
            index = int(np.argmax(bad))
            raise RecordingError(
                f"{self._locate(index)} holds polarity {polarities[index]}, but a recording's polarities must all be 0 "
                "or 1, or all be -1 or 1."
            )

    def _locate(self, index: int) -> str:
        return self.locate_event(index) if self.locate_event else f"{self.path}, event {index + 1},"

    def _covered(self, frames: Frames | None, what: str) -> Frames | None:
        if frames is None:
            return None
        inside = np.flatnonzero(frames.trajectory.covers(frames.times))
        self._note_dropped(len(frames.times) - len(inside), len(frames.times), what)
        return frames.subset(inside) if len(inside) else None

    def _note_dropped(self, dropped: int, total: int, what: str) -> None:
        if dropped:
            share = f"{100 * dropped / total:.2g} %"
            self.notes.append(f"{dropped:,} of {total:,} {what} ({share}) lie outside the poses and are left out.")


def read_recording(path: Path | str, format: str = "auto") -> EventRecording:
    """Reads a recording; its events are read when first asked for. A folder is read once per process.

    Args:
        path: Folder of the recording; never written to.
        format: "esim", "davis", or "auto" to find out.

    Raises:
        RecordingError: The folder is of no known format, or anything in it cannot be used.
    """
    return _read_recording(Path(path).resolve(), format)


@cache
def _read_recording(path: Path, format: str) -> EventRecording:
    from enerf_ns.dataparsers import davis, esim  # here, since they import this module

    formats = {"esim": esim, "davis": davis}
    if not path.exists():
        raise RecordingError(f"{path} does not exist; give the folder of a recording.")
    if not path.is_dir():
        raise RecordingError(f"{path} is a file, but a recording is a folder; give the folder that it lies in.")
    if format != "auto":
        return formats[format].read(path)
    found = {name: sum(any(path.glob(pattern)) for pattern in reader.FILES) for name, reader in formats.items()}
    best = [name for name, count in found.items() if count == max(found.values())]
    if len(best) == 1:
        return formats[best[0]].read(path)
    looked_for = "; ".join(f"for {name}: {', '.join(reader.FILES)}" for name, reader in formats.items())
    names = sorted(entry.name + "/" * entry.is_dir() for entry in path.iterdir())
    listed = ", ".join(names[:8]) + (f" and {len(names) - 8} more" if len(names) > 8 else "")
    raise RecordingError(
        f"{path} is a folder of no known format, since it must hold exactly one format's files ({looked_for}) but "
        f"holds {listed or 'nothing'}."
    )


def load_image(path: Path) -> UInt8[np.ndarray, "height width channels"]:
    """An image file as uint8 with one or three channels; transparency is dropped, 16 bits become 8.

    Raises:
        RecordingError: The file is missing or cannot be decoded.
    """
    try:
        with Image.open(path) as image:
            if image.mode.startswith("I"):
                return (np.asarray(image).clip(0, 65535) // 256).astype(np.uint8)[..., None]
            grey = image.mode in ("1", "L", "LA")
            pixels = np.array(image.convert("L" if grey else "RGB"))
    except (OSError, SyntaxError, ValueError) as error:
        raise _unreadable(path, "an image", error) from error
    return pixels[..., None] if grey else pixels


def check_image_size(path: Path, width: int, height: int) -> None:
    """Reads an image's header only.

    Raises:
        RecordingError: The file is missing, no image, or not of the size in pixels.
    """
    if (found := image_size(path)) != (width, height):
        raise RecordingError(
            f"{path} has {found[0]} x {found[1]} pixels, but {width} x {height} as of the sensor were expected."
        )


def image_size(path: Path) -> tuple[int, int]:
    """Width and height in pixels, from the header only.

    Raises:
        RecordingError: The file is missing or no image.
    """
    try:
        with Image.open(path) as image:
            return image.size
    except (OSError, SyntaxError, ValueError) as error:
        raise _unreadable(path, "an image", error) from error


def load_array(path: Path, mmap_mode: str | None = None) -> Float[np.ndarray, "..."]:
    """An array of real numbers from a .npy file.

    Args:
        path: The file.
        mmap_mode: As of `numpy.load`; "r" to read the header only.

    Raises:
        RecordingError: The file is missing, or holds no such array.
    """
    try:
        array = np.load(path, mmap_mode=mmap_mode)  # type: ignore[arg-type]
    except (OSError, ValueError, EOFError, SyntaxError) as error:
        raise _unreadable(path, "a NumPy array (.npy)", error) from error
    if not isinstance(array, np.ndarray) or array.dtype.kind not in "biuf":
        raise RecordingError(f"{path} holds no array of numbers, but a .npy file of numbers was expected.")
    return array


def _unreadable(path: Path, expected: str, error: Exception) -> RecordingError:
    if not path.exists():
        return RecordingError(f"{path} is missing; {expected} was expected there.")
    if path.is_file() and path.stat().st_size == 0:
        return RecordingError(f"{path} is empty; {expected} was expected.")
    reason = str(error).splitlines()[0].rstrip(".") if str(error) else type(error).__name__
    return RecordingError(f"{path} cannot be read as {expected} ({reason}); copy it again from its source.")


def _seconds(time: int) -> str:
    return f"{int(time) * 1e-9:.6f} s"
