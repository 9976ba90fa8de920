"""A recording of an event camera in any format: events, frames, cameras and poses on one clock.

The constructors check the values. `enerf_ns.dataparsers.formats.registry` reads recordings from folders.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32, Int, Int64, Shaped
from PIL import Image
from scipy.spatial.transform import Rotation

from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.dataparsers.recording.errors import FlagError, RecordingError
from enerf_ns.dataparsers.recording.hdf5_files import is_deep_picture, load_depth_map, load_picture
from enerf_ns.dataparsers.recording.picture_depth import find_white_level
from enerf_ns.dataparsers.recording.pose_noise import pose_noise
from enerf_ns.dataparsers.recording.time_units import Times, check_units, unusual_units
from enerf_ns.dataparsers.recording.trajectory import Trajectory, evenly_spaced

EVENTS_AT_A_TIME = 2**18
"""Number of events that a reader yields at once: enough for speed, with little memory."""

LARGEST_GAMMA = 4.0
"""Largest exponent of gamma-encoded frames. Screens have 2.2."""
KINDS_OF_FRAMES = {"frames": "frames", "blurred_frames": "blurred frames", "depth_maps": "depth maps"}
"""Frames on the clock of a recording, by the name of its field, in words."""

LONGEST_REFRACTORY_PERIOD = 10**12
"""Longest refractory period, nanoseconds."""

CONTRAST_THRESHOLD_LIMITS = (1e-3, 10.0)
"""Least and largest contrast threshold, change of log brightness. Sensors have more than ten times the least. The
largest is a change of brightness by e^10, which is 22,000."""

MOUNTING_TOLERANCE = 1e-6
"""Largest motion of a camera in the axes of one that it is mounted beside: metres, and entries of the rotation."""

DEPTH_LIMITS = (1e-6, 1e9)
"""Least and largest depth, metres."""

EXPOSURE_OVERLAP = 1.1
"""Largest ratio of an exposure to the time between frames. It is above 1, since stamps jitter."""

LONGEST_EXPOSURE = 10**15
"""Limit to which longer exposures are clipped, nanoseconds. All such exposures are refused."""

SHORTEST_EXPOSURE = 1_000
"""Shortest exposure above 0, nanoseconds. Shorter ones are in another unit."""


@dataclass(frozen=True)
class Events:
    """Events in time order, one array for each column."""

    x: Int[np.ndarray, " events"]
    """Columns of the pixels, of any integer type."""
    y: Int[np.ndarray, " events"]
    """Rows of the pixels, of any integer type."""
    t: Int64[np.ndarray, " events"]
    """Times in nanoseconds, never decreasing."""
    p: Int[np.ndarray, " events"]
    """Polarities: 1 for brighter; -1, 0 or false for darker."""

    def __len__(self) -> int:
        return len(self.t)


@dataclass(frozen=True)
class Frames:
    """Frames, one file each, or pictures within an HDF5 file (`hdf5_files`), with their camera.

    Raises:
        ValueError: The exposures are out of range. The message can follow "FILE holds".
    """

    filenames: tuple[Path, ...]
    times: Int64[np.ndarray, " frames"]
    """Times in nanoseconds, strictly increasing: the middle of each exposure."""
    camera: Camera
    trajectory: Trajectory
    """Trajectory of the camera of the frames."""
    depth_filenames: tuple[Path, ...] | None = None
    """Depth maps of the camera, .npy files or within an HDF5 file, float32 [height, width]: depth along the optical
    axis in metres, 0 where nothing was hit."""
    exposures: Int64[np.ndarray, " frames"] | None = None
    """Exposure of each frame, ns: 0, or from `SHORTEST_EXPOSURE` to the time between frames. None if it is not known. A
    frame is the mean brightness during its exposure."""
    numbers: Int64[np.ndarray, " frames"] = field(default_factory=lambda: np.zeros(0, np.int64))
    """Number of each frame in its folder, from 0. Default: 0, 1, 2 and so on."""
    downscale_factor: float = 1.0
    """Width of a downscaled pixel in pixels of the frame, at least 1."""
    stated_white: float | None = None
    """The value of full brightness in files of more than 8 bits; None if the recording does not state it."""
    gamma: float = 1.0
    """Exponent, from 1 to `LARGEST_GAMMA`, that turns stored values in [0, 1] into linear brightness."""
    files_of_recording: tuple[Path, ...] = ()
    """All frames of the recording, from which that value is found if it is not stated. Default: `filenames`."""

    def __post_init__(self) -> None:
        if not len(self.numbers):
            object.__setattr__(self, "numbers", np.arange(len(self.times)))
        if self.exposures is not None:
            _check_exposures(self.times, self.exposures)

    @property
    def exposed(self) -> Int64[np.ndarray, "frames 2"]:
        """First and last instant (ns) of each exposure. Both are the frame's time if the exposure is not known."""
        exposures = np.zeros_like(self.times) if self.exposures is None else self.exposures
        opens = self.times - exposures // 2
        return np.stack([opens, opens + exposures], axis=1)

    @property
    def picture_camera(self) -> Camera:
        """The camera of the pictures: without distortion, downscaled."""
        camera = self.camera.undistorted()
        return camera if self.downscale_factor == 1.0 else camera.downscaled(self.downscale_factor)

    @cached_property
    def white_level(self) -> float:
        """The value of full brightness in files of more than 8 bits.

        Raises:
            RecordingError: A file of the recording is missing or cannot be decoded.
        """
        return self.stated_white or find_white_level(self.files_of_recording or self.filenames)

    @property
    def white_in_words(self) -> str:
        """Words that state the value of full brightness; empty for frames of 8 bits."""
        return f", white is {self.white_level:g}" if is_deep_picture(self.filenames[0]) else ""

    def image(self, index: int) -> Shaped[np.ndarray, "height width channels"]:
        """Returns the linear brightness of a frame with one or three channels.

        It is uint8, or float32 in [0, 1] for files of more bits and for gamma-encoded ones.

        Raises:
            RecordingError: The file is missing or cannot be decoded, or holds a value above the stated full brightness.
        """
        image = load_picture(self.filenames[index])
        if image.dtype == np.uint8 and self.gamma == 1.0:
            return image
        white = 255.0 if image.dtype == np.uint8 else self.white_level
        if image.max() > white:
            raise RecordingError(
                f"{self.filenames[index]} holds {image.max():g}, but {white:g} is stated to be white; state the "
                "largest value that the camera writes."
            )
        return (image / np.float32(white)) ** np.float32(self.gamma)

    def picture(self, index: int) -> Shaped[np.ndarray, "height width channels"]:
        """Returns a frame as the `picture_camera` sees it, of the same type as `image`; raises what `image` raises."""
        return self.downscaled(self.camera.undistort(self.image(index)))

    def downscaled(
        self, image: Shaped[np.ndarray, "height width channels"]
    ) -> Shaped[np.ndarray, "new_height new_width channels"]:
        """Returns an image of the frames' size at the size of the `picture_camera`, antialiased; uint8 or float32."""
        if self.downscale_factor == 1.0:
            return image
        camera = self.picture_camera
        right, lower = camera.width * self.downscale_factor, camera.height * self.downscale_factor
        size, box = (camera.width, camera.height), (0.0, 0.0, right, lower)
        parts = [image] if image.dtype == np.uint8 else np.split(image, image.shape[2], axis=2)
        shown = [Image.fromarray(part[..., 0] if part.shape[2] == 1 else part) for part in parts]
        small = [np.asarray(part.resize(size, Image.Resampling.HAMMING, box)) for part in shown]
        return np.dstack(small)

    def depth(self, index: int) -> Float32[np.ndarray, "height width"] | None:
        """Returns depth along the optical axis in metres at the middles of downscaled pixels, 0 where it is unknown.

        Raises:
            RecordingError: The file is missing or holds no depth map.
        """
        if self.depth_filenames is None:
            return None
        depth = self.camera.undistort_depth(load_depth_map(self.depth_filenames[index]))
        camera = self.picture_camera
        rows, columns = (
            ((np.arange(side) + 0.5) * self.downscale_factor).astype(int) for side in (camera.height, camera.width)
        )
        return depth[np.ix_(rows, columns)]

    def with_exposure(self, exposure: int | None) -> Frames:
        """Returns the frames with the same exposure (ns) for all; None for an unknown exposure."""
        exposures = None if exposure is None else np.full(len(self.times), min(exposure, LONGEST_EXPOSURE))
        return replace(self, exposures=exposures)

    def subset(self, indices: Int[np.ndarray, " chosen"]) -> Frames:
        """Returns the frames at the given indices."""
        depth = self.depth_filenames and tuple(self.depth_filenames[i] for i in indices)
        return replace(
            self,
            filenames=tuple(self.filenames[i] for i in indices),
            times=self.times[indices],
            depth_filenames=depth,
            exposures=None if self.exposures is None else self.exposures[indices],
            numbers=self.numbers[indices],
            files_of_recording=self.files_of_recording or self.filenames,
        )


