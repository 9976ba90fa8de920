"""Statistics of a recording's events, and problems of the recording."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64, Int64
from scipy.ndimage import median_filter
from scipy.spatial.transform import Rotation

from enerf_ns.dataparsers.index.indexing import index_events
from enerf_ns.dataparsers.recording.errors import RecordingError
from enerf_ns.dataparsers.recording.files import read_json
from enerf_ns.dataparsers.recording.recording import EventRecording, Frames, nanoseconds, percent
from enerf_ns.dataparsers.recording.trajectory import evenly_spaced
from enerf_ns.dataparsers.scene.depth_range import recording_parallax

MAX_BINS = 1000
"""Most bins of the event rate. A screen does not resolve more."""

EVENTS_PER_BIN = 200
"""Fewest events in a bin of the event rate on average, so that random events never leave a bin empty."""

SAMPLED_EVENTS = 2**22
"""Most events that are looked at to find problems, evenly taken, so that a training does not wait."""

EVENTS_AT_ONCE = 2**24
"""Events whose times are held in memory while they are counted."""

MAX_SHARE_OUTSIDE = 0.05
"""Largest share of events or frames without poses. A camera that starts a moment before the tracker loses less."""

SMALLEST_PART = 0.25
"""Least share of the time with poses in a part without gaps that an advice names."""

MAX_TURN = 5.0
"""Largest turn of the camera between two poses, degrees. A hand's angular acceleration of 1000 degrees/s² turns the
camera by 2.5 degrees between poses at 20 poses per second. Interpolation is then wrong by 0.3 degrees, a few pixels."""

JUMP_RATIO = 5
"""Factor by which a jump between two poses exceeds the median speed around it. The noise of a tracker stays below 3."""

JUMP_NEIGHBOURHOOD = 11
"""Steps between poses in that median: more than twice the two steps of one wrong pose."""

MIN_JUMP = 5.0
"""Smallest excess motion of the picture in a jump, pixels. Smaller jumps blur edges, but do not double them."""

MOVING = 0.3
"""Share of the picture's speed at a fast moment (90th percentile) above which the camera moves."""

DROPOUT_RATIO = 0.02
"""Share of the usual event rate below which the sensor is silent. In dim light, noise alone reaches some per cent."""

MIN_SILENT_MOTION = 5.0
"""Smallest motion of the picture during a silence, pixels. If the camera turns back, edges pass a pixel twice before it
fires."""

BURST_RATIO = 20
"""Factor by which a burst exceeds the usual event rate, beyond the speed of the camera."""

MAX_POLARITY_RATIO = 3.0
"""Largest ratio between on and off events. Sensors are set up for equal thresholds, and stay below 2 as delivered."""

MAX_SHARE_BELOW_TWO = 0.5
"""Largest share of pixels with fewer than two events, which give no pair to learn from."""

MIN_EVENTS_PER_PIXEL = 10
"""Fewest events per pixel on average, about a few grey levels. Recordings of publications have dozens."""

MIN_SHARE_AT_CUT = 0.2
"""Events in the last two columns (or rows) with any, as a share of the median column, above which the coordinate is
cut. Fewer events may end at the border of the scene."""

MIN_SHARE_BEYOND = 0.02
"""Least share of the columns (or rows) beyond a cut. Some sensors have a few at the border that never fire."""

FLOAT_TIMES, FEWEST_FLOAT_TIMES = 2**16, 100
"""Number of event times that are tested for single precision, and fewest different ones among them."""

MAX_SHARE_HOT = 0.001
"""Largest share of hot pixels. A healthy sensor has a handful."""

MIN_FRAMES = 8
"""Fewest frames. With every fourth held out, six remain for learning and two for scores."""

MAX_SHARE_DROPPED_FRAMES = 0.05
"""Largest share of missing frames in a regular sequence. More suggest wrong time stamps."""

MIN_PARALLAX = 5.0
"""Smallest motion of the nearest point against the farthest, pixels of the event camera. Less is lost in blur."""

ASSUMED_NEAREST = 0.5
"""Nearest depth (metres) of a scene whose depth range is unknown."""

