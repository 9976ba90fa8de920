"""A recording of an event camera, whatever format it was read from: events, frames, cameras and poses on one clock.

A format is a module with `FILES`, the glob patterns that its folders are recognised by, and `read(folder)`; adding one
means writing that module and naming it in `FORMATS`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int, Int64, UInt8
from PIL import Image

if TYPE_CHECKING:
    from enerf_ns.dataparsers.calibration import Camera
    from enerf_ns.dataparsers.events import EventIndex, Survey
    from enerf_ns.dataparsers.trajectory import Trajectory

EVENTS_AT_A_TIME = 2**18
"""Events that readers hand on at once: enough for speed, few enough to need hardly any memory."""

LARGEST_RATE = 2e9
"""Events per second that no sensor can send; more of them means that times are in another unit than was thought."""

LARGEST_SPAN_RATIO = 300
"""Between the spans of events or frames and poses; units of time differ by 1000."""

SHORTEST_FOCAL_LENGTH, LONGEST_FOCAL_LENGTH = 0.01, 1e4
"""As a multiple of the width, or of the height: a view of 179 degrees, and one of 0.006."""

FARTHEST_PRINCIPAL_POINT = 10
"""From the middle of the image, as a multiple of its width or height."""

STEEPEST_DIRECTION = 1e4
"""Largest x / z and y / z of where a pixel looks."""

SHORTEST_FRAME_STEP = 1_000_000
"""Nanoseconds; frames closer together than this are in another unit if they also span hardly any of the poses."""


class RecordingError(ValueError):
    """Input that cannot be used. The message is one sentence: which file, what was found, what was expected."""


@dataclass(frozen=True)
class Events:
    """Brightness changes in time order, one array a column."""

    x: Int[np.ndarray, " events"]
    """Columns, of any integer type."""
    y: Int[np.ndarray, " events"]
    """Rows, of any integer type."""
    t: Int64[np.ndarray, " events"]
    """Nanoseconds, never decreasing."""
    p: Int[np.ndarray, " events"]
    """Polarity: 1 where it became brighter; where it became darker, -1, or 0 or false as some formats write."""

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
    numbers: Int64[np.ndarray, " frames"] = field(default_factory=lambda: np.zeros(0, np.int64))
    """Of each frame in its folder, from 0; counted here unless given."""

    def __post_init__(self) -> None:
        if not len(self.numbers):
            object.__setattr__(self, "numbers", np.arange(len(self.times)))

    def subset(self, indices: Int[np.ndarray, " chosen"]) -> Frames:
        """The frames at the given indices only."""
        depth = self.depth_filenames and tuple(self.depth_filenames[i] for i in indices)
        return replace(
            self,
            filenames=tuple(self.filenames[i] for i in indices),
            times=self.times[indices],
            depth_filenames=depth,
            numbers=self.numbers[indices],
        )


@dataclass(eq=False)
class EventRecording:
    """What a reader found in a folder. Frames outside the poses are dropped at once, events when they are indexed."""

    path: Path
    format: str
    camera: Camera
    """Of the events."""
    trajectory: Trajectory
    """Of the event camera."""
    stream_events: Callable[[], Iterator[Events]]
    """Reads the events as they are in the files, in pieces of at most about `EVENTS_AT_A_TIME`. Every call starts again
    and gives the same events, whatever a file has grown by since the reader looked at it."""
    event_files: tuple[Path, ...]
    """All files that the events come from."""
    frames: Frames | None = None
    """Sharp frames."""
    blurred_frames: Frames | None = None
    """The same instants, blurred by motion."""
    held_out_frames: Frames | None = None
    """Views for evaluation alone, on a trajectory and a clock of their own."""
    contrast_thresholds: tuple[float, float] | None = None
    """Of on and of off events, above 0, where the recording knows them."""
    refractory_period: int = 0
    """For how long a pixel is blind after an event, ns."""
    bayer_pattern: str | None = None
    """Colours of the sensor's pixels (0, 0), (1, 0), (0, 1) and (1, 1) as x, y, such as RGGB; None: a grey sensor."""
    depth_range: tuple[float, float] | None = None
    """Nearest and farthest depth in metres, where the recording knows them."""
    notes: list[str] = field(default_factory=list)
    """What was dropped or renormalised, one sentence each."""
    shares_outside_poses: dict[str, float] = field(default_factory=dict)
    """Of "events", "frames" and "blurred frames", the share that is left out, where it is above 0."""
    locate_event: Callable[[int], str] | None = None
    """File and line of event number i of the stream, for error messages."""
    num_events: int | None = None
    """In the files, where that is known before they are read; for progress alone."""
    time_range: tuple[int, int] | None = None
    """First and last time (ns) of what is used of the recording; set by `select`."""
    keep_hot_pixels: bool = False
    """Whether pixels that fire far more often than their neighbourhood are used; set by `select`."""

    def __post_init__(self) -> None:
        states = [(file.resolve(), file.stat()) for file in self.event_files]
        self._source = [(str(path), state.st_size, state.st_mtime_ns) for path, state in states]
        kinds = (self.frames, self.blurred_frames, self.held_out_frames)
        for camera in (self.camera, *(frames.camera for frames in kinds if frames is not None)):
            self._check_camera(camera)
        self.frames = self._covered(self.frames, "frames")
        self.blurred_frames = self._covered(self.blurred_frames, "blurred frames")

    def select(self, time_range: tuple[float, float] | None, keep_hot_pixels: bool) -> None:
        """Which part of the events is used.

        Args:
            time_range: First and last time in seconds on the recording's clock, or None for all.
            keep_hot_pixels: Use pixels that fire far more often than their neighbourhood.

        Raises:
            RecordingError: The range holds no poses.
        """
        self.keep_hot_pixels = keep_hot_pixels
        if time_range is not None:
            self.time_range = round(time_range[0] * 1e9), round(time_range[1] * 1e9)
            start, end = self.span
            if not start < end:
                raise RecordingError(
                    f"--time-range {time_range[0]:g} {time_range[1]:g} (seconds) holds none of the poses of "
                    f"{self.path}, which lie from {_seconds(self.trajectory.start)} to {_seconds(self.trajectory.end)}."
                )

    @property
    def span(self) -> tuple[int, int]:
        """First and last time (ns) that is used: of the poses, within the range that was selected."""
        start, end = self.time_range or (self.trajectory.start, self.trajectory.end)
        return max(start, self.trajectory.start), min(end, self.trajectory.end)

    @property
    def has_frames(self) -> bool:
        """Whether there are frames of any kind."""
        return self.frames is not None or self.blurred_frames is not None

    def __deepcopy__(self, memo: dict) -> EventRecording:
        """The recording itself: it is read-only and large, and Nerfstudio copies what it hands to data sets."""
        return self

    @cached_property
    def index(self) -> EventIndex:
        """All events of the span, checked and sorted by pixel. Made, or found in the cache, at first access.

        Raises:
            RecordingError: No events, a coordinate outside the sensor, time that goes backwards, times in another unit
                than those of the poses, a polarity other than {0, 1} or ±1, no events within the poses, or fewer than
                two events at every pixel.
        """
        from enerf_ns.dataparsers.events import survey_events, with_progress  # here, since it imports this module
        from enerf_ns.dataparsers.index_cache import build_index, entry_name, load_index

        camera, (start, end) = self.camera, self.span
        first = next((int(events.t[0]) for events in self.stream_events() if len(events)), None)
        if first is None:
            raise RecordingError(f"{self.path} holds no events; give a recording with some.")
        name = entry_name(
            format=self.format,
            files=self._source,
            first=first,
            sensor=[camera.width, camera.height],
            span=[start, end],
            keep_hot_pixels=self.keep_hot_pixels,
        )
        loaded = load_index(name)
        if loaded is not None:
            index, survey = loaded
        else:
            stream = with_progress(self.stream_events, self.num_events)
            survey = survey_events(stream, camera.width, camera.height, start, end)
            self._check(survey)
            if not self.keep_hot_pixels:
                survey.leave_out_hot_pixels(camera.height)
            try:
                index = build_index(stream, survey, name, self.notes)
            except ValueError as error:
                raise RecordingError(f"{self.path} {error}; wait until it is written, then read it again.") from error
            except OSError as error:
                raise RecordingError(
                    f"{self.path} holds {survey.counts.sum():,} events, more than fit into a quarter of the memory, "
                    f"and their index cannot be stored ({error}); make room, set ENERF_CACHE to another folder, or "
                    "use less of the recording with --time-range."
                ) from error
        self._note_events(survey)
        return index

    def _check(self, survey: Survey) -> None:
        x, y, t, p = survey.odd_event
        if survey.outside is not None:
            name, value, size = ("x", x, survey.width) if not 0 <= x < survey.width else ("y", y, self.camera.height)
            raise RecordingError(
                f"{self._locate(survey.outside)} holds {name} = {value}, which lies outside the sensor of "
                f"{self.camera.width} x {self.camera.height} pixels ({name} from 0 to {size - 1})."
            )
        if survey.backwards is not None:
            raise RecordingError(
                f"{self._locate(survey.backwards)} goes back in time from {_seconds(survey.last)} to {_seconds(t)}, "
                "but events must be in time order; sort them."
            )
        if survey.odd_polarity is not None:
            raise RecordingError(
                f"{self._locate(survey.odd_polarity)} holds polarity {p}, but a recording's polarities must all be 0 "
                "or 1, or all be -1 or 1."
            )
        span, poses = (survey.last - survey.first) * 1e-9, (self.trajectory.end - self.trajectory.start) * 1e-9
        if survey.num_events >= 1000 and (
            survey.num_events > LARGEST_RATE * span or not 1 / LARGEST_SPAN_RATIO < span / poses < LARGEST_SPAN_RATIO
        ):
            raise RecordingError(
                f"{self.path} holds {survey.num_events:,} events within {span:.6g} s and poses within {poses:.6g} s, "
                "which does not fit together; state the times of both in the unit that the format asks for."
            )
        if not survey.counts.any():
            raise RecordingError(
                f"The poses of {self.path} do not cover the events, which lie from {_seconds(survey.first)} to "
                f"{_seconds(survey.last)} while the poses{' in the time range' * bool(self.time_range)} lie from "
                f"{_seconds(survey.start)} to {_seconds(survey.end)}; both must be on one clock."
            )
        if survey.counts.max() < 2:
            raise RecordingError(
                f"{self.path} holds {survey.counts.sum():,} events within the poses and never two at one pixel, but "
                "learning needs pixels with at least two; give a longer recording."
            )
        if survey.counts.sum() >= 2**31:
            raise RecordingError(
                f"{self.path} holds {survey.counts.sum():,} events, but an index holds fewer than 2^31; use less of "
                "the recording with --time-range."
            )

    def _note_events(self, survey: Survey) -> None:
        used = int(survey.counts.sum())
        if self.time_range is None:
            self._note_dropped(survey.num_events - survey.num_hot_events - used, survey.num_events, "events")
        if len(survey.hot_pixels):
            self.notes.append(
                f"{len(survey.hot_pixels):,} hot pixels, which fire over 10 times as often as their neighbourhood, are "
                f"left out with {survey.num_hot_events:,} events; --keep-hot-pixels True keeps them."
            )

    def _locate(self, index: int) -> str:
        return self.locate_event(index) if self.locate_event else f"{self.path}, event {index + 1},"

    def _check_camera(self, camera: Camera) -> None:
        axes = ((camera.width, camera.fx, camera.cx), (camera.height, camera.fy, camera.cy))
        fits = all(
            SHORTEST_FOCAL_LENGTH * side < focal_length < LONGEST_FOCAL_LENGTH * side
            and abs(principal_point - side / 2) < FARTHEST_PRINCIPAL_POINT * side
            for side, focal_length, principal_point in axes
        )
        if not fits:
            raise RecordingError(
                f"{self.path} holds a camera of {camera.width} x {camera.height} pixels with the focal lengths "
                f"{camera.fx:g} and {camera.fy:g} and the principal point ({camera.cx:g}, {camera.cy:g}), which fits "
                "no lens; state all in pixels."
            )
        if camera.directions is not None and not np.abs(camera.directions).max() < STEEPEST_DIRECTION:
            raise RecordingError(
                f"{self.path} holds a table of where each pixel of a camera looks, in which x / z and y / z reach "
                f"{np.abs(camera.directions).max():g}, which fits no lens; make it again."
            )

    def _covered(self, frames: Frames | None, what: str) -> Frames | None:
        if frames is None:
            return None
        steps, poses = np.diff(frames.times), frames.trajectory.end - frames.trajectory.start
        too_long = steps.sum() > LARGEST_SPAN_RATIO * poses
        too_short = len(steps) and np.median(steps) < SHORTEST_FRAME_STEP and LARGEST_SPAN_RATIO * steps.sum() < poses
        if too_long or too_short:
            raise RecordingError(
                f"{self.path} holds {what} within {steps.sum() * 1e-9:.6g} s and poses within {poses * 1e-9:.6g} s, "
                "which does not fit together; state the times of both in the unit that the format asks for."
            )
        inside = np.flatnonzero(frames.trajectory.covers(frames.times))
        self._note_dropped(len(frames.times) - len(inside), len(frames.times), what)
        return frames.subset(inside) if len(inside) else None

    def _note_dropped(self, dropped: int, total: int, what: str) -> None:
        if dropped:
            share = f"{100 * dropped / total:.2g} %"
            self.notes.append(f"{dropped:,} of {total:,} {what} ({share}) lie outside the poses and are left out.")
            self.shares_outside_poses[what] = dropped / total