@dataclass(frozen=True, eq=False)
class EventRecording:
    """A recording as a reader returns it.

    The constructor drops frames outside the poses. The index of the events drops events outside the poses.

    Raises:
        RecordingError: The time spans of frames and poses do not fit together.
        ValueError: A threshold, the refractory period, the Bayer pattern, the response or the depth range is invalid.
            The message can follow "FILE holds".
    """

    path: Path
    format: str
    """Name of the format, one of `enerf_ns.dataparsers.formats.registry`."""
    camera: Camera
    """Camera of the events."""
    trajectory: Trajectory
    """Trajectory of the event camera. Without poses, that of a camera at rest."""
    stream_events: Callable[[], Iterator[Events]]
    """Function that yields the events as they are in the files, in pieces of about `EVENTS_AT_A_TIME`. All calls yield
    the same events, even if a file has grown since the reader opened it."""
    event_files: tuple[Path, ...]
    """All files of the events."""
    frames: Frames | None = None
    """Sharp frames."""
    blurred_frames: Frames | None = None
    """Frames that are blurred by motion or reconstructed from events."""
    reconstructed_by: str | None = None
    """Name of the method that reconstructed the blurred frames from events; None if a camera took them."""
    held_out_frames: Frames | None = None
    """Views only for evaluation, with their own trajectory and clock."""
    depth_maps: Frames | None = None
    """Instants with depth maps but without pictures, whose `filenames` are those of the depth maps."""
    contrast_thresholds: tuple[float, float] | None = None
    """Contrast thresholds of on and of off events, within `CONTRAST_THRESHOLD_LIMITS`; None if they are not known."""
    refractory_period: int = 0
    """Refractory period of a pixel after an event, ns; at most 1000 s."""
    bayer_pattern: str | None = None
    """Colours of the pixels (x, y) = (0, 0), (1, 0), (0, 1) and (1, 1), such as RGGB; None for a grey sensor."""
    response: str | None = None
    """Response of the sensor to brightness, as in `enerf_ns.sensor.response`: linlog, or logarithm:OFFSET; None if the
    recording does not state it."""
    depth_range: tuple[float, float] | None = None
    """Nearest and farthest depth in metres, within `DEPTH_LIMITS`; None if they are not known."""
    notes: tuple[str, ...] = ()
    """Sentences on what was dropped or renormalised. The index has such sentences on events."""
    shares_outside_poses: dict[str, float] = field(default_factory=dict)
    """Share of "frames" and of "blurred frames" outside the poses, which are left out, if it is above 0."""
    locate_event: Callable[[int], str] | None = None
    """Function that returns the file and line of event number i of the stream, for error messages."""
    num_events: int | None = None
    """Number of events in the files, only to show progress; None if it is not known before reading."""
    times_in: Mapping[str, tuple[Path, str]] = field(default_factory=dict)
    """File and unit (s, us or ns) of the times of "events", "poses", "frames" and "blurred frames", for error messages.
    Default: the folder, ns."""
    read_with: Mapping[str, object] = field(default_factory=dict)
    """Options of the format, all of them, since some of them choose other events from the same files."""
    zero: int = 0
    """Time on the clock of the files at which the recording has its time 0, ns."""
    time_range: tuple[int, int] | None = None
    """First and last time (ns) of the selected range; None for the whole recording."""
    keep_hot_pixels: bool = False
    """Whether pixels that fire far more often than their neighbourhood are used."""
    keep_pose_gaps: bool = False
    """Whether instants within the gaps of the trajectory are used."""
    has_poses: bool = True
    """Whether the trajectory of the event camera is known."""
    as_read: EventRecording | None = None
    """The original recording if the poses or the camera of this one were refined. The events are the same."""
    pose_noise_taken_off: tuple[float, float] | None = None
    """Standard deviations of the noise removed from the poses, along an axis (metres) and about it (radians); None if
    the poses were not smoothed."""
    event_file_states: tuple[tuple[str, int, int, int], ...] = ()
    """Path, size in bytes, and times of modification and of change (ns) of each of `event_files`. Default: their state
    now."""

    def __post_init__(self) -> None:
        self._check_what_is_stated()
        if not self.event_file_states:
            states = [(file.resolve(), file.stat()) for file in self.event_files]
            found = ((str(path), now.st_size, now.st_mtime_ns, now.st_ctime_ns) for path, now in states)
            self._set(event_file_states=tuple(found))
        self._set_files_of_recording()
        notes, shares = [*self.notes], dict(self.shares_outside_poses)
        covered = {
            name: self._covered(getattr(self, name), what, notes, shares) for name, what in KINDS_OF_FRAMES.items()
        }
        self._set(**covered, notes=tuple(notes), shares_outside_poses=shares)

    def selected(
        self,
        time_range: tuple[float, float] | None,
        keep_hot_pixels: bool,
        keep_pose_gaps: bool = False,
        undistort: bool = True,
        smooth_poses: bool = False,
    ) -> EventRecording:
        """Returns the recording with these selections; the same selections return the same object.

        Args:
            time_range: First and last time in seconds on the recording's clock, or None for all.
            keep_hot_pixels: Use pixels that fire far more often than their neighbourhood.
            keep_pose_gaps: Use instants within the gaps of the trajectory.
            undistort: Use the distortion of the cameras; otherwise they have none.
            smooth_poses: Remove the noise from the poses (`pose_noise`).

        Raises:
            FlagError: The time range holds no poses, or lies within a gap that is left out.
        """
        range_ns = time_range and (nanoseconds(time_range[0]), nanoseconds(time_range[1]))
        selection = self
        chosen = range_ns, keep_hot_pixels, keep_pose_gaps
        if chosen != (self.time_range, self.keep_hot_pixels, self.keep_pose_gaps):
            selection = _with_selection(self, *chosen)
        if not undistort:
            selection = _without_lenses(selection)
        if smooth_poses:
            selection = _with_smooth_poses(selection)
        start, end = selection.span
        if time_range is not None and not start < end:
            raise FlagError(
                f"--time-range {time_range[0]:g} {time_range[1]:g} (seconds) holds none of the poses of "
                f"{self.path}, which lie from {seconds(self.trajectory.start)} to {seconds(self.trajectory.end)}."
            )
        if not len(selection.stretches):
            ((begin, after),) = selection.pose_gaps
            raise FlagError(
                f"The time range lies within a gap of the poses of {self.path}, from {seconds(begin)} to "
                f"{seconds(after)}; give another --time-range, or use it with --keep-pose-gaps True."
            )
        return selection

    @property
    def span(self) -> tuple[int, int]:
        """First and last time (ns) that is used: the poses within the selected range."""
        start, end = self.time_range or (self.trajectory.start, self.trajectory.end)
        return max(start, self.trajectory.start), min(end, self.trajectory.end)

    @property
    def pose_gaps(self) -> Int64[np.ndarray, "gaps 2"]:
        """The `Trajectory.gaps` that overlap the span, whether they are kept or not."""
        (start, end), gaps = self.span, self.trajectory.gaps
        return gaps[(gaps[:, 0] < end) & (gaps[:, 1] > start)]

    @property
    def stretches(self) -> Int64[np.ndarray, "stretches 2"]:
        """First and last instant (ns) of each used part of the span: the whole span, or the parts between gaps."""
        start, end = self.span
        gaps = self.pose_gaps[: 0 if self.keep_pose_gaps else None]
        stretches = np.concatenate([[start], gaps.flatten(), [end]]).reshape(-1, 2)
        return stretches[stretches[:, 0] <= stretches[:, 1]]

    def instants(self, number: int) -> Int64[np.ndarray, " number"]:
        """Returns instants (ns) spread evenly over the `stretches`, both ends included; `number` is at least 2."""
        return self._instants_at(evenly_spaced(0, self._num_instants - 1, number))

    def spans(self, number: int, share: float) -> Int64[np.ndarray, "number 2"]:
        """Returns first and last instant (ns) of equally long spans, spread evenly over the `stretches`.

        Args:
            number: Number of spans.
            share: Total length of the spans as a share of the stretches, above 0 and at most 1.
        """
        length = max(int(share * self._num_instants) // number, 1)
        middles = (2 * np.arange(number) + 1) * self._num_instants // (2 * number)
        begins = (middles - length // 2).clip(0)
        return np.column_stack([self._instants_at(begins), self._instants_at(begins + length - 1)])

    @property
    def _num_instants(self) -> int:
        begins, ends = self.stretches.T
        return int((ends - begins + 1).sum())

    def _instants_at(self, places: Int64[np.ndarray, " places"]) -> Int64[np.ndarray, " places"]:
        """Returns the instants (ns) with these numbers, which count the nanoseconds of all stretches from 0."""
        begins, ends = self.stretches.T
        after = np.cumsum(ends - begins + 1)
        return places + (ends + 1 - after)[np.searchsorted(after, places, "right")]

    def in_left_out_gaps(self, times: Int64[np.ndarray, " times"]) -> Bool[np.ndarray, " times"]:
        """Returns which times (ns) are not used because they lie in gaps of the poses; none if gaps are kept."""
        return self.trajectory.in_gaps(times) & (not self.keep_pose_gaps)

    def knows_poses(self, frames: Frames) -> Bool[np.ndarray, " frames"]:
        """Returns which frames have poses during their whole exposure, outside gaps that are not used."""
        opens, closes = frames.exposed.T
        covered = frames.trajectory.covers(opens) & frames.trajectory.covers(closes)
        return covered & (self.keep_pose_gaps | ~frames.trajectory.in_gaps(opens, closes))

    @property
    def has_frames(self) -> bool:
        """Whether there are sharp or blurred frames."""
        return self.frames is not None or self.blurred_frames is not None

    @property
    def camera_frames(self) -> Frames | None:
        """Frames that a camera took: the sharp ones, else the blurred ones, unless those are reconstructed from
        events."""
        return self.frames or (self.blurred_frames if self.reconstructed_by is None else None)

    def locate(self, index: int) -> str:
        """Returns the file, and the line or number, of event number `index` of the stream, for error messages."""
        if self.locate_event:
            return self.locate_event(index)
        return f"{self.event_files[0] if len(self.event_files) == 1 else self.path}, event {index + 1}"

    def __deepcopy__(self, memo: dict) -> EventRecording:
        """Returns the recording itself, which is read-only and large; Nerfstudio copies the input of data sets."""
        return self

    def check_units(self, num_events: int, span: int) -> None:
        """Checks that events, poses and frames can be in the units in which they were read.

        Args:
            num_events: Number of all events.
            span: Time from the first event to the last, ns.

        Raises:
            RecordingError: They cannot.
        """
        check_units(self.path, self._all_times(num_events, span))

    def not_covered(self, first: int, last: int) -> RecordingError:
        """Returns the error for events of which none lies within the poses in use.

        Args:
            first, last: Times of the first and the last event, ns.
        """
        start, end = self.span
        return RecordingError(
            f"The poses of {self.path} do not cover the events, which lie from {seconds(first)} to {seconds(last)} "
            f"while the poses{' in the time range' * bool(self.time_range)} lie from {seconds(start)} to "
            f"{seconds(end)}; both must be on one clock."
        )

    def unusual_units(self, num_events: int, span: int) -> str | None:
        """Returns what `time_units.unusual_units` says of events, poses and frames; takes what `check_units` takes."""
        return unusual_units(self._all_times(num_events, span))

    def _all_times(self, num_events: int, span: int) -> list[Times]:
        pixels = self.camera.width * self.camera.height
        times = [Times.of_events(*self._file_of("events"), num_events, span, pixels), self._times_of_poses]
        kinds = {"frames": self.frames, "blurred frames": self.blurred_frames}
        return times + [self._times_of(frames, what) for what, frames in kinds.items() if frames is not None]

    @property
    def _times_of_poses(self) -> Times:
        return Times.of_rows("poses", *self._file_of("poses"), self.trajectory.times)

    def _times_of(self, frames: Frames, what: str) -> Times:
        return Times.of_rows("frames", *self._file_of(what), frames.times)

    def _file_of(self, what: str) -> tuple[Path, str]:
        return self.times_in.get(what, (self.path, "ns"))

    def _check_what_is_stated(self) -> None:
        on, off = self.contrast_thresholds or (1.0, 1.0)
        least, largest = CONTRAST_THRESHOLD_LIMITS
        if not (least <= on <= largest and least <= off <= largest):
            raise ValueError(
                f"the contrast thresholds {on:g} (of on events) and {off:g} (of off events), but both must be from "
                f"{least:g} to {largest:g}."
            )
        if not 0 <= self.refractory_period <= LONGEST_REFRACTORY_PERIOD:
            raise ValueError(
                f"the refractory period {self.refractory_period:g} ns, but from 0 to {LONGEST_REFRACTORY_PERIOD:g} ns "
                "were expected."
            )
        pattern = self.bayer_pattern
        if pattern is not None and not (isinstance(pattern, str) and len(pattern) == 4 and set(pattern) <= set("RGB")):
            raise ValueError(
                f"the Bayer pattern {pattern!r}, but four letters of R, G and B, the colours of the pixels (0, 0), "
                "(1, 0), (0, 1) and (1, 1), such as RGGB, were expected."
            )
        if self.response is not None and not _is_response(self.response):
            raise ValueError(
                f"the response {self.response!r}, but linlog, or logarithm:OFFSET with an offset from 1e-9 to 1, such "
                "as logarithm:0.001, was expected."
            )
        if not isinstance(self.reconstructed_by, str | None):
            raise ValueError(f"reconstructed_by = {self.reconstructed_by!r}, but a text was expected.")
        near, far = self.depth_range or (1.0, 2.0)
        if not DEPTH_LIMITS[0] <= near < far <= DEPTH_LIMITS[1]:
            raise ValueError(
                f"the range of depth {near:g} m to {far:g} m, but the nearest and, farther than that, the farthest "
                f"depth, both from {DEPTH_LIMITS[0]:g} m to {DEPTH_LIMITS[1]:g} m, were expected."
            )

    def _set(self, **values: object) -> None:
        for name, value in values.items():
            object.__setattr__(self, name, value)

    def _set_files_of_recording(self) -> None:
        """Makes frames of all kinds use the same value of full brightness."""
        kinds = ("frames", "blurred_frames", "held_out_frames")
        all_frames = {kind: frames for kind in kinds if (frames := getattr(self, kind)) is not None}
        files = tuple(file for frames in all_frames.values() for file in frames.filenames)
        for kind, frames in all_frames.items():
            if not frames.files_of_recording:
                self._set(**{kind: replace(frames, files_of_recording=files)})

    def _covered(self, frames: Frames | None, what: str, notes: list[str], shares: dict[str, float]) -> Frames | None:
        """Returns the frames within the poses; adds to notes and shares if some are left out."""
        if frames is None:
            return None
        check_units(self.path, [self._times_of_poses, self._times_of(frames, what)])
        inside = np.flatnonzero(frames.trajectory.covers(frames.times))
        dropped = len(frames.times) - len(inside)
        if not dropped:
            return frames
        notes.append(left_out(dropped, len(frames.times), what))
        shares[what] = dropped / len(frames.times)
        return frames.subset(inside) if len(inside) else None


def _check_exposures(times: Int64[np.ndarray, " frames"], exposures: Int64[np.ndarray, " exposures"]) -> None:
    if len(exposures) != len(times):
        raise ValueError(f"{len(exposures)} exposures of {len(times)} frames, but one of each was expected.")
    wrong = (exposures < 0) | ((0 < exposures) & (exposures < SHORTEST_EXPOSURE))
    if wrong.any():
        raise ValueError(
            f"the exposure {exposures[wrong][0]} ns, but 0, or at least {SHORTEST_EXPOSURE} ns, was expected."
        )
    steps, means = np.diff(times), (exposures[:-1] + exposures[1:]) / 2
    wrong = means > EXPOSURE_OVERLAP * steps
    if wrong.any():
        raise ValueError(
            f"exposures of {means[wrong][0] * 1e-6:g} ms of frames that are {steps[wrong][0] * 1e-6:g} ms apart, but "
            "exposures up to the time from frame to frame were expected."
        )


def _is_response(name: object) -> bool:
    """Returns whether a text has the form of a response's name, with an offset that
    `enerf_ns.sensor.response` takes."""
    if name == "linlog":
        return True
    kind, _, offset = name.partition(":") if isinstance(name, str) else ("", "", "")
    try:
        return kind == "logarithm" and 1e-9 <= float(offset) <= 1
    except ValueError:
        return False


@cache
def _with_selection(
    recording: EventRecording, time_range: tuple[int, int] | None, keep_hot_pixels: bool, keep_pose_gaps: bool
) -> EventRecording:
    return replace(recording, time_range=time_range, keep_hot_pixels=keep_hot_pixels, keep_pose_gaps=keep_pose_gaps)


@cache
def _with_smooth_poses(recording: EventRecording) -> EventRecording:
    noise = pose_noise(recording.trajectory)
    if noise is None:
        return recording
    given = recording.trajectory
    smooth = {id(given): noise.smooth}

    def of(frames: Frames | None) -> Frames | None:
        if frames is None:
            return None
        own = frames.trajectory
        if id(own) not in smooth and _is_mounted(own, given):
            smooth[id(own)] = _carried(own, given, noise.smooth)
        elif id(own) not in smooth:
            found = pose_noise(own)
            smooth[id(own)] = own if found is None else found.smooth
        return replace(frames, trajectory=smooth[id(own)])

    frames = {kind: of(getattr(recording, kind)) for kind in KINDS_OF_FRAMES}
    taken_off = noise.position, noise.rotation
    return replace(recording, trajectory=noise.smooth, pose_noise_taken_off=taken_off, **frames)


def _is_mounted(own: Trajectory, given: Trajectory) -> bool:
    """Returns whether a camera has the same pose in the axes of another one at all of its poses."""
    if not np.array_equal(own.times, given.times):
        return False
    back = Rotation.from_quat(given.quaternions).inv()
    places = back.apply(own.positions - given.positions)
    turns = (back * Rotation.from_quat(own.quaternions)).as_matrix()
    return bool(max(np.ptp(places, axis=0).max(), np.ptp(turns, axis=0).max()) < MOUNTING_TOLERANCE)


def _carried(own: Trajectory, given: Trajectory, smooth: Trajectory) -> Trajectory:
    """Returns the trajectory of a camera beside another one, whose poses at the same times are smoothed."""
    turns = Rotation.from_quat(smooth.quaternions) * Rotation.from_quat(given.quaternions).inv()
    positions = smooth.positions + turns.apply(own.positions - given.positions)
    return Trajectory(own.times, positions, (turns * Rotation.from_quat(own.quaternions)).as_quat())


@cache
def _without_lenses(recording: EventRecording) -> EventRecording:
    frames = {kind: getattr(recording, kind) for kind in (*KINDS_OF_FRAMES, "held_out_frames")}
    frames = {kind: value and replace(value, camera=value.camera.without_lens()) for kind, value in frames.items()}
    return replace(recording, camera=recording.camera.without_lens(), **frames)


def overlaps(one: Int64[np.ndarray, "ones 2"], other: Int64[np.ndarray, "others 2"]) -> Int64[np.ndarray, "overlaps 2"]:
    """Returns the intervals that lie in both lists of disjoint intervals (first and last instant), in order."""
    begins = np.maximum(one[:, None, 0], other[:, 0])
    ends = np.minimum(one[:, None, 1], other[:, 1])
    return np.stack([begins, ends], axis=-1)[begins <= ends]


def left_out(dropped: int, total: int, what: str) -> str:
    """Returns a note about frames or events outside the poses."""
    return f"{dropped:,} of {total:,} {what} ({percent(dropped / total)}) lie outside the poses and are left out."


def percent(share: float) -> str:
    """Returns a share in [0, 1] in per cent as text with two digits."""
    value = 100 * share
    if 0 < value < 0.01:
        return "less than 0.01 %"
    return f"{value:.0f} %" if value >= 9.95 else f"{value:.2g} %"


def nanoseconds(time: float) -> int:
    """Returns a time in seconds as nanoseconds."""
    return round(time * 1e9)


def seconds(time: int) -> str:
    """Returns a time in nanoseconds as text in seconds."""
    return f"{int(time) * 1e-9:.6f} s"