MAX_EXTENT = 100.0
"""Largest extent of the camera's path, metres. A hand-held path that is read in millimetres spans hundreds."""

MAX_DEPTH_RATIO = 100.0
"""Largest ratio between farthest and nearest depth. Cells and samples of a field are spread over the whole range."""


@dataclass(frozen=True)
class Problem:
    """Something about a recording that makes learning from it worse, or impossible."""

    what: str
    """The finding with its numbers, in one sentence."""
    advice: str
    """Advice on what to do, in one or two sentences."""


@dataclass(frozen=True)
class OpenQuestion:
    """A question about a recording that nothing in it answers."""

    question: str
    """The question, which can follow "It is unknown"."""
    why: str
    """The reason, which can follow "because"."""

    @property
    def sentence(self) -> str:
        return f"It is unknown {self.question}, because {self.why}."


@dataclass(frozen=True)
class EventStatistics:
    """Counts of a recording's events, without the hot pixels that are left out."""

    edges: Int64[np.ndarray, " bins+1"]
    """Edges of the bins of time, ns, from the first event to the last."""
    rate: Float64[np.ndarray, " bins"]
    """Events per second in each bin of time."""
    counts: Int64[np.ndarray, "height width"]
    """Events of each pixel."""
    num_on: int
    num_off: int
    num_hot_pixels: int

    @property
    def num_events(self) -> int:
        return self.num_on + self.num_off

    @property
    def seconds(self) -> float:
        """Time from the first event to the last, seconds, at least a nanosecond."""
        return max(int(self.edges[-1] - self.edges[0]), 1) * 1e-9

    @property
    def share_below_two(self) -> float:
        """Share of all pixels that have fewer than two events."""
        return float((self.counts < 2).mean())

    @property
    def events_per_pixel(self) -> float:
        return self.num_events / self.counts.size