def read_recording(
    path: Path | str,
    format: str = "auto",
    time_range: tuple[float, float] | None = None,
    keep_hot_pixels: bool = False,
    **options: object,
) -> EventRecording:
    """Reads a recording; its events are read when first asked for. A folder is read once per process.

    Args:
        path: Folder of the recording; never written to.
        format: A name of `FORMATS`, or "auto" to find out.
        time_range: As of `EventRecording.select`.
        keep_hot_pixels: As of `EventRecording.select`.
        options: Of the format's reader.

    Raises:
        RecordingError: The folder is of no known format, or anything in it cannot be used.
    """
    return _read_recording(Path(path).resolve(), format, time_range, keep_hot_pixels, **options)


FORMATS = ("esim", "esim_npz", "esim_bag", "davis", "eds", "tum_vie", "event_recording")
"""Names of the formats, which are those of their readers' modules."""


@cache
def _read_recording(path: Path, format: str, time_range, keep_hot_pixels: bool, **options: object) -> EventRecording:
    if not path.exists():
        raise RecordingError(f"{path} does not exist; give the folder of a recording.")
    if not path.is_dir():
        raise RecordingError(f"{path} is a file, but a recording is a folder; give the folder that it lies in.")
    reader = import_module(f"enerf_ns.dataparsers.{_find_format(path) if format == 'auto' else format}")
    recording = reader.read(path, **options)
    recording.select(time_range, keep_hot_pixels)
    return recording


def _find_format(path: Path) -> str:
    """Of the formats, the one most of whose files lie in a folder."""
    readers = {name: import_module(f"enerf_ns.dataparsers.{name}") for name in FORMATS}
    found = {name: sum(any(path.glob(pattern)) for pattern in reader.FILES) for name, reader in readers.items()}
    best = [name for name, count in found.items() if count == max(found.values())]
    if len(best) == 1:
        return best[0]
    looked_for = "; ".join(f"for {name}: {', '.join(reader.FILES)}" for name, reader in readers.items())
    names = sorted(entry.name + "/" * entry.is_dir() for entry in path.iterdir())
    listed = ", ".join(names[:8]) + (f" and {len(names) - 8} more" if len(names) > 8 else "")
    raise RecordingError(
        f"{path} is a folder of no known format, since it must hold exactly one format's files ({looked_for}) but "
        f"holds {listed or 'nothing'}."
    )


def load_image(path: Path) -> UInt8[np.ndarray, "height width channels"]:
    """An image file as uint8 with one or three channels; what is transparent is laid over white, 16 bits become 8.

    Raises:
        RecordingError: The file is missing or cannot be decoded.
    """
    try:
        with Image.open(path) as image:
            image.verify()  # the checksums of a PNG, which decoding passes over
        with Image.open(path) as image:
            if image.mode.startswith("I"):
                return (np.asarray(image).clip(0, 65535) // 256).astype(np.uint8)[..., None]
            grey = image.mode in ("1", "L", "LA")
            if image.mode in ("LA", "PA", "RGBA") or "transparency" in image.info:
                colors = image.convert("RGBA")
                image = Image.alpha_composite(Image.new("RGBA", image.size, "white"), colors)
            pixels = np.array(image.convert("L" if grey else "RGB"))
    except Exception as error:  # of any kind, since Pillow has some of its own for what is damaged
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
    except Exception as error:  # of any kind, since Pillow has some of its own for what is damaged
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
    except Exception as error:  # of any kind, since NumPy parses the header as Python
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