def event_statistics(recording: EventRecording, at_most: int | None = None) -> EventStatistics:
    """Counts the events of a recording.

    Args:
        recording: Its index is made if it is not there yet.
        at_most: Most events that the rate is measured with, evenly taken. Default: all. The other numbers are exact.

    Raises:
        RecordingError: The events cannot be used.
    """
    index, camera = index_events(recording), recording.camera
    step = 1 if at_most is None else -(-len(index) // at_most)
    num_bins = int(np.clip(len(index) // step // EVENTS_PER_BIN, 1, MAX_BINS))
    start, end = index.span
    edges, counted = evenly_spaced(start, end, num_bins + 1), np.zeros(num_bins, np.int64)
    inner = torch.from_numpy(edges[1:-1])
    for first in range(0, len(index), step * EVENTS_AT_ONCE):
        times = index.times[first : first + step * EVENTS_AT_ONCE : step].contiguous()
        counted += torch.bucketize(times, inner, right=True).bincount(minlength=num_bins).numpy()
    return EventStatistics(
        edges=edges,
        rate=counted * step / np.maximum(np.diff(edges) * 1e-9, 1e-9),
        counts=index.offsets.diff().numpy().reshape(camera.height, camera.width),
        num_on=index.num_positive,
        num_off=len(index) - index.num_positive,
        num_hot_pixels=len(index.hot_pixels),
    )


def find_problems(
    recording: EventRecording,
    depth_range: tuple[float, float] | None = None,
    statistics: EventStatistics | None = None,
) -> list[Problem]:
    """Problems of a recording, with advice. Takes seconds once the events are indexed.

    Without poses, only events and frames are looked at.

    Args:
        recording: Its index is made if it is not there yet.
        depth_range: Nearest and farthest depth, metres. Default: the range that the recording states, if any.
        statistics: Those of the recording. Default: they are measured here, with at most `SAMPLED_EVENTS` events.

    Raises:
        RecordingError: The events cannot be used.
    """
    statistics = statistics or event_statistics(recording, SAMPLED_EVENTS)
    return [
        *_unfinished(recording.path),
        *_problems_of_motion(recording, depth_range or recording.depth_range, statistics),
        *_count_problems(statistics),
        *_cut_coordinates(statistics),
        *_unusual_times(recording),
        *_coarse_times(recording),
        *_frame_problems(recording.frames or recording.blurred_frames),
    ]


def _problems_of_motion(
    recording: EventRecording, depth_range: tuple[float, float] | None, statistics: EventStatistics
) -> Iterator[Problem]:
    """Problems of the poses, of the parallax, and of event rates that the motion of the camera does not explain."""
    if not recording.has_poses:
        return
    gaps, jumps = pose_gaps(recording, statistics), pose_jumps(recording, statistics, depth_range)
    swings = pose_swings(recording, statistics, depth_range, jumps)
    silences, bursts = unusual_rates(recording, statistics, depth_range)
    flag = _time_range_without(np.concatenate([gaps, jumps, swings, silences, bursts]), statistics)
    yield from _left_out({**recording.shares_outside_poses, "events": index_events(recording).share_outside_poses})
    yield from _pose_problems(recording, statistics, gaps, jumps, swings, flag)
    yield from _distance_problems(recording, statistics, depth_range)
    yield from _rate_problems(silences, bursts, flag)


def pose_gaps(recording: EventRecording, statistics: EventStatistics) -> Int64[np.ndarray, "gaps 2"]:
    """Begin and end (ns) of each gap of the poses that overlaps the span of the events."""
    (first, *_, last), gaps = statistics.edges, recording.pose_gaps
    return gaps[(gaps[:, 0] < last) & (gaps[:, 1] > first)]


def pose_jumps(
    recording: EventRecording, statistics: EventStatistics, depth_range: tuple[float, float] | None
) -> Int64[np.ndarray, "jumps 2"]:
    """Times (ns) of the poses before and after each jump, the largest jump first.

    Args:
        recording: Its poses are searched.
        statistics: Of its events.
        depth_range: Nearest and farthest depth, metres, if known.
    """
    times, turns, moves = _pose_steps(recording, statistics)
    intervals = np.diff(times)
    shift = recording.camera.fx * (turns + moves / _viewing_distance(recording, statistics, depth_range))
    usual = median_filter(shift / intervals, JUMP_NEIGHBOURHOOD, mode="nearest") * intervals
    jumps = np.flatnonzero((shift > JUMP_RATIO * usual) & (shift > usual + MIN_JUMP))
    jumps = jumps[np.argsort(usual[jumps] - shift[jumps])]
    return np.stack([times[jumps], times[jumps + 1]], axis=1)


def pose_swings(
    recording: EventRecording,
    statistics: EventStatistics,
    depth_range: tuple[float, float] | None,
    jumps: Int64[np.ndarray, "jumps 2"],
) -> Int64[np.ndarray, "swings 2"]:
    """Times (ns) of the poses between which the interpolated path swings out, as before and after two poses whose
    stamps almost coincide, the largest swing first.

    Args:
        recording: Its poses are searched.
        statistics: Of its events.
        depth_range: Nearest and farthest depth, metres, if known.
        jumps: Those of `pose_jumps`, around which the path swings too.
    """
    times = recording.trajectory.times[_poses_used(recording, statistics)]
    steps = np.stack([times[:-1], times[1:]], axis=1)
    shift = recording.camera.fx * _swings(recording, steps) / _viewing_distance(recording, statistics, depth_range)
    usual = median_filter(shift, JUMP_NEIGHBOURHOOD, mode="nearest")
    near_jumps = np.abs(np.arange(len(steps))[:, None] - np.searchsorted(times, jumps[:, 0])).min(1, initial=9) < 9
    swings = np.flatnonzero((shift > JUMP_RATIO * usual) & (shift > usual + MIN_JUMP) & ~near_jumps)
    return steps[swings[np.argsort(-shift[swings])]]


def _swings(recording: EventRecording, steps: Int64[np.ndarray, "steps 2"]) -> Float64[np.ndarray, " steps"]:
    """Distance in metres of the interpolated path from the straight way, halfway from each pose to the next."""
    begin, end, middle = (
        recording.trajectory.poses(torch.from_numpy(times)).numpy()[:, :, 3]
        for times in (steps[:, 0], steps[:, 1], steps.sum(axis=1) // 2)
    )
    return np.linalg.norm(middle - (begin + end) / 2, axis=1)


def unusual_rates(
    recording: EventRecording, statistics: EventStatistics, depth_range: tuple[float, float] | None
) -> tuple[Int64[np.ndarray, "silences 2"], Int64[np.ndarray, "bursts 2"]]:
    """Begin and end (ns) of each silence of the sensor while the camera moves, and of each burst of events.

    Args:
        recording: Its poses give the speed of the camera.
        statistics: Of its events.
        depth_range: Nearest and farthest depth, metres, if known.
    """
    edges, rate = statistics.edges, statistics.rate
    poses = recording.trajectory.poses(torch.from_numpy(edges)).numpy()
    distance = _viewing_distance(recording, statistics, depth_range)
    turns, moves = _steps(Rotation.from_matrix(poses[:, :, :3]), poses[:, :, 3])
    known = ~recording.trajectory.in_gaps(edges)
    shift = np.where(known[:-1] & known[1:], recording.camera.fx * (turns + moves / distance), 0.0)
    speed = shift / np.maximum(np.diff(edges), 1)
    moving = speed > MOVING * np.percentile(speed, 90)
    usual_rate, usual_speed = (np.median(column[moving]) if moving.any() else 0.0 for column in (rate, speed))
    silences = _spans(moving & (rate < DROPOUT_RATIO * usual_rate), edges)
    shifted = np.append(0.0, np.cumsum(shift))[np.searchsorted(edges, silences)]
    burst = (rate > BURST_RATIO * usual_rate) & (rate * usual_speed > BURST_RATIO * usual_rate * speed)
    return silences[shifted[:, 1] - shifted[:, 0] > MIN_SILENT_MOTION], _spans(burst & (usual_rate > 0), edges)


def _unfinished(folder: Path) -> Iterator[Problem]:
    settings = folder / "simulation.json"
    try:
        stopped = settings.is_file() and read_json(settings).get("finished") is False
    except RecordingError as error:
        yield Problem(str(error), "Simulate the recording again; without this file, it may be only a part of it.")
        return
    if stopped:
        yield Problem(
            "The simulation of this recording was stopped before its end.",
            "Simulate it again into a new folder, or use the part that was simulated.",
        )


def _left_out(shares_outside_poses: dict[str, float]) -> Iterator[Problem]:
    for what, share in shares_outside_poses.items():
        if share > MAX_SHARE_OUTSIDE:
            yield Problem(
                f"{percent(share)} of the {what} lie outside the poses and are left out.",
                "Check that poses and events are on one clock, and add the poses that are missing. If the tracker saw "
                "only a part of the recording, there is nothing else to do.",
            )


def _pose_problems(
    recording: EventRecording,
    statistics: EventStatistics,
    gaps: np.ndarray,
    jumps: np.ndarray,
    swings: np.ndarray,
    flag: str,
) -> Iterator[Problem]:
    times, turns, moves = _pose_steps(recording, statistics)
    usual_interval = f"{np.median(np.diff(times)) * 1e-6:.3g} ms"
    if len(gaps):
        begin, end = gaps[np.argmax(gaps[:, 1] - gaps[:, 0])]
        ends = np.concatenate([times[:1], gaps.ravel(), times[-1:]])
        parts = ends[1::2] - ends[::2]
        is_enough = parts.max() >= SMALLEST_PART * parts.sum()
        yield Problem(
            f"There are no poses for {(end - begin) * 1e-9:.3g} s from {begin * 1e-9:.2f} s on"
            + (f", and in {_count(len(gaps) - 1, 'other gap')}" if len(gaps) > 1 else "")
            + f", while they usually come every {usual_interval}; events and frames there are "
            + ("used with interpolated poses." if recording.keep_pose_gaps else "left out."),
            "Add the poses that are missing" + (f", or use a part that the tracker saw: {flag}." if is_enough else "."),
        )
    inside = ~np.isin(times[:-1], gaps[:, 0])
    if inside.any() and (turn := math.degrees(np.percentile(turns[inside], 99))) > MAX_TURN:
        yield Problem(
            f"The camera turns by up to {turn:.0f} degrees from one pose to the next, too far to interpolate.",
            f"Record poses more often than every {usual_interval}, or use a slower part with --time-range.",
        )
    if len(jumps):
        largest = np.searchsorted(times, jumps[0, 0])
        yield Problem(
            f"The poses hold {_count(len(jumps), 'jump')}; the largest is by {moves[largest]:.3g} m and "
            f"{math.degrees(turns[largest]):.2g} degrees at {jumps[0, 0] * 1e-9:.2f} s.",
            "Remove the wrong poses from their file, so that they are interpolated, or use a part without jumps: "
            f"{flag}.",
        )
    if len(swings):
        yield Problem(
            f"The path through the poses swings by {_swings(recording, swings[:1])[0]:.3g} m at "
            f"{swings[0].mean() * 1e-9:.2f} s, where they lie on a straight way.",
            "Two poses there have almost the same stamp, as if stamps were times of arrival: remove those whose stamp "
            f"is wrong from their file, or use a part without them: {flag}.",
        )


def _distance_problems(
    recording: EventRecording, statistics: EventStatistics, depth_range: tuple[float, float] | None
) -> Iterator[Problem]:
    extent, parallax = _extent(recording, statistics), recording_parallax(recording)
    nearest = depth_range[0] if depth_range else ASSUMED_NEAREST
    shift = recording.camera.fx * extent / nearest
    if parallax.is_ruled_out:
        yield Problem(
            f"The camera only turns: {parallax.why_ruled_out}.",
            "Nothing shows how far surfaces are, so that training learns a panorama, which has no depth, no mesh and "
            "no view from another place. For these, move the camera sideways, and check that its positions are in "
            "metres.",
        )
    elif shift < MIN_PARALLAX:
        yield Problem(
            f"The camera hardly moves: its path spans {extent:.2g} m, which moves a point at {nearest:.2g} m by "
            f"{shift:.1f} pixels.",
            "Without parallax, depth is unknown: move the camera sideways, and check that its positions are in metres.",
        )
    if extent > MAX_EXTENT:
        yield Problem(
            f"The path of the camera spans {extent:,.0f} m.",
            "Check that the positions are in metres and not in millimetres. If the path really is so long, use a part "
            "with --time-range.",
        )
    if depth_range and depth_range[1] > MAX_DEPTH_RATIO * depth_range[0]:
        yield Problem(
            f"The scene reaches from {depth_range[0]:.3g} m to {depth_range[1]:.3g} m.",
            "So large a range costs detail: if it is too wide, state a narrower one with --depth-range NEAR FAR of the "
            "data parser (metres).",
        )


def _rate_problems(silences: np.ndarray, bursts: np.ndarray, flag: str) -> Iterator[Problem]:
    if len(silences):
        begin, end = silences[np.argmax(silences[:, 1] - silences[:, 0])]
        yield Problem(
            f"The sensor is silent {_times(len(silences))} while the camera moves; the longest silence lasts "
            f"{(end - begin) * 1e-9:.3g} s from {begin * 1e-9:.2f} s on.",
            f"Lost events look like a scene without edges: use a part without silences ({flag}), or record fewer "
            "events with higher thresholds or slower motion.",
        )
    if len(bursts):
        yield Problem(
            f"The event rate bursts {_times(len(bursts))}, first at {bursts[0, 0] * 1e-9:.2f} s, to over "
            f"{BURST_RATIO} times the usual rate, which the camera's motion does not explain.",
            "No static scene explains the events of a flash, of flicker or of a knock: use a part without bursts "
            f"({flag}).",
        )


def _count_problems(statistics: EventStatistics) -> Iterator[Problem]:
    few, many = sorted((statistics.num_on, statistics.num_off))
    kind, other = ("on", "off") if statistics.num_on == many else ("off", "on")
    if few == 0:
        yield Problem(
            f"All events are {kind} events.",
            "Check how polarity is written (0 and 1, or -1 and 1), and that the sensor sends both.",
        )
    elif many > MAX_POLARITY_RATIO * few:
        yield Problem(
            f"There are {many / few:.1f} {kind} events for every {other} event.",
            f"Check that polarity was read right and that no light was switched or dimmed; for a new recording, raise "
            f"the sensor's threshold of {kind} events.",
        )
    if statistics.share_below_two > MAX_SHARE_BELOW_TWO:
        yield Problem(
            f"{100 * statistics.share_below_two:.0f} % of the pixels have fewer than two events.",
            "Learning needs two events at a pixel: use a longer part, record more motion or more texture, or lower the "
            "sensor's thresholds.",
        )
    if statistics.events_per_pixel < MIN_EVENTS_PER_PIXEL:
        yield Problem(
            f"There are only {statistics.events_per_pixel:.2g} events per pixel.",
            f"Learning needs {MIN_EVENTS_PER_PIXEL} and more: use a longer part, record more motion or more texture, "
            "or lower the sensor's thresholds.",
        )
    hot = statistics.num_hot_pixels
    if hot > MAX_SHARE_HOT * statistics.counts.size:
        yield Problem(
            f"The sensor has {_count(hot, 'hot pixel')} ({percent(hot / statistics.counts.size)}), left out here.",
            "If they see bright points of the scene, keep them with --keep-hot-pixels True. Otherwise raise the "
            "sensor's thresholds, let it cool, or mask the pixels in its settings.",
        )


def _cut_coordinates(statistics: EventStatistics) -> Iterator[Problem]:
    """Reports coordinates that end before the sensor does, with as many events at the end as elsewhere."""
    for name, axis in (("x", 0), ("y", 1)):
        counts = statistics.counts.sum(axis)
        last = int(np.flatnonzero(counts).max(initial=0))
        seen, beyond = counts[: last + 1], len(counts) - 1 - last
        if beyond <= MIN_SHARE_BEYOND * len(counts) or seen[-2:].mean() <= MIN_SHARE_AT_CUT * np.median(seen):
            continue
        why, advice = (
            "the sensor seems to be cropped",
            "Give the calibration of the part that was read: its width and height, and cx and cy less its first column "
            "and row.",
        )
        if last == 255:
            why = f"{name} seems to be cut to 8 bits"
            advice = f"Write {name} again from the source of the events, in 16 bits (numpy.uint16)."
        elif last + 1 == statistics.counts.shape[axis]:
            why = "x and y seem to be exchanged, and the events outside the sensor to be left out"
            advice = "Write the events again from their source, with the column as x and the row as y."
        yield Problem(
            f"No event has {name} above {last}, though the sensor has {len(counts)} pixels along it, and as many "
            f"events have {name} = {last} as other values: {why}.",
            advice,
        )


def _unusual_times(recording: EventRecording) -> Iterator[Problem]:
    index = index_events(recording)
    first, last = index.span
    if wrong := recording.unusual_units(len(index), last - first):
        yield Problem(
            f"The recording holds {wrong}",
            "If the times are right, so fast or slow a recording is learned from all the same.",
        )


def _coarse_times(recording: EventRecording) -> Iterator[Problem]:
    """Reports times that were stored as float32, with a significand of 24 bits: all are multiples of its spacing."""
    index = index_events(recording)
    times = np.unique(index.times[:: -(-len(index) // FLOAT_TIMES)].numpy())
    times = times[np.abs(times) >= 2**24]
    if len(times) < FEWEST_FLOAT_TIMES or (times.astype(np.float32).astype(np.int64) != times).any():
        return
    unit = int(np.gcd.reduce(times))
    binary, spacing = unit & -unit, int(np.spacing(np.float32(np.abs(times).max())))
    if unit == binary or binary < spacing:  # otherwise they are multiples of a unit, such as a microsecond
        yield Problem(
            f"The times of the events are numbers of single precision (float32), which resolve {spacing:,} ns at "
            f"{times[-1] * 1e-9:.3g} s.",
            "Write them again from their source, as int64 or in double precision (float64).",
        )


def _frame_problems(frames: Frames | None) -> Iterator[Problem]:
    if frames is None:
        return
    if len(frames.times) < MIN_FRAMES:
        yield Problem(
            f"There {'is' if len(frames.times) == 1 else 'are'} only {_count(len(frames.times), 'frame')}.",
            "Some of them are held out for scores: use a longer part, or learn from events alone.",
        )
    intervals, steps = np.diff(frames.times), np.diff(frames.numbers)
    if not len(intervals):
        return
    usual = np.median(intervals / steps)
    missing = int((np.rint(intervals / usual) - steps).clip(0).sum())
    if missing > MAX_SHARE_DROPPED_FRAMES * (missing + len(frames.times)):
        widest = np.argmax(intervals / steps)
        yield Problem(
            f"In the sequence of frames {_count(missing, 'frame')} seem to be missing; they come every "
            f"{usual * 1e-6:.3g} ms, but after {frames.times[widest] * 1e-9:.2f} s there is none for "
            f"{intervals[widest] * 1e-9:.3g} s.",
            "Check that frames and events show the same at the same time: one lost file or stamp shifts all later "
            "frames.",
        )


def _poses_used(recording: EventRecording, statistics: EventStatistics) -> slice:
    """The poses around the events, at least two."""
    times = recording.trajectory.times
    first = np.searchsorted(times[:-1], statistics.edges[0], "right") - 1
    return slice(int(first), int(np.searchsorted(times[1:], statistics.edges[-1], "left")) + 2)


def _pose_steps(recording: EventRecording, statistics: EventStatistics) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times (ns) of the poses around the events, and the turn (radians) and the way (metres) from each to the next."""
    used = _poses_used(recording, statistics)
    rotations = Rotation.from_quat(recording.trajectory.quaternions[used])
    return recording.trajectory.times[used], *_steps(rotations, recording.trajectory.positions[used])


def _steps(rotations: Rotation, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The turn (radians) and the way (metres) from each pose to the next."""
    turns = (rotations[:-1].inv() * rotations[1:]).magnitude()
    return turns, np.linalg.norm(np.diff(positions, axis=0), axis=1)


def _extent(recording: EventRecording, statistics: EventStatistics) -> float:
    """Diagonal of the box around the path of the camera, metres."""
    return float(np.linalg.norm(np.ptp(recording.trajectory.positions[_poses_used(recording, statistics)], axis=0)))


def _viewing_distance(
    recording: EventRecording, statistics: EventStatistics, depth_range: tuple[float, float] | None
) -> float:
    """Distance of the scene, metres: the geometric mean of its depth range, else the extent of the path."""
    return math.sqrt(depth_range[0] * depth_range[1]) if depth_range else _extent(recording, statistics) or 1.0


def _spans(chosen: np.ndarray, edges: np.ndarray) -> Int64[np.ndarray, "spans 2"]:
    """Begin and end of each run of chosen bins."""
    return edges[np.flatnonzero(np.diff(chosen, prepend=False, append=False))].reshape(-1, 2)


def _time_range_without(spans: np.ndarray, statistics: EventStatistics) -> str:
    """The flag for the longest time range of the events that touches none of the spans (ns), in whole milliseconds."""
    spans = spans[np.argsort(spans[:, 0])]
    begins = np.maximum.accumulate(np.concatenate([statistics.edges[:1], spans[:, 1]]))
    ends = np.concatenate([spans[:, 0], statistics.edges[-1:]])
    longest = np.argmax(ends - begins)
    begin, end = int(begins[longest]), int(ends[longest])
    first, last = -(-begin // 10**6), end // 10**6
    first += nanoseconds(first / 1e3) < begin
    last -= nanoseconds(last / 1e3) > end
    return f"--time-range {first / 1e3} {last / 1e3}"


def _count(number: int, what: str) -> str:
    return f"{number:,} {what}{'s' * (number != 1)}"


def _times(number: int) -> str:
    return "once" if number == 1 else f"{number:,} times"
